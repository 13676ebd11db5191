"""The audit passes intact recordings, and says where and why others fail: bytes, chain, results or signature."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.audit.engines import Engines
from agent.cli.audit import audit_files, run_audit
from agent.cli.given import GivenFiles, recordings_of
from agent.core.events import RunStart
from agent.recording.comparison import OTHER_CPU
from agent.recording.files import recordings
from agent.recording.fingerprint import environment_for, fingerprint
from tests.replay.forgery import with_sums
from tests.replay.stand_in import Recorded, StandIn, record_run
from tests.replay.test_replay import alter_data, record_again

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    """Three files of one run."""
    record_run(tmp_path, blocks=12, rotate_at=(9, 20))
    return [path for _, path in recordings(tmp_path)]


def audit(files: list[Path], capsys: pytest.CaptureFixture[str], **options: Any) -> tuple[int, str]:
    status = run_audit(recordings_of(files), Engines(StandIn.restore), as_json=False, **options)
    return status, capsys.readouterr().out


def test_sound_recordings_pass(files: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    for given in (files, files[:1], files[1:]):
        status, said = audit(given, capsys)
        assert status == 0, said
        assert said.count("equal bit for bit") == len(given)


def test_json_is_one_object(files: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert run_audit(GivenFiles(files), Engines(StandIn.restore), as_json=True) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["ok"], said["undecidable"]) == (True, 0)
    assert [file["size"] for file in said["files"]] == [path.stat().st_size for path in files]
    assert [file["replay"]["in_chain"] for file in said["files"]] == [False, True, True]


def test_a_changed_byte_fails_and_is_placed(files: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    whole = files[0].read_bytes()
    for offset in np.random.default_rng(1).choice(len(whole), 40, replace=False).tolist():
        changed = bytearray(whole)
        changed[offset] ^= 0x20
        files[0].write_bytes(changed)
        status, said = audit(files[:1], capsys)
        assert status == 3
        assert "FAILED" in said
        assert "  byte " in said or "  incomplete, last good byte " in said


def test_an_unfinished_file_is_incomplete(files: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    whole = files[0].read_bytes()
    files[0].write_bytes(whole[:5000])
    status, said = audit(files, capsys)
    assert status == 3
    first = audit_files(GivenFiles(files), Engines(StandIn.restore))[0]
    assert first.incomplete
    assert f"incomplete, last good byte {first.good_bytes}: byte" in said
    assert said.count("FAILED") == 1  # the next file passes
    assert first.replay.equal


def test_a_replaced_file_breaks_the_chain(files: list[Path], tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    record_run(other, blocks=12, rotate_at=(9, 20), seed=2)
    (other / files[1].name).rename(files[1])
    first, second, third = audit_files(GivenFiles(files), Engines(StandIn.restore))
    assert first.ok
    assert "the results do not follow from the data: event 9, snapshot" in second.reasons[0]
    assert any("SHA-256 differs" in reason for reason in third.reasons)


def test_a_file_number_that_was_changed_is_found_though_the_sums_fit(files: list[Path]) -> None:
    data = files[0].read_bytes()
    at = data.index(b"file_sequence") + len(b"file_sequence") + 4
    assert data[at : at + 1] == b"1"
    files[0].write_bytes(with_sums(data[:at] + b"7" + data[at + 1 :]))
    (file,) = audit_files(GivenFiles(files[:1]), Engines(StandIn.restore))
    assert file.reasons == ["its metadata says file number 7, its RunStart 1"]


def test_results_that_do_not_follow_fail_though_every_sum_is_right(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record_again(tmp_path / "again", record_run(tmp_path), alter_data)
    status, said = audit([path], capsys)
    assert status == 3
    assert "the results do not follow from the data: event" in said


def test_a_recording_that_is_not_given_is_named(files: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    status, said = audit([files[0], files[2]], capsys)
    assert status == 0
    assert f"not proven: that {files[2]} follows {files[0]}: recording 2 is not given" in said
    assert "note: events 9 to 19 are in none of these files" in said
    files[1].unlink()
    status, said = audit([files[0].parent], capsys)
    assert status == 3
    assert "recording 2 is missing before it, and no recording given here says that retention deleted it" in said


@pytest.mark.parametrize("content", [b"", b"not an MCAP file at all", b"\x89MCAP0\r\n\x89MCAP0\r\n"])
def test_other_files_fail(tmp_path: Path, content: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    assert audit([path], capsys)[0] == 3


def test_a_file_that_cannot_be_read_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_audit(GivenFiles([tmp_path / "gone.mcap"]), Engines(StandIn.restore), as_json=False) == 2
    assert run_audit(GivenFiles([tmp_path]), Engines(StandIn.restore), as_json=False) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.splitlines() == [
        f"{tmp_path / 'gone.mcap'}: No such file or directory",
        f"{tmp_path}: Is a directory",
    ]


def test_another_fingerprint_is_compared_within_the_tolerance(tmp_path: Path) -> None:
    def elsewhere(entry: Recorded) -> Recorded:
        number, event, results = entry
        if isinstance(event, RunStart):
            event = msgspec.structs.replace(event, fingerprint=event.fingerprint | {"machine": "aarch64"})
        return number, event, results

    path = record_again(tmp_path / "again", record_run(tmp_path), elsewhere)
    (file,) = audit_files(GivenFiles([path]), Engines(StandIn.restore))
    assert file.ok
    assert file.replay.tolerance == OTHER_CPU
    assert file.notes


RECORD = """
import sys
from pathlib import Path
from tests.replay.stand_in import record_run
record_run(Path(sys.argv[1]))
"""
AUDIT = """
import sys
from pathlib import Path
from agent.audit.engines import Engines
from agent.cli.audit import run_audit
from agent.cli.given import GivenFiles
from agent.recording.fingerprint import compute_as
from agent.recording.reading import first_event
from tests.replay.stand_in import StandIn
path = Path(sys.argv[1])
compute_as(first_event(path).fingerprint)
sys.exit(run_audit(GivenFiles([path]), Engines(StandIn.restore), as_json=True))
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="names kernels of x86")
def test_an_audit_computes_with_the_kernels_of_the_recording(tmp_path: Path) -> None:
    kernel = "Nehalem" if fingerprint()["blas_kernel"] != "Nehalem" else "Prescott"
    features = fingerprint()["cpu_features"]
    there = os.environ | {"OPENBLAS_CORETYPE": kernel, "NPY_DISABLE_CPU_FEATURES": features}
    subprocess.run([sys.executable, "-c", RECORD, str(tmp_path)], cwd=REPOSITORY, env=there, check=True, timeout=60)
    command = [sys.executable, "-c", AUDIT, str(tmp_path / "fieldcal-000001.mcap")]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, check=False, timeout=60)
    assert done.stderr == b""
    (file,) = json.loads(done.stdout)["files"]
    assert (done.returncode, file["ok"], file["replay"]["tolerance"], file["notes"]) == (0, True, 0.0, [])


