"""Sample blocks as protobuf messages, bit for bit both ways. agent/proto/fieldcal.proto describes the fields.

Values that follow one another are close to each other. So their differences need few bytes, and the high ones hardly
change; side by side, a compressor leaves little of these. Decimals that a device sent as text are whole numbers here,
made of their digits.

On the wire, a packed array of fixed-size numbers is a byte string that contains the array. RawBlockBytes declares these
fields as byte strings. Its wire bytes are equal to those of RawBlock, which is the schema in a recording.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.proto import fieldcal_pb2 as pb
from hw.block import BlockFlags, SampleBlock
from hw.promises import MOST_SAMPLES, block_fault

COUNTS, DECIMALS = ("x_counts", "y_counts", "z_counts"), ("x", "y", "z")
INT32, INT64, FLOAT64 = np.dtype("<i4"), np.dtype("<i8"), np.dtype("<f8")
WIDTHS = {width: np.dtype(f"<i{width}") for width in (1, 2, 4)}  # bytes of a difference
MOST_PLACES = 9  # decimal places: whole numbers of 32 bits have no more digits
TRIED = 8  # values whose shortest texts tell from how many decimal places on whole numbers are tried


def encode_block(event_sequence: int, block: SampleBlock) -> bytes:
    """Encode a block as protobuf wire bytes. Raises ValueError where its indications are neither int32 nor float64."""
    decimal = block.indications.dtype == np.float64
    if not decimal and block.indications.dtype != np.int32:
        raise ValueError(f"indications of {block.device} are {block.indications.dtype}, not int32 or float64")
    rows: NDArray[Any] = np.ascontiguousarray(block.indications.T, FLOAT64 if decimal else INT32)
    message = pb.RawBlockBytes(
        event_sequence=event_sequence,
        device=block.device,
        boot_id=block.boot_id,
        t_utc_ns=block.t_utc_ns,
        first_index=block.first_index,
        nominal_rate_hz=block.nominal_rate_hz,
        flags=int(block.flags),
        temperature_raw=block.temperature_raw,
        temperature_degc=block.temperature_degc,
        axes=len(rows),
        decimal=decimal,
    )
    _put_bursts(message, block.burst_t_monotonic_ns, block.burst_count)
    if not decimal:
        _put_whole_numbers(message, rows)
    elif (found := _whole_numbers(rows)) is not None:
        whole, message.decimal_places = found
        _put_whole_numbers(message, whole)
        negative_zeros = np.flatnonzero((np.signbit(rows) & (whole == 0)).T)
        message.negative_zeros = negative_zeros.astype(INT32).tobytes()
    else:
        for name, row in zip(DECIMALS, rows, strict=False):
            setattr(message, name, row.tobytes())
    return message.SerializeToString(deterministic=True)


def decode_block(data: bytes) -> tuple[int, SampleBlock]:
    """Decode wire bytes into (event_sequence, block).

    The arrays of bursts may be read-only; the indications, (n, axes), are C-contiguous.
    Raises ValueError or protobuf's DecodeError where the bytes are not a block, or one with a `block_fault`.
    """
    m = pb.RawBlockBytes.FromString(data)
    if m.axes not in (1, 3):
        raise ValueError(f"the block says {m.axes} axes; only 1 and 3 are possible")
    if _has_two(m):
        raise ValueError("the block has samples, arrivals or counts of bursts in two fields")
    block = SampleBlock(
        device=m.device,
        boot_id=m.boot_id,
        t_utc_ns=m.t_utc_ns,
        first_index=m.first_index,
        nominal_rate_hz=m.nominal_rate_hz,
        burst_t_monotonic_ns=_arrivals(m),
        burst_count=(count := _counts(m)),
        indications=_whole_indications(m, int(count[-1])) if m.order and len(count) else _plain_indications(m),
        flags=BlockFlags(m.flags),
        temperature_raw=m.temperature_raw if m.HasField("temperature_raw") else None,
        temperature_degc=m.temperature_degc if m.HasField("temperature_degc") else None,
    )
    if fault := block_fault(block):
        raise ValueError(fault)
    return m.event_sequence, block


def _put_bursts(message: pb.RawBlockBytes, arrival: NDArray[np.int64], count: NDArray[np.int32]) -> None:
    """Set the fields of the bursts; their arrivals and their sizes each in the shorter form where it can hold them."""
    intervals = arrival[1:] - arrival[:-1]
    if len(arrival) and (intervals == (small := intervals.astype(INT32))).all():
        message.first_burst_t_monotonic_ns, message.burst_intervals_ns = arrival[0], _transposed(small, 4)
    else:
        message.burst_t_monotonic_ns = arrival.astype(INT64, copy=False).tobytes()
    sizes = np.concatenate((count[:1], count[1:] - count[:-1]))
    if len(sizes) and sizes.min() > 0 and sizes.max() < 256:
        message.burst_sizes = sizes.astype(np.uint8).tobytes()
    else:
        message.burst_count = count.astype(INT32, copy=False).tobytes()


def _put_whole_numbers(message: pb.RawBlockBytes, rows: NDArray[np.int32]) -> None:
    """Set the fields of the samples, (axes, n), with the order that makes the differences smaller."""
    if not rows.size:
        return
    first = rows[:, 1:] - rows[:, :-1]
    second = first[:, 1:] - first[:, :-1]
    order, differences, values = 1, first, rows[:, :1]
    if np.abs(second).sum() < np.abs(first).sum():
        order, differences, values = 2, second, np.concatenate((values, first[:, :1]), axis=1)
    least, most = int(differences.min(initial=0)), int(differences.max(initial=0))
    width = next(width for width in WIDTHS if -1 << 8 * width - 1 <= least and most < 1 << 8 * width - 1)
    message.order, message.first_values = order, values.tobytes()
    message.differences = _transposed(differences, width)


def _transposed(numbers: NDArray[np.int32], width: int) -> bytes:
    """The lowest byte of all numbers, then the next byte of all, up to `width` bytes."""
    return numbers.view(np.uint8).reshape(-1, INT32.itemsize).T[:width].tobytes()


def _numbers(transposed: bytes, width: int) -> NDArray[Any]:
    """The whole numbers of `width` bytes that `_transposed` gave. Raises ValueError."""
    n, rest = divmod(len(transposed), width)
    if rest:
        raise ValueError(f"{len(transposed)} bytes are no whole numbers of {width} bytes")
    data = bytearray(n * width)
    for place in range(width):
        data[place::width] = transposed[place * n : (place + 1) * n]
    return np.frombuffer(data, WIDTHS[width])


def _has_two(m: pb.RawBlockBytes) -> bool:
    """Whether something is there in both forms."""
    if m.burst_t_monotonic_ns and (m.burst_intervals_ns or m.first_burst_t_monotonic_ns):
        return True
    if m.burst_count and m.burst_sizes:
        return True
    return bool((m.x_counts or m.y_counts or m.z_counts or m.x or m.y or m.z) and (m.order or m.differences))


def _arrivals(m: pb.RawBlockBytes) -> NDArray[np.int64]:
    """The arrivals of the bursts. Raises ValueError."""
    if plain := m.burst_t_monotonic_ns:
        return np.frombuffer(plain, INT64)
    intervals = _numbers(m.burst_intervals_ns, 4)
    arrivals = np.empty(len(intervals) + 1, INT64)
    arrivals[0], arrivals[1:] = m.first_burst_t_monotonic_ns, intervals
    return np.add.accumulate(arrivals, out=arrivals)


def _counts(m: pb.RawBlockBytes) -> NDArray[np.int32]:
    """How many samples had been read with each burst. Raises ValueError."""
    sizes = m.burst_sizes
    if len(sizes) > MOST_SAMPLES:
        raise ValueError(f"the block has {len(sizes)} bursts; at most {MOST_SAMPLES} are possible")
    if not sizes:
        return np.frombuffer(m.burst_count, INT32)
    return np.add.accumulate(np.frombuffer(sizes, np.uint8), dtype=INT32)


def _whole_indications(m: pb.RawBlockBytes, n: int) -> NDArray[Any]:
    """The indications (n, axes) of differences. Raises ValueError."""
    axes, order, differences = m.axes, m.order, m.differences
    if order > 2 or not order <= n <= MOST_SAMPLES or len(m.first_values) != order * axes * INT32.itemsize:
        raise ValueError(f"order {order}, {n} samples and {len(m.first_values)} bytes of first values do not agree")
    width, rest = divmod(len(differences), axes * (n - order)) if n > order else (1, len(differences))
    if width not in WIDTHS or rest:
        raise ValueError(f"{n} samples of {axes} axes do not have {len(differences)} bytes of differences")
    first_values = np.frombuffer(m.first_values, INT32).reshape(axes, order)
    rows = np.concatenate((first_values, _numbers(differences, width).reshape(axes, n - order)), axis=1)
    if order == 2:
        np.add.accumulate(rows[:, 1:], axis=1, out=rows[:, 1:])
    np.add.accumulate(rows, axis=1, out=rows)
    if not m.decimal:
        return np.ascontiguousarray(rows.T)
    if m.decimal_places > MOST_PLACES:
        raise ValueError(f"decimal_places is {m.decimal_places}; at most {MOST_PLACES} are possible")
    indications = np.ascontiguousarray((rows / 10.0**m.decimal_places).T)
    if m.negative_zeros:
        at = np.frombuffer(m.negative_zeros, INT32)
        if at.min() < 0 or at.max() >= indications.size or indications.flat[at].any():
            raise ValueError("negative_zeros names a sample that is not there, or not 0")
        indications.flat[at] = -0.0
    return indications


def _plain_indications(m: pb.RawBlockBytes) -> NDArray[Any]:
    """The indications (n, axes) of an array for each axis. Raises ValueError."""
    names, kind = (DECIMALS, FLOAT64) if m.decimal else (COUNTS, INT32)
    columns = [np.frombuffer(getattr(m, name), kind) for name in names[: m.axes]]
    n = len(columns[0])
    if any(len(column) != n for column in columns):
        raise ValueError(f"x has {n} samples; another axis has another number of them")
    indications = np.empty((n, m.axes), kind)
    for axis, column in enumerate(columns):
        indications[:, axis] = column
    return indications


def _whole_numbers(decimals: NDArray[np.float64]) -> tuple[NDArray[np.int32], int] | None:
    """Whole numbers, and the decimal places with which they give the same decimals (0.0 for -0.0); None if none do."""
    if not decimals.size or not np.abs(decimals).max() < 2.0**31:  # NaN is not below either
        return None
    texts = (repr(value).removesuffix(".0") for value in decimals[0, :TRIED].tolist())
    least = max(len(text.partition(".")[2]) for text in texts)
    for places in range(least, MOST_PLACES + 1):
        power = 10.0**places
        whole = np.rint(decimals * power)
        if np.abs(whole).max() < 2.0**31 and (whole / power == decimals).all():
            return whole.astype(INT32), places
    return None
