"""What a consumer remembers over its own restarts: the last result of each gateway that it was done with."""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping
from pathlib import Path

import msgspec

SIZE_MAX = 16 << 20  # bytes; a gateway has fifty


class MemoryFileError(Exception):
    """The file cannot be read, or is not what was written. The message names it."""


class _Content(msgspec.Struct, forbid_unknown_fields=True):
    last_sequence: dict[str, int]
    crc32: int  # of last_sequence: a digit that changed would skip results in silence


def load(path: Path) -> dict[str, int]:
    """`<site>/<gateway>`: number; empty where there is no file yet. Raises MemoryFileError."""
    try:
        with open(path, "rb") as file:
            content = msgspec.json.decode(file.read(SIZE_MAX), type=_Content)
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise MemoryFileError(f"{path}: cannot be read: {error.strerror}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise MemoryFileError(f"{path}: not what a consumer remembers: {error}") from None
    if content.crc32 != _crc32(content.last_sequence):
        raise MemoryFileError(f"{path}: damaged: its CRC does not fit; without the file everything comes again")
    return content.last_sequence


def save(path: Path, last_sequence: Mapping[str, int]) -> None:
    """Replace the file; it is the old or the new one whenever the power goes. Raises OSError."""
    kept = dict(last_sequence)
    new = path.with_name(path.name + ".new")
    with open(new, "wb") as file:
        file.write(msgspec.json.encode(_Content(kept, _crc32(kept))))
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def _crc32(last_sequence: dict[str, int]) -> int:
    return zlib.crc32(msgspec.json.encode(last_sequence, order="deterministic"))