IN_ANOTHER_PROGRAM = """
import sys
from agent.cli.main import run_cli
print("begun", flush=True)
run_cli([sys.argv[1], sys.argv[2]])
print("gone on")
"""


@pytest.mark.one_case
@pytest.mark.skipif(platform.machine() != "x86_64", reason="names kernels of x86")
@pytest.mark.parametrize("command", ["replay", "audit"])
def test_a_program_that_runs_a_command_is_not_begun_anew(command: str, tmp_path: Path) -> None:
    """Its command line is not that of the command; a test run ended so without a word, with status 0."""
    kernel = "Nehalem" if fingerprint()["blas_kernel"] != "Nehalem" else "Prescott"
    there = os.environ | {"OPENBLAS_CORETYPE": kernel, "NPY_DISABLE_CPU_FEATURES": fingerprint()["cpu_features"]}
    subprocess.run([sys.executable, "-c", RECORD, str(tmp_path)], cwd=REPOSITORY, env=there, check=True, timeout=60)
    program = [sys.executable, "-c", IN_ANOTHER_PROGRAM, command, str(tmp_path / "fieldcal-000001.mcap")]
    done = subprocess.run(program, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=60)
    assert (done.stdout.count("begun"), done.stdout.count("gone on")) == (1, 1)


def test_kernels_that_this_cpu_lacks_are_never_asked_for() -> None:
    here = fingerprint()
    assert environment_for(here | {"blas_kernel": "Other"}) is not None
    for name, value in (
        ("cpu_features", "NO_SUCH_FEATURE"),
        ("numpy", "1.0"),
        ("machine", "vax"),
        ("blas_kernel", "x\0y"),
        ("blas_threads", ""),
    ):
        assert environment_for(here | {name: value}) is None
    assert environment_for({}) is None
