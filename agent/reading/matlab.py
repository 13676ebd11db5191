"""MATLAB files of version 4 to 7 by scipy; version 7.3 is HDF5."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from agent.reading.hdf5 import RATES, columns_of, with_times
from agent.reading.source import Arrays, Column, Slices, TableError, bounded_memory, check_announced

HEADER_BYTES = 128
COMPRESSED = 15  # data type of an element
PIECE = 1 << 20
LEAST_MEMORY, COPIES = 1 << 29, 6  # bytes that reading may take: so many at least, and copies of all values


def open_matlab(path: Path) -> Arrays:
    """Variables with numbers as columns; a structure is a group. Raises TableError.

    scipy reads the file in a process of its own, because a damaged file can end that process.
    """
    memory = LEAST_MEMORY + COPIES * _unpacked_bytes(path)
    command = [sys.executable, "-m", "agent.reading.matlab", str(path), str(memory)]
    done = subprocess.run(command, capture_output=True, check=False)
    if done.returncode:
        reason = done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2] or "its reader failed"
        raise TableError(f"{path}: the file cannot be read: {reason}; save it with -v7 or -v7.3")
    values: dict[Column, Slices] = {}
    rates: dict[str, float] = {}
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as found:
        for k, (group, name) in enumerate(found["names"].tolist()):
            array = found[str(k)]
            if array.size == 1 and name.lower() in RATES:
                rates[group] = float(array.ravel()[0])
            elif array.size and array.ndim in (1, 2):
                values |= columns_of(name, array, "", group)
    return Arrays(path, with_times(values, rates))


def main(path: str, memory_bytes: str) -> None:
    """Write the arrays of numbers in the file to standard output, as npz without objects."""
    from scipy.io import loadmat

    with suppress(ImportError):  # Windows has none
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    found: dict[tuple[str, str], NDArray[Any]] = {}
    try:
        with bounded_memory(int(memory_bytes)):  # scipy allots what a cell array announces
            for name, value in loadmat(path, squeeze_me=True).items():
                if not name.startswith("__"):
                    _take(name, value, "", found)
    except MemoryError:
        sys.exit("the file announces more than it holds")
    except Exception as error:  # scipy raises many kinds for broken files
        sys.exit(str(error) or type(error).__name__)
    whole = io.BytesIO()
    names = np.array(list(found) or np.empty((0, 2)), dtype=str)
    np.savez(whole, names=names, **{str(k): array for k, array in enumerate(found.values())})  # type: ignore[arg-type]
    sys.stdout.buffer.write(whole.getbuffer())


def _take(name: str, value: Any, group: str, found: dict[tuple[str, str], NDArray[Any]]) -> None:
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
    main(*sys.argv[1:])
