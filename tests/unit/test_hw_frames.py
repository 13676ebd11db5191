"""Frames compared with byte pairs and with a simple parser; any bytes can be fed into every stream of frames."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from hw import witmotion_frames as wit
from hw.block import BlockFlags
from hw.cutting import Cutter, follow
from hw.frames import CHECKSUMS, ChecksumName, Layout, NumberType, find, numbers
from hw.serial_binary import BinaryStream, SerialBinaryOptions
from hw.virtual.witmotion_twin import frame
from hw.witmotion import WitMotionOptions, WitStream

LAYOUT = Layout(b"\xaa\x55", 6, "sum8")


@pytest.mark.parametrize(
    ("name", "value"),
    # published check values for "123456789"
    [("sum8", 0xDD), ("xor8", 0x31), ("crc16-ccitt", 0x29B1), ("crc16-modbus", 0x4B37), ("none", 0)],
)
def test_checksums(name: ChecksumName, value: int) -> None:
    assert CHECKSUMS[name][1](b"123456789", "little") == value


def test_sum_of_words() -> None:
    # Worked by hand: 8001 + FFFF + 0003 = 18003 hexadecimal; the bytes of each word exchanged: 0180 + FFFF + 0300
    words = bytes.fromhex("8001 ffff 0003")
    assert CHECKSUMS["sum16"][1](words, "big") == 0x8003
    assert CHECKSUMS["sum16"][1](words, "little") == 0x047F


@pytest.mark.parametrize(
    "packet",
    [
        "7565 0102 0202 e1c7",  # MIP: set to idle
        "7565 0102 0201 e0c6",  # MIP: ping
    ],
)
def test_fletcher_of_whole_packets(packet: str) -> None:
    # Worked by hand for the ping: a = 75 DA DB DD DF E0, b = 75 14F 22A 307 3E6 4C6
    data = bytes.fromhex(packet)
    assert CHECKSUMS["fletcher16"][1](data[:-2], "little").to_bytes(2, "little") == data[-2:]


@pytest.mark.parametrize(
    ("kind", "data", "little", "big"),
    [
        ("u8", "ff", 255, 255),
        ("i8", "ff", -1, -1),
        ("u16", "ff80", 0x80FF, 0xFF80),
        ("i16", "ff80", -32513, -128),
        ("i24", "000080", -(2**23), 128),
        ("i24", "ffff7f", 2**23 - 1, -129),
        ("u32", "01000000", 1, 2**24),
        ("i32", "ffffffff", -1, -1),
        ("f32", "0000c03f", 1.5, np.array([0x0000C03F], np.uint32).view(np.float32)[0]),
    ],
)
def test_numbers(kind: NumberType, data: str, little: float, big: float) -> None:
    frames = np.frombuffer(b"\x11" + bytes.fromhex(data) + b"\x22", np.uint8)[None]
    assert numbers(frames, 1, kind, "little").tolist() == [little]
    assert numbers(frames, 1, kind, "big").tolist() == [big]


def closed(body: bytes) -> bytes:
    return body + bytes([sum(body) & 0xFF])


pieces = st.lists(
    st.one_of(
        st.binary(min_size=3, max_size=3).map(lambda payload: closed(b"\xaa\x55" + payload)),
        st.binary(min_size=1, max_size=8),
        st.just(b"\xaa"),
        st.just(b"\xaa\x55\xaa\x55"),
    ),
    max_size=20,
)


def plain_reading(data: bytes) -> tuple[list[int], int]:
    """Ends of the frames, and the position from which the bytes may still become a frame."""
    ends, at = list[int](), 0
    while at < len(data):
        whole = data[at : at + 6]
        if len(whole) < 6 and (whole.startswith(b"\xaa\x55") or whole == b"\xaa"):
            return ends, at
        if len(whole) == 6 and whole.startswith(b"\xaa\x55") and sum(whole[:5]) & 0xFF == whole[5]:
            at += 6
            ends.append(at)
        else:
            at += 1
    return ends, at


@given(pieces)
def test_frames_as_a_plain_reading(parts: list[bytes]) -> None:
    data = b"".join(parts)
    ends, rest_at = plain_reading(data)
    found = find(data, LAYOUT)
    assert found.end.tolist() == ends
    assert found.rest == data[rest_at:]
    assert found.dropped == rest_at - 6 * len(ends)
    starts = [end - 6 for end in ends]
    befores = [0, *ends]
    assert found.slipped.tolist() == [a != b for a, b in zip([*starts, rest_at], befores, strict=True)]
    assert [bytes(frame) for frame in found.frames] == [data[at : at + 6] for at in starts]


@given(pieces, st.integers(0, 200))
def test_a_stream_cut_anywhere_reads_as_one(parts: list[bytes], cut: int) -> None:
    data = b"".join(parts)
    one = find(data[:cut], LAYOUT)
    two = find(one.rest + data[cut:], LAYOUT)
    whole = find(data, LAYOUT)
    assert [*map(bytes, one.frames), *map(bytes, two.frames)] == [*map(bytes, whole.frames)]
    assert one.dropped + two.dropped == whole.dropped


def test_steps_of_a_count() -> None:
    breaks = follow(np.array([1, 3, 0, 1, 11, 12, -1]), longest_gap=10)
    assert [(b.at, b.flags, b.missing) for b in breaks] == [
        (1, BlockFlags.GAP, 2),
        (2, BlockFlags.RESTART, 0),
        (4, BlockFlags.GAP, 10),
        (5, BlockFlags.RESTART, 0),
        (6, BlockFlags.RESTART, 0),
    ]


def test_witmotion_bytes() -> None:
    assert wit.write(0x03, 0x0B).hex(" ") == "ff aa 03 0b 00"
    assert wit.write(wit.KEY, wit.UNLOCK).hex(" ") == "ff aa 69 88 b5"
    assert wit.ask(0x02).hex(" ") == "ff aa 27 02 00"
    sent = bytes.fromhex("55 51 01 00 ff ff 00 80 c7 09")
    data = np.frombuffer(closed(sent), np.uint8)[None]
    assert wit.counts(data).tolist() == [[1, -1, -32768]]
    assert wit.temperature(data[0]) == (2503, 25.03)
    assert frame(0x51, 1, -1, -32768, 2503) == closed(sent)
    # 23:59:59.995, and 5 ms later on the next day
    late = np.frombuffer(frame(0x50, 24 | 1 << 8, 1 | 23 << 8, 59 | 59 << 8, 995), np.uint8)
    early = np.frombuffer(frame(0x50, 24 | 1 << 8, 2, 0, 0), np.uint8)
    times_ms = wit.milliseconds(np.stack([late, early]))
    assert times_ms.tolist() == [86_399_995, 0]
    assert wit.steps(times_ms, 200.0).tolist() == [1]


def options(**changes: object) -> dict[str, object]:
    known: dict[str, object] = {"port": "p", "rate_hz": 100.0, "start": "aa55", "length": 12, "checksum": "sum8"}
    return known | {"indications": [{"at": at, "type": "i16"} for at in (3, 5, 7)]} | changes


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"length": 8}, "the i16 at 7 ends at byte 9; in a frame of 8 bytes numbers must end at 7 or before"),
        ({"indications": [{"at": 2, "type": "u8"}] * 2}, "1 or 3 numbers are needed, not 2"),
        ({"sequence": {"at": 2, "type": "i8"}}, "type must be u8, u16 or u32, not i8"),
        ({"rate_hz": 1000.0}, "1000 frames/s of 12 bytes, 10 bits each, are 120000 bit/s; baud_rate is only 115200"),
        ({"start": "aa5"}, "two hexadecimal digits each"),
        ({"temperature": {"at": 9, "type": "i16", "counts_per_degc": 0.0}}, "0 counts per degree"),
    ],
)
def test_frames_that_cannot_be_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        SerialBinaryOptions.model_validate(options(**changes))


def test_witmotion_refuses_what_its_port_cannot_carry() -> None:
    with pytest.raises(
        ValidationError, match="100 samples/s of 22 bytes, 10 bits each, are 22000 bit/s; baud_rate is only 9600"
    ):
        WitMotionOptions.model_validate({"port": "p", "baud_rate": 9600})
    with pytest.raises(ValidationError, match="60 Hz is not a rate of this device; use one of 200, 100"):
        WitMotionOptions.model_validate({"port": "p", "rate_hz": 60.0})


def binary_stream(**changes: object) -> BinaryStream:
    return BinaryStream(Cutter("s", 100.0), SerialBinaryOptions.model_validate(options(**changes)))


frames_of_wit = st.one_of(
    st.tuples(st.sampled_from([0x50, 0x51, 0x52, 0x5F]), *[st.integers(0, 0xFFFF)] * 4).map(lambda args: frame(*args)),
    st.binary(max_size=30),
)


@pytest.mark.slow
@given(st.lists(st.lists(frames_of_wit, max_size=8).map(b"".join), max_size=6))
def test_any_bytes_pass_through_the_witmotion_stream(bursts: list[bytes]) -> None:
    stream = WitStream(Cutter("s", 200.0), 200.0)
    samples = 0
    for i, burst in enumerate(bursts):
        if burst:
            stream.feed(burst, i + 1, i + 1)
        for block in stream.blocks():
            samples += block.n
            assert block.burst_count[-1] == block.n
    assert samples <= sum(map(len, bursts)) // 22


frames_of_binary = st.one_of(
    st.binary(min_size=9, max_size=9).map(lambda payload: closed(b"\xaa\x55" + payload)), st.binary(max_size=30)
)


@pytest.mark.one_case
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"sequence": {"at": 2, "type": "u8"}},
        {"indications": [{"at": 3, "type": "f32"}], "temperature": {"at": 7, "type": "f32"}},
        {"indications": [{"at": 3, "type": "f32"}], "sequence": {"at": 7, "type": "u32"}},
    ],
)
@given(bursts=st.lists(st.lists(frames_of_binary, max_size=8).map(b"".join), max_size=6))
def test_any_bytes_pass_through_the_binary_stream(changes: dict[str, object], bursts: list[bytes]) -> None:
    stream = binary_stream(**changes)
    index = 0
    for i, burst in enumerate(bursts):
        if burst:
            stream.feed(burst, i + 1, i + 1)
        for block in stream.blocks():
            assert np.isfinite(block.indications).all()
            assert block.first_index >= index
            index = block.first_index + block.n
            assert bool(block.flags & BlockFlags.GAP) <= (changes.get("sequence") is not None)


def test_a_number_that_is_none_is_no_sample() -> None:
    stream = binary_stream(indications=[{"at": 3, "type": "f32"}])
    good = closed(b"\xaa\x55\x00" + np.float32(1.5).tobytes() + bytes(4))
    bad = closed(b"\xaa\x55\x00" + np.float32(np.nan).tobytes() + bytes(4))
    stream.feed(good + bad + good, 1, 1)
    first, second = stream.blocks()
    assert (first.n, second.n, second.flags) == (1, 1, BlockFlags.RESTART)


def test_garbage_at_the_end_of_a_block_is_told_in_the_next() -> None:
    stream = binary_stream()
    good = closed(b"\xaa\x55" + bytes(9))
    stream.feed(good + b"\x00\x00", 1, 1)
    (first,) = stream.blocks()
    stream.feed(good, 2, 2)
    (second,) = stream.blocks()
    assert (first.flags, second.flags) == (BlockFlags.RESTART, BlockFlags.RESTART)
    assert second.first_index == 1
