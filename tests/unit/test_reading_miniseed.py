"""MiniSEED as loggers leave it: the file that is named is read, from its bytes, each record at its own time."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from agent.calibrate.tables import SensorFile, read_sensor
from agent.reading import seismic
from agent.reading.ground_motion import GroundMotion
from agent.reading.seismic import open_miniseed
from agent.reading.stationxml import StationChannel, StationXml
from tests.unit.test_reading_csv import written
from tests.unit.test_reading_formats import fault

obspy = pytest.importorskip("obspy", reason="ObsPy is not installed (extra seismic)")
pytestmark = pytest.mark.filterwarnings("default")  # ObsPy's own
BEGIN_S = 1_700_000_000
RATE_HZ = 100.0
V = np.round(1000.0 * np.random.default_rng(36).normal(size=(4800, 3)))


def records(v: np.ndarray, start_s: float = 0.0, rate_hz: float = RATE_HZ, reclen: int = 512) -> bytes:
    """MiniSEED of one stretch by ObsPy, three components."""
    about = {
        "network": "XX",
        "station": "A",
        "sampling_rate": rate_hz,
        "starttime": obspy.UTCDateTime(BEGIN_S) + start_s,
    }
    traces = [
        obspy.Trace(np.ascontiguousarray(v[:, k], np.int32), about | {"channel": f"HN{code}"})
        for k, code in enumerate("ENZ")
    ]
    whole = io.BytesIO()
    obspy.Stream(traces).write(whole, format="MSEED", reclen=reclen)
    return whole.getvalue()


def begins(found: SensorFile) -> int:
    """How many rows are there whose samples are those of V from its first on, each at its time."""
    n = int(np.isfinite(found.v[:]).all(axis=1).sum())
    np.testing.assert_array_equal(found.v[:][:n], V[:n])
    np.testing.assert_allclose(found.time_s[:][:n], BEGIN_S + np.arange(n) / RATE_HZ, rtol=0, atol=5e-7)
    return n


@pytest.mark.parametrize("name", ["S[1].mseed", "S?.mseed", "*.mseed", "S{1,2}.mseed"])
def test_the_file_that_is_named_is_read(name: str, tmp_path: Path) -> None:
    for other in ("S1.mseed", "SX.mseed", "a.mseed"):
        written(tmp_path, records(-V), other)
    assert begins(read_sensor(written(tmp_path, records(V), name))) == len(V)


def test_an_archive_behind_the_records_is_not_unpacked(tmp_path: Path) -> None:
    """ObsPy by name would give what is in the archive, however large that is."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("other.mseed", records(-V))
    found = read_sensor(written(tmp_path, records(V) + archive.getvalue(), "a.mseed"))
    assert begins(found) == len(V)
    assert f"{len(archive.getvalue())} bytes are no records of MiniSEED; they are left out" in found.said[0]


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, records(V), "a.mseed")
    monkeypatch.setattr(seismic, "LARGEST", path.stat().st_size - 1)
    fault(path, "the file has more than .* bytes, so it is not read; split it by time")


def test_records_that_announce_too_much_are_refused(tmp_path: Path) -> None:
    record = bytearray(records(V)[:512])
    record[30:32] = b"\xff\xff"  # number of samples
    fault(written(tmp_path, bytes(record) * 1200, "a.mseed"), "cannot be read|are allowed for its size")


def test_what_a_power_cut_leaves(tmp_path: Path) -> None:
    data = records(V)
    cut = read_sensor(written(tmp_path, data[:-700], "a.mseed"))
    assert 0.8 * len(V) < begins(cut) < len(V)
    at = len(data) - 1024
    assert (
        f"the file ends early, as after a power cut; it is read up to byte {at} of {len(data) - 700} (" in cut.said[0]
    )
    zeros = read_sensor(written(tmp_path, data + bytes(5000), "b.mseed"))
    assert begins(zeros) == len(V)
    assert "5000 bytes are no records" in zeros.said[0]
    inside = read_sensor(written(tmp_path, data[:5120] + bytes(700) + data[5120:], "c.mseed"))
    assert begins(inside) == len(V)


