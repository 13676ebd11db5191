"""Sample blocks on the wire: every bit comes back, in few bytes; bytes of a hostile file cost no more than an error."""

from __future__ import annotations

import tracemalloc
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.proto import fieldcal_pb2 as pb
from agent.recording.files import RecordingFile
from agent.recording.messages import MessageError, decode
from agent.recording.raw_block import decode_block, encode_block
from hw.block import SampleBlock
from hw.virtual.bench import Bench
from hw.virtual.presets import plain
from tests.replay.stand_in import CONFIG, StandIn, run_start

EXTREMES = [-(2**31), -(2**31) + 1, -1, 0, 1, 127, 128, 32767, 32768, 2**31 - 1]


def made(indications: Any, arrivals: Any = None, counts: Any = None) -> SampleBlock:
    n = len(indications)
    arrivals = np.arange(1, 3, dtype=np.int64) * 5_000_000 if arrivals is None else arrivals
    return SampleBlock(
        "acc", "boot", 7, 0, 1000.0, np.asarray(arrivals, np.int64),
        np.asarray([n // 2, n] if counts is None else counts, np.int32), np.asarray(indications),
    )  # fmt: skip


def wire(block: SampleBlock) -> pb.RawBlock:
    """The fields that are on the wire, after a check that all bits come back."""
    data = encode_block(3, block)
    number, back = decode_block(data)
    assert number == 3
    for name in ("indications", "burst_t_monotonic_ns", "burst_count"):
        sent, received = getattr(block, name), getattr(back, name)
        assert (sent.dtype, sent.shape, sent.tobytes()) == (received.dtype, received.shape, received.tobytes()), name
    return pb.RawBlock.FromString(data)


@given(
    axes=st.sampled_from([1, 3]),
    rows=st.lists(st.tuples(*3 * [st.integers(-(2**31), 2**31 - 1) | st.sampled_from(EXTREMES)]), min_size=1),
)
def test_counts_whose_differences_wrap_around_come_back(axes: int, rows: list[tuple[int, int, int]]) -> None:
    assert wire(made(np.array(rows, np.int32)[:, :axes])).order in (1, 2)


@given(places=st.integers(0, 9), whole=st.lists(st.integers(-(10**9), 10**9), min_size=1, max_size=60))
def test_decimals_of_a_text_are_whole_numbers_with_decimal_places(places: int, whole: list[int]) -> None:
    texts = [f"{Decimal(number).scaleb(-places):.{places}f}" for number in whole]
    message = wire(made(np.array([[float(text)] for text in texts])))
    assert (message.order > 0, len(message.x)) == (True, 0)
    assert message.decimal_places <= places


def test_a_negative_zero_stays_one() -> None:
    texts = ["-0.00", "0.00", "-0.01", "-0.00", "1.25", "-0.0", "0.5", "3", "-0.0"]
    message = wire(made(np.array([float(text) for text in texts]).reshape(3, 3)))
    assert (list(message.negative_zeros), message.decimal_places) == ([0, 3, 5, 8], 2)


@pytest.mark.parametrize(
    "values",
    [[np.nan], [np.inf, 1.0], [1e300], [5e-324], [2.0**31], [1 / 3], [0.1 + 0.2], [float(np.float32(0.1))], [1e-10]],
)
def test_other_decimals_keep_their_64_bits(values: list[float]) -> None:
    message = wire(made(np.array(values)[:, np.newaxis]))
    assert (message.order, message.differences, len(message.x)) == (0, b"", len(values))


@pytest.mark.parametrize(
    ("arrivals", "is_plain"),
    [
        ([-(2**63), -(2**63) + 2**31 - 1], False),
        ([0, 2**31], True),
        ([2**63 - 1, -(2**63)], False),  # the interval wraps around to 1
        ([5, 5 - 2**31], False),
        ([0, 2**40], True),
    ],
)
def test_arrivals_come_back_whatever_their_intervals(arrivals: list[int], is_plain: bool) -> None:
    assert bool(wire(made(np.zeros((4, 1), np.int32), arrivals)).burst_t_monotonic_ns) == is_plain


@pytest.mark.parametrize(("counts", "is_plain"), [([1, 2, 257], False), ([255, 510, 510], True), ([1, 257, 300], True)])
def test_bursts_of_more_than_255_samples_come_back(counts: list[int], is_plain: bool) -> None:
    message = wire(made(np.zeros((counts[-1], 1), np.int32), [1, 2, 3], counts))
    assert bool(message.burst_count) == is_plain


def test_slow_motion_takes_second_differences_and_noise_first_ones() -> None:
    noise = np.random.default_rng(1).integers(-100, 100, (500, 1)).astype(np.int32)
    motion = np.rint(1e5 * np.sin(np.arange(500) / 50))[:, np.newaxis].astype(np.int32)
    assert (wire(made(noise)).order, wire(made(noise + motion)).order) == (1, 2)


def test_no_samples_are_no_bytes() -> None:
    message = wire(made(np.empty((0, 3), np.int32)))
    assert (message.order, message.differences) == (0, b"")


@pytest.mark.parametrize("decimal", [False, True])
def test_blocks_of_older_files_are_read_as_before(decimal: bool) -> None:
    values = np.random.default_rng(2).integers(-(2**31), 2**31, (5, 3)) / (7.0 if decimal else 1)
    block = made(values if decimal else values.astype(np.int32))
    names = ("x", "y", "z") if decimal else ("x_counts", "y_counts", "z_counts")
    old = pb.RawBlock(
        event_sequence=3, device="acc", boot_id="boot", t_utc_ns=7, nominal_rate_hz=1000.0, axes=3, decimal=decimal,
        burst_t_monotonic_ns=block.burst_t_monotonic_ns.tolist(), burst_count=block.burst_count.tolist(),
        **dict(zip(names, block.indications.T.tolist(), strict=True)),
    )  # fmt: skip
    _, back = decode_block(old.SerializeToString())
    assert back.indications.tobytes() == block.indications.tobytes()
    assert back.indications.flags.c_contiguous
    assert back.burst_count.tolist() == [2, 5]
    assert back.burst_t_monotonic_ns.tolist() == [5_000_000, 10_000_000]


def test_the_message_with_byte_strings_has_the_bytes_of_the_schema() -> None:
    for values in (np.arange(12, dtype=np.int32), np.arange(12) / 8, -np.zeros(12), np.full(12, np.pi)):
        data = encode_block(7, made(values.reshape(4, 3)))
        assert pb.RawBlock.FromString(data).SerializeToString(deterministic=True) == data


def hostile(**changes: Any) -> bytes:
    """A block of four samples of one axis, with some fields changed."""
    fields: dict[str, Any] = {
        "axes": 1, "nominal_rate_hz": 1.0, "burst_sizes": b"\4", "order": 1, "first_values": [5], "differences": b"abc",
    }  # fmt: skip
    return pb.RawBlock(**(fields | changes)).SerializeToString()


def test_the_hostile_blocks_are_good_before_they_are_changed() -> None:
    assert decode_block(hostile())[1].indications[:, 0].tolist() == [5, 102, 200, 299]


@pytest.mark.parametrize(
    "changes",
    [
        {"axes": 0}, {"axes": 2}, {"axes": 2**32 - 1}, {"order": 3}, {"order": 2}, {"order": 2**32 - 1}, {"order": 0},
        {"differences": b""}, {"differences": b"ab"}, {"differences": b"abcd"}, {"differences": bytes(9)},
        {"differences": bytes(24)}, {"first_values": []}, {"first_values": [5, 6]}, {"axes": 3},
        {"burst_sizes": b""}, {"burst_sizes": b"\3"}, {"burst_sizes": b"\xff"}, {"burst_sizes": b"\0"},
        {"burst_sizes": b"", "burst_count": [4, -4]}, {"burst_sizes": b"", "burst_count": [2**31 - 1]},
        {"burst_sizes": b"\1\1\2"}, {"burst_intervals_ns": b"\1\0\0"}, {"burst_intervals_ns": b"\1\0\0\0"},
        {"x_counts": [5]}, {"z": [5.0]},
        {"burst_t_monotonic_ns": [1, 2]}, {"burst_t_monotonic_ns": [0], "burst_intervals_ns": b"\1\0\0\0"},
        {"burst_count": [4]}, {"burst_t_monotonic_ns": [1], "first_burst_t_monotonic_ns": 1},
        {"burst_count": [4], "order": 0, "x_counts": [1, 2, 3, 4]}, {"decimal": True, "decimal_places": 10},
        {"decimal": True, "negative_zeros": [0]}, {"decimal": True, "negative_zeros": [4]},
        {"decimal": True, "negative_zeros": [-1]}, {"nominal_rate_hz": float("nan")},
    ],
    ids=str,
)  # fmt: skip
def test_a_hostile_block_is_refused_with_one_line(changes: dict[str, Any]) -> None:
    with pytest.raises(MessageError) as told:
        decode("fieldcal.v1.RawBlock", hostile(**changes))
    assert len(str(told.value)) < 200
    assert "\n" not in str(told.value)


def test_what_a_block_announces_takes_no_memory() -> None:
    sizes = pb.RawBlock(axes=3, nominal_rate_hz=1.0, burst_sizes=b"\xff" * 4_000_000, order=1, first_values=[0] * 3)
    long = hostile(differences=bytes(4_000_000), burst_sizes=b"", burst_count=[4_000_001])
    for data in (sizes.SerializeToString(), long):
        tracemalloc.start()
        with pytest.raises(ValueError, match=r"\d"):
            decode_block(data)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 6 * len(data)


def test_bytes_of_a_block_that_are_changed_give_a_block_or_an_error() -> None:
    values = np.random.default_rng(3).integers(-9, 9, (40, 3))
    data = encode_block(1, made(values.astype(np.int32)))
    refused = 0
    for at in range(len(data)):
        for value in (0, 1, 0x7F, 0x80, 0xFF, data[at] ^ 1):
            try:
                decode("fieldcal.v1.RawBlock", data[:at] + bytes([value]) + data[at + 1 :])
            except MessageError:
                refused += 1
    assert refused > 100


def bench_blocks(device: str, values: np.ndarray, rng: np.random.Generator) -> list[SampleBlock]:
    """Blocks of half a second at 1 kHz; a poll each 8 ms, late by 0.1 ms on average, takes what there is."""
    found = []
    for first in range(0, len(values), 500):
        arrival_s = 0.008 * np.arange(1, 63) + rng.exponential(1e-4, 62)
        count = np.minimum(np.floor(arrival_s * 1000), 500).astype(np.int32)
        count[-1] = 500
        arrival_ns = np.round((first * 1e-3 + 3600 + arrival_s) * 1e9).astype(np.int64)
        part = np.ascontiguousarray(values[first : first + 500])
        found.append(SampleBlock(device, "boot", int(arrival_ns[-1]), first, 1000.0, arrival_ns, count, part))
    return found


def test_a_recording_of_the_bench_takes_few_bytes(tmp_path: Path) -> None:
    """The whole file, synced each 2 s. Steim2 takes 1.8 bytes for the samples alone; with plain arrays it was 4.2."""
    bench, rng, n = Bench(plain(1), 1), np.random.default_rng(1), 40_000
    counts, decimals = bench.sensor_counts(0, n), np.round(bench.reference_values(0, n), 5)
    file = RecordingFile(tmp_path, run_start(StandIn(CONFIG), 0, 1), [], {})
    pairs = zip(bench_blocks("acc", counts, rng), bench_blocks("ref", decimals, rng), strict=True)
    for number, pair in enumerate(pairs):
        for block in pair:
            file.append(f"/{block.device}/raw", encode_block(number, block), block.t_utc_ns, block.t_utc_ns, number)
        if number % 4 == 3:
            file.sync()
    file.finish()
    assert file.final_path.stat().st_size / (4 * n) < 1.75
