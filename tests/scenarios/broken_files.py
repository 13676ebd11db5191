"""Files that are broken in one place each: what they hold, and what must be said of the place and of the remedy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.scenarios.forty_files import TIME_S, WRITERS

HEADER = "time_s,vx,vy,vz\n"
ROWS = "".join(f"{t},1,2,{t}\n" for t in TIME_S[:50].tolist())


@dataclass(frozen=True)
class Broken:
    """A file, and regular expressions of the place and the remedy that must be told. `needs`: libraries."""

    name: str
    make: Callable[[Path, np.ndarray], None]
    place: str
    remedy: str
    needs: tuple[str, ...] = ()


def text(content: str | bytes) -> Callable[[Path, np.ndarray], None]:
    data = content if isinstance(content, bytes) else content.encode()

    def make(path: Path, _: np.ndarray) -> None:
        path.write_bytes(data)

    return make


def changed(line: int, to: str) -> Callable[[Path, np.ndarray], None]:
    lines = (HEADER + ROWS).splitlines()
    lines[line - 1] = to
    return text("\n".join(lines) + "\n")


def cut(writer: str, share: float = 0.5) -> Callable[[Path, np.ndarray], None]:
    """A file of another program, of which the end is missing."""

    def make(path: Path, v: np.ndarray) -> None:
        WRITERS[writer].write(path, "sensor", v)
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])

    return make


def part(writer: str, rows: int = len(TIME_S), axes: int = 3) -> Callable[[Path, np.ndarray], None]:
    """A file of another program with less in it."""
    return lambda path, v: WRITERS[writer].write(path, "sensor", v[:rows, :axes])


def matlab(**told: Any) -> Callable[[Path, np.ndarray], None]:
    def make(path: Path, _: np.ndarray) -> None:
        from scipy.io import savemat

        savemat(path, told)

    return make


def linked(path: Path, _: np.ndarray) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file["time"], file["x"], file["y"] = TIME_S, TIME_S, TIME_S
        file.create_dataset("z", (len(TIME_S),), "f8", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])


def workbook(path: Path, _: np.ndarray) -> None:
    import openpyxl

    book = openpyxl.Workbook()
    for line in (HEADER + ROWS).splitlines():
        book.active.append([cell if "v" in line else float(cell) for cell in line.split(",")])
    book.active["C11"] = "two"
    book.save(path)


BROKEN = {
    "a word among numbers": Broken("a.csv", changed(20, "0.1,1,two,3"), "line 20, column vy: 'two'", "write|correct"),
    "a field too few": Broken("a.csv", changed(20, "0.1,1,2"), "line 20", "add|correct|columns"),
    "an infinite value": Broken("a.csv", changed(20, "0.1,1,inf,3"), "line 20, column vy", "correct|remove"),
    "an infinite time": Broken("a.csv", changed(20, "inf,1,2,3"), "line 20, column time_s", "correct|remove"),
    "a time that decreases": Broken("a.csv", changed(20, "0.01,1,2,3"), "line 20, column time_s", "sort or cut"),
    "a column that is missing": Broken("a.csv", changed(1, "time_s,vx,vy,w"), "line 1.*vz is missing", "--columns"),
    "a constant time": Broken("a.csv", text(HEADER + "1,2,3,4\n" * 9), "column time_s", "time must increase"),
    "a header alone": Broken("a.csv", text(HEADER), "0 rows", "at least 2"),
    "an empty file": Broken("a.csv", text(""), "a.csv", "empty|no columns|at least"),
    "bytes of no format": Broken("a.bin", text(bytes(range(256)) * 9), "line 1", "write it as CSV"),
    "a Parquet file that is cut": Broken("a.parquet", cut("pandas parquet"), "a.parquet", "write it", ("pyarrow",)),
    "a Feather file that is cut": Broken("a.feather", cut("pandas feather"), "a.feather", "write it", ("pyarrow",)),
    "an HDF5 file that is cut": Broken("a.h5", cut("h5py", 0.3), "a.h5", "write it", ("h5py",)),
    "an HDF5 file with values elsewhere": Broken("a.h5", linked, "data set /z", "not read", ("h5py",)),
    "a MATLAB file that is cut": Broken("a.mat", cut("scipy mat"), "a.mat", "save it with -v7"),
    "a MATLAB file with different lengths": Broken(
        "a.mat", matlab(t=TIME_S, x=TIME_S, y=TIME_S, z=TIME_S[:9]), "'z' has 9", "choose others"),
    "a WAV file with one channel": Broken("a.wav", part("scipy wav float32", axes=1), "a.wav", "--columns"),
    "a WAV file without samples": Broken("a.wav", cut("scipy wav int16", 0.002), "a.wav", "write it|at least"),
    "a MiniSEED file that is cut": Broken("a.mseed", cut("ObsPy int16", 0.002), "a.mseed", "write it", ("obspy",)),
    "a TDMS file that is cut": Broken("a.tdms", cut("npTDMS", 0.003), "a.tdms", "write it|columns", ("nptdms",)),
    "an Excel file that is cut": Broken("a.xlsx", cut("openpyxl"), "a.xlsx", "as CSV", ("openpyxl",)),
    "a word in Excel": Broken("a.xlsx", workbook, "row 11, column vy: 'two'", "correct it", ("openpyxl",)),
    "a bag that is cut before a message": Broken(
        "a.mcap", cut("rosbags Imu", 0.0005), "byte \\d+ of \\d+", "record it anew", ("rosbags",)),
    "a bag of ROS 1 that is cut before a message": Broken(
        "a.bag", cut("rosbags Imu of ROS 1", 0.0005), "byte \\d+ of \\d+", "record it anew", ("rosbags",)),
    "a database that is cut": Broken(
        "a.db3", cut("rosbags Imu in SQLite", 0.0005), "a.db3", "record it anew|give a .db3", ("rosbags",)),
    "a bag without Imu": Broken("a.mcap", part("rosbags AccelStamped", rows=3), "/imu", "--mapping", ("rosbags",)),
}  # fmt: skip
