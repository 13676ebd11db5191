"""Blocks of lines of text: what is missing, what is dropped, and why."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hw.block import BlockFlags, Drop, SampleBlock
from hw.cutting import Break, Cutter
from hw.line_columns import Column, DeviceTime, columns_of, kind_of
from hw.line_stream import LineStream
from hw.lines import UNREADABLE

X_Y_Z = columns_of(3, sequence=False)


def stream(sequence: bool = True, columns: tuple[Column, ...] | None = None, rate_hz: float = 100.0) -> LineStream:
    listening = LineStream(Cutter("device", rate_hz), columns or columns_of(1, sequence), longest_gap=10 * rate_hz)
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


@pytest.mark.parametrize("damaged", [30, 0, 1029, 1034, 1530, 10301031, -1030])
def test_a_damaged_counter_between_two_good_ones_is_a_line_lost_and_no_gap_of_another_length(damaged: int) -> None:
    listening = stream()
    told = feed(listening, numbered(1028, 1029, damaged, 1031, 1032))
    assert shape(told) == [(0, 2, RESTART), (3, 2, GAP)]
    assert listening.take_drops() == [
        Drop(1, "lines", "line whose sample counter (seq) fits neither the line before nor the one behind")
    ]


def test_after_a_damaged_counter_at_the_end_of_a_stretch_nothing_is_counted() -> None:
    listening = stream()
    first, second = feed(listening, numbered(1028, 1029, 30)), feed(listening, numbered(1031, 1032))
    assert shape(first + second) == [(0, 2, RESTART), (2, 1, RESTART), (3, 2, RESTART)]


@pytest.mark.parametrize("bad", [b"1.5,2\n", b"1e-3,2\n"])
def test_a_sequence_number_is_a_whole_number(bad: bytes) -> None:
    listening = stream()
    assert shape(feed(listening, numbered(1, 2) + bad + numbered(3))) == [(0, 3, RESTART)]
    assert listening.take_drops() == [Drop(1, "lines", "line whose sample counter (seq) is not a whole number")]


@pytest.mark.parametrize(("value", "samples"), [(b"1e12", 3), (b"1.1e12", 2), (b"-1.1e12", 2)])
def test_no_indication_is_beyond_the_largest(value: bytes, samples: int) -> None:
    listening = stream(sequence=False)
    blocks = feed(listening, b"1\n" + value + b"\n3\n")
    assert sum(block.n for block in blocks) == samples
    assert [block.flags for block in blocks] == [RESTART] * (4 - samples), "a lost line is a restart"
    assert listening.take_drops() == [Drop(1, "lines", UNREADABLE)][: 3 - samples]


@pytest.mark.parametrize(
    ("rate_hz", "numbers", "expected"),
    [
        # A counter of 8 bits at 20 Hz wraps after 12.8 s: a gap of at most 10 s has a known length
        (20, [254, 255, 0, 1], [(0, 4, RESTART)]),
        (20, [254, 255, 0, 1, 4], [(0, 4, RESTART), (6, 1, GAP)]),
        # at 100 Hz it wraps after 2.56 s, so 2 samples may be missing or 258
        (100, [254, 255, 0, 1, 4], [(0, 4, RESTART), (4, 1, RESTART)]),
        (100, [65534, 65535, 0, 1, 4], [(0, 4, RESTART), (6, 1, GAP)]),
        (100, [32766, 32767, -32768, -32767, -32764], [(0, 4, RESTART), (6, 1, GAP)]),
        (100, [127, -128, -127], [(0, 3, RESTART)]),
        (100, [2**32 - 1, 0, 1], [(0, 3, RESTART)]),
        (100, [2**31 - 1, -(2**31), 1 - 2**31], [(0, 3, RESTART)]),
        # no wraps: a board that started again, a number that was damaged, a wrap within which a line was lost
        (100, [253, 254, 0, 1], [(0, 2, RESTART), (2, 2, RESTART)]),
        (100, [300, 45, 46], [(0, 1, RESTART), (1, 2, RESTART)]),
        (100, [254, 255, 1, 2], [(0, 2, RESTART), (2, 2, RESTART)]),
        (100, [98, 99, 0, 1], [(0, 2, RESTART), (2, 2, RESTART)]),
    ],
)
def test_a_counter_begins_again(
    rate_hz: float, numbers: list[int], expected: list[tuple[int, int, BlockFlags]]
) -> None:
    assert shape(feed(stream(rate_hz=rate_hz), numbered(*numbers))) == expected


def timed(*times: float) -> bytes:
    return b"".join(b"%.16g,1\n" % t for t in times)


@pytest.mark.parametrize(
    ("column", "times", "expected"),
    [
        ("millis", [70, 80, 91, 100], [(0, 4, RESTART)]),
        ("millis", [70, 80, 110, 120], [(0, 2, RESTART), (4, 2, GAP)]),
        ("millis", [70, 80, 180], [(0, 2, RESTART), (11, 1, GAP)]),
        # 25 periods at a rate that may be 2 % wrong: 24 or 25
        ("millis", [70, 80, 330], [(0, 2, RESTART), (2, 1, RESTART)]),
        ("millis", [70, 80, 80, 90], [(0, 2, RESTART), (2, 2, RESTART)]),
        ("millis", [70, 80, 0, 10], [(0, 2, RESTART), (2, 2, RESTART)]),
        ("millis", [2**32 - 10, 0, 10], [(0, 3, RESTART)]),
        ("millis", [2**31 - 5, 5 - 2**31, 15 - 2**31], [(0, 3, RESTART)]),
        ("millis", [1.7e12, 1.7e12 + 10, 1.7e12 + 30], [(0, 2, RESTART), (3, 1, GAP)]),
        ("micros", [70000.5, 80000.25, 110000, 120000], [(0, 2, RESTART), (4, 2, GAP)]),
        ("micros", [1.7e15, 1.7e15 + 1e4, 1.7e15 + 2e4], [(0, 3, RESTART)]),
    ],
)
def test_a_time_tells_what_is_missing(
    column: Column, times: list[float], expected: list[tuple[int, int, BlockFlags]]
) -> None:
    assert shape(feed(stream(columns=(column, "a")), timed(*times))) == expected


def test_milliseconds_at_1_khz_do_not_tell_one_sample() -> None:
    listening = stream(columns=("millis", "a"), rate_hz=1000.0)
    assert shape(feed(listening, timed(5, 6, 6, 8, 9, 14, 15))) == [(0, 5, RESTART), (5, 2, RESTART)]


def test_a_late_sample_of_a_device_that_keeps_its_schedule() -> None:
    """16 ms is nearer to two periods than to one. The next sample, 4 ms later, tells that none was missing."""
    listening = stream(columns=("micros", "a"))
    assert shape(feed(listening, timed(0, 10_000, 26_000, 30_000))) == [
        (0, 2, RESTART), (3, 1, GAP), (4, 1, RESTART),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("columns", "lines", "reason"),
    [
        (("seq", "x", "y", "z"), [b"%d,0.1,0.2,9.8" % (10 * k) for k in range(3912)], "it is a time; set columns = "
         '["millis", "x", "y", "z"]'),
        (("seq", "x", "y", "z"), [b"%d,0.1,0.2,9.8" % (10_000 * k) for k in range(3912)], '["micros", "x", "y", "z"]'),
        (("seq", "a"), [b"%d,1" % (2 * k) for k in range(3912)], "the sample counter does not rise by one"),
        (("seq", "a"), [b"0,1"] * 3912, "the sample counter does not rise by one"),
        (("millis", "a"), [b"%d,1" % (80 * k) for k in range(3912)], "does not rise as at rate_hz = 100"),
        (("a",), [b"1", b"gyro"] * 3912, "samples among lines that cannot be read"),
    ],
)  # fmt: skip
def test_a_stream_of_gaps_is_told_and_makes_no_blocks(
    columns: tuple[Column, ...], lines: list[bytes], reason: str
) -> None:
    """The agent's queue holds 60 blocks of a device; such a stream made 3912 of one sample each."""
    listening = stream(columns=columns)
    blocks: list[SampleBlock] = []
    for begin in range(0, len(lines), 50):
        blocks += feed(listening, b"\n".join(lines[begin : begin + 50]) + b"\n")
    drops = [drop for drop in listening.take_drops() if drop.unit == "samples"]
    assert blocks == []
    assert [(drop.count, reason in drop.reason) for drop in drops] == [(3912, True)]


