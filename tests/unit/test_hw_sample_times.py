"""Sample times from a driver's arrivals compared with the twin's truth: rate error, thermal wander, stalls."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from calib.signal.timing import ClockModel
from hw.adxl355 import Adxl355
from hw.fifo_sensor import FifoSensor
from hw.lsm6dso import Lsm6dso
from hw.mpu6050 import Mpu6050
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.fifo_twin import FifoTwin
from hw.virtual.kernel import I2CBus, installed
from hw.virtual.lsm6dso_twin import Lsm6dsoTwin
from hw.virtual.mpu6050_twin import Mpu6050Twin
from hw.virtual.timebase import Clock

SECONDS = 90.0
RESONANT_125_HZ, RESONANT_500_HZ = 2.381966 / (125.0 * 0.02) - 1, 8.381966 / (500.0 * 0.016) - 1
# Scheduler: 0.2 ms mean, 1 % stalls of 5 to 20 ms, as measured on a loaded gateway. The FIFO is large enough for them.
MEAN_LATE_S, STALLS, STALL_S = 0.2e-3, 0.01, (5e-3, 20e-3)


class Machine:
    """A simulated clock, and a scheduler that sometimes wakes a sleeper later than requested."""

    def __init__(self, seed: int) -> None:
        self.t_s = 0.0
        self._random = np.random.default_rng(seed)

    def clock(self) -> tuple[int, int]:
        ns = round(self.t_s * 1e9)
        return ns, ns

    def sleep(self, seconds: float) -> None:
        late_s = self._random.exponential(MEAN_LATE_S)
        if self._random.random() < STALLS:
            late_s += self._random.uniform(*STALL_S)
        self.t_s += seconds + late_s


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("driver", "twin", "options", "rate_error", "bias_us", "sd_us", "largest_us"),
    [
        # From poll to poll these clocks make a whole number of samples and 0.382: with 0.618, the golden ratio, polls
        # that are later by that part from one to the next would all come at the same part of a sample period.
        (Adxl355, Adxl355Twin, {"rate_hz": 125.0}, RESONANT_125_HZ, 100, 120, 350),
        (Adxl355, Adxl355Twin, {"rate_hz": 1000.0}, 3.3e-3, 50, 50, 150),
        pytest.param(Mpu6050, Mpu6050Twin, {"rate_hz": 1000.0}, 3.3e-3, 50, 50, 150, marks=pytest.mark.thorough),
        pytest.param(Lsm6dso, Lsm6dsoTwin, {"rate_hz": 833.0}, 3.3e-3, 50, 50, 150, marks=pytest.mark.thorough),
        pytest.param(Adxl355, Adxl355Twin, {"rate_hz": 125.0}, 3.3e-3, 100, 120, 350, marks=pytest.mark.thorough),
        pytest.param(
            Adxl355, Adxl355Twin, {"rate_hz": 500.0}, RESONANT_500_HZ, 50, 50, 150, marks=pytest.mark.thorough
        ),
    ],
)
def test_sample_times(
    driver: type[FifoSensor],
    twin: type[FifoTwin],
    options: dict[str, Any],
    rate_error: float,
    bias_us: float,
    sd_us: float,
    largest_us: float,
) -> None:
    machine = Machine(1)
    rate_hz = options["rate_hz"]
    truth = Clock(rate_hz, rate_error=rate_error, offset_s=0.3e-3, wander=250e-6, wander_period_s=600.0)
    device = twin(
        lambda first, n: np.column_stack([np.arange(first, first + n) % 1000, np.arange(first, first + n) // 1000] * 2)[
            :, :3
        ].astype(np.int32),
        lambda t_s: int(truth.due(t_s)),
        lambda: machine.t_s,
    )
    settings = driver.options_model.model_validate(options)
    errors_s = []
    with installed({"/dev/i2c-1": I2CBus({settings.address: device})}):  # type: ignore[attr-defined]
        sensor = driver("sensor", settings, clock=machine.clock, sleep=machine.sleep)
        info = sensor.open()
        model = ClockModel(info.nominal_rate_hz)
        while machine.t_s < SECONDS:
            block = sensor.read_block()
            assert block is not None
            assert not block.first_index or not block.flags, f"lost samples at {machine.t_s} s"
            last = block.first_index + block.burst_count - 1
            model.update(last, block.burst_t_monotonic_ns * 1e-9)
            if machine.t_s > 60.0:
                number = int(block.indications[0, 0]) + 1000 * int(block.indications[0, 1])
                estimate_s = model.result().time_of(block.first_index + np.arange(block.n))
                errors_s.append(estimate_s - truth.times(number, block.n))
        sensor.close()
    errors_us = 1e6 * np.concatenate(errors_s)
    assert abs(errors_us.mean()) < bias_us
    assert errors_us.std() < sd_us
    assert np.abs(errors_us).max() < largest_us
