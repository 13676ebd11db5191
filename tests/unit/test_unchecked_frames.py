"""Frames without a checksum: a place in the stream is taken only where it is the one that fits."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hw.block import BlockFlags
from hw.cutting import Cutter
from hw.frames import CHECKSUMS, Layout, numbers
from hw.serial_binary import BinaryStream, SerialBinaryOptions
from hw.unchecked_frames import UncheckedFrames

RATE_HZ = 200.0
AXES = [{"at": at, "type": "i32"} for at in (5, 9, 13)]
COUNTED = {"sequence": {"at": 17, "type": "u16"}}
CLOSED = {"end": "0d"}
SUMMED: dict[str, Any] = {"end": "0d", "length": 22, "checksum": "sum16", "checksum_from": 1, "checksum_order": "big"}
FLETCHER: dict[str, Any] = {"start": "8065", "length": 22, "checksum": "fletcher16"}


def axes(n: int) -> list[tuple[int, ...]]:
    """Indications of n samples; each sample has others."""
    return [(16_000_000 + 97 * k, -1_000_003 * (k % 16) - k, 0x0102_0304 ^ k) for k in range(n)]


def epson(n: int, *, summed: bool = False) -> list[bytes]:
    """Frames of an M-A352: 80, temperature, x, y, z, count, checksum where asked, 0D.

    The last byte of the temperature (0980, 25.8 degC) is 80, as the first byte of the frame.
    """
    frames = []
    for k, indications in enumerate(axes(n)):
        body = struct.pack(">4iH", 0x0980, *indications, k % 65536)
        if summed:
            body += struct.pack(">H", sum(struct.unpack(">9H", body)) % 65536)
        frames.append(b"\x80" + body + b"\r")
    return frames


def stream(**changes: object) -> BinaryStream:
    known: dict[str, object] = {"port": "p", "rate_hz": RATE_HZ, "baud_rate": 460800, "start": "80", "length": 20}
    options = known | {"byte_order": "big", "indications": AXES} | changes
    return BinaryStream(Cutter("s", RATE_HZ), SerialBinaryOptions.model_validate(options))


def read(data: bytes, *, piece: int = 1000, **changes: Any) -> tuple[list[tuple[int, ...]], int, BinaryStream]:
    """The indications that are handed on, and the number of bytes that are not, from the first one on."""
    made = stream(**changes)
    rows: list[tuple[int, ...]] = []
    for i in range(0, len(data), piece):
        made.feed(data[i : i + piece], i + 1, i + 1)
        rows += [tuple(row) for block in made.blocks() for row in block.indications.tolist()]
    return rows, sum(drop.count for drop in made.take_drops()), made


def test_a_byte_inside_that_looks_like_the_start() -> None:
    """The stream begins one byte late. Before, 1999 of 1999 samples were wrong, 3 bytes dropped, nothing told."""
    rows, _, made = read(b"".join(epson(2000))[1:])
    assert rows == []
    assert made.undecided.startswith("2 bytes of each 20 may be the start of a frame (80), in 19")


@pytest.mark.parametrize("changes", [CLOSED, COUNTED, CLOSED | COUNTED])
def test_what_tells_the_start(changes: dict[str, Any]) -> None:
    rows, dropped, made = read(b"".join(epson(2000))[1:], **changes)
    assert rows == axes(2000)[2 : 2000 - ("end" not in changes)]  # the first whole frame only proves the second
    assert (dropped, made.undecided) == (0, "")


def test_a_checksum_tells_the_start() -> None:
    rows, dropped, made = read(b"".join(epson(2000, summed=True))[1:], **SUMMED)
    assert rows == axes(2000)[1:]
    assert (dropped, made.undecided) == (0, "")


def test_the_place_is_told_as_soon_as_the_other_one_does_not_fit() -> None:
    frames = epson(400)
    frames[300] = frames[300].replace(b"\x09\x80", b"\x09\x81", 1)
    rows, dropped, made = read(b"".join(frames))
    assert rows == axes(400)[1:399]
    assert (dropped, made.undecided) == (0, "")


def counter(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Byte 1 of each frame."""
    return numbers(frames, 1, "u8", "little").astype(np.uint8)