def test_a_slow_stream_of_gaps_is_told_too() -> None:
    """At 4 Hz half a second has two samples: eight gaps in a row are enough."""
    listening = stream(rate_hz=4.0)
    blocks = [block for k in range(40) for block in feed(listening, numbered(500 * k, 500 * k + 250))]
    assert len(blocks) == 10
    (drop,) = listening.take_drops()
    assert (drop.unit, drop.count) == ("samples", 80 - len(blocks))
    assert 'set columns = ["millis", "a"]' in drop.reason


def test_after_a_dropped_stretch_samples_restart() -> None:
    listening = stream()
    feed(listening, numbered(1, 2, 3))
    assert feed(listening, numbered(*range(10, 60, 2))) == []
    assert shape(feed(listening, numbered(59, 60, 61))) == [(3, 3, RESTART)]
    assert [(drop.count, drop.unit) for drop in listening.take_drops()] == [(25, "samples")]


def test_eight_losses_in_half_a_second_are_gaps() -> None:
    numbers = [k for k in range(50) if k % 6 != 5]
    blocks = feed(stream(), numbered(*numbers))
    assert [(block.n, block.flags) for block in blocks] == [(5, RESTART), *[(5, GAP)] * 7, (2, GAP)]


@pytest.mark.parametrize(
    ("degrees", "degc"), [(["20", "23.5"], 23.5), (["23.5", "-127"], None), (["23.5", "1e9"], None)]
)
def test_the_temperature_of_the_last_line(degrees: list[str], degc: float | None) -> None:
    text = "".join(f"0.1 0.2 9.8 {of}\n" for of in degrees).encode()
    (block,) = feed(stream(columns=("x", "y", "z", "temperature")), text)
    assert block.temperature_degc == degc
    assert block.indications.tolist() == [[0.1, 0.2, 9.8]] * 2
    assert feed(stream(columns=X_Y_Z), b"1,2,3\n")[0].temperature_degc is None


