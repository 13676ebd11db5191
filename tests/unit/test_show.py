"""`fieldcal show` on a data directory: at rest, under a running agent, empty, missing and torn."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from agent.cli.show import show
from agent.core.events import Result as PipelineResult
from agent.delivery.history import FILE_NAME, StoredResult
from agent.delivery.store import Store
from tests.unit.results import calibration, clock, status, window


def run_show(*arguments: str | Path) -> Result:
    return CliRunner().invoke(show, [str(a) for a in arguments], standalone_mode=False)


def fill(directory: Path, *results: PipelineResult) -> Store:
    store = Store(directory, 0)
    store.commit([StoredResult.of(r, recorded=True, recording="fieldcal-000001.mcap") for r in results])
    return store


def test_it_shows_what_is_in_force_while_the_agent_has_the_store(tmp_path: Path) -> None:
    store = fill(tmp_path, window(1), calibration(2), status(3), calibration(4, sxx=26000.0), window(5, used=False))
    (tmp_path / "fieldcal-000001.mcap").write_bytes(b"x" * 1500)
    (tmp_path / "fieldcal-000002.mcap.active").write_bytes(b"x" * 500)
    said = run_show("--data-dir", tmp_path)
    assert (said.return_value, said.stderr) == (0, "")
    for words in (
        "mems  VALID  since 2023-11-14 22:13:20 UTC  8 windows", "26000 ± 12", "250 ± 80", "count per m/s²",
        "U with k = 2, type A, white",
        "method 3 (recursive adjustment), 8 windows, in force since", "Sxx 26154 ± 12", "30 deg  used, 6000 points",
        f"2 recordings in {tmp_path}, 2 kB: fieldcal-000001.mcap to fieldcal-000002.mcap.active",
    ):  # fmt: skip
        assert words in said.stdout, words
    store.close()


def test_json_is_one_object_with_the_results_as_published(tmp_path: Path) -> None:
    fill(tmp_path, window(1), calibration(2), status(3), calibration(4, qz_known=False)).close()
    (tmp_path / "fieldcal-000001.mcap").write_bytes(b"x" * 1500)
    said = run_show("--data-dir", tmp_path, "--json", "-", "--limit", "1")
    assert said.return_value == 0
    shown = json.loads(said.stdout)
    mems = shown["sensors"]["mems"]
    assert mems["status"]["status"] == "VALID"
    assert mems["calibration"]["sequence"] == 4
    assert mems["calibration"]["offset"] == [250.0, 250.0, None]
    assert mems["calibration"]["recorded"] is True
    assert [r["sequence"] for r in mems["history"]] == [4]
    assert [r["sequence"] for r in mems["windows"]] == [1]
    assert mems["drift"] == []
    assert shown["recordings"] == [{"file": "fieldcal-000001.mcap", "size_bytes": 1500, "finished": True}]


def test_the_newest_clock_results_are_shown_in_words(tmp_path: Path) -> None:
    fill(tmp_path, status(1), *(clock(n, device=d) for n, d in enumerate(("reference", "mems") * 2, start=2))).close()
    said = run_show("--data-dir", tmp_path, "--limit", "2").stdout
    own = "999.7123 ± 0.0042 Hz, nominal 1000 Hz; bursts come 0.31 ms late and scatter by 0.22 ms"
    assert f"UTC  clock of mems: {own}; lag 2.50 ± 0.30 ms\n" in said
    assert f"UTC  clock of reference: {own}\n" in said
    shown = json.loads(run_show("--data-dir", tmp_path, "--json", "-").stdout)
    assert [r["device"] for r in shown["sensors"]["mems"]["clock"]] == ["mems", "reference"] * 2


def test_a_calibration_that_is_not_in_force_is_history(tmp_path: Path) -> None:
    fill(tmp_path, calibration(1), status(2, "UNCALIBRATED", "another device")).close()
    said = run_show("--data-dir", tmp_path)
    assert "UNCALIBRATED" in said.stdout
    assert "no calibration in force" in said.stdout
    assert "Sxx 26154 ± 12" in said.stdout


def test_a_parameter_that_is_not_known_is_said_so(tmp_path: Path) -> None:
    fill(tmp_path, calibration(1, qz_known=False)).close()
    assert "not known" in run_show("--data-dir", tmp_path).stdout


@pytest.mark.parametrize("json_option", [[], ["--json", "-"]])
def test_nothing_there_is_one_line_and_status_2(tmp_path: Path, json_option: list[str]) -> None:
    for directory in (tmp_path, tmp_path / "missing"):
        said = run_show("--data-dir", directory, *json_option)
        assert said.return_value == 2
        assert said.stdout == ""
        remedy = "`fieldcal run` makes it in its data directory"
        assert said.stderr == f"fieldcal show: {directory / FILE_NAME}: there is no such file; {remedy}\n"


def test_a_store_without_results_is_no_fault(tmp_path: Path) -> None:
    fill(tmp_path).close()
    assert "no results yet" in run_show("--data-dir", tmp_path).stdout


@pytest.mark.parametrize("content", [b"", b"garbage, longer than the header of a database" * 9])
def test_what_is_no_store_is_one_line_and_status_2(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FILE_NAME).write_bytes(content)
    said = run_show("--data-dir", tmp_path)
    assert said.return_value == 2
    assert said.stderr.startswith(f"fieldcal show: {tmp_path / FILE_NAME}: ")
    assert said.stderr.count("\n") == 1


def test_a_result_of_another_version_is_one_line_and_status_2(tmp_path: Path) -> None:
    store = Store(tmp_path, 0)
    store.commit([StoredResult(1, "r", "mems", "calibration", b'{"sequence":1}', 1, True, "f")])
    store.close()
    said = run_show("--data-dir", tmp_path)
    assert said.return_value == 2
    assert "result 1, a calibration, cannot be read" in said.stderr


@pytest.mark.slow
@pytest.mark.root
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to become a user who may not write")
def test_a_reader_who_may_not_write_sees_a_store_that_was_closed(tmp_path: Path) -> None:
    fill(tmp_path, calibration(1), status(2)).close()
    # Another one as root first, so that all modules are loaded, which that user might not be allowed to read.
    command = (
        "import os, sys; from agent.cli.show import show; show(['--data-dir', sys.argv[2]], standalone_mode=False); "
        "os.setuid(65534); sys.exit(show(['--data-dir', sys.argv[1]], standalone_mode=False))"
    )
    copy = Path("/var/tmp") / f"fieldcal-show-{os.getpid()}"
    shutil.copytree(tmp_path, copy)
    try:
        copy.chmod(0o555)
        said = subprocess.run(
            [sys.executable, "-c", command, copy, tmp_path], capture_output=True, text=True, timeout=60
        )
    finally:
        copy.chmod(0o755)
        shutil.rmtree(copy)
    assert (said.returncode, said.stderr) == (0, "")
    assert said.stdout.count("in force since") == 2