def test_a_counter_rises_evenly() -> None:
    """At the other place stands a byte that is never twice the same, but does not count."""
    frames = [bytes([0x80, 3 * k % 256, 0x80, k * k % 251, 7]) for k in range(90)]
    search = UncheckedFrames(Layout(b"\x80", 5), counter)
    found = search.find(b"".join(frames)[1:])
    assert list(map(bytes, found.frames)) == frames[2:89]


@pytest.mark.slow
@pytest.mark.parametrize("changes", [COUNTED, CLOSED | COUNTED])
def test_two_halves_of_different_frames_are_no_sample(changes: dict[str, Any]) -> None:
    """Bytes were lost until the same byte of a later frame: start and end fit. The counter, which is behind the other
    numbers, does not."""
    frames, true = epson(60), axes(60)
    for cut in range(1, 19):  # from byte 19 on the whole of the numbers is of frame 20
        data = b"".join([*frames[:20], frames[20][:cut] + frames[25][cut:], *frames[26:]])
        rows, _, _ = read(data, piece=37, **changes)
        assert set(rows) <= set(true)
        assert not {true[k] for k in range(26, 59)} - set(rows)


def test_another_place_that_fits_after_a_loss_is_left_again() -> None:
    """Bytes are lost until the place that was taken is one at which the frames fit, too. Their counter does not."""
    frames = [bytes([0x80, 3 * k % 256, 0x80, k * k % 251, 7]) for k in range(90)]
    for piece in (7, 1000):
        search, rest, found = UncheckedFrames(Layout(b"\x80", 5), counter), b"", list[bytes]()
        data = b"".join(frames[:40]) + b"".join(frames[45:])[2:]
        for at in range(0, len(data), piece):
            new = search.find(rest + data[at : at + piece])
            rest, found = new.rest, [*found, *map(bytes, new.frames)]
        assert found == frames[1:40] + frames[48:89]  # 45 is cut, 46 and 47 are behind it


def damaged(frames: list[bytes], k: int, kind: str) -> Iterator[bytes]:
    """The stream with each byte of frame k lost, doubled, or with another byte before it."""
    whole, at = b"".join(frames), sum(map(len, frames[:k]))
    for i in range(at, at + len(frames[k])):
        if kind == "cut":
            yield whole[i:]
        elif kind == "lost":
            yield whole[:i] + whole[i + 1 :]
        elif kind == "flipped":
            yield from (whole[:i] + bytes([whole[i] ^ 1 << bit]) + whole[i + 1 :] for bit in range(8))
        else:
            yield from (whole[:i] + bytes([octet]) + whole[i:] for octet in (0x80, 0x0D, 0, 255, whole[i]))


@pytest.mark.two_cases
@pytest.mark.parametrize("kind", ["cut", "lost", "added"])
@pytest.mark.parametrize("changes", [CLOSED, COUNTED, CLOSED | COUNTED])
def test_the_way_is_found_within_two_frames(changes: dict[str, Any], kind: str) -> None:
    frames, true = epson(64), axes(64)
    for data in damaged(frames, 20, kind):
        rows, _, _ = read(data, piece=37, **changes)
        assert set(rows) <= set(true)
        assert rows[-1] == true[63 if "end" in changes else 62]
        before, behind = (20, 2) if kind == "cut" else (19, 3)  # frame 20 is damaged; 21 only proves 22
        lost = sorted(set(range(1 if before == 19 else 20, 63)) - {true.index(row) for row in rows})
        assert set(lost) <= set(range(before, 20 + behind))


@pytest.mark.two_cases
@pytest.mark.parametrize("kind", ["cut", "lost", "added", "flipped"])
@pytest.mark.parametrize("name", ["sum16", "fletcher16"])
def test_a_checksum_lets_no_damaged_frame_through(name: str, kind: str) -> None:
    frames, true, changes = epson(40, summed=True), axes(40), SUMMED
    if name == "fletcher16":
        bodies = [b"\x80\x65" + frame[2:20] for frame in frames]
        frames = [body + CHECKSUMS["fletcher16"][1](body, "little").to_bytes(2, "little") for body in bodies]
        changes = FLETCHER
    for data in damaged(frames, 20, kind):
        rows, _, _ = read(data, piece=37, **changes)
        assert set(rows) <= set(true)
        if kind == "cut":
            assert rows in (true[20:], true[21:])
        else:
            assert [row for row in true if row not in rows] in ([true[20]], [true[20], true[21]], [])