def test_axes_are_found_by_name() -> None:
    (block,) = feed(stream(columns=("z", "-", "x", "seq", "y")), b"9.8,ok,0.1,7,0.2\n")
    assert block.indications.tolist() == [[0.1, 0.2, 9.8]]


@pytest.mark.parametrize("ending", [b"\n", b"\r\n", b"\r", b"\n\r", b"\r\r\n"])
def test_any_end_of_line_cut_anywhere(ending: bytes) -> None:
    text = b"".join(b"%d,%d%s" % (k, k, ending) for k in range(4))
    for cut in range(len(text)):
        blocks = feed(stream(), text[:cut], text[cut:])
        assert shape(blocks) == [(0, 4, RESTART)], (ending, cut)


BOOT = b"""ets Jun  8 2016 00:22:57

rst:0x1 (POWERON_RESET),boot:0x13 (SPI_FAST_FLASH_BOOT)
configsip: 0, SPIWP:0xee
mode:DIO, clock div:1
load:0x3fff0030,len:1344
entry 0x400805f0
ax,ay,az
OK
"""  # an ESP32's, as in the threads of espressif/arduino-esp32


def test_a_board_that_starts_again_costs_one_restart() -> None:
    for sequence in (True, False):
        listening = stream(sequence)
        one = [b"%d,7\n" % k if sequence else b"7\n" for k in range(20)]
        blocks = feed(listening, b"".join(one) + b"\x00\x00\xff" + BOOT.replace(b"\n", b"\r\n") + b"".join(one))
        assert shape(blocks) == [(0, 20, RESTART), (20, 20, RESTART)]
        assert sum(drop.count for drop in listening.take_drops()) == 8


