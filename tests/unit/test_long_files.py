"""Memory of `fieldcal calibrate` and `fieldcal export` does not grow with the length of what they read."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("pyarrow")  # writes the files
from benchmarks.long_files import LIMIT_MB, WRITERS, calibrate, measured, pose_options

# The clock of a file is fitted to pieces of 17 minutes, which are what needs the most memory; from the second one on it
# is the same.
LENGTHS_MIN = (34, 51)
MOST_GROWTH_MB = 20.0  # in memory, the samples of 17 minutes have 49 MB


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A recording of each length."""
    return [WRITERS["mcap"](tmp_path_factory.mktemp("recording"), count, 1)[0] for count in LENGTHS_MIN]


def grew(peaks_mb: list[float]) -> float:
    assert max(peaks_mb) < LIMIT_MB
    return peaks_mb[1] - peaks_mb[0]


def calibrated(sensor: Path, reference: Path, count: int) -> float:
    """Peak memory in MB of a calibration that must be right."""
    _, peak_mb, worst = calibrate(sensor, reference, pose_options(sensor.parent, count, 1))
    assert worst < 2.0  # times U
    return peak_mb


@pytest.fixture(autouse=True)
def _one_thread_of_arrow(monkeypatch: pytest.MonkeyPatch) -> None:
    """What several threads hold at once depends on what else the machine does."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # of those that compute
    monkeypatch.setenv("ARROW_IO_THREADS", "1")


@pytest.mark.thorough
def test_calibrate_from_files(tmp_path: Path) -> None:
    assert grew([calibrated(*WRITERS["csv"](tmp_path, n, 1), n) for n in LENGTHS_MIN]) < MOST_GROWTH_MB


@pytest.mark.thorough
def test_calibrate_from_a_recording(recordings: list[Path]) -> None:
    peaks_mb = [calibrated(path, path, count) for path, count in zip(recordings, LENGTHS_MIN, strict=True)]
    assert grew(peaks_mb) < MOST_GROWTH_MB


@pytest.mark.thorough
def test_export(recordings: list[Path], tmp_path: Path) -> None:
    written = [tmp_path / f"{count}.parquet" for count in LENGTHS_MIN]
    peaks_mb = [
        measured(["export", str(path), "--to", str(to)])[1] for path, to in zip(recordings, written, strict=True)
    ]
    assert grew(peaks_mb) < MOST_GROWTH_MB
