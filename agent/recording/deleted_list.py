"""The list of all recordings that retention has deleted, one line each: `deleted.list` beside the recordings.

Every recording names the bytes and the SHA-256 of the list as it was, so the signature of a recording covers the list.
A head that was kept for years can so be compared with the recording that it names, though this is deleted.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Iterable
from pathlib import Path

from agent.config.files import open_file
from agent.recording.pruned_ranges import Deleted

LIST_NAME = "deleted.list"
_LONGEST = 256  # bytes of a line; an entry has at most 200
_log = logging.getLogger(__name__)


class DeletedList:
    """Appends to the list of a directory, and knows what a recording must name.

    `named`: what the newest recording names. What follows that in the file is dropped: it is in no recording, so
    anybody may have written it. Where the file does not begin with it, a new list is begun, and a warning is logged.
    """

    def __init__(self, directory: Path, named: str) -> None:
        self._path = directory / LIST_NAME
        self._sha256, self._size = hashlib.sha256(), 0
        self._fault: OSError | None = None
        try:
            _, fault = listed(directory, named, ())
            if not fault and (size := _length(named)):
                with open(self._path, "rb") as file:
                    self._sha256.update(file.read(size))
                self._size = size
        except OSError as error:  # appending would overwrite what cannot be read now
            _log.warning("%s cannot be read, and nothing is added to it: %s", self._path, error.strerror)
            self._fault = error
        else:
            if fault:
                _log.warning("%s; a new list is begun, and heads of recordings in the old one prove less", fault)

    @property
    def text(self) -> str:
        """`<bytes> <SHA-256>` of the list."""
        return f"{self._size} {self._sha256.hexdigest()}"

    def add(self, entries: Iterable[Deleted]) -> None:
        """Append entries and wait until they are on the disk. Raises OSError; then the list is as before."""
        if self._fault is not None:
            raise self._fault
        data = "".join(f"{entry.text}\n" for entry in entries).encode()
        if not data:
            return
        with open(os.open(self._path, os.O_WRONLY | os.O_CREAT, 0o644), "wb", buffering=0) as file:
            file.truncate(self._size)
            file.seek(self._size)
            rest = memoryview(data)
            while rest:
                rest = rest[file.write(rest) :]
            os.fsync(file.fileno())
        self._sha256.update(data)
        self._size += len(data)


def listed(directory: Path, named: str, wanted: Iterable[int]) -> tuple[list[Deleted], str]:
    """(the entries of the `wanted` numbers in the list that a recording names, what is wrong with the list or "").

    `named`: `<bytes> <SHA-256>`. What was added to the list later does not count. Raises OSError.
    """
    left, numbers, path = _length(named), frozenset(wanted), directory / LIST_NAME
    found, digest = list[Deleted](), hashlib.sha256()
    if not left:
        return [], ""
    if not path.exists():
        return [], f"{path} is missing; the newest recording names its first {left} bytes"
    with open_file(path) as file:
        while left and (line := file.readline(min(left, _LONGEST))):
            left -= len(line)
            digest.update(line)
            entry = Deleted.of_text(line.rstrip(b"\n").decode("ascii", "replace"))
            if entry is not None and entry.first in numbers:
                found.append(entry)
    if left or digest.hexdigest() != named.partition(" ")[2]:
        what = f"its first {_length(named)} bytes are others"
        return [], f"{path} is not the list that the newest recording names: {what}"
    return found, ""


def _length(named: str) -> int:
    """The bytes that a recording names; 0 where it names none."""
    length = named.partition(" ")[0]
    return int(length) if length.isascii() and length.isdigit() and len(length) < 19 else 0
