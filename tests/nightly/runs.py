"""The agent itself in the machine: `fieldcal run` on the kernel's own adapter, and on the kernel's own IIO device."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from hw.block import BlockFlags
from tests.nightly.checks import IIO, Machine, Row, same
from tests.nightly.site import ADDRESSES, RATES_HZ

RUN_S = 15.0
SHORTEST_S = 5.0  # of it: before that, devices open one after the other
TRIGGER = "/sys/kernel/config/iio/triggers/hrtimer/pace"
PACE_HZ = 26.0
# The stamp is taken at the trigger, the number when the kernel's thread has the processor and the transfer is through:
# some ms, 130 on a machine under load. Stamps of another clock or unit are off by seconds.
LATE_S = 0.25


def own_drivers(machine: Machine) -> Iterator[Row]:
    """Four FIFOs at once through i2c-dev: no sample may be lost, doubled or shifted."""
    machine.twins.hold(None)
    devices = {
        name: (name, f"bus = {machine.bus}, address = {address}, rate_hz = {RATES_HZ[name]}")
        for name, address in ADDRESSES.items()
    }
    found = agent_run(machine, "own", devices)
    yield same("fieldcal run", "gaps and losses", "; ".join(found["faults"]) or "none", "none")
    for name in devices:
        device = found["devices"].get(name, {"numbers": [], "flags": []})
        steps = np.diff(device["numbers"])
        restarts = sum(flags != 0 for flags in device["flags"])
        agree = len(steps) > SHORTEST_S * RATES_HZ[name] and bool((steps == 1).all()) and restarts == 1
        told = f"{len(device['numbers'])} samples, {int((steps != 1).sum())} out of order, {restarts} restart"
        yield Row(name, "fieldcal run, FIFO", told, "0 out of order, 1 restart", agree)


def through_iio(machine: Machine) -> Iterator[Row]:
    """Driver `iio` on st_lsm6dsx_i2c, paced by the kernel's timer: each number stands at the time of its stamp."""
    guest = machine.guest
    machine.twins.hold(None)
    guest.sh(f"mkdir {TRIGGER}")
    directory = guest.sh(f"grep -l pace {IIO}/trigger*/name | xargs dirname")
    guest.write(f"{directory}/sampling_frequency", f"{PACE_HZ:g}")
    options = f'device = "lsm6dsox_accel", rate_hz = {PACE_HZ}, trigger = "pace"'
    found = agent_run(machine, "iio", {"lsm6dso": ("iio", options)})
    yield same("driver iio", "losses", "; ".join(found["faults"]) or "none", "none")
    device = found["devices"].get("lsm6dso", {"numbers": [], "flags": [], "stamps_ns": []})
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in device["stamps_ns"]], dtype=float)
    numbers = np.array(device["numbers"])[[count - 1 for _, count in device["stamps_ns"]]]
    late_s = numbers / RATES_HZ["lsm6dso"] - (stamps_ns - stamps_ns.min(initial=0)) * 1e-9
    spread_s = float(np.ptp(late_s)) if len(late_s) else float("nan")
    agree = len(numbers) > SHORTEST_S * PACE_HZ and bool((np.diff(numbers) >= 0).all()) and spread_s < LATE_S
    gaps = sum(bool(flags & (BlockFlags.GAP | BlockFlags.RESTART)) for flags in device["flags"])
    told = f"{len(numbers)} samples, stamps within {1e3 * spread_s:.0f} ms, {gaps} breaks"
    yield Row("driver iio", "sample numbers at their stamps", told, f"in order, within {1e3 * LATE_S:.0f} ms", agree)


def iio_refusals(machine: Machine) -> Iterator[Row]:
    """What driver `iio` says where the kernel refuses; LSM6DSO and trigger as `through_iio` left them."""
    said = json.loads(machine.guest.python("-m", "tests.nightly.iio_refusals", f"{PACE_HZ:g}"))
    rates = machine.guest.sh(f"cat {IIO}/*/sampling_frequency_available | grep 26.000 | head -n 1")
    wanted = {
        "a rate that is rounded": "wrote 100, it says 104.000000",
        "a rate that is refused": f"5000 is refused, it takes {rates}",
        "no buffer": "no buffer",
        "somebody else reads it": "Device or resource busy",
    }
    for question, words in wanted.items():
        found = said[question]
        kind, _, message = found.partition(": ")
        agree = kind == "ConfigurationError" and words in message
        yield Row("driver iio", question, words if agree else found, kind, agree)
    yield same("driver iio", "the first reader goes on", said["the first reader goes on"], "samples come")


def agent_run(machine: Machine, name: str, devices: dict[str, tuple[str, str]]) -> dict[str, Any]:
    """Run the agent in the machine on these devices (driver, options); what it recorded."""
    text = '[gateway]\nsite = "nightly"\nname = "guest"\n[zenoh]\nenabled = false\n'
    for device, (driver, options) in devices.items():
        text += f'[[devices]]\nname = "{device}"\ndriver = "{driver}"\noptions = {{ {options} }}\n'
        text += f'[[channels]]\nsensor = "{device}"\n'
    machine.guest.put(f"/run/{name}.toml", text)
    machine.guest.python(
        *("-m", "agent", "run", f"/run/{name}.toml", "--data-dir", f"/run/{name}", "--duration", f"{RUN_S:g}")
    )
    found: dict[str, Any] = json.loads(machine.guest.python("-m", "tests.nightly.recorded", f"/run/{name}"))
    return found
