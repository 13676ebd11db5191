"""Decoding of lines, compared with a simple parser of the protocol, line by line."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hw.block import BlockFlags, Drop, SampleBlock
from hw.cutting import Cutter
from hw.line_stream import LineStream
from hw.lines import decode

# The protocol as a second implementation: sign, digits with at most one point, exponent; spaces around a number are
# allowed.
DECIMAL = re.compile(rb"[+-]?(\d*)\.?(\d*)([eE][+-]?\d+)?\Z")


def is_decimal(field: bytes) -> bool:
    match = DECIMAL.match(field.strip(b" \t"))
    return match is not None and len(match[1] + match[2]) > 0 and len(match[1]) <= 16 and len(match[2]) <= 24


def plain_reading(line: bytes, columns: int) -> list[float] | None:
    fields = line.removesuffix(b"\r").split(b",")
    if len(fields) != columns or not all(map(is_decimal, fields)):
        return None
    values = [float(field) for field in fields]
    return values if all(abs(value) <= 1e12 for value in values) else None


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
lines = st.one_of(
    st.lists(decimals, min_size=3, max_size=3).map(lambda fields: ",".join(fields).encode()),
    st.lists(decimals, max_size=5).map(lambda fields: ",".join(fields).encode()),
    st.sampled_from([b"", b"\r", b"# a comment", b" # 1,2,3", b"\xff\x00", b",,", b"1,2,3,"]),
)
endings = st.sampled_from([b"\n", b"\r\n"])


@given(st.lists(st.tuples(lines, endings), min_size=1, max_size=40))
def test_as_a_plain_reading_line_by_line(texts: list[tuple[bytes, bytes]]) -> None:
    decoded = decode(b"".join(line + ending for line, ending in texts), 3)
    expected = [(i, plain_reading(line, 3)) for i, (line, _) in enumerate(texts)]
    good = [(i, values) for i, values in expected if values is not None]
    ignored = {i for i, (line, _) in enumerate(texts) if not line.strip() or line.lstrip().startswith(b"#")}
    assert decoded.line.tolist() == [i for i, _ in good]
    assert decoded.values.tolist() == [values for _, values in good]
    assert decoded.bad_at == [i for i, values in expected if values is None and i not in ignored]
    assert decoded.bad_lines == len(decoded.bad_at)


@pytest.mark.parametrize("field", ["1", "-2.5", "+.5", "5.", "1e-3", "1E12", "0" * 16, "." + "3" * 24, "    7    "])
def test_a_decimal(field: str) -> None:
    assert decode(f"{field}\n".encode(), 1).values.tolist() == [[float(field)]]


@pytest.mark.parametrize(
    "field", ["nan", "-inf", "1_0", "-", ".", "1e400", "1.1e12", "0x1", "1 2", "0" * 17, "." + "3" * 25]
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
    assert (decoded.bad_lines, decoded.bad_bytes) == (1, 301 + 266 + 257 + 257)


def stream(sequence: bool = True, axes: int = 1) -> LineStream:
    listening = LineStream(Cutter("device", 100.0), axes, sequence=sequence, longest_gap=1000)
    listening.feed(b"\n", 0, 0)
    return listening


def feed(listening: LineStream, *bursts: bytes) -> list[SampleBlock]:
    for number, burst in enumerate(bursts):
        listening.feed(burst, 1000 * (number + 1), 5000 + 1000 * (number + 1))
    return listening.blocks()


def shape(blocks: list[SampleBlock]) -> list[tuple[int, int, BlockFlags]]:
    return [(block.first_index, block.n, block.flags) for block in blocks]


def numbered(*numbers: int) -> bytes:
    return b"".join(b"%d,%d\n" % (number, number) for number in numbers)


NONE, GAP, RESTART = BlockFlags.NONE, BlockFlags.GAP, BlockFlags.RESTART


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ([5, 6, 7], [(0, 3, RESTART)]),
        ([5, 6, 9, 10], [(0, 2, RESTART), (4, 2, GAP)]),
        ([5, 6, 1007], [(0, 2, RESTART), (1002, 1, GAP)]),
        ([5, 6, 1008], [(0, 2, RESTART), (2, 1, RESTART)]),
        ([5, 6, 6, 7], [(0, 2, RESTART), (2, 2, RESTART)]),
        ([5, 6, 0, 1], [(0, 2, RESTART), (2, 2, RESTART)]),
        ([5, 7, 9], [(0, 1, RESTART), (2, 1, GAP), (4, 1, GAP)]),
    ],
)
def test_sequence(numbers: list[int], expected: list[tuple[int, int, BlockFlags]]) -> None:
    assert shape(feed(stream(), numbered(*numbers))) == expected
    # cut anywhere into blocks, the result is the same
    for cut in range(1, len(numbers)):
        listening = stream()
        blocks = feed(listening, numbered(*numbers[:cut])) + feed(listening, numbered(*numbers[cut:]))
        joints = {(block.first_index, block.flags) for block in blocks if block.flags}
        assert joints == {(first, flags) for first, _, flags in expected}
        assert [int(value) for block in blocks for value in block.indications[:, 0]] == numbers


@pytest.mark.parametrize("bad", [b"-1,2\n", b"1.5,2\n", b"1e-3,2\n"])
def test_a_sequence_number_is_a_whole_number(bad: bytes) -> None:
    listening = stream()
    assert shape(feed(listening, numbered(1, 2) + bad + numbered(3))) == [(0, 3, RESTART)]
    assert listening.take_drops() == [Drop(1, "lines", "line without the expected decimal numbers")]


def test_arrivals_belong_to_the_burst_that_ends_the_line() -> None:
    (block,) = feed(stream(), b"1,1\n2,", b"2", b"\n3,3\n4,4\n5", b",5\n")
    assert block.burst_count.tolist() == [1, 4, 5]
    assert block.burst_t_monotonic_ns.tolist() == [1000, 3000, 4000]
    assert block.t_utc_ns == 9000


def test_a_gap_inside_a_burst_splits_it_and_keeps_its_arrival() -> None:
    first, second = feed(stream(), numbered(1, 2), numbered(3, 6), numbered(7))
    assert (first.burst_count.tolist(), first.burst_t_monotonic_ns.tolist()) == ([2, 3], [1000, 2000])
    assert (second.burst_count.tolist(), second.burst_t_monotonic_ns.tolist()) == ([1, 2], [2000, 3000])
    assert (first.t_utc_ns, second.t_utc_ns) == (7000, 8000)


def test_without_sequence_a_bad_line_restarts_at_its_place() -> None:
    listening = stream(sequence=False)
    blocks = feed(listening, b"1\n2\nx\n3\n", b"# fine\n4\n", b"5\nbad\nworse\n")
    assert shape(blocks) == [(0, 2, RESTART), (2, 3, RESTART)]
    assert shape(feed(listening, b"6\n")) == [(5, 1, RESTART)]
    assert listening.take_drops() == [Drop(3, "lines", "line without the expected decimal numbers")]


@pytest.mark.parametrize("rest", [b"", b"3", b"123,123", b"x" * 5000])
def test_the_line_within_which_the_port_was_opened_is_no_loss(rest: bytes) -> None:
    listening = LineStream(Cutter("device", 100.0), 1, sequence=True, longest_gap=1000)
    assert shape(feed(listening, rest, b"\n7,7\n8,8\n")) == [(0, 2, RESTART)]
    assert listening.take_drops() == []


def test_a_new_port_begins_anew_and_the_index_goes_on() -> None:
    listening = stream()
    feed(listening, numbered(1, 2) + b"3,")
    listening.begin()
    assert shape(feed(listening, b"9\n", numbered(4, 5))) == [(2, 2, RESTART)]


def damage(text: bytes, rng: np.random.Generator) -> bytes:
    """Flip a bit, remove a byte, double one, insert one, or remove a piece."""
    kind, place, bit, other, piece = rng.integers(0, (5, len(text), 8, 256, 40)).tolist()
    before, at, after = text[:place], text[place], text[place + 1 :]
    match kind:
        case 0:
            return before + bytes([at ^ 1 << bit]) + after
        case 1:
            return before + after
        case 2:
            return before + bytes([at, at]) + after
        case 3:
            return before + bytes([other, at]) + after
        case _:
            return before + text[place + piece :]


@pytest.mark.parametrize("sequence", [True, False])
def test_a_hundred_thousand_damaged_bursts(sequence: bool) -> None:
    # 50 000 each: no exception, only finite numbers, increasing indices, nothing is held back, most lines are decoded.
    rng = np.random.default_rng(20240601)
    listening = stream(sequence)
    intact = [b"%d,%.3f\n" % (k, math.sin(k)) if sequence else b"%.3f\n" % math.sin(k) for k in range(8)]
    text = b"".join(intact)
    next_index = samples = 0
    for burst in range(50_000):
        listening.feed(damage(text, rng), burst, burst)
        if burst % 50 == 49:
            for block in listening.blocks():
                assert np.isfinite(block.indications).all()
                assert block.first_index >= next_index
                assert block.burst_count[-1] == block.n > 0
                next_index = block.first_index + block.n
                samples += block.n
            assert sum(drop.count for drop in listening.take_drops()) > 0
            assert len(listening._tail) <= 256
            assert listening.size == 0
    # A removed piece destroys up to five of eight lines, the other damages one line
    assert samples > 0.6 * 50_000 * len(intact)
