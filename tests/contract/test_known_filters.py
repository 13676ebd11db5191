"""What drivers state of the filters of their chips, against what the chips' twins make of sines, by FFT."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.model import Array
from calib.signal.known_filters import filter_of
from hw import (
    adxl345_registers,
    adxl355_registers,
    icm20948_registers,
    icm42688_registers,
    lis3dh_registers,
    lsm6dso_registers,
    mpu6050_registers,
)
from hw.adxl345 import Adxl345
from hw.adxl355 import Adxl355, Adxl357, Adxl359
from hw.fifo_sensor import FifoSensor
from hw.icm20948 import Icm20948
from hw.icm42688 import Icm42688
from hw.lis3dh import Lis3dh
from hw.lsm6dso import Lsm6dso
from hw.mpu6050 import Mpu6050
from hw.virtual.adxl345_twin import Adxl345Twin
from hw.virtual.adxl355_twin import Adxl355Twin, Adxl357Twin, Adxl359Twin
from hw.virtual.fifo_twin import FifoTwin
from hw.virtual.icm20948_twin import Icm20948Twin
from hw.virtual.icm42688_twin import Icm42688Twin
from hw.virtual.kernel import I2CBus, installed
from hw.virtual.lis3dh_twin import Lis3dhTwin
from hw.virtual.lsm6dso_twin import Lsm6dsoTwin
from hw.virtual.mpu6050_twin import Mpu6050Twin, Mpu6500Twin

Complex = NDArray[np.complex128]
SAMPLES = 2000
CYCLES = np.array([20, 100, 260, 500, 700])  # of each sine in all samples: up to 0.35 of the rate
COUNTS = 400.0  # amplitude of each; together within 12 bits


def passed(driver: type[FifoSensor], twin_class: type[FifoTwin], rate_hz: float) -> tuple[Complex, tuple[str, ...]]:
    """h of the chip at the frequencies of the sines, as the driver sets and reads it; what the driver states."""
    now = [0.0]

    def source(first: int, n: int) -> NDArray[np.int32]:
        time_s = (first + np.arange(n)) / rate_hz
        h = twin.response(CYCLES * rate_hz / SAMPLES)
        turns = np.exp(2j * np.pi * np.multiply.outer(time_s, CYCLES * rate_hz / SAMPLES))
        sines = np.rint(COUNTS * (turns * h).real.sum(axis=1)).astype(np.int32)
        return np.column_stack([first + np.arange(n), sines, sines]).astype(np.int32)

    def sleep(seconds: float) -> None:
        now[0] += seconds

    twin = twin_class(source, lambda t_s: int(t_s * rate_hz), lambda: now[0])
    options: Any = driver.options_model.model_validate({"rate_hz": rate_hz})
    with installed({"/dev/i2c-1": I2CBus({options.address: twin})}):
        sensor = driver("sensor", options, clock=lambda: (round(now[0] * 1e9), 0), sleep=sleep)
        info, held = sensor.open(), [np.empty((0, 3))]
        while sum(map(len, held)) < SAMPLES:
            if (block := sensor.read_block()) is not None:
                held.append(block.indications.astype(float))
        sensor.close()
    read = np.concatenate(held)[:SAMPLES]
    assert (np.diff(read[:, 0]) == 1.0).all()
    lines = np.fft.rfft(read[:, 1])[CYCLES] * 2.0 / SAMPLES / COUNTS
    return lines * np.exp(-2j * np.pi * CYCLES * read[0, 0] / SAMPLES), info.filters


def stated(lines: tuple[str, ...], frequency_hz: Array) -> tuple[Complex, Array]:
    """h that is stated, and the relative standard uncertainty of its size."""
    found = [filter_of(line) for line in lines]
    h = np.prod([one.at(frequency_hz) for one in found], axis=0)
    moved = [np.abs(one.at(frequency_hz / (1.0 + one.u_scale)) / one.at(frequency_hz)) - 1.0 for one in found]
    return h, np.sqrt(np.sum(np.square(moved), axis=0))


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("driver", "twin_class", "rate_hz", "exact"),
    [
        (Adxl355, Adxl355Twin, 1000.0, True),
        (Adxl355, Adxl355Twin, 125.0, True),
        (Adxl357, Adxl357Twin, 500.0, True),
        (Adxl359, Adxl359Twin, 62.5, True),
        (Adxl345, Adxl345Twin, 800.0, False),
        (Adxl345, Adxl345Twin, 100.0, False),
        (Icm20948, Icm20948Twin, 1125.0, False),
        (Icm20948, Icm20948Twin, 225.0, False),
        (Icm42688, Icm42688Twin, 1000.0, True),
        (Icm42688, Icm42688Twin, 100.0, True),
        (Lis3dh, Lis3dhTwin, 400.0, False),
        (Lsm6dso, Lsm6dsoTwin, 104.0, False),
        (Mpu6050, Mpu6050Twin, 1000.0, False),
        (Mpu6050, Mpu6050Twin, 100.0, False),
    ],
)
def test_a_driver_states_what_its_chip_makes_of_sines(
    driver: type[FifoSensor], twin_class: type[FifoTwin], rate_hz: float, exact: bool
) -> None:
    found, lines = passed(driver, twin_class, rate_hz)
    h, u = stated(lines, CYCLES * rate_hz / SAMPLES)
    assert np.abs(found[-1]) < 0.99  # the chip has a filter
    assert (np.abs(np.abs(found / h) - 1.0) <= 2.0 * u + 1e-3).all()
    if exact:  # the data sheet tells all of it: size and delay
        assert np.abs(found - h).max() < 2e-3


# Data sheet of the ADXL355, "Digital filter group delay and profile": by rate, delay in ms, and dB of the whole path at
# a quarter of the rate.
DATA_SHEET = {
    4000.0: (0.63, -3.63), 2000.0: (1.00, -2.26), 1000.0: (1.78, -1.93), 500.0: (3.26, -1.83),
    250.0: (6.27, -1.83), 125.0: (12.34, -1.83), 62.5: (24.18, -1.83),
}  # fmt: skip


@pytest.mark.parametrize("rate_hz", DATA_SHEET)
def test_the_adxl355_states_the_attenuation_and_the_delay_of_its_data_sheet(rate_hz: float) -> None:
    lines = adxl355_registers.filters(rate_hz)
    late_ms, wanted_db = DATA_SHEET[rate_hz]
    h, u = stated(lines, np.array([rate_hz / 4.0]))
    assert 20.0 * np.log10(abs(h[0])) == pytest.approx(wanted_db, abs=0.03)
    assert 1e3 * sum(filter_of(line).group_delay_s for line in lines) == pytest.approx(late_ms, abs=0.13)
    if rate_hz < 4000.0:  # that the corner is at a quarter of the rate lies within U
        assert abs(abs(h[0]) * 10.0 ** (3.01 / 20.0) - 1.0) <= 2.0 * u[0]


@pytest.mark.parametrize(
    ("order", "at_1500_hz"),
    [(3, 0.5), (1, 0.7)],  # text of the ADXL359's data sheet: sinc3, 50 % at 1.5 kHz; of the ADXL355's: sinc, 30 % down
)
@pytest.mark.parametrize("rate_hz", adxl355_registers.RATES_HZ)
def test_the_adxl355s_u_contains_the_analog_filter_that_the_text_of_the_sheets_states(
    rate_hz: float, order: int, at_1500_hz: float
) -> None:
    # The table of the same sheets leaves next to nothing for the analog filter (0.02 % at 100 Hz).
    zero_hz = np.linspace(2000.0, 6000.0, 40001)  # first zero of the sinc
    text_hz = zero_hz[np.abs(np.sinc(1500.0 / zero_hz) ** order - at_1500_hz).argmin()]
    f = rate_hz / 4.0 * np.array([0.02, 0.1, 0.5, 1.0])
    lines = adxl355_registers.filters(rate_hz)
    _, u = stated(lines, f)
    differs = np.sinc(f / text_hz) ** order / np.abs(filter_of(lines[0]).at(f)) - 1.0
    assert (np.abs(differs) <= 2.0 * u).all()
    if (rate_hz, order) == (4000.0, 3):
        assert differs[1] == pytest.approx(-0.003, abs=3e-4)  # at 100 Hz


@pytest.mark.parametrize(
    ("chip", "rates_hz"),
    [
        (adxl355_registers, adxl355_registers.RATES_HZ),
        (adxl345_registers, tuple(adxl345_registers.RATE_CODES)),
        (icm20948_registers, icm20948_registers.RATES_HZ),
        (icm42688_registers, tuple(icm42688_registers.RATES)),
        (lis3dh_registers, tuple(lis3dh_registers.RATE_CODES)),
        (lsm6dso_registers, lsm6dso_registers.RATES_HZ),
        (mpu6050_registers, mpu6050_registers.RATES_HZ),
    ],
)
def test_what_drivers_state_can_be_read_at_every_rate(chip: Any, rates_hz: tuple[float, ...]) -> None:
    for rate_hz in rates_hz:
        filters = [filter_of(line) for line in chip.filters(rate_hz)]
        assert filters or rate_hz < 2.0


@pytest.mark.parametrize(
    ("who_am_i", "rate_hz", "corner_hz"),
    [
        (0x68, 1000.0, 184),
        (0x68, 100.0, 44),
        (0x70, 200.0, 92),
        (0x71, 1000.0, 218.1),
        (0x73, 100.0, 44.8),
        (0x19, 200.0, 99),  # MPU-6886
        (0x98, 100.0, None),
    ],
)
def test_the_filters_of_an_mpu_are_those_of_its_identity(
    who_am_i: int, rate_hz: float, corner_hz: float | None
) -> None:
    class Part(Mpu6500Twin if who_am_i != 0x68 else Mpu6050Twin):  # type: ignore[misc]
        identity = who_am_i

    twin = Part(lambda _, n: np.zeros((n, 3), np.int32), int, lambda: 0.0)
    options: Any = Mpu6050.options_model.model_validate({"rate_hz": rate_hz, "clone": True})
    with installed({"/dev/i2c-1": I2CBus({0x68: twin})}):
        info = Mpu6050("sensor", options, sleep=lambda _: None).open()
    if corner_hz is None:  # no source tells the filters of this part, nor which settings are its filters
        assert (info.filters, info.filter_settings) == ((), ())
    else:
        assert info.filters == (f"lowpass order=1 corner_hz={corner_hz:g} u_corner_pct=50",)
        assert set(info.filter_settings) == {"SMPLRT_DIV", "CONFIG", "ACCEL_CONFIG_2"}


def test_before_the_part_is_known_u_contains_the_filters_of_all() -> None:
    for rate_hz in mpu6050_registers.RATES_HZ:
        f = rate_hz * np.array([0.05, 0.2, 0.35])
        h, u = stated(mpu6050_registers.filters(rate_hz), f)
        for part in (*mpu6050_registers.PARTS.values(), mpu6050_registers.clone(0x19)):
            other, _ = stated(mpu6050_registers.filters(rate_hz, part), f)
            assert (np.abs(np.abs(other / h) - 1.0) <= 2.0 * u).all()
