"""Chips on an I2C bus of libumockdev, which `init` finds, and one on SPI, which is named: `run` makes each VALID."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from hw.virtual import adxl355_twin, icm20948_twin
from hw.virtual.bench import Bench
from hw.virtual.fifo_twin import FifoTwin
from hw.virtual.kernel import BCM2835, I2CBus
from hw.virtual.motion import Motion
from hw.virtual.presets import COUNTS_PER_MPS2, HOLD_S, PRESETS, SLOW_HZ, THETA_DEG
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
# Two lines that never cancel, and so slow that 5 ms of delay, of a machine under load, change S by 0.4 % at most.
MOTION = Motion(np.array([1.3, 2.9]), np.array([[2.0, 0.0, 0.0], [3.5, 0.0, 0.0]], complex))
ABSENCE = absence()


class Chip(NamedTuple):
    """A chip at 4 g; its noise is that of the data sheet over its bandwidth. Without an address it is on SPI."""

    twin: type[FifoTwin]
    address: int | None
    rate_hz: float
    counts_per_g: float
    noise_g: float
    response: Response


CHIPS = {
    "icm20948": Chip(icm20948_twin.Icm20948Twin, 0x68, 112.5, 8192.0, 1.6e-3, icm20948_twin.filters(3)),
    # At this rate no FIFO of 32 samples overflows while a machine under load runs other processes.
    "adxl355": Chip(adxl355_twin.Adxl355Twin, None, 62.5, 128_000.0, 0.09e-3, adxl355_twin.filters(62.5)),
}


@contextmanager
def plugged(chip: Chip) -> Iterator[tuple[Bench, UmockdevSite, PtyDevice]]:
    """The plain bench with this chip, and its reference on a serial port; time begins when the chip measures."""
    preset, began = PRESETS["plain"](1), BenchTime()
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
    reference = replace(preset.reference, clock=replace(preset.reference.clock, nominal_rate_hz=SLOW_HZ))
    schedule = replace(preset.schedule, stands=tuple(clamped(THETA_DEG, alpha, HOLD_S) for alpha in ALPHAS_DEG))
    bench = Bench(replace(preset, motion=MOTION, schedule=schedule, sensor=sensor, reference=reference), 1)

    def due(t_s: float) -> int:
        if not began.begun:
            began.begin(t_s)
        return bench.sensor_samples_due(began(t_s))

    bench.sensor_counts(0, 1)
    bench.reference_values(0, 1)
    port = PtyDevice(serial_lines(bench, "reference", began))
    twin = chip.twin(bench.sensor_counts, due, time.monotonic)
    spi = {"/dev/spidev0.0": SpiBus(twin)}
    port.start()
    with UmockdevSite({"/dev/i2c-1": I2CBus({chip.address: twin}, adapter=BCM2835)} if chip.address else spi) as site:
        yield bench, site, port
    port.stop()


@pytest.mark.thorough
@pytest.mark.skipif(ABSENCE is not None, reason=str(ABSENCE))
@pytest.mark.parametrize("name", ["adxl355", pytest.param("icm20948", marks=pytest.mark.nightly)])
def test_a_chip_becomes_valid(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chip = CHIPS[name]
    data_dir, config, output = tmp_path / "data", tmp_path / "gateway.toml", tmp_path / "output"

    def statuses() -> list[str]:
        return [result["status"] for result in results(data_dir, "status")]

    with plugged(chip) as (bench, site, port):
        for variable, value in site.environment.items():
            monkeypatch.setenv(variable, value)
        named = [] if chip.address else ["--sensor", name, "--sensor-option", "bus=spi0.0"]
        options = [f"--sensor-option={option}" for option in (f"rate_hz={chip.rate_hz}", "range_g=4")]
        lines = (f"rate_hz={SLOW_HZ}", "axes=1", "sequence=true")
        options += [f"--reference-option={option}" for option in lines]
        done = fieldcal("init", config, *named, *options, "--reference-port", port.path, "--theta-deg", str(THETA_DEG))
        assert (done.returncode, done.stderr) == (0, "")
        assert f'driver = "{name}"' in config.read_text()
        assert fieldcal("check", config).returncode == 0
        with started("run", config, "--data-dir", data_dir, output=output) as process:
            wait_until(lambda: "VALID" in statuses() or process.poll() is not None, THROUGH_S, "VALID")
            interrupt(process)
        assert process.returncode == 0, output.read_text()
    assert "VALID" in statuses()
    last, true = results(data_dir, "calibration")[-1], bench.truth.sensitivity
    nominal, u = chip.counts_per_g / STANDARD_GRAVITY_MPS2, np.reshape(last["standard_uncertainty"][:9], (3, 3))
    error = np.abs(np.array(last["sensitivity"]) - true)
    assert (error < 4.0 * u).all()
    assert u.max() < 0.03 * nominal
    assert error.max() < np.abs(nominal * np.eye(3) - true).max(), "no better than the data sheet"
    assert all(last["determined"])
