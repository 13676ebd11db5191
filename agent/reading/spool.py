"""Rows of numbers on disk, so that the samples of a file need no memory while they are used."""

from __future__ import annotations

import tempfile
import weakref
from dataclasses import dataclass

import numpy as np

from agent.reading.source import Array


class Spool:
    """Rows of `width` numbers in a temporary file, 8 bytes for each number. The file goes with the last user."""

    def __init__(self, width: int) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as there is a user
        weakref.finalize(self, self._file.close)
        self.width, self.rows = width, 0

    def append(self, rows: Array) -> None:
        """Add rows (n, width). Raises OSError."""
        self._file.seek(0, 2)
        self._file.write(np.ascontiguousarray(rows, np.float64).data)
        self.rows += len(rows)

    def read(self, first: int, stop: int) -> Array:
        """The rows `first` to `stop` (n, width), a copy."""
        found = np.empty((max(stop - first, 0), self.width))
        self._file.seek(8 * self.width * first)
        self._file.readinto(found.data.cast("B"))
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Spooled:
    """A column of a spool (n,), or several (n, k): read where they are sliced, as an array would be."""

    spool: Spool
    of: int | slice

    def __len__(self) -> int:
        return self.spool.rows

    def __getitem__(self, rows: slice, /) -> Array:
        first, stop, step = rows.indices(self.spool.rows)
        return self.spool.read(first, stop)[::step, self.of]
