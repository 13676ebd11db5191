"""Parquet and Feather (Arrow IPC), read by pyarrow in pieces."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agent.reading.source import ROWS_AT_ONCE, Array, Column, Progress, Source, TableError, check_announced

BUFFER_BYTES = 1 << 20  # of a column chunk of Parquet


class Arrow(Source):
    """Numbers and dates of a Parquet or Feather file; columns of other types are left out. Raises TableError."""

    def __init__(self, path: Path) -> None:
        import pyarrow as pa

        self.path, self._error = path, pa.ArrowException
        self._file: Any = None
        try:
            schema = self._schema()
        except (pa.ArrowException, OSError, ValueError) as error:
            raise self._damaged(error) from None
        self.columns = [Column(f.name, "s" if pa.types.is_timestamp(f.type) else "") for f in schema
                        if _is_number(f.type)]  # fmt: skip

    def pieces(self, columns: Sequence[Column], progress: Progress | None) -> Iterator[Array]:
        """Yield the rows of these columns. Raises TableError."""
        done = 0
        try:
            for batch, share in self._batches([column.name for column in columns]):
                for first in range(0, batch.num_rows, ROWS_AT_ONCE):
                    part = batch.slice(first, ROWS_AT_ONCE)
                    yield np.column_stack([_values(part.column(column.name)) for column in columns])
                if progress is not None:
                    progress(round(share * self.path.stat().st_size) - done)
                    done = round(share * self.path.stat().st_size)
        except (self._error, OSError, ValueError) as error:
            raise self._damaged(error) from None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _damaged(self, error: Exception) -> TableError:
        reason = str(error).partition("\n")[0]
        return TableError(f"{self.path}: the file cannot be read: {reason}; write it anew")

    def _schema(self) -> Any:
        raise NotImplementedError

    def _batches(self, names: Sequence[str]) -> Iterator[tuple[Any, float]]:
        """Yield batches of rows, each with the share of the file that is read then."""
        raise NotImplementedError


class Parquet(Arrow):
    """A Parquet file."""

    def _schema(self) -> Any:
        from pyarrow import parquet

        # Without the first option all column chunks that were read stay in memory; without the second, a whole one.
        self._file = parquet.ParquetFile(self.path, pre_buffer=False, buffer_size=BUFFER_BYTES)
        about = self._file.metadata
        check_announced(self.path, 8 * about.num_rows * about.num_columns)
        check_announced(self.path, sum(about.row_group(k).total_byte_size for k in range(about.num_row_groups)))
        return self._file.schema_arrow

    def _batches(self, names: Sequence[str]) -> Iterator[tuple[Any, float]]:
        done = 0
        for batch in self._file.iter_batches(ROWS_AT_ONCE, columns=list(names), use_threads=False):
            done += batch.num_rows
            yield batch, done / self._file.metadata.num_rows


class Feather(Arrow):
    """A Feather file (version 2, which is Arrow IPC)."""

    def _schema(self) -> Any:
        import pyarrow as pa

        self._file = pa.OSFile(str(self.path))
        self._table = pa.ipc.open_file(self._file)
        return self._table.schema

    def _batches(self, names: Sequence[str]) -> Iterator[tuple[Any, float]]:
        for k in range(self._table.num_record_batches):
            batch = self._table.get_batch(k)
            check_announced(self.path, 8 * batch.num_rows * batch.num_columns)
            yield batch.select(list(names)), (k + 1) / self._table.num_record_batches


def _is_number(kind: Any) -> bool:
    import pyarrow as pa

    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_timestamp(kind))


def _values(column: Any) -> Array:
    """A column as numbers, a date as seconds since 1970, NaN where there is no value."""
    import pyarrow as pa

    if pa.types.is_timestamp(column.type):
        per_second = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[column.type.unit]
        whole = np.asarray(np.from_dlpack(column.cast(pa.int64()).fill_null(-(2**63))))
        seconds = whole // per_second + (whole % per_second) / per_second
        return np.where(whole == -(2**63), np.nan, seconds)
    numbers = column.cast(pa.float64(), safe=False)
    return np.array(np.from_dlpack(numbers.fill_null(np.nan) if numbers.null_count else numbers))
