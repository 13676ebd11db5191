"""MATLAB files of version 4 to 7 by scipy; version 7.3 is HDF5."""

from __future__ import annotations

import os
import sys
import zlib
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from agent.reading.hdf5 import RATES, columns_of, with_times
from agent.reading.own_process import Name, arrays_of, write_arrays
from agent.reading.source import Arrays, Column, check_announced
from calib.model import Slices

HEADER_BYTES = 128
COMPRESSED = 15  # data type of an element
PIECE = 1 << 20
LEAST_MEMORY, COPIES = 1 << 29, 6  # bytes that reading may take: so many at least, and copies of all values


def open_matlab(path: Path) -> Arrays:
    """Variables with numbers as columns; a structure is a group. Raises TableError.

    scipy reads the file in a process of its own, because a damaged file can end that process.
    """
    memory = LEAST_MEMORY + COPIES * _unpacked_bytes(path)
    values: dict[Column, Slices] = {}
    rates: dict[str, float] = {}
    for (group, name), array in arrays_of("agent.reading.matlab", path, memory, "save it with -v7 or -v7.3"):
        if array.size == 1 and name.lower() in RATES:
            rates[group] = float(array.ravel()[0])
        elif array.size and array.ndim in (1, 2):
            values |= columns_of(name, array, "", group)
    return Arrays(path, with_times(values, rates))


def _arrays(path: str) -> dict[Name, NDArray[Any]]:
    """The arrays of numbers in the file, each named by its structure and its name."""
    from scipy.io import loadmat

    found: dict[Name, NDArray[Any]] = {}
    for name, value in loadmat(path, squeeze_me=True).items():
        if not name.startswith("__"):
            _take(name, value, "", found)
    return found


def _take(name: str, value: Any, group: str, found: dict[Name, NDArray[Any]]) -> None:
    """Take a variable with numbers, or the fields of a structure with one element."""
    array = np.asarray(value)
    if array.dtype.names and array.ndim == 0:
        for field in array.dtype.names:
            _take(field, array[field][()], f"{group}/{name}" if group else name, found)
    elif array.dtype.kind in "iuf":
        found[group, name] = array


def _unpacked_bytes(path: Path) -> int:
    """The size of the file with its compressed elements unpacked, which are not kept.

    Raises TableError where it is far larger than the file.
    """
    size = path.stat().st_size
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
                        return size  # scipy tells it
                    check_announced(path, size)
                    data = unpack.unconsumed_tail
    return size


if __name__ == "__main__":
    write_arrays(_arrays, *sys.argv[1:])
