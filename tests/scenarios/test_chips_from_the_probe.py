"""Chips on an I2C bus of libumockdev: `init` finds each without an option of its own, and `run` calibrates it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from hw.virtual import icm20948_twin, icm42688_twin, lis3dh_twin
from hw.virtual.bench import Bench
from hw.virtual.fifo_twin import FifoTwin
from hw.virtual.kernel import BCM2835, I2CBus
from hw.virtual.presets import COUNTS_PER_MPS2, PRESETS
from hw.virtual.response import Response
from hw.virtual.schedule import STANDARD_GRAVITY_MPS2
from hw.virtual.serial_bench import serial_lines
from hw.virtual.serial_port import PtyDevice
from hw.virtual.timebase import BenchTime
from tests.scenarios.processes import fieldcal, interrupt, results, started, wait_until
from tests.scenarios.umockdev_site import UmockdevSite, absence

THROUGH_S = 100.0  # four positions take 52 s; where a busy machine lost samples, one round more
ABSENCE = absence()


class Chip(NamedTuple):
    """A chip at 4 g; its noise is that of the data sheet over its bandwidth."""

    twin: type[FifoTwin]
    address: int
    rate_hz: float
    counts_per_g: float
    noise_g: float
    response: Response


CHIPS = {
    "lis3dh": Chip(lis3dh_twin.Lis3dhTwin, 0x19, 100.0, 500.0, 3e-3, lis3dh_twin.filters(100.0)),
    "icm20948": Chip(icm20948_twin.Icm20948Twin, 0x68, 112.5, 8192.0, 1.6e-3, icm20948_twin.filters(3)),
    "icm42688": Chip(icm42688_twin.Icm42688Twin, 0x69, 100.0, 8192.0, 0.5e-3, icm42688_twin.filters(8)),
}


@contextmanager
def plugged(chip: Chip) -> Iterator[tuple[Bench, I2CBus, PtyDevice]]:
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
    bench = Bench(replace(preset, sensor=sensor), 1)

    def due(t_s: float) -> int:
        if not began.begun:
            began.begin(t_s)
        return bench.sensor_samples_due(began(t_s))

    bench.sensor_counts(0, 1)
    bench.reference_values(0, 1)
    port = PtyDevice(serial_lines(bench, "reference", began))
    bus = I2CBus({chip.address: chip.twin(bench.sensor_counts, due, time.monotonic)}, adapter=BCM2835)
    port.start()
    yield bench, bus, port
    port.stop()


@pytest.mark.slow
@pytest.mark.skipif(ABSENCE is not None, reason=str(ABSENCE))
@pytest.mark.parametrize("name", CHIPS)
def test_a_chip_from_the_probe_to_s_and_q(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chip = CHIPS[name]
    data_dir, config, output = tmp_path / "data", tmp_path / "gateway.toml", tmp_path / "output"
    with plugged(chip) as (bench, bus, port), UmockdevSite({"/dev/i2c-1": bus}) as site:
        for variable, value in site.environment.items():
            monkeypatch.setenv(variable, value)
        options = [f"--sensor-option={option}" for option in (f"rate_hz={chip.rate_hz}", "range_g=4")]
        options += [f"--reference-option={option}" for option in ("rate_hz=1000", "axes=1", "sequence=true")]
        pose = "--theta-deg", "35", "--alpha-deg", "0,30,120,210"
        done = fieldcal("init", config, *options, "--reference-port", port.path, *pose)
        assert (done.returncode, done.stderr) == (0, "")
        assert f'driver = "{name}"' in config.read_text()
        assert fieldcal("check", config).returncode == 0
        with started("run", config, "--data-dir", data_dir, output=output) as process:
            wait_until(lambda: results(data_dir, "calibration") or process.poll() is not None, THROUGH_S, "S and Q")
            interrupt(process)
        assert process.returncode == 0, output.read_text()
    last, true = results(data_dir, "calibration")[-1], bench.truth
    u = np.reshape(last["standard_uncertainty"][:9], (3, 3))
    assert (np.abs(np.array(last["sensitivity"]) - true.sensitivity) < 4.0 * u).all()
    assert u.max() < 0.05 * chip.counts_per_g / STANDARD_GRAVITY_MPS2
    assert all(last["determined"])
