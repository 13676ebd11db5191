"""Bytes of the ADXL345, LSM6DSO and MPU-6050 families and their meaning; any bytes can be decoded; refused options."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from hw import adxl345_registers, lsm6dso_registers, mpu6050_registers
from hw.adxl345 import Adxl345Options
from hw.fifo import plain_samples
from hw.fifo_options import FifoOptions
from hw.lsm6dso import Lsm6dsoOptions
from hw.mpu6050 import Mpu6050Options
from hw.virtual.lsm6dso_twin import words


def refusal(options: type[FifoOptions], **given: object) -> str:
    with pytest.raises(ValidationError) as refused:
        options.model_validate(given)
    (error,) = refused.value.errors()
    return str(error["msg"])


def by_name(settings: dict[int, tuple[str, int]]) -> dict[str, int]:
    return dict(settings.values())


@pytest.mark.parametrize(
    ("data", "byte_order", "counts"),
    [
        ("0001 00ff ff7f", "<", [256, -256, 32767]),
        ("0100 ff00 7fff", ">", [256, -256, 32767]),
        ("ff0f 00f0 0000", "<", [4095, -4096, 0]),  # the lowest and highest value of the ADXL345's 13 bits
    ],
)
def test_plain_samples(data: str, byte_order: str, counts: list[int]) -> None:
    assert plain_samples(bytes.fromhex(data), byte_order).counts.tolist() == [counts]


def test_adxl345_settings() -> None:
    found = by_name(adxl345_registers.settings(800.0, 16))
    # Data sheet: 0x0D is 800 Hz, 0x0A 100 Hz; FULL_RES and 16 g; stream mode; measure.
    assert {name: value for name, value in found.items() if value} == {
        "BW_RATE": 0x0D,
        "POWER_CTL": 0x08,
        "DATA_FORMAT": 0x0B,
        "FIFO_CTL": 0x80,
    }
    assert by_name(adxl345_registers.settings(100.0, 2))["BW_RATE"] == 0x0A
    assert by_name(adxl345_registers.settings(1.5625, 2))["BW_RATE"] == 0x04
    assert adxl345_registers.limits(2) == (-512, 511)
    assert adxl345_registers.limits(16) == (-4096, 4095)


def test_mpu6050_settings() -> None:
    part = mpu6050_registers.PARTS[0x68]
    found = by_name(mpu6050_registers.settings(part, 200.0, 16))
    # Register map: 1000 Hz / (1 + 4); filter 94 Hz; 16 g; accelerometer into the FIFO.
    assert (found["SMPLRT_DIV"], found["CONFIG"], found["ACCEL_CONFIG"], found["FIFO_EN"]) == (4, 2, 0x18, 0x08)
    assert "ACCEL_CONFIG_2" not in found
    assert by_name(mpu6050_registers.settings(mpu6050_registers.PARTS[0x71], 4.0, 2))["ACCEL_CONFIG_2"] == 6


@pytest.mark.parametrize(
    ("who_am_i", "raw", "degc"),
    [(0x68, -521, 35.0), (0x68, 0, 36.53), (0x70, 0, 21.0), (0x71, 3339, 31.0)],  # register maps; -521 at 35 degC
)
def test_mpu6050_temperature(who_am_i: int, raw: int, degc: float) -> None:
    found = mpu6050_registers.PARTS[who_am_i].temperature(raw.to_bytes(2, "big", signed=True))
    assert found == (raw, pytest.approx(degc, abs=0.01))


@pytest.mark.parametrize(
    ("rate_hz", "freq_fine", "actual_hz"),
    [(6667.0, 0, 6667.0), (833.0, 0, 833.375), (12.5, 0, 13.02148), (833.0, 0x7F, 992.133), (833.0, 0x80, 673.367)],
)
def test_lsm6dso_states_its_own_rate(rate_hz: float, freq_fine: int, actual_hz: float) -> None:
    # AN5272: (6667 + 0.0015 FREQ_FINE 6667) / 1, 8, 512; FREQ_FINE is signed.
    assert lsm6dso_registers.actual_rate_hz(rate_hz, freq_fine) == pytest.approx(actual_hz, abs=1e-3)


def test_mpu6050_filter_is_the_widest_that_is_not_wider_than_half_the_rate() -> None:
    # DLPF_CFG of RM-MPU-6000A 4.3: 1 is 184 Hz, 2 94 Hz, 3 44 Hz, 4 21 Hz, 5 10 Hz, 6 5 Hz
    codes = {1000.0: 1, 200.0: 2, 100.0: 3, 43.0: 4, 42.0: 4, 20.0: 5, 19.0: 6, 4.0: 6}
    assert {rate_hz: mpu6050_registers.low_pass_code(rate_hz) for rate_hz in codes} == codes


def test_mpu6050_self_test_figures_of_the_maker() -> None:
    # RM-MPU-6000A 4.1: bits 4:2 of the codes in the axes' registers, bits 1:0 in the fourth; 0.34 g at 1, 0.92 g at 31.
    part = mpu6050_registers.PARTS[0x68]
    assert mpu6050_registers.factory_trim_g(part, bytes([0, 0xE0, 0, 0x1C])) == [
        pytest.approx(0.34),
        pytest.approx(0.92),
        0.0,
    ]
    # AN-MPU-9250A-03: 2620 counts at 2 g, 1 % more per code
    later = mpu6050_registers.PARTS[0x71]
    assert mpu6050_registers.factory_trim_g(later, bytes([1, 2, 0, 9])) == [
        pytest.approx(2620 / 16384),
        pytest.approx(2620 * 1.01 / 16384),
        0.0,
    ]


def test_lsm6dso_settings() -> None:
    found = by_name(lsm6dso_registers.settings(833.0, 16))
    # Data sheet: 833 Hz is 7, 16 g is 1; BDU and IF_INC; continuous mode.
    assert {name: value for name, value in found.items() if value} == {
        "FIFO_CTRL3": 0x07,
        "FIFO_CTRL4": 0x06,
        "CTRL1_XL": 0x74,
        "CTRL3_C": 0x44,
        "CTRL9_XL": 0xE2,
    }
    assert by_name(lsm6dso_registers.settings(833.0, 8))["CTRL1_XL"] == 0x7C


def test_lsm6dso_word() -> None:
    # Tag 2 << 3, counter 1 << 1, parity bit 0: 0x12 has two bits set.
    data = bytes.fromhex("12 0100 ffff 0080")
    samples, counter = lsm6dso_registers.tagged_samples(data, 0)
    assert samples.counts.tolist() == [[1, -1, -32768]]
    assert (samples.breaks, samples.dropped, counter) == ([], 0, 1)
    assert words(2, 1, np.array([[1, -1, -32768]], np.int32)) == data
    assert lsm6dso_registers.tagged_samples(data, 1)[0].breaks == [0]
    assert lsm6dso_registers.tagged_samples(bytes([0x13]) + data[1:], 0)[0].dropped == 1


@given(st.integers(0, 3), st.lists(st.sampled_from(["next", "skip", "other", "odd"]), max_size=60), st.integers(0, 60))
def test_lsm6dso_words_as_a_plain_reading(first: int, kinds: list[str], cut: int) -> None:
    data, expected, breaks, counter, last = b"", list[int](), list[int](), first, first
    for i, kind in enumerate(kinds):
        counter += {"next": 1, "skip": 2, "other": 0, "odd": 1}[kind]
        word = words(1 if kind == "other" else 2, counter, np.full((1, 3), i, np.int32))
        data += bytes([word[0] ^ 1]) + word[1:] if kind == "odd" else word
        if kind in ("next", "skip"):
            if (counter - last) % 4 != 1:
                breaks.append(len(expected))
            expected.append(i)
            last = counter
    one, end = lsm6dso_registers.tagged_samples(data[: 7 * cut], first & 3)
    two, _ = lsm6dso_registers.tagged_samples(data[7 * cut :], end)
    assert [*one.counts[:, 0].tolist(), *two.counts[:, 0].tolist()] == expected
    found = one.breaks + [len(one.counts) + at for at in two.breaks]
    assert found == breaks
    assert one.dropped + two.dropped == len(kinds) - len(expected)


@given(st.binary(max_size=7 * 64).map(lambda data: data[: len(data) // 7 * 7]), st.none() | st.integers(0, 3))
def test_any_words_decode(data: bytes, last: int | None) -> None:
    samples, counter = lsm6dso_registers.tagged_samples(data, last)
    assert len(samples.counts) + samples.dropped == len(data) // 7
    assert counter in (last, 0, 1, 2, 3)


def test_what_the_bus_or_the_fifo_cannot_do_is_refused_with_the_arithmetic() -> None:
    # 11 bytes x 9 bit x 800 Hz + 4 bytes x 9 bit x 100 polls/s = 82.8 kbit/s
    told = refusal(Adxl345Options, bus_khz=100.0)
    assert "82.8 kbit/s, 83% of bus_khz 100; at most 70% may be used: set rate_hz = 400, or use a faster bus" in told
    assert Adxl345Options(bus_khz=100.0, rate_hz=400.0).rate_hz == 400.0
    # 6 bytes x 9 bit x 1000 Hz + 12 bytes x 9 bit x 62.5 polls/s = 60.75 kbit/s
    assert Mpu6050Options(bus_khz=100.0).interval_s == 0.016
    assert "bus too slow" in refusal(Lsm6dsoOptions, rate_hz=6667.0)
    assert "the FIFO holds 85 and at most 74" in refusal(Mpu6050Options, poll_interval_s=0.08)
    assert "900 Hz is not a rate of this device; use one of 1000, 500, 250, 200" in refusal(
        Mpu6050Options, rate_hz=900.0
    )
    assert "1600 Hz is not a rate" in refusal(Adxl345Options, rate_hz=1600.0)
