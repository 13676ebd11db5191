"""MATLAB files of version 4 to 7 by scipy; version 7.3 is HDF5."""

from __future__ import annotations

import os
import zlib
from pathlib import Path
from typing import Any, Literal

import numpy as np

from agent.reading.hdf5 import RATES, columns_of, with_times
from agent.reading.source import Arrays, Column, Slices, TableError, check_announced

HEADER_BYTES = 128
COMPRESSED = 15  # data type of an element
PIECE = 1 << 20


def open_matlab(path: Path) -> Arrays:
    """Variables with numbers as columns; a structure is a group. Raises TableError."""
    from scipy.io import loadmat

    _check_size(path)
    try:
        read = loadmat(path, squeeze_me=True)
    except (ValueError, NotImplementedError, TypeError, OSError, KeyError, IndexError, zlib.error) as error:
        raise TableError(f"{path}: the file cannot be read: {error}; save it with -v7 or -v7.3") from None
    values: dict[Column, Slices] = {}
    rates: dict[str, float] = {}
    for name, value in read.items():
        if not name.startswith("__"):
            _take(name, value, "", values, rates)
    return Arrays(path, with_times(values, rates))


def _take(name: str, value: Any, group: str, values: dict[Column, Slices], rates: dict[str, float]) -> None:
    """Take a variable, or the fields of a structure with one element."""
    array = np.asarray(value)
    if array.dtype.names and array.ndim == 0:
        for field in array.dtype.names:
            _take(field, array[field][()], f"{group}/{name}" if group else name, values, rates)
    elif array.dtype.names is None and array.size == 1 and array.dtype.kind in "iuf" and name.lower() in RATES:
        rates[group] = float(array.ravel()[0])
    elif array.dtype.names is None and array.size and array.ndim in (1, 2):
        values |= columns_of(name, array, "", group)


def _check_size(path: Path) -> None:
    """Unpack compressed elements without keeping them, and refuse a file that is too large then. Raises TableError."""
    size = 0
    with path.open("rb") as file:
        order: Literal["big", "little"] = "big" if file.read(HEADER_BYTES)[126:] == b"MI" else "little"
        while len(tag := file.read(8)) == 8:
            kind, length = int.from_bytes(tag[:4], order), int.from_bytes(tag[4:], order)
            if kind != COMPRESSED:
                file.seek(length, os.SEEK_CUR)
                continue
            unpack = zlib.decompressobj()
            while length > 0 and (data := file.read(min(PIECE, length))):
                length -= len(data)
                while data:
                    try:
                        size += len(unpack.decompress(data, PIECE))
                    except zlib.error:
                        return  # scipy tells it
                    check_announced(path, size)
                    data = unpack.unconsumed_tail