def test_records_doubled_and_out_of_order(tmp_path: Path) -> None:
    data = records(V)
    parts = [data[k : k + 512] for k in range(0, len(data), 512)]
    order = np.random.default_rng(2).permutation(len(parts))
    shuffled = read_sensor(written(tmp_path, b"".join(parts[k] for k in order), "a.mseed"))
    assert begins(shuffled) == len(V)
    doubled = read_sensor(written(tmp_path, data + data[: 512 * 20], "b.mseed"))
    assert begins(doubled) == len(V)
    assert "20 records are there twice; each is taken once" in doubled.said[0]


STARTS_S = (0.0, 52.00337, 107.1, 3000.0004)  # the logger is on for 12 s each; no start is on the grid of another
STAY = 1200


def test_a_logger_that_is_off_gives_gaps(tmp_path: Path) -> None:
    stays = [records(V[k * STAY : (k + 1) * STAY], start) for k, start in enumerate(STARTS_S)]
    found = read_sensor(written(tmp_path, b"".join(stays), "a.mseed"))
    v, time_s = found.v[:], found.time_s[:]
    there = np.isfinite(v).all(axis=1)
    np.testing.assert_array_equal(v[there], V)
    truth = np.concatenate([start + np.arange(STAY) / RATE_HZ for start in STARTS_S])
    np.testing.assert_allclose(time_s[there] - BEGIN_S, truth, rtol=0, atol=1e-6)
    assert np.flatnonzero(~there).tolist() == [k * (STAY + 1) - 1 for k in (1, 2, 3)]  # a gap, not 2800 s of rows
    assert (np.diff(time_s) > 0.0).all()


def test_a_jump_from_1970_is_a_gap(tmp_path: Path) -> None:
    """As from a logger that begins before its clock is set."""
    stays = records(V[:STAY], 5.0 - BEGIN_S) + records(V[STAY : 2 * STAY], 100.0)
    found = read_sensor(written(tmp_path, stays, "a.mseed"))
    assert len(found.v) == 2 * STAY + 1
    assert np.isnan(found.v[:][STAY]).all()
    np.testing.assert_allclose(found.time_s[:][[0, STAY - 1, STAY + 1]], [5.0, 16.99, BEGIN_S + 100.0], atol=1e-6)


def test_a_short_hole_has_a_row_for_each_sample(tmp_path: Path) -> None:
    found = read_sensor(
        written(tmp_path, records(V[:STAY]) + records(V[STAY + 30 :], (STAY + 30) / RATE_HZ), "a.mseed")
    )
    assert len(found.v) == len(V)
    assert np.flatnonzero(np.isnan(found.v[:][:, 0])).tolist() == [*range(STAY, STAY + 30)]
    np.testing.assert_array_equal(found.v[:][STAY + 30 :], V[STAY + 30 :])


@pytest.mark.parametrize("true_hz", [1003.3, 996.7, 1000.05])
def test_the_times_of_the_records_tell_the_rate(true_hz: float, tmp_path: Path) -> None:
    """The header says 1000 Hz. With its rate, the records would overlap, or have holes, or drift by 0.2 ms."""
    made = [records(V[k : k + 400], k / true_hz, 1000.0, 4096) for k in range(0, len(V), 400)]
    found = read_sensor(written(tmp_path, b"".join(made), "a.mseed"))
    np.testing.assert_array_equal(found.v[:], V)
    np.testing.assert_allclose(found.time_s[:] - BEGIN_S, np.arange(len(V)) / true_hz, rtol=0, atol=6e-5)


def test_each_stretch_is_differentiated_alone(tmp_path: Path) -> None:
    components = tuple(
        StationChannel(f"XX.A..HN{code}", 0.0, 1e11, RATE_HZ, "M/S", 1e5, 1.0, azimuth, dip)
        for code, azimuth, dip in (("E", 90.0, 0.0), ("N", 0.0, 0.0), ("Z", 0.0, -90.0))
    )

    def accelerations(data: bytes) -> np.ndarray:
        source = open_miniseed(written(tmp_path, data, "a.mseed"))
        moved = GroundMotion(source, StationXml(tmp_path / "s.xml", components), "reference")
        return np.concatenate(list(moved.pieces(moved.columns[1:], None)))

    stays = [records(V[k * STAY : (k + 1) * STAY], start) for k, start in enumerate(STARTS_S[:2])]
    both, alone = accelerations(b"".join(stays)), [accelerations(stay) for stay in stays]
    np.testing.assert_array_equal(both[np.isfinite(both).all(axis=1)], np.concatenate(alone))
