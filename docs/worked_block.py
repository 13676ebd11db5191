"""The worked block of docs/recording.md: three samples of three axes, byte by byte.

`.venv/bin/python -m docs.worked_block` writes it; `tests/unit/test_docs_recording.py` fails when it is stale.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from agent.proto import fieldcal_pb2 as pb
from agent.recording.raw_block import encode_block
from hw.block import BlockFlags, SampleBlock

PAGE = Path(__file__).parent / "recording.md"
BEGIN, END = "<!-- worked block: begin -->", "<!-- worked block: end -->"
ARRIVALS_NS = np.array([5_000_000_000, 5_010_000_000], dtype=np.int64)
SAMPLES = np.array([[100, -20, 25000], [103, -21, 25300], [101, -19, 25000]], dtype=np.int32)
BLOCK = SampleBlock(
    "acc", "b1", 1_700_000_000_000_000_000, 40, 200.0, ARRIVALS_NS, np.array([2, 3], dtype=np.int32), SAMPLES,
    BlockFlags.RESTART, temperature_degc=21.5,
)  # fmt: skip
EVENT = 7
BESIDE = 15  # bytes in a line before what they say
FIXED = {1: 8, 5: 4}  # bytes of a value by its type on the wire


def fields(data: bytes) -> Iterator[tuple[bytes, int]]:
    """The bytes of each field of a protobuf message, tag included, and its number."""
    at = 0
    while at < len(data):
        begin = at
        tag, at = _varint(data, at)
        kind = tag & 7
        if kind in FIXED:
            at += FIXED[kind]
        else:
            value, at = _varint(data, at)
            at += value if kind == 2 else 0
        yield data[begin:at], tag >> 3


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A whole number of 7 bits a byte, the lowest first, and where it ends."""
    value, shift = 0, 0
    while True:
        value |= (data[at] & 0x7F) << shift
        shift, at = shift + 7, at + 1
        if data[at - 1] < 0x80:
            return value, at


def table() -> str:
    """The block in lines: bytes in hexadecimal, field, value."""
    data = encode_block(EVENT, BLOCK)
    message = pb.RawBlock.FromString(data)
    lines = []
    for part, number in fields(data):
        name = message.DESCRIPTOR.fields_by_number[number].name
        value = getattr(message, name)
        said = value.hex(" ") if isinstance(value, bytes) else value if isinstance(value, str) else f"{value}"
        rows = [part[k : k + BESIDE].hex(" ") for k in range(0, len(part), BESIDE)]
        lines += [f"{rows[0]:<{3 * BESIDE}} {number:>2} {name} {said}", *rows[1:]]
    return "\n".join(["```text", *lines, "```"])


def page() -> str:
    """The page with today's block."""
    before, _, rest = PAGE.read_text("utf-8").partition(BEGIN)
    return f"{before}{BEGIN}\n{table()}\n{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
