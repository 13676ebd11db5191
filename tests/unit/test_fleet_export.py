"""`fieldcal fleet replay --export`: the files of `fieldcal export`, the same with 1 and 2 processes, resumed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from agent.cli.export import export
from agent.cli.fleet_replay import replay
from tests.unit.recorded_bench import record


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings, and a file that is none."""
    directory = tmp_path_factory.mktemp("recordings")
    for seed in (1, 2):
        record(directory / f"made-{seed}", 3.0, seed=seed)
        shutil.move(directory / f"made-{seed}" / "fieldcal-000001.mcap", directory / f"gateway-{seed}.mcap")
    (directory / "other.mcap").write_bytes(b"other")
    return directory


def exported(*arguments: object) -> tuple[int, list[dict[str, Any]]]:
    done = CliRunner().invoke(replay, [*map(str, arguments), "--json", "-"], standalone_mode=False)
    assert done.exception is None, done.output
    return int(done.return_value), json.loads(done.stdout)["files"]


def written(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


@pytest.mark.thorough
def test_files_are_those_of_export_with_one_and_two_processes_and_go_on_where_they_ended(
    recordings: Path, tmp_path: Path
) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    status, files = exported(recordings, "--export", "csv", "--workers", 1, "-o", one)
    assert (status, [bool(file["reasons"]) for file in files]) == (3, [False, False, True])
    assert exported(recordings, "--export", "csv", "--workers", 2, "-o", two) == (status, files)
    assert written(one) == written(two)
    for file in files[:2]:
        alone = tmp_path / "alone.csv"
        assert CliRunner().invoke(export, [file["place"], "--to", str(alone)], standalone_mode=False).return_value == 0
        (made,) = file["exported"]
        assert (two / made["file"]).read_bytes() == alone.read_bytes()
        assert alone.read_bytes().count(b"\n") == 1 + made["samples"]
        alone.unlink()
    spoilt, whole = (two / file["exported"][0]["file"] for file in files[:2])
    spoilt.write_bytes(spoilt.read_bytes()[:-10])
    before = whole.stat().st_ino
    status, again = exported(recordings, "--export", "csv", "--workers", 1, "-o", two)
    assert [file["unchanged"] for file in again] == [False, True, False]
    assert whole.stat().st_ino == before
    assert written(two) == written(one)


def test_export_needs_a_directory_and_nothing_beside_it(recordings: Path, tmp_path: Path) -> None:
    for more in ((), ("-o", str(tmp_path), "--audit")):
        done = CliRunner().invoke(replay, [str(recordings), "--export", "csv", *more], standalone_mode=False)
        assert "--export needs -o DIR" in str(done.exception)
