"""Decoding of lines, compared with a simple parser of the protocol, line by line."""

from __future__ import annotations

import re
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hw.lines import (
    DECIMAL_COMMAS,
    NAMED_NUMBERS,
    OTHER_COLUMNS,
    UNREADABLE,
    decode,
    with_newlines,
)

# The protocol as a second implementation: sign, digits with at most one point, exponent; between the numbers commas, or
# semicolons, with blanks around them, or blanks alone; one separator may stand at the end.
DECIMAL = re.compile(rb"[+-]?(\d*)\.?(\d*)([eE][+-]?\d+)?\Z")


def is_decimal(field: bytes) -> bool:
    match = DECIMAL.match(field.strip(b" \t"))
    return match is not None and len(match[1] + match[2]) > 0 and len(match[1]) <= 16 and len(match[2]) <= 24


def plain_reading(line: bytes, columns: int) -> list[float] | None:
    line = line.strip(b" \t")
    for fields in (line.removesuffix(b",").split(b","), line.removesuffix(b";").split(b";"), line.split()):
        if len(fields) == columns and all(map(is_decimal, fields)):
            values = [float(field) for field in fields]
            return values if all(abs(value) <= 2.0**53 for value in values) else None
    return None


decimals = st.one_of(
    st.integers(-(10**9), 10**9).map(str),
    st.floats(allow_nan=False, allow_infinity=False, width=32).map(repr),
    st.sampled_from(
        [
            "nan",
            "inf",
            "-inf",
            "1_0",
            "",
            "-",
            "1e400",
            "0x10",
            "1e13",
            "9" * 40,
            " 7",
            "+.5",
            "5.",
            "1 2",
            ".",
            "0." + "3" * 30,
            "-1.5E-7",
        ]
    ),
)
separators = st.sampled_from([",", ";", " ", "\t", ", ", " ;", "  "])
lines = st.one_of(
    st.builds(lambda fields, by: by.join(fields).encode(), st.lists(decimals, min_size=3, max_size=3), separators),
    st.builds(lambda fields, by: by.join(fields).encode(), st.lists(decimals, max_size=5), separators),
    st.sampled_from([b"", b"# a comment", b" # 1,2,3", b"\xff\x00", b",,", b"1,2,3,", b"1;2;3; ", b"1,2;3", b"1 2,3"]),
)


@pytest.mark.slow
@given(st.lists(lines, min_size=1, max_size=40), st.sampled_from([b"\n", b"\r\n", b"\r"]))
def test_as_a_plain_reading_line_by_line(texts: list[bytes], ending: bytes) -> None:
    decoded = decode(with_newlines(b"".join(line + ending for line in texts)), 3)
    expected = [(i, plain_reading(line, 3)) for i, line in enumerate(texts)]
    good = [(i, values) for i, values in expected if values is not None]
    ignored = {i for i, line in enumerate(texts) if not line.strip() or line.lstrip().startswith(b"#")}
    assert decoded.line.tolist() == [i for i, _ in good]
    assert decoded.values.tolist() == [values for _, values in good]
    assert decoded.bad_at == [i for i, values in expected if values is None and i not in ignored]
    assert decoded.bad_lines.total() == len(decoded.bad_at)


@pytest.mark.parametrize("field", ["1", "-2.5", "+.5", "5.", "1e-3", "1E12", "0" * 16, "." + "3" * 24, "    7    "])
def test_a_decimal(field: str) -> None:
    assert decode(f"{field}\n".encode(), 1).values.tolist() == [[float(field)]]


@pytest.mark.parametrize(
    "field", ["nan", "-inf", "1_0", "-", ".", "1e400", "9.1e15", "0x1", "1 2", "0" * 17, "." + "3" * 25]
)
def test_no_decimal(field: str) -> None:
    assert decode(f"{field}\n".encode(), 1).bad_at == [0]


@given(st.binary(max_size=2000), st.integers(1, 4))
def test_any_bytes_decode(text: bytes, columns: int) -> None:
    decoded = decode(text + b"\n", columns)
    assert np.isfinite(decoded.values).all()
    assert len(decoded.line) + len(decoded.bad_at) <= text.count(b"\n") + 1
    assert decoded.bad_bytes <= len(text) + 1


@given(st.lists(st.floats(-1e12, 1e12), min_size=4, max_size=400).map(lambda v: v[: len(v) // 4 * 4]))
def test_decimals_come_back_exactly(values: list[float]) -> None:
    rows = np.array(values).reshape(-1, 4)
    text = b"".join(",".join(map(repr, row)).encode() + b"\n" for row in rows.tolist())
    assert np.array_equal(decode(text, 4).values, rows)


def test_overlong_lines_are_counted_in_bytes() -> None:
    overlong = [b"7" * 300, b"1,2," + b" " * 260 + b"3", b"#" * 256, b"x" * 256]
    decoded = decode(b"1,2,3\n" + b"\n4,5,6\n".join(overlong) + b"\n" + b"x" * 255 + b"\n" + b"#" * 255 + b"\n", 3)
    assert decoded.line.tolist() == [0, 2, 4, 6]
    assert decoded.bad_at == [1, 3, 5, 7, 8]
    assert (decoded.bad_lines.total(), decoded.bad_bytes) == (1, 301 + 266 + 257 + 257)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"1,5;2,3;9,8", DECIMAL_COMMAS),
        (b"1,5 2,3\t9,8", DECIMAL_COMMAS),
        (b"17;0,5;-2,3;9,8;", DECIMAL_COMMAS),
        (b"1,2;3", DECIMAL_COMMAS),
        (b"1;2,3,4", UNREADABLE),
        (b"X:1.0,Y:2.0,Z:3.0", NAMED_NUMBERS),
        (b"ax = 1\tay = 2\taz = 3", NAMED_NUMBERS),
        (b'{"x": 1, "y": 2, "z": 3}', NAMED_NUMBERS),
        (b"1,2", OTHER_COLUMNS),
        (b"1 2 3 4", OTHER_COLUMNS),
        (b"ax,ay,az", UNREADABLE),
        (b"OK", UNREADABLE),
        (b"ets Jun  8 2016 00:22:57", UNREADABLE),
        (b"nan,nan,nan", UNREADABLE),
        (b"1,,3", UNREADABLE),
        (b"0x10,2,3", UNREADABLE),
        (b"1,2,3\x00", UNREADABLE),
        (b"\xef\xbb\xbf1,2,3", UNREADABLE),
    ],
)
def test_what_is_wrong_with_a_line(line: bytes, reason: str) -> None:
    decoded = decode(line + b"\n", 3)
    assert (decoded.bad_at, dict(decoded.bad_lines)) == ([0], {reason: 1})


def test_fields_that_are_not_read_may_hold_anything() -> None:
    decoded = decode(b"12:30:01.5,1,2,OK\n12:30:02.0;3;4;0x1F\n,5,6,OK\n#1,7,8,OK\na b,5,6,OK\n", 4, frozenset({0, 3}))
    assert decoded.values.tolist() == [[1, 2], [3, 4]]
    assert decoded.bad_at == [2, 4]


@pytest.mark.parametrize(
    "line", [b"1," * 127 + b"1", b"1 " * 127, b"1\t,\t" * 63, b"a:" * 127, b";, " * 85, b"1" * 255]
)
def test_a_line_that_no_pattern_fits_costs_no_time(line: bytes) -> None:
    began_s = time.process_time()
    decode((line + b"\n") * 1000, 3)
    assert time.process_time() - began_s < 1.0, "1 ms a line: some pattern tries the same bytes again and again"
