"""A recording of an enDAQ recorder (IDE) gives the samples that its maker's library gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agent.calibrate.tables import read_reference, read_sensor
from agent.cli.main import run_cli
from agent.reading.source import TableError
from tests.realdata.datasets import dataset

G = 9.80665
MAGIC = b"\x1aE\xdf\xa3\x9fB\x86\x81\x01B\xf7\x81\x01B\xf2\x81\x04B\xf3\x81\x08B\x82\x84mide"


def recording() -> tuple[Path, Path]:
    """The recording, and its samples as numbers."""
    directory = dataset("endaq_shaker")
    path = directory / "SSX66115.IDE"
    if not path.is_file():
        pytest.skip(f"{path} is not there; it is testing/SSX66115.IDE of github.com/MideTechnology/idelib")
    pytest.importorskip("idelib", reason="idelib is not installed (extra endaq)")
    return path, directory / "SSX66115.npz"


def test_both_accelerometers_of_a_recorder() -> None:
    path, numbers = recording()
    with np.load(numbers) as told:
        sensor = read_sensor(path, columns="group=16g DC Acceleration")
        np.testing.assert_allclose(sensor.time_s[:], told["t_dut"], rtol=0, atol=1e-9)
        expected = told["dut_raw_g"] * told["factory_gain"] + told["factory_offset_g"]
        np.testing.assert_allclose(sensor.v[:], expected, rtol=1e-12, atol=1e-12)
        reference = read_reference(path, columns="group=Main Acceleration")
        assert reference.quantity == "acceleration"
        np.testing.assert_allclose(reference.time_s[:], told["t_ref"], rtol=0, atol=1e-9)
        np.testing.assert_allclose(reference.x[:], told["ref_g"] * G, rtol=0, atol=1e-6 * G)  # the numbers are float32


@pytest.mark.parametrize("length", [3000, 300_000])
def test_a_recording_that_was_cut(length: int, tmp_path: Path) -> None:
    path, _ = recording()
    (tmp_path / "cut.ide").write_bytes(path.read_bytes()[:length])
    with pytest.raises(TableError, match=r"cut\.ide: the file cannot be read: .*; export it as CSV") as told:
        read_sensor(tmp_path / "cut.ide")
    assert "\n" not in str(told.value)


def test_what_only_begins_like_a_recording(tmp_path: Path) -> None:
    pytest.importorskip("idelib", reason="idelib is not installed (extra endaq)")
    (tmp_path / "a.ide").write_bytes(MAGIC + bytes(range(256)))
    with pytest.raises(
        TableError, match=r"a\.ide: (the file cannot be read: .*; export it as CSV|there are no columns)"
    ):
        read_sensor(tmp_path / "a.ide")


def test_without_the_library_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("agent.reading.ide.find_spec", lambda _: None)
    (tmp_path / "a.ide").write_bytes(MAGIC)
    assert run_cli(["convert", str(tmp_path / "a.ide"), "-o", str(tmp_path / "a.csv")]) == 2
    error = capsys.readouterr().err
    assert "IDE files need idelib, which is not installed: fieldcal extras --install endaq" in error
    assert error.count("\n") == 1
