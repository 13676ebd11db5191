"""A full disk, recordings deleted by retention, kill -9: the audit knows what was deleted, and by whom."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.recording.files import recordings
from agent.recording.retention import KeepFiles
from agent.recording.set_aside import set_aside
from agent.recording.signing import Signer
from agent.recording.writer import Recorder
from tests.attacks.chain_site import KEY, audited, record
from tests.replay.stand_in import CONFIG, StandIn, run_start


def recorder_on(directory: Path) -> Recorder:
    """As a start makes it, with a limit that leaves two or three recordings."""
    size = sum(path.stat().st_size for _, path in recordings(directory))
    recorder = Recorder(directory, ["acc"], ["bridge-1"], keep=KeepFiles(bytes=size // 2), signer=Signer(KEY))
    recorder.close_torn()
    return recorder


def start(recorder: Recorder, number: int = 0) -> bool:
    pipeline = StandIn(CONFIG)
    event = run_start(pipeline, number, recorder.next_file_sequence)
    return recorder.record(number, event, pipeline.step(event))


def cannot(*_: object) -> None:
    raise OSError(errno.EIO, os.strerror(errno.EIO), "fieldcal-000001.deleted")


def prune_while_full(directory: Path, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Delete by retention while nothing can be recorded, then be killed; returns the numbers that are left."""
    with monkeypatch.context() as full:
        full.setattr("agent.recording.writer.free_bytes", lambda _: 0)
        recorder = recorder_on(directory)
        assert not start(recorder)
        assert os.strerror(errno.ENOSPC) in recorder.fault
        pruned = recorder.pruning
        assert pruned is not None
        assert not recorder.record(1, pruned, [])
    left = [number for number, _ in recordings(directory)]
    assert left[0] == pruned.last_file + 1 >= 3
    return left


def test_deletions_on_a_full_disk_are_known_after_a_kill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = tmp_path / "a"
    record(directory)
    whole = sum(path.stat().st_size for path in directory.glob("fieldcal-*"))
    left = prune_while_full(directory, monkeypatch)
    assert sum(path.stat().st_size for path in directory.glob("fieldcal-*")) < 0.7 * whole, "space was made"
    status, text = audited(directory)
    assert status == 0, text
    recorder = recorder_on(directory)
    with monkeypatch.context() as failing:
        failing.setattr("agent.recording.writer.remove_statements", cannot)
        assert start(recorder), "what cannot be deleted costs no recording"
    assert list(directory.glob("*.deleted"))
    recorder.close()
    left.append(left[-1] + 1)
    recorder = recorder_on(directory)
    assert start(recorder)
    assert [number for number, _ in recordings(directory)] == [*left, left[-1] + 1]
    assert not list(directory.glob("*.deleted")), "the recording says it now"
    recorder.close()
    status, text = audited(directory)
    assert status == 0, text


def test_a_kill_between_the_steps_of_a_deletion_loses_nothing(tmp_path: Path) -> None:
    files = record(tmp_path / "a")
    whole = files[0].read_bytes()
    aside = files[0].rename(files[0].with_name("fieldcal-000001.deleted"))
    recorder_on(tmp_path / "a")  # killed after the renaming: the recording is still there
    assert files[0].read_bytes() == whole
    set_aside(tmp_path / "a", 1, 1, "site/gateway", Signer(KEY))
    statement = aside.read_bytes()
    aside.write_bytes(statement + whole[len(statement) :])  # killed before the file was cut
    status, text = audited(tmp_path / "a")
    assert status == 0, text
    recorder_on(tmp_path / "a")
    assert aside.read_bytes() == statement


@pytest.mark.parametrize("forged", ["another key", "another number", "another gateway", "unsigned", "rubbish"])
def test_a_thief_cannot_say_that_retention_deleted_a_recording(tmp_path: Path, forged: str) -> None:
    files = record(tmp_path / "a")
    other = record(tmp_path / "b", gateway="other" if forged == "another gateway" else "gateway")
    key = Ed25519PrivateKey.generate() if forged == "another key" else KEY
    number = 2 if forged == "another number" else 1
    gateway = "site/other" if forged == "another gateway" else "site/gateway"
    set_aside(other[0].parent, number, number, gateway, None if forged == "unsigned" else Signer(key))
    files[0].unlink()
    statement = (other[0].parent / f"fieldcal-{number:06d}.deleted").read_bytes()
    aside = tmp_path / "a" / "fieldcal-000001.deleted"
    aside.write_bytes(b"rubbish" if forged == "rubbish" else statement)
    for _ in range(2):
        status, text = audited(tmp_path / "a")
        assert status == 3
        assert "recording 1 is missing before it" in text
        recorder = recorder_on(tmp_path / "a")  # nor does the agent repeat it in a signed recording
        assert start(recorder)
        recorder.close()
