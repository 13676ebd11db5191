"""What every format gives: named columns of numbers, read in pieces, so that memory does not grow with the length."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from calib.model import Slices
from calib.recorded.choice import Column as Column

Array = NDArray[np.float64]
Progress = Callable[[int], Any]  # called with the number of bytes that were just read

ROWS_AT_ONCE = 1 << 16
# A compressed file of measured samples does not grow more than this. A file that says so is damaged or hostile.
MOST_EXPANSION = 200
ALWAYS_ALLOWED_BYTES = 1 << 28


class TableError(Exception):
    """The file cannot be used. The message names file, line or row, column, value and remedy."""


class Source(ABC):
    """An opened file. `columns`: what it has. `header`: the place where it names them, for messages.

    `said`: what was guessed or left out of the file and of the columns that were read last, for the user. `rate_hz`: as
    the file states it. `counted`: name of a column that counts samples at this rate. `filters`: the known filters of
    its devices, by group, each in one line of text (calib.signal.known_filters). `repeated`: columns of times that
    another column tells too, at least as finely. `remedy`: what to do where the columns are not those that are needed,
    "" where the file does not tell it.
    """

    path: Path
    columns: Sequence[Column]
    header = "columns"
    said: Sequence[str] = ()
    rate_hz: float | None = None
    counted = ""
    repeated: Sequence[Column] = ()
    remedy = ""
    filters: Mapping[str, tuple[str, ...]] = MappingProxyType({})

    @abstractmethod
    def pieces(self, columns: Sequence[Column], progress: Progress | None) -> Iterator[Array]:
        """Yield the rows (n, k) of these columns in order, NaN where the file has no value. Raises TableError."""

    def close(self) -> None:  # noqa: B027 - most formats keep no file open
        """Close the file."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def place(self, row: int) -> str:
        """Where row `row`, counted from 0, is found in the file."""
        return f"row {row + 1}"


@dataclass(frozen=True, slots=True)
class Grid:
    """The times of samples at a constant rate, in s."""

    start_s: float
    rate_hz: float
    samples: int

    def __len__(self) -> int:
        return self.samples

    def __getitem__(self, rows: slice, /) -> Array:
        return self.start_s + np.arange(*rows.indices(self.samples)) / self.rate_hz


@dataclass(frozen=True, slots=True)
class Stretches:
    """The times of samples in stretches, in s. `firsts`: the first row of each; `starts_s`: its time; `periods_s`."""

    rate_hz: float
    samples: int
    firsts: tuple[int, ...]
    starts_s: tuple[float, ...]
    periods_s: tuple[float, ...]

    def __len__(self) -> int:
        return self.samples

    def __getitem__(self, rows: slice, /) -> Array:
        at = np.arange(*rows.indices(self.samples))
        k = np.searchsorted(self.firsts, at, "right") - 1
        return np.asarray(np.array(self.starts_s)[k] + (at - np.array(self.firsts)[k]) * np.array(self.periods_s)[k])

    @property
    def start_s(self) -> float:
        """The time of the first sample."""
        return self.starts_s[0]

    def place(self, time_s: float) -> tuple[int, int, float]:
        """The row at a time, the row where its stretch ends, and the time at which the next one begins."""
        k = max(0, bisect_right(self.starts_s, time_s + 0.5 / self.rate_hz) - 1)
        stop, next_s = (
            (self.firsts[k + 1], self.starts_s[k + 1]) if k + 1 < len(self.firsts) else (self.samples, math.inf)
        )
        return self.firsts[k] + round((time_s - self.starts_s[k]) / self.periods_s[k]), stop, next_s


class Arrays(Source):
    """A file whose columns can be sliced: each column with its values (n,). `closes` closes the file.

    Raises TableError for a file that announces far more values than its size can hold.
    """

    def __init__(
        self, path: Path, values: Mapping[Column, Slices], closes: Callable[[], object] = lambda: None
    ) -> None:
        check_announced(path, sum(8 * len(v) for v in values.values() if not isinstance(v, Grid | Stretches)))
        self.path, self.columns, self._values, self._closes = path, tuple(values), values, closes

    def close(self) -> None:
        """Close the file."""
        self._closes()

    def pieces(self, columns: Sequence[Column], progress: Progress | None) -> Iterator[Array]:
        """Yield the rows of these columns, which must have the same length."""
        lengths = {str(column): len(self._values[column]) for column in columns}
        n = min(lengths.values())
        if max(lengths.values()) != n:
            told = ", ".join(f"{name!r} has {length}" for name, length in lengths.items())
            raise TableError(f"{self.path}: the columns have different numbers of values: {told}; choose others")
        share = self.path.stat().st_size / max(n, 1)
        for first in range(0, n, ROWS_AT_ONCE):
            rows = slice(first, min(first + ROWS_AT_ONCE, n))
            try:
                part = np.column_stack([np.asarray(self._values[c][rows], dtype=np.float64).ravel() for c in columns])
            except Exception as error:  # the libraries raise many kinds for damaged files
                reason = str(error).partition("\n")[0]
                where = f"{self.path}, {self.place(first)} to {rows.stop}"
                raise TableError(f"{where}: the values cannot be read: {reason}; write the file anew") from None
            yield part
            if progress is not None:
                progress(round(share * (rows.stop - first)))


def check_announced(path: Path, size_bytes: int) -> None:
    """Refuse a file that announces far more values than its own size can hold. Raises TableError."""
    allowed = max(ALWAYS_ALLOWED_BYTES, MOST_EXPANSION * path.stat().st_size)
    if size_bytes > allowed:
        raise TableError(
            f"{path}: the file says that it holds {size_bytes:.3g} bytes of values, {allowed:.3g} are allowed for its "
            "size; it is damaged or hostile: write it anew without compression"
        )


@contextmanager
def bounded_memory(size_bytes: int) -> Iterator[None]:
    """Let this process take at most so many more bytes of memory, so that a library that trusts a file raises
    MemoryError. Only Linux can limit it so; elsewhere nothing is limited."""
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (ImportError, OSError):
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    limits = [pages * resource.getpagesize() + size_bytes, *(limit for limit in (soft, hard) if limit >= 0)]
    resource.setrlimit(resource.RLIMIT_AS, (min(limits), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
