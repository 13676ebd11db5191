"""Honest data directories that look odd: the audit with key and kept heads calls none of them forged."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from agent.core.events import Tick
from agent.delivery.store import Store
from agent.engine import identity
from agent.engine.known import known_engines
from agent.recording.end_check import GivenHead
from agent.recording.files import recordings
from agent.recording.head import HEAD_NAME
from agent.recording.retention import KeepFiles
from agent.recording.signing import Signer
from agent.recording.writer import Recorder
from benchmarks.attacks.site import OTHER
from tests.attacks import chain_site
from tests.attacks.chain_site import KEY, audited, known
from tests.replay.stand_in import CONFIG, EPOCH_NS, SECOND, StandIn, happenings, run_start

record = partial(chain_site.record, blocks=10)
Heads = list[bytes]


def begun(directory: Path, heads: Heads, events: int = 8) -> Recorder:
    """A run that is going on, with its data on the disk."""
    directory.mkdir(exist_ok=True)
    recorder = Recorder(directory, ["acc", "ref"], ["bridge-1"], signer=Signer(KEY), tell_head=heads.append)
    recorder.close_torn()
    pipeline = StandIn(CONFIG)
    start = run_start(pipeline, 0, recorder.next_file_sequence)
    for number, event in enumerate((start, *happenings(14, 3))):
        if number == events:
            break
        assert recorder.record(number, event, pipeline.step(event))
    recorder.sync()
    return recorder


def killed(directory: Path, heads: Heads, torn: bytes = b"", events: int = 8) -> Path:
    """A run that was killed; `torn`: what it had begun to write."""
    recorder = begun(directory, heads, events)
    path = recorder.path
    assert recorder._file is not None
    assert path is not None
    recorder._file.abandon()
    with open(path, "ab") as file:
        file.write(torn)
    return path


def two_runs(directory: Path, heads: Heads) -> None:
    record(directory, heads=heads)
    record(directory, seed=2, heads=heads)


def killed_while_writing(directory: Path, heads: Heads) -> None:
    killed(directory, heads, b"\x06\xff\x00\x00")
    record(directory, seed=2, heads=heads)


def killed_zeros(directory: Path, heads: Heads) -> None:
    killed(directory, heads, bytes(5000))
    record(directory, seed=2, heads=heads)


def killed_three_times(directory: Path, heads: Heads) -> None:
    for _ in range(3):
        killed(directory, heads, events=1)
    record(directory, seed=2, heads=heads)


def killed_before_its_first_event(directory: Path, heads: Heads) -> None:
    files = record(directory, heads=heads)
    (directory / f"fieldcal-{len(files) + 1:06d}.mcap.active").write_bytes(b"\x89MCAP0\r\n")
    record(directory, seed=2, heads=heads)


def killed_before_the_renaming(directory: Path, heads: Heads) -> None:
    files = record(directory, heads=heads)
    files[-1].rename(f"{files[-1]}.active")


def killed_before_the_renaming_and_started(directory: Path, heads: Heads) -> None:
    killed_before_the_renaming(directory, heads)
    record(directory, seed=2, heads=heads)


def empty_runs(directory: Path, heads: Heads) -> None:
    record(directory, heads=heads)
    for _ in range(2):
        begun(directory, heads, events=1).close()
    record(directory, seed=2, heads=heads)


def no_devices(directory: Path, heads: Heads) -> None:
    recorder = begun(directory, heads, events=1)
    for number in range(1, 30):
        assert recorder.record(number, Tick(t_monotonic_ns=number * SECOND, t_utc_ns=EPOCH_NS + number * SECOND), [])
    recorder.close()


def published(directory: Path) -> None:
    """All results are with the consumers: what is not published is never deleted."""
    store = Store(directory, 0)
    store.mark_published(store.last_sequence())
    store.close()


def retention(directory: Path, heads: Heads) -> None:
    files = record(directory, heads=heads)
    published(directory)
    record(directory, seed=2, heads=heads, keep=KeepFiles(bytes=3 * files[0].stat().st_size))
    assert recordings(directory)[0][0] > 2


def store_lost(directory: Path, heads: Heads) -> None:
    record(directory, heads=heads)
    for path in directory.glob("state.*"):
        path.unlink()
    record(directory, seed=2, heads=heads)


def store_lost_after_a_kill(directory: Path, heads: Heads) -> None:
    record(directory, heads=heads)
    killed(directory, heads)
    for path in directory.glob("state.*"):
        path.unlink()
    record(directory, seed=2, heads=heads)


def restored_from_a_backup(directory: Path, heads: Heads) -> None:
    record(directory, heads=heads)
    backup = shutil.copytree(directory, directory.with_name("backup"))
    record(directory, seed=2)  # these heads reached nobody
    shutil.rmtree(directory)
    shutil.copytree(backup, directory)
    record(directory, seed=3, heads=heads)


def deleted_ones_put_back(directory: Path, heads: Heads) -> None:
    files = record(directory, heads=heads)
    held = {path: path.read_bytes() for path in files[:2]}
    published(directory)
    record(directory, seed=2, heads=heads, keep=KeepFiles(bytes=3 * files[0].stat().st_size))
    for path, content in held.items():
        assert not path.exists()
        path.write_bytes(content)


def head_lost(directory: Path, heads: Heads) -> None:
    two_runs(directory, heads)
    (directory / HEAD_NAME).unlink()


def older_head(directory: Path, heads: Heads) -> None:
    two_runs(directory, heads)
    (directory / HEAD_NAME).write_bytes(heads[1])


def other_files(directory: Path, heads: Heads) -> None:
    files = record(directory, heads=heads)
    for name in ("notes.txt", "head.json.new", "state.sqlite.corrupt-1", f"{files[0].name}.lock", "export.csv"):
        (directory / name).write_bytes(b"x")
    (directory / "copies").mkdir()


def key_replaced(directory: Path, heads: Heads) -> None:
    record(directory, heads=heads)
    record(directory, seed=2, heads=heads, key=OTHER)


def full_disk(directory: Path, heads: Heads) -> None:
    """A write fails in the middle of a run; the next file begins ten seconds later."""
    recorder = begun(directory, heads)
    assert recorder._file is not None
    with pytest.MonkeyPatch.context() as full:
        full.setattr(recorder._file, "sync", no_space)
        recorder.sync()
        assert not recorder.recording
    pipeline = StandIn(CONFIG)
    start = run_start(pipeline, 0, recorder.next_file_sequence, 20 * SECOND)
    assert recorder.record(0, start, pipeline.step(start))
    recorder.close()


def no_space() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def older_engine(directory: Path, heads: Heads) -> None:
    """The first run is by another release, whose results are the same."""
    with pytest.MonkeyPatch.context() as older:
        older.setattr(identity, "name", lambda: f"{known_engines()[-1].number}-{known_engines()[-1].id}")
        record(directory, heads=heads)
    record(directory, seed=2, heads=heads)


def clock_set(directory: Path, heads: Heads) -> None:
    """The second run has a clock that is a year behind, the third one that is years ahead."""
    for seed, shift_ns in ((1, 0), (2, -31_536_000 * SECOND), (3, 315_360_000 * SECOND)):
        with pytest.MonkeyPatch.context() as clock:
            clock.setattr("tests.replay.stand_in.EPOCH_NS", EPOCH_NS + shift_ns)
            record(directory, seed=seed, heads=heads)


HONEST: dict[str, Callable[[Path, Heads], None]] = {
    "two runs": two_runs,
    "killed while it wrote": killed_while_writing,
    "a power cut that left zeros": killed_zeros,
    "killed three times": killed_three_times,
    "killed before the first event": killed_before_its_first_event,
    "killed before the renaming": killed_before_the_renaming,
    "killed before the renaming, then started": killed_before_the_renaming_and_started,
    "runs without events": empty_runs,
    "no devices": no_devices,
    "retention": retention,
    "store lost": store_lost,
    "store lost after a kill": store_lost_after_a_kill,
    "restored from a backup": restored_from_a_backup,
    "deleted recordings put back": deleted_ones_put_back,
    "head lost": head_lost,
    "an older head": older_head,
    "other files": other_files,
    "key replaced": key_replaced,
    "a full disk": full_disk,
    "another engine": older_engine,
    "a clock that was set": clock_set,
}


@pytest.mark.parametrize("case", HONEST)
def test_an_honest_directory_passes(case: str, tmp_path: Path) -> None:
    heads: Heads = []
    HONEST[case](tmp_path / "data", heads)
    kept = [GivenHead("kept", head, elsewhere=True) for head in heads]
    status, text = audited(tmp_path / "data", heads=kept, keys=known(KEY, OTHER), strict=False)
    assert status == 0, text


def test_what_a_recording_that_a_crash_left_open_does_not_prove_is_said(tmp_path: Path) -> None:
    """Between a crash and the next start, who can write the directory can change samples on which no result depends."""
    killed_while_writing(tmp_path / "killed", [])
    two_runs(tmp_path / "ended", [])
    said = "not proven: that the samples of 1 recordings that a crash left open are as measured"
    assert said in audited(tmp_path / "killed", strict=False)[1]
    assert said not in audited(tmp_path / "ended", strict=False)[1]