@pytest.mark.parametrize(
    ("kind", "rate_hz", "values"),
    [
        ("seq", 100, [k % 256 for k in range(300)]),
        ("seq", 100, [k for k in range(300) if k % 20]),
        ("seq", 100, [5000, 5001, *range(300)]),
        ("seq", 1000, list(range(300))),
        ("seq", 100, [(k + 2**15 - 100) % 2**16 - 2**15 for k in range(300)]),
        ("millis", 100, [10 * k + (k % 3) for k in range(300)]),
        ("millis", 98.7, [10 * k for k in range(300)]),
        ("millis", 1000, [k - (k % 7 == 3) for k in range(300)]),
        ("micros", 1000, [(2**32 - 1500 + 1000 * k) % 2**32 for k in range(300)]),
        (None, 100, [0] * 300),
        (None, 100, [10 * (k % 20) for k in range(300)]),
        (None, 100, [2 * k for k in range(300)]),
        (None, 100, [k % 100 * (k % 2) for k in range(300)]),
        (None, 100, [20 + 1e-3 * k for k in range(300)]),
        (None, 100, [math.sin(k) for k in range(300)]),
        (None, 100, [round(1000 * math.sin(k / 50)) for k in range(300)]),
        (None, 100, [1, 2]),
    ],
)
def test_what_a_column_is(kind: str | None, rate_hz: float, values: list[float]) -> None:
    assert kind_of(np.array(values, float), rate_hz) == kind


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
    listening = LineStream(Cutter("device", 100.0), ("seq", "a"), longest_gap=1000)
    assert shape(feed(listening, rest, b"\n7,7\n8,8\n")) == [(0, 2, RESTART)]
    assert listening.take_drops() == []


def test_a_new_port_begins_anew_and_the_index_goes_on() -> None:
    listening = stream()
    feed(listening, numbered(1, 2) + b"3,")
    listening.begin()
    assert shape(feed(listening, b"9\n", numbered(4, 5))) == [(2, 2, RESTART)]


def test_a_gap_in_the_device_s_time_has_at_most_the_samples_that_are_filled() -> None:
    """At 10 ticks a sample: 1 and 3 samples are missing, then 4, where 3 are the most."""
    found = DeviceTime(1000.0, 100.0, 3).breaks(np.array([10.0, 20.0, 40.0, 50.0, 90.0, 100.0, 150.0]))
    assert found == [Break(2, GAP, 1), Break(4, GAP, 3), Break(6, RESTART)]


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sequence", "bursts"),
    [(True, 10_000), *(pytest.param(k, 50_000, marks=pytest.mark.thorough) for k in (True, False))],
)
def test_damaged_bursts(sequence: bool, bursts: int) -> None:
    # No exception, only finite numbers, increasing indices, nothing is held back, most lines are decoded.
    # In every second half second each burst is damaged: then all lines are dropped, since no blocks of use remain.
    rng = np.random.default_rng(20240601)
    listening = stream(sequence)
    next_index = samples = dropped = bad = 0
    for burst in range(bursts):
        texts = [
            b"%d,%.3f\n" % (k, math.sin(k)) if sequence else b"%.3f\n" % math.sin(k)
            for k in range(8 * burst, 8 * burst + 8)
        ]
        text = b"".join(texts)
        listening.feed(damage(text, rng) if burst // 50 % 2 or burst % 25 == 0 else text, burst, burst)
        if burst % 50 == 49:
            for block in listening.blocks():
                assert np.isfinite(block.indications).all()
                assert block.first_index >= next_index
                assert block.burst_count[-1] == block.n > 0
                next_index = block.first_index + block.n
                samples += block.n
            drops = listening.take_drops()
            dropped += sum(drop.count for drop in drops if drop.unit == "samples")
            bad += sum(drop.count for drop in drops if drop.unit == "lines")
            assert len(listening._tail) <= 256
            assert listening.size == 0
    # A removed piece destroys up to five of eight lines, the other damages one line
    assert samples > 0.9 * bursts * 4
    assert dropped > 0.6 * bursts * 4
    assert bad > 0.2 * bursts
