"""Decimals by words against `float`: every number it accepts is right, everything else it declines."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from agent.calibrate.decimals import decimals


def text_of(rows: list[list[str]]) -> bytes:
    return "".join(",".join(row) + "\n" for row in rows).encode()


@st.composite
def plain_numbers(draw: st.DrawFn, digits: int) -> str:
    whole = draw(st.text("0123456789", max_size=min(digits, 16)))
    fraction = draw(st.text("0123456789", max_size=min(digits - len(whole), 24)))
    if not whole + fraction:
        whole = "0"
    point = "." if fraction or draw(st.booleans()) else ""
    return draw(st.sampled_from(["", "-"])) + whole + point + fraction


@given(st.lists(st.lists(plain_numbers(15), min_size=3, max_size=3), min_size=1, max_size=8))
@settings(deadline=None)
def test_up_to_fifteen_digits_are_those_of_float(rows: list[list[str]]) -> None:
    digits = max(len(n.strip("-").partition(".")[0]) for r in rows for n in r)
    digits += max(len(n.partition(".")[2]) for r in rows for n in r)
    found = decimals(text_of(rows), 3)
    assert found is not None
    expected = np.array([[float(n) for n in row] for row in rows])
    if digits <= 15:
        np.testing.assert_array_equal(found, expected)
    else:
        np.testing.assert_array_max_ulp(found, expected, maxulp=2)


@given(st.lists(st.floats(-1e15, 1e15).map(lambda x: f"{x:.20f}"), min_size=1, max_size=8))
@example(["1700000000.12345678901234"])
@settings(deadline=None)
def test_long_ones_are_right_to_two_units(numbers: list[str]) -> None:
    found = decimals(text_of([[n] for n in numbers]), 1)
    assert found is not None
    np.testing.assert_array_max_ulp(found[:, 0], np.array([float(n) for n in numbers]), maxulp=2)


@given(st.lists(st.text("0123456789.-+eE_ naif\t;", max_size=20), min_size=2, max_size=6))
@settings(deadline=None, max_examples=500)
def test_what_it_accepts_float_accepts_alike(fields: list[str]) -> None:
    found = decimals(text_of([fields]), len(fields))
    if found is not None:
        np.testing.assert_array_max_ulp(found[0], np.array([float(f) for f in fields]), maxulp=2)


def test_other_spellings_and_shapes_are_declined() -> None:
    for text in (b"1,2\n3\n", b"1\n2,3\n", b"1,2,3\n", b"1,\n", b",1\n", b"-,1\n", b".,1\n", b"1..2,1\n", b"1e3,1\n",
                 b"nan,1\n", b" 1,1\n", b"1-,1\n", b"0x1,1\n", b"12345678901234567,1\n", b"\n", b""):  # fmt: skip
        assert decimals(text, 2) is None, text
