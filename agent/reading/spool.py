"""Rows of numbers on disk, so that the samples of a file need no memory while they are used."""

from __future__ import annotations

import os
import tempfile
import weakref
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.reading.source import Array


class Spool:
    """Rows of `width` numbers in a temporary file, 8 bytes for each number. The file goes with the last user."""

    def __init__(self, width: int) -> None:
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - open as long as there is a user
        weakref.finalize(self, self._file.close)
        self.width, self.rows = width, 0

    def append(self, rows: Array) -> None:
        """Add rows (n, width). Raises OSError, which names the directory and the remedy."""
        left = np.ascontiguousarray(rows, np.float64).ravel().view(np.uint8)
        try:
            self._file.seek(0, os.SEEK_END)
            while len(left):
                left = left[self._file.write(left.data) :]
        except OSError as error:
            told = f"{error.strerror}; set TMPDIR to a directory with room for all samples, 8 bytes for each number"
            raise OSError(error.errno, told, tempfile.gettempdir()) from None
        self.rows += len(rows)

    def read(self, first: int, stop: int) -> Array:
        """The rows `first` to `stop` (n, width), a copy."""
        found = np.empty((max(stop - first, 0), self.width))
        left = found.ravel().view(np.uint8)
        self._file.seek(8 * self.width * first)
        while len(left):
            left = left[self._file.readinto(left.data) :]
        return found

    def take(self, rows: NDArray[np.intp]) -> Array:
        """These rows (n, width) in this order, a copy; in memory are never more than as many again."""
        found = np.empty((len(rows), self.width))
        step = max(len(rows), 1)
        for first in np.unique(rows // step).tolist():
            inside = np.flatnonzero(rows // step == first)
            part = self.read(first * step, min((first + 1) * step, self.rows))
            found[inside] = part[rows[inside] - first * step]
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
        return np.ascontiguousarray(self.spool.read(first, stop)[::step, self.of])  # no view, which would keep all rows
