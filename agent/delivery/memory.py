"""The memory file of a consumer: the number of the last result of each gateway that it has processed."""

from __future__ import annotations

import os
import time
import zlib
from collections.abc import Mapping
from pathlib import Path

import msgspec

from agent.config.files import read_file

SIZE_MAX = 16 << 20  # bytes read at most; one gateway takes about 50
SAVE_S = 1.0  # s between two writes of the file while results come without a pause; a pause writes it at once


class MemoryFileError(Exception):
    """The memory file cannot be read or is damaged. The message names the file."""


class _MemoryFile(msgspec.Struct, forbid_unknown_fields=True):
    last_sequence: dict[str, int]
    crc32: int  # of last_sequence; without it, a changed digit would skip results unnoticed


class ProcessedNumbers:
    """`numbers`: of the last result that was processed, by gateway; kept in a file where there is a `path`.

    Raises MemoryFileError where the file cannot be read; the methods raise OSError where it cannot be written.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self.numbers = self._saved = load(path) if path is not None else {}
        self._saved_s = time.monotonic()

    def processed(self, numbers: dict[str, int]) -> None:
        """The results up to these numbers are processed. Saves them, unless it did within SAVE_S."""
        self.numbers = numbers
        if time.monotonic() - self._saved_s > SAVE_S:
            self.save()

    def save(self) -> None:
        """Save the numbers where they have changed."""
        if self._path is not None and self.numbers != self._saved:
            save(self._path, self.numbers)
            self._saved, self._saved_s = self.numbers, time.monotonic()


def load(path: Path) -> dict[str, int]:
    """Read the last sequence number by `<site>/<gateway>`; empty where there is no file. Raises MemoryFileError."""
    try:
        content = msgspec.json.decode(read_file(path, SIZE_MAX), type=_MemoryFile)
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise MemoryFileError(f"{path}: cannot be read: {error.strerror}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise MemoryFileError(f"{path}: not the memory file of a consumer: {error}") from None
    if content.crc32 != _crc32(content.last_sequence):
        raise MemoryFileError(
            f"{path}: damaged: its CRC does not fit; delete the file to begin again with the values in force"
        )
    return content.last_sequence


def save(path: Path, last_sequence: Mapping[str, int]) -> None:
    """Replace the file; after a power cut it is the complete old or the complete new one. Raises OSError."""
    kept = dict(last_sequence)
    new = path.with_name(path.name + ".new")
    with open(new, "wb") as file:
        file.write(msgspec.json.encode(_MemoryFile(kept, _crc32(kept))))
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
