"""MATLAB, HDF5 and TDMS files that other programs made give the same samples; hostile ones are refused."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from agent.calibrate.tables import read_reference, read_sensor
from agent.reading import source
from calib.recorded.units import sensitivity_of
from tests.unit.test_reading_csv import written
from tests.unit.test_reading_formats import RATE_HZ, TIME_S, V, fault, same

# MATLAB


MATLAB: dict[str, dict[str, Any]] = {
    "vectors": {"t": TIME_S, "x": V[:, 0], "y": V[:, 1], "z": V[:, 2]},
    "columns": {"t": TIME_S[:, None], "x": V[:, :1], "y": V[:, 1:2], "z": V[:, 2:]},
    "a matrix": {"time": TIME_S, "acc": V},
    "a matrix on its side": {"time": TIME_S, "acc": V.T},
    "a rate": {"fs": 100.0, "acc": V},
    "a structure": {"imu": {"time": TIME_S, "acc": V, "note": "text"}, "other": 3},
    "names": {"Time": TIME_S, "AccX": V[:, 0], "AccY": V[:, 1], "AccZ": V[:, 2], "GyroX": V[:, 0], "cell": ["a", "b"]},
}


@pytest.mark.one_case
@pytest.mark.parametrize(("kind", "compressed"), [*((kind, True) for kind in MATLAB), ("a structure", False)])
def test_matlab(kind: str, compressed: bool, tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", MATLAB[kind], do_compression=compressed)
    same(tmp_path / "a.mat")


def test_a_bomb_of_matlab_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    savemat(tmp_path / "a.mat", {"x": {"y": np.zeros(1_000_000)}}, do_compression=True)
    assert (tmp_path / "a.mat").stat().st_size < 1e4
    monkeypatch.setattr(source, "ALWAYS_ALLOWED_BYTES", 1 << 20)  # so that the test needs no 300 MB
    fault(tmp_path / "a.mat", "the file says that it holds .* are allowed for its size")


def test_a_bomb_beside_the_variables_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    savemat(tmp_path / "a.mat", {"x": np.zeros(3)})
    packed = zlib.compress(bytes(4 << 20))  # an element that holds no variable
    data = (tmp_path / "a.mat").read_bytes() + struct.pack("<II", 15, len(packed)) + packed
    monkeypatch.setattr(source, "ALWAYS_ALLOWED_BYTES", 1 << 20)
    fault(written(tmp_path, data, "b.mat"), "the file says that it holds .* are allowed for its size")


@pytest.mark.slow
def test_a_cell_array_that_announces_too_much_is_refused(tmp_path: Path) -> None:
    cells = np.empty((2, 3), object)
    cells[:] = "a"
    savemat(tmp_path / "a.mat", {"c": cells})
    data = (tmp_path / "a.mat").read_bytes()
    dimensions = struct.pack("<ii", 2, 3)
    assert data.count(dimensions) == 1
    path = written(tmp_path, data.replace(dimensions, struct.pack("<ii", 1 << 16, 1 << 15)), "b.mat")
    fault(path, "announces more than it holds; save it with -v7")


@pytest.mark.slow
def test_a_file_that_ends_its_reader_is_told(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", MATLAB["vectors"])
    data = bytearray((tmp_path / "a.mat").read_bytes())
    numbers = data.index(struct.pack("<II", 9, 8 * len(V)))  # the tag of V's numbers: of type 9, double
    data[numbers : numbers + 4] = struct.pack("<I", 8)  # scipy 1.17 has no such type, and looks for it at address 0
    fault(written(tmp_path, bytes(data), "b.mat"), "cannot be read: .*; save it with -v7")


@pytest.mark.thorough
def test_damaged_matlab(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", MATLAB["vectors"], do_compression=True)
    data = (tmp_path / "a.mat").read_bytes()
    fault(written(tmp_path, data[:300], "b.mat"), "cannot be read: .*; save it with -v7")
    fault(written(tmp_path, data[:400] + b"\xff" * 400 + data[800:], "c.mat"), "cannot be read: .*; save it with -v7")
    fault(written(tmp_path, b"MATLAB 5.0", "e.mat"), "cannot be read: .*; save it with -v7")
    fault(written(tmp_path, data[:128], "d.mat"), "there are no columns of numbers")


# HDF5


def hdf5(path: Path, fill: Callable[[Any], None]) -> Path:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed (extra hdf5)")
    with h5py.File(path, "w") as file:
        fill(file)
    return path


def plain(file: Any) -> None:
    for name, values in {"time": TIME_S, "x": V[:, 0], "y": V[:, 1], "z": V[:, 2]}.items():
        file[name] = values


def in_a_group(file: Any) -> None:
    group = file.create_group("run/imu")
    group.attrs["sample_rate"] = float(RATE_HZ)
    group.create_dataset("acc", data=V.T, chunks=(3, 100), compression="gzip", shuffle=True)
    file.create_group("run/empty")
    file["run/label"] = "text"


def records(file: Any) -> None:
    table = np.zeros(len(V), [("time", "f8"), ("ax", "f8"), ("ay", "f8"), ("az", "f8"), ("ok", "S1")])
    table["time"], table["ax"], table["ay"], table["az"] = TIME_S, *V.T
    file["table"] = table


@pytest.mark.parametrize("fill", [plain, in_a_group, records], ids=lambda fill: fill.__name__)
def test_hdf5(fill: Callable[[Any], None], tmp_path: Path) -> None:
    same(hdf5(tmp_path / "a.h5", fill))


def test_units_of_hdf5(tmp_path: Path) -> None:
    def fill(file: Any) -> None:
        file["time"], file["acc"] = TIME_S, V[:, 0]
        file["acc"].attrs["units"] = "mg"

    found = read_reference(hdf5(tmp_path / "a.h5", fill))
    np.testing.assert_allclose(found.x[:][:, 0], 9.80665e-3 * V[:, 0], rtol=1e-14)


def test_matlab_7_3(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed (extra hdf5)")
    path = tmp_path / "a.mat"
    with h5py.File(path, "w", userblock_size=512) as file:  # as MATLAB: a header of text before the HDF5 file
        file["t"], file["acc"] = TIME_S[None, :], V.T
    data = path.read_bytes()
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(128) + data[128:])
    same(path)


def test_nothing_outside_an_hdf5_file_is_read(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed (extra hdf5)")
    secret = written(tmp_path, V[:, 0].tobytes(), "secret")
    hdf5(tmp_path / "other.h5", plain)

    def external(file: Any) -> None:
        plain(file)
        file.create_dataset("w", (len(V),), "f8", external=[(str(secret), 0, h5py.h5f.UNLIMITED)])

    def link(file: Any) -> None:
        for name in ("time", "x", "y", "z"):
            file[name] = h5py.ExternalLink(str(tmp_path / "other.h5"), name)

    def virtual(file: Any) -> None:
        plain(file)
        layout = h5py.VirtualLayout((len(V),), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "x", (len(V),))
        file.create_virtual_dataset("w", layout)

    fault(hdf5(tmp_path / "a.h5", external), "data set /w: its values are in another file, which is not read")
    fault(hdf5(tmp_path / "b.h5", link), "there are no columns of numbers")
    fault(hdf5(tmp_path / "c.h5", virtual), "data set /w: its values are in another file, which is not read")


def test_hostile_hdf5(tmp_path: Path) -> None:
    def circle(file: Any) -> None:
        plain(file)
        file["again"] = file["/"]

    def bomb(file: Any) -> None:
        file.create_dataset("x", (1 << 40,), "f8", chunks=(1 << 20,), compression="gzip")

    fault(hdf5(tmp_path / "a.h5", circle), "groups in each other")
    fault(hdf5(tmp_path / "b.h5", bomb), "the file says that it holds 8.8e\\+12 bytes of values")
    packed = bytearray(hdf5(tmp_path / "e.h5", in_a_group).read_bytes())
    at = packed.index(b"\x78\x5e")  # a chunk that zlib packed
    packed[at + 20 : at + 40] = bytes(20)
    fault(written(tmp_path, bytes(packed), "f.h5"), "row 1 to 400: the values cannot be read: .*; write the file anew")
    data = hdf5(tmp_path / "c.h5", plain).read_bytes()
    fault(written(tmp_path, data[: len(data) // 2], "d.h5"), "cannot be read: .*; write it anew")


# TDMS


def tdms(path: Path, **properties: Any) -> Path:
    nptdms = pytest.importorskip("nptdms", reason="npTDMS is not installed (extra tdms)")
    with nptdms.TdmsWriter(path) as writer:
        for first in range(0, len(V), 150):
            part = slice(first, first + 150)
            writer.write_segment(
                [nptdms.ChannelObject("imu", f"acc {a}", V[part, k], properties) for k, a in enumerate("xyz")]
            )
    return path


def test_tdms_with_waveforms(tmp_path: Path) -> None:
    start = np.datetime64("2023-11-14T22:13:20.25")
    path = tdms(tmp_path / "a.tdms", wf_increment=1 / RATE_HZ, wf_start_time=start, unit_string="g")
    same(path, 1_700_000_000.25 + TIME_S)
    np.testing.assert_allclose(read_reference(path).x[:], 9.80665 * V, rtol=1e-14)


def test_tdms_with_stamps(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms", reason="npTDMS is not installed (extra tdms)")
    stamps = np.datetime64("2023-11-14T22:13:20") + (TIME_S * 1e6).round().astype("timedelta64[us]")
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment([nptdms.ChannelObject("log", "time", stamps)])
        writer.write_segment([nptdms.ChannelObject("log", n, V[:, k]) for k, n in enumerate("xyz")])
    found = read_sensor(tmp_path / "a.tdms")
    np.testing.assert_allclose(found.time_s[:], 1_700_000_000 + TIME_S, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(found.v[:], V)


def test_broken_tdms(tmp_path: Path) -> None:
    path = tdms(tmp_path / "a.tdms")
    fault(path, "column time_s is missing in the header 'imu.acc x,imu.acc y,imu.acc z'")
    data = path.read_bytes()
    fault(written(tmp_path, data[:20], "b.tdms"), "cannot be read: .*; write it anew|no columns of numbers")
    fault(written(tmp_path, data[:28] + b"\xff" * 60 + data[88:], "c.tdms"), "cannot be read: .*; write it anew")


# MiniSEED


def miniseed(path: Path, parts: list[tuple[str, np.ndarray, float]]) -> Path:
    """Traces of a station: code of the channel, samples, start in s after 22:13:20."""
    obspy = pytest.importorskip("obspy", reason="ObsPy is not installed (extra seismic)")
    traces = []
    for code, samples, start_s in parts:
        about = {"network": "XX", "station": "FIELD", "channel": code, "sampling_rate": RATE_HZ}
        about["starttime"] = obspy.UTCDateTime("2023-11-14T22:13:20") + start_s
        traces.append(obspy.Trace(samples, about))
    obspy.Stream(traces).write(str(path), format="MSEED")
    return path


@pytest.mark.filterwarnings("default")
def test_miniseed(tmp_path: Path) -> None:
    whole = np.round(1000 * V).astype(np.int32)
    x, y, z = whole.T
    path = miniseed(
        tmp_path / "a.mseed", [("HNE", x, 0.0), ("HNN", y, 0.0), ("HNZ", z[:100], 0.0), ("HNZ", z[130:], 1.3)]
    )
    gap = whole.astype(float)
    gap[100:130] = np.nan
    same(path, 1_700_000_000 + TIME_S, gap)
    found = read_reference(
        miniseed(tmp_path / "b.mseed", [("HHZ", z, 0.0)]), None, None, sensitivity_of("50 counts/(m/s)")
    )
    assert found.quantity == "velocity"
    np.testing.assert_allclose(found.x[:][:, 0], z / 50, rtol=1e-14)


@pytest.mark.filterwarnings("default")
def test_broken_miniseed(tmp_path: Path) -> None:
    pytest.importorskip("obspy", reason="ObsPy is not installed (extra seismic)")
    fault(written(tmp_path, b"nothing of that kind\0" * 40, "a.mseed"), "cannot be read: .*; write it anew")
    data = miniseed(tmp_path / "b.mseed", [("HNE", np.arange(300, dtype=np.int32), 0.0)]).read_bytes()
    fault(written(tmp_path, data[:30], "c.mseed"), "cannot be read: .*; write it anew")
