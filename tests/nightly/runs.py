"""The agent in the machine: `fieldcal run` on the kernel's own adapter and on the kernel's own IIO device."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from tests.nightly.checks import IIO, Machine, Row, same
from tests.nightly.site import ADDRESSES, RATES_HZ

RUN_S = 15.0
SHORTEST_S = 3.0  # of the recording: at the start the devices are opened one after the other
TRIGGERS = "/sys/kernel/config/iio/triggers/hrtimer"
NOTHING: dict[str, Any] = {"numbers": [], "stamps_ns": [], "told": 0, "untold": 0}
PACED = {"lsm6dso": ("lsm6dsox_accel", 26.0), "adxl355": ("adxl355", 31.25)}  # name in the kernel, rate in Hz
# The stamp is taken at the trigger. The sample number is read when the kernel's thread runs and the transfer is done:
# some ms later, 275 ms on a machine under heavy load. A stamp of another clock or in another unit would be off by
# seconds.
LATE_S = 0.5


def own_drivers(machine: Machine) -> Iterator[Row]:
    """Read four FIFOs at once through i2c-dev: no sample may be lost, doubled or shifted without a report.

    If the machine waits for a processor, FIFOs may overrun; then the loss is reported.
    """
    machine.twins.hold(None)
    devices = {
        name: (name, f"bus = {machine.bus}, address = {address}, rate_hz = {RATES_HZ[name]}")
        for name, address in ADDRESSES.items()
    }
    found = agent_run(machine, "own", devices)
    yield same("fieldcal run", "losses", "; ".join(found["losses"]) or "none", "none")
    for name in devices:
        device = found["devices"].get(name, NOTHING)
        agree = len(device["numbers"]) > SHORTEST_S * RATES_HZ[name] and device["untold"] == 0
        told = f"{len(device['numbers'])} samples, {device['told']} told restarts, {device['untold']} untold"
        yield Row(name, "fieldcal run, FIFO", told, "0 untold", agree)


def through_iio(machine: Machine) -> Iterator[Row]:
    """Driver `iio` on the kernel's drivers, triggered by the kernel's timer: each sample belongs to its stamp's
    time."""
    machine.twins.hold(None)
    paced = {name: pace for name, pace in PACED.items() if name in machine.bound}
    devices = {}
    for name, (kernel_name, rate_hz) in paced.items():
        add_trigger(machine, name, rate_hz)
        devices[name] = "iio", f'device = "{kernel_name}", rate_hz = {rate_hz}, trigger = "{name}"'
    found = agent_run(machine, "iio", devices)
    yield same("driver iio", "losses", "; ".join(found["losses"]) or "none", "none")
    for name, (_, rate_hz) in paced.items():
        device = found["devices"].get(name, NOTHING)
        stamps_ns = np.array([stamp_ns for stamp_ns, _ in device["stamps_ns"]], dtype=float)
        numbers = np.array(device["numbers"])[[count - 1 for _, count in device["stamps_ns"]]]
        late_s = numbers / RATES_HZ[name] - (stamps_ns - stamps_ns.min(initial=0)) * 1e-9
        spread_s = float(np.ptp(late_s)) if len(late_s) else float("nan")
        agree = len(numbers) > SHORTEST_S * rate_hz and bool((np.diff(numbers) >= 0).all()) and spread_s < LATE_S
        told = f"{len(numbers)} samples, within {1e3 * spread_s:.0f} ms, {device['told']} breaks"
        yield Row(
            "driver iio", f"{name}, numbers at their stamps", told, f"in order, within {1e3 * LATE_S:.0f} ms", agree
        )


def add_trigger(machine: Machine, name: str, rate_hz: float) -> None:
    """Add a timer of the kernel that triggers the samples of its drivers."""
    machine.guest.sh(f"mkdir {TRIGGERS}/{name}")
    directory = machine.guest.sh(f"grep -l {name} {IIO}/trigger*/name | xargs dirname")
    machine.guest.write(f"{directory}/sampling_frequency", f"{rate_hz:g}")


def iio_refusals(machine: Machine) -> Iterator[Row]:
    """Messages of driver `iio` when the kernel refuses; the LSM6DSO and its trigger are as `through_iio` left them."""
    said = json.loads(machine.guest.python("-m", "tests.nightly.iio_refusals"))
    rates = machine.guest.sh(f"cat {IIO}/*/sampling_frequency_available | grep 26.000 | head -n 1")
    wanted = {
        "a rate that is rounded": "wrote 100, the kernel driver set 104.000000",
        "a rate that is refused": f"5000 is refused; accepted values: {rates}",
        "no buffer": "no buffer",
        "another process reads the device": "Device or resource busy",
    }
    for question, words in wanted.items():
        found = said[question]
        kind, _, message = found.partition(": ")
        agree = kind == "ConfigurationError" and words in message
        yield Row("driver iio", question, words if agree else found, kind, agree)
    yield same("driver iio", "the first reader continues", said["the first reader continues"], "samples arrive")


def agent_run(machine: Machine, name: str, devices: dict[str, tuple[str, str]]) -> dict[str, Any]:
    """Run the agent in the machine with these devices (driver, options); returns the summary of its recording."""
    text = '[gateway]\nsite = "nightly"\nname = "guest"\n[zenoh]\nenabled = false\n'
    for device, (driver, options) in devices.items():
        text += f'[[devices]]\nname = "{device}"\ndriver = "{driver}"\noptions = {{ {options} }}\n'
        text += f'[[channels]]\nsensor = "{device}"\nprior = {{}}\n'
    machine.guest.put(f"/run/{name}.toml", text)
    machine.guest.python(
        *("-m", "agent", "run", f"/run/{name}.toml", "--data-dir", f"/run/{name}", "--duration", f"{RUN_S:g}")
    )
    found: dict[str, Any] = json.loads(machine.guest.python("-m", "tests.nightly.recorded", f"/run/{name}"))
    return found
