"""The format between the auditor's program and the process of an engine.

A frame is its length, then a list of byte strings, each with its length before it. Lengths are unsigned numbers of 32
bits, little-endian. The first byte string names the frame. Numbers in a frame are decimal digits. Each frame to the
engine has one answer.

| to the engine | answer |
| --- | --- |
| `engine`, version of this format, id | the same three of the engine, which ends if the versions differ |
| `begin`, schema, message: makes the pipeline anew from a RunStart, and steps it | `results` |
| `step`, schema, message: gives an event to the pipeline | `results` |
| `snapshot` | `snapshot`, the bytes of Pipeline.snapshot() |
| `memories` | `memories`, then for each memory: sensor, identity, number of the last result, state |

`results` are the number of the event, then schema and message of each result. Schemas are full names, and messages are
bytes as in a recording (agent/proto/fieldcal.proto): the engine decodes the format of its own time. `fault`, with a
text, is the answer where the pipeline raises an exception. What begins a file is `begin`; where a file continues the
one before it, its RunStart can also be given as a `step`.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from io import RawIOBase

VERSION = b"1"  # of this format; an engine is kept with the version that its process speaks
LARGEST = 256 << 20  # bytes of a frame; the largest snapshot of a pipeline has a few megabytes
_NUMBER = struct.Struct("<I")


class FrameError(ValueError):
    """What was read is no frame."""


def packed(parts: Sequence[bytes]) -> bytes:
    """The bytes of a frame."""
    body = b"".join(piece for part in parts for piece in (_NUMBER.pack(len(part)), part))
    return _NUMBER.pack(len(body)) + body


class Unpacker:
    """Gives frames from bytes that come in pieces of any size."""

    def __init__(self) -> None:
        self._data = bytearray()

    def feed(self, data: bytes) -> list[bytes] | None:
        """Take more bytes, and give the frame that is now complete; None while bytes are missing.

        Raises FrameError where lengths are impossible, or bytes follow the frame, for each frame waits for its answer.
        """
        self._data += data
        if len(self._data) < _NUMBER.size:
            return None
        end = _NUMBER.size + _NUMBER.unpack_from(self._data)[0]
        if end > LARGEST:
            raise FrameError(f"a frame of {end} bytes; at most {LARGEST} are allowed")
        if len(self._data) < end:
            return None
        if len(self._data) > end:
            raise FrameError("bytes follow a frame that has no answer yet")
        parts, place = [], _NUMBER.size
        while place < end:
            if place + _NUMBER.size > end:
                raise FrameError("a frame ends within the length of a part")
            first = place + _NUMBER.size
            place = first + _NUMBER.unpack_from(self._data, place)[0]
            if place > end:
                raise FrameError("a part is longer than its frame")
            parts.append(bytes(self._data[first:place]))
        if not parts:
            raise FrameError("a frame without a name")
        self._data.clear()
        return parts


def read(stream: RawIOBase) -> list[bytes] | None:
    """The next frame from a pipe; None at its end. Raises FrameError."""
    unpacker = Unpacker()
    while data := stream.read(1 << 20):
        if (parts := unpacker.feed(data)) is not None:
            return parts
    return None