def test_bytes_between_frames_restart_the_clock_where_nothing_counts() -> None:
    frames = epson(40)
    made = stream(**CLOSED)
    made.feed(b"".join([*frames[:20], b"\x01\x02", *frames[20:]]), 1, 1)
    first, second = made.blocks()
    assert (first.n, second.n, second.flags) == (19, 19, BlockFlags.RESTART)  # frame 20 only proves frame 21


def test_each_sample_has_the_arrival_of_its_own_last_byte() -> None:
    """A frame that is found only when the next one begins arrived no later for that."""
    made, frames = stream(**COUNTED), epson(60)
    arrivals: dict[int, int] = {}
    for k, frame in enumerate(frames):
        made.feed(frame, 1000 + k, 1000 + k)
        for block in made.blocks():
            count = np.diff(block.burst_count, prepend=0)
            times = np.repeat(block.burst_t_monotonic_ns, count).tolist()
            arrivals |= {
                axes(60).index(tuple(row)): t for row, t in zip(block.indications.tolist(), times, strict=True)
            }
    assert arrivals == {k: 1000 + k for k in range(1, 59)}


@pytest.mark.slow
@given(st.lists(st.one_of(st.binary(max_size=12), st.sampled_from([b"\x80abcde\r" * 9, b"\x80\r"])), max_size=12),
       st.lists(st.integers(0, 300), max_size=5), st.sampled_from([b"", b"\r"]))  # fmt: skip
def test_a_stream_cut_anywhere_gives_the_same_frames(parts: list[bytes], cuts: list[int], end: bytes) -> None:
    data, layout = b"".join(parts), Layout(b"\x80", 7, end=end)
    whole = UncheckedFrames(layout).find(data)
    search, rest, frames, dropped = UncheckedFrames(layout), b"", [], 0
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    for begin, stop in itertools.pairwise(edges):
        found = search.find(rest + data[begin:stop])
        frames += list(map(bytes, found.frames))
        rest, dropped = found.rest, dropped + found.dropped
    assert frames == list(map(bytes, whole.frames))
    assert (rest, dropped) == (whole.rest, whole.dropped)
    assert 7 * len(frames) + dropped + len(rest) == len(data)


@pytest.mark.parametrize(
    ("changes", "advised"),
    [({}, True), ({"start": "8065"}, False), (CLOSED, False), (COUNTED, False), (SUMMED, False)],
)
def test_one_byte_that_tells_nothing_is_advised_against(changes: dict[str, Any], advised: bool) -> None:
    advice = stream(**changes)._options.advice
    assert bool(advice) == advised
    assert all("start is the single byte 80" in text and "state checksum, end or sequence" in text for text in advice)


@pytest.mark.parametrize("sequence", [{"at": 1, "type": "u16"}, {"at": 17, "type": "u8"}])
def test_frames_that_do_not_follow_each_other_are_told_and_make_no_blocks_of_one_sample(
    sequence: dict[str, object],
) -> None:
    frames = epson(500, summed=True)
    rows, dropped, made = read(b"".join(frames), piece=100 * len(frames[0]), **SUMMED, sequence=sequence)
    assert rows == []
    assert dropped == len(frames)
    made.feed(b"".join(frames[:100]), 6, 6)
    made.blocks()
    (drop,) = made.take_drops()
    assert (drop.count, drop.unit) == (100, "samples")
    assert "most samples do not follow the one before" in drop.reason


def test_a_stream_with_some_losses_is_read() -> None:
    frames = epson(500, summed=True)
    broken = [frame if k % 4 else frame[:-1] for k, frame in enumerate(frames)]
    rows, _, _ = read(b"".join(broken), piece=100 * len(frames[0]), **SUMMED)
    assert rows == [indications for k, indications in enumerate(axes(500)) if k % 4]
