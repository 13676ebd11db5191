"""Chips on an I2C bus of libumockdev, which `init` finds, and one on SPI, which is named: `run` makes each VALID.

All gateways run at the same time: each waits half a minute for the positions of its bench.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from hw.virtual import adxl355_twin, icm20948_twin, icm42688_twin, lis3dh_twin
from hw.virtual.bench import Bench
from hw.virtual.fifo_twin import FifoTwin
from hw.virtual.kernel import BCM2835, I2CBus
from hw.virtual.motion import multisine
from hw.virtual.presets import BY_HAND_HZ, COUNTS_PER_MPS2, HOLD_S, PRESETS, THETA_DEG
from hw.virtual.response import Response
from hw.virtual.schedule import STANDARD_GRAVITY_MPS2, clamped
from hw.virtual.serial_bench import serial_lines
from hw.virtual.serial_port import PtyDevice
from hw.virtual.spi_bus import SpiBus
from hw.virtual.timebase import BenchTime
from tests.scenarios.processes import fieldcal, interrupt, results, started, wait_until
from tests.scenarios.umockdev_site import UmockdevSite, absence

THROUGH_S = 100.0  # three positions take 39 s; where a busy machine lost samples, one round more
ALPHAS_DEG = (0.0, 120.0, 240.0)  # what `init` writes where no turns are stated
MOTION_HZ = 3.0  # highest frequency: 5 ms of delay change S by 0.4 % there, and by 3 % at 8 Hz
ABSENCE = absence()
pytestmark = [pytest.mark.slow, pytest.mark.skipif(ABSENCE is not None, reason=str(ABSENCE))]


class Chip(NamedTuple):
    """A chip at 4 g; its noise is that of the data sheet over its bandwidth. Without an address it is on SPI."""

    twin: type[FifoTwin]
    address: int | None
    rate_hz: float
    counts_per_g: float
    noise_g: float
    response: Response


CHIPS = {
    "lis3dh": Chip(lis3dh_twin.Lis3dhTwin, 0x19, 100.0, 500.0, 3e-3, lis3dh_twin.filters(100.0)),
    "icm20948": Chip(icm20948_twin.Icm20948Twin, 0x68, 112.5, 8192.0, 1.6e-3, icm20948_twin.filters(3)),
    "icm42688": Chip(icm42688_twin.Icm42688Twin, 0x69, 100.0, 8192.0, 0.5e-3, icm42688_twin.filters(8)),
    "adxl355": Chip(adxl355_twin.Adxl355Twin, None, 125.0, 128_000.0, 0.13e-3, adxl355_twin.filters(125.0)),
}


class Gateway(NamedTuple):
    """A gateway with one chip: what its commands answered, and the running agent with its files."""

    made: subprocess.CompletedProcess[str]
    config: Path
    checked: subprocess.CompletedProcess[str]
    process: subprocess.Popen[bytes]
    data_dir: Path
    output: Path


def bench_with(chip: Chip) -> Bench:
    """The plain bench with this chip, and motion that is slow against the delays of a machine under load."""
    preset = PRESETS["plain"](1)
    motion = multisine(np.random.default_rng(1), high_hz=MOTION_HZ)
    scale = chip.counts_per_g / STANDARD_GRAVITY_MPS2 / COUNTS_PER_MPS2
    sensor = replace(
        preset.sensor,
        sensitivity=preset.sensor.sensitivity * scale,
        offset=preset.sensor.offset * scale,
        nominal_sensitivity=COUNTS_PER_MPS2 * scale,
        limit=4.0 * chip.counts_per_g - 1.0,
        clock=replace(preset.sensor.clock, nominal_rate_hz=chip.rate_hz),
        noise_mps2=chip.noise_g * STANDARD_GRAVITY_MPS2,
        response=chip.response,
    )
    reference = replace(preset.reference, clock=replace(preset.reference.clock, nominal_rate_hz=BY_HAND_HZ))
    schedule = replace(preset.schedule, stands=tuple(clamped(THETA_DEG, alpha, HOLD_S) for alpha in ALPHAS_DEG))
    return Bench(replace(preset, motion=motion, schedule=schedule, sensor=sensor, reference=reference), 1)


def serve(name: str, pipe: Connection) -> None:
    """Serve the bench, with its reference on a serial port, until the other end of the pipe is closed.

    Sends the environment in which a process finds the chip, and the port. Time begins when the chip measures.
    """
    chip, bench, began = CHIPS[name], bench_with(CHIPS[name]), BenchTime()

    def due(t_s: float) -> int:
        if not began.begun:
            began.begin(t_s)
        return bench.sensor_samples_due(began(t_s))

    bench.sensor_counts(0, 1)
    bench.reference_values(0, 1)
    twin = chip.twin(bench.sensor_counts, due, time.monotonic)
    spi = {"/dev/spidev0.0": SpiBus(twin)}
    nodes = {"/dev/i2c-1": I2CBus({chip.address: twin}, adapter=BCM2835)} if chip.address else spi
    port = PtyDevice(serial_lines(bench, "reference", began))
    port.start()
    try:
        with UmockdevSite(nodes) as site, suppress(EOFError):
            pipe.send((site.environment, str(port.path)))
            pipe.recv()
    finally:
        port.stop()


@contextmanager
def served(name: str) -> Iterator[tuple[dict[str, str], str]]:
    """A process of its own serves the bench, so that no bench waits for the threads of another."""
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(name, theirs))
    process.start()
    theirs.close()
    try:
        yield ours.recv()
    finally:
        ours.close()
        process.join()


@contextmanager
def running(name: str, directory: Path) -> Iterator[Gateway]:
    """`init`, `check` and `run` of a gateway with this chip."""
    chip, config, output = CHIPS[name], directory / "gateway.toml", directory / "output"
    with served(name) as (environment, port), pytest.MonkeyPatch.context() as patch:
        for variable, value in environment.items():
            patch.setenv(variable, value)
        named = [] if chip.address else ["--sensor", name, "--sensor-option", "bus=spi0.0"]
        options = [f"--sensor-option={option}" for option in (f"rate_hz={chip.rate_hz}", "range_g=4")]
        lines = (f"rate_hz={BY_HAND_HZ}", "axes=1", "sequence=true")
        options += [f"--reference-option={option}" for option in lines]
        made = fieldcal("init", config, *named, *options, "--reference-port", port, "--theta-deg", str(THETA_DEG))
        checked = fieldcal("check", config)
        with started("run", config, "--data-dir", directory / "data", output=output) as process:
            patch.undo()
            yield Gateway(made, config, checked, process, directory / "data", output)


@pytest.fixture(scope="module")
def gateways(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Gateway]]:
    with ExitStack() as stack:
        yield {name: stack.enter_context(running(name, tmp_path_factory.mktemp(name))) for name in CHIPS}


def statuses(gateway: Gateway) -> list[str]:
    return [result["status"] for result in results(gateway.data_dir, "status")]


@pytest.mark.parametrize("name", CHIPS)
def test_a_chip_becomes_valid(name: str, gateways: dict[str, Gateway]) -> None:
    gateway, chip = gateways[name], CHIPS[name]
    assert (gateway.made.returncode, gateway.made.stderr) == (0, "")
    assert f'driver = "{name}"' in gateway.config.read_text()
    assert gateway.checked.returncode == 0, gateway.checked.stderr
    wait_until(lambda: "VALID" in statuses(gateway) or gateway.process.poll() is not None, THROUGH_S, "VALID")
    interrupt(gateway.process)
    assert gateway.process.returncode == 0, gateway.output.read_text()
    assert "VALID" in statuses(gateway)
    last, true = results(gateway.data_dir, "calibration")[-1], bench_with(chip).truth.sensitivity
    nominal, u = chip.counts_per_g / STANDARD_GRAVITY_MPS2, np.reshape(last["standard_uncertainty"][:9], (3, 3))
    error = np.abs(np.array(last["sensitivity"]) - true)
    assert (error < 4.0 * u).all()
    assert u.max() < 0.03 * nominal
    assert error.max() < np.abs(nominal * np.eye(3) - true).max(), "it is no better than the data sheet"
    assert all(last["determined"])
