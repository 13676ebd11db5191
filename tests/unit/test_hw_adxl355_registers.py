"""Bytes of the ADXL355 and their meaning; `triples` compared with a simple parser of the markers."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from hw.adxl345 import Adxl345Options
from hw.adxl355 import Adxl355Options
from hw.adxl355_registers import ADXL355, ADXL357, ADXL359, settings, temperature, triples, without_empty
from hw.virtual.adxl355_twin import encode


@pytest.mark.parametrize(
    ("entry", "count"),
    [
        ("000000", 0),
        ("000010", 1),
        ("fffff0", -1),
        ("7ffff0", 524287),
        ("800000", -524288),
        ("3e8000", 256000),  # 1 g at 2 g range
        ("c18000", -256000),
    ],
)
def test_entry(entry: str, count: int) -> None:
    y_z = bytes.fromhex(entry)
    x = y_z[:2] + bytes([y_z[2] | 1])
    assert triples(x + y_z + y_z).counts.tolist() == [[count, count, count]]
    assert encode(np.full((1, 3), count, np.int32)) == x + y_z + y_z


def test_temperature_ignores_what_is_above_12_bits() -> None:
    # Data sheet: 1885 at 25 degC, -9.05 LSB per degC.
    assert temperature(ADXL355, bytes.fromhex("075d")) == (1885, 25.0)
    raw, degc = temperature(ADXL355, bytes.fromhex("f702"))
    assert raw == 1794
    assert degc == pytest.approx(25 + 91 / 9.05)


def test_the_family() -> None:
    # Data sheets: ranges and LSB/g; ADXL357/359: 1852 LSB at 25 degC, part ID 0xED as the ADXL355, and 0xE9.
    assert ADXL357.counts_per_g == ADXL359.counts_per_g == {10: 51200, 20: 25600, 40: 12800}
    assert (ADXL355.identity[2], ADXL357.identity[2], ADXL359.identity[2]) == (0xED, 0xED, 0xE9)
    assert temperature(ADXL357, bytes.fromhex("073c")) == (1852, 25.0)
    assert settings(ADXL357, 1000.0, 40)[0x2C - 0x1E] == 0x83


def test_settings_by_register() -> None:
    # 0x1E..0x2E: offsets, activity, filter, FIFO, interrupts, sync, range, power, self-test.
    assert settings(ADXL355, 1000.0, 2).hex() == "0000000000000000000102600000810000"
    assert settings(ADXL355, 3.90625, 8).hex() == "000000000000000000010a600000830000"


def test_empty_entries_are_left_out() -> None:
    full = bytes.fromhex("000011 000020 000030".replace(" ", ""))
    assert without_empty(full + bytes.fromhex("000002") + full + bytes.fromhex("abcd03")) == full + full


def plain_reading(marks: str) -> tuple[list[int], int]:
    """Starts of the complete triples in a string of X and o; number of entries at the end that may become a triple."""
    starts = [i for i in range(len(marks) - 2) if marks[i : i + 3] == "Xoo" and marks[i + 3 : i + 4] in ("", "X")]
    rest = 2 if marks.endswith("Xo") else 1 if marks.endswith("X") else 0
    return starts, rest


mostly_triples = st.lists(st.sampled_from(["Xoo"] * 6 + ["X", "o", "Xo", "oo", "Xooo"]), max_size=30).map("".join)


@pytest.mark.slow
@given(mostly_triples)
def test_triples_as_a_plain_reading_of_the_marks(marks: str) -> None:
    data = b"".join((16 * i + (mark == "X")).to_bytes(3, "big") for i, mark in enumerate(marks))
    starts, rest = plain_reading(marks)
    found = triples(data)
    assert found.counts.tolist() == [[i, i + 1, i + 2] for i in starts]
    assert found.last.tolist() == [i + 2 for i in starts]
    assert found.rest == data[len(data) - 3 * rest :] if rest else found.rest == b""
    assert found.dropped == len(marks) - 3 * len(starts) - rest
    edges = [-3, *starts, len(marks) - rest]
    assert found.breaks == [k for k, (a, b) in enumerate(itertools.pairwise(edges)) if b - a != 3]


@given(st.binary(max_size=900).map(lambda data: data[: len(data) // 3 * 3]))
def test_any_bytes_decode(data: bytes) -> None:
    found = triples(without_empty(data))
    assert found.counts.min(initial=0) >= -(2**19)
    assert found.counts.max(initial=0) < 2**19


@given(st.lists(st.tuples(*[st.integers(-(2**19), 2**19 - 1)] * 3), max_size=40), st.integers(0, 120))
def test_a_stream_cut_anywhere_decodes_as_one(rows: list[tuple[int, int, int]], cut: int) -> None:
    counts = np.array(rows, np.int32).reshape(-1, 3)
    data = encode(counts)
    first = triples(data[: 3 * cut])
    second = triples(first.rest + data[3 * cut :])
    assert np.array_equal(np.concatenate([first.counts, second.counts]), counts)
    assert first.breaks == second.breaks == []


def refusal(**options: object) -> str:
    with pytest.raises(ValidationError) as refused:
        Adxl355Options.model_validate(options)
    (error,) = refused.value.errors()
    return str(error["msg"])


def test_a_bus_that_is_too_slow_is_refused_with_the_arithmetic() -> None:
    # 9 bytes x 9 bit x 1000 Hz + 12 bytes x 9 bit x 125 polls/s = 94.5 kbit/s
    assert "94.5 kbit/s, 94% of bus_khz 100; at most 70%" in refusal(bus_khz=100.0)
    assert "378 kbit/s" in refusal(rate_hz=4000.0)
    assert Adxl355Options(rate_hz=4000.0, bus_khz=1000.0).interval_s == pytest.approx(0.002)
    assert Adxl355Options(rate_hz=500.0, bus_khz=100.0).interval_s == pytest.approx(0.016)


def test_a_poll_that_the_fifo_cannot_wait_for_is_refused() -> None:
    assert "gathers 29 samples" in refusal(poll_interval_s=0.029)
    assert Adxl355Options(poll_interval_s=0.028).interval_s == 0.028


def test_rates() -> None:
    assert Adxl355Options(rate_hz=3.906).rate_hz == 3.90625
    assert Adxl355Options(rate_hz=3.90625).interval_s == 0.1
    assert "900 Hz is not a rate of this device; use one of 4000, 2000, 1000" in refusal(rate_hz=900.0)


@pytest.mark.parametrize(
    ("options", "stated_hz", "instead"),
    [
        ({"rate_hz": 1000.0}, 800, "500"),
        ({}, 800, "500"),
        ({"rate_hz": 500.0}, None, ""),
        ({"rate_hz": 500.0, "bus_khz": 100.0}, 200, "125"),
        ({"rate_hz": 4000.0, "bus_khz": 1000.0}, 2000, "2000"),
        ({"rate_hz": 2000.0, "bus_khz": 1000.0}, None, ""),
    ],
)
def test_a_rate_above_that_of_the_data_sheet_is_advised_against(
    options: dict[str, float], stated_hz: int | None, instead: str
) -> None:
    # Data sheet: 800 Hz at 400 kHz, 200 Hz at 100 kHz, in proportion
    advice = Adxl355Options.model_validate(options).advice
    assert len(advice) == (stated_hz is not None)
    for told in advice:
        assert f"is above {stated_hz} Hz, the highest rate that the data sheet states" in told
        assert f"set rate_hz = {instead}, or use a bus of at least" in told


def test_the_adxl345_at_its_highest_rate_needs_a_bus_of_400_khz() -> None:
    assert Adxl345Options().advice == ()
    (told,) = Adxl345Options(bus_khz=399.0).advice
    assert "rate_hz 800 is above 798 Hz" in told
    assert "set rate_hz = 400, or use a bus of at least 400 kHz" in told
