"""Recordings are deleted oldest first, said before they go, and never while somebody needs them."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from agent.core.events import Pruned
from agent.recording.files import recordings
from agent.recording.reading import RecordingReader, open_recording
from agent.recording.retention import KeepFiles, due, free_bytes
from agent.recording.writer import Recorder
from tests.replay.stand_in import CONFIG, EPOCH_NS, SECOND, StandIn, record_run, run_start

FILES = 6


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    """Six files of one run, the last of them of an hour ago, each a day older than the next."""
    record_run(tmp_path, blocks=30, rotate_at=range(12, 12 * FILES, 12))
    files = recordings(tmp_path)
    assert len(files) == FILES
    for number, path in files:
        age_s = 3600 + 86400 * (FILES - number)
        os.utime(path, (path.stat().st_atime, path.stat().st_mtime - age_s))
    return tmp_path


def numbers(directory: Path) -> list[int]:
    return [number for number, _ in recordings(directory)]


def total(directory: Path, count: int) -> int:
    """Bytes of the newest `count` files."""
    return sum(path.stat().st_size for _, path in recordings(directory)[-count:])


def span(pruned: Pruned | None) -> tuple[int, int] | None:
    return (pruned.first_file, pruned.last_file) if pruned else None


@contextmanager
def begun(directory: Path, keep: KeepFiles, waiting: str = "") -> Iterator[Recorder]:
    """A recorder that has begun file 7."""

    class Ledger:
        def published(self) -> int:
            return 0

        def file_sequence(self) -> int:
            return 0

        def mark_file(self, file_sequence: int) -> None: ...

        def first_waiting_recording(self) -> str:
            return waiting

    recorder = Recorder(directory, ["acc"], ["bridge-1"], keep=keep, ledger=Ledger())
    assert recorder.record(0, run_start(StandIn(CONFIG), 0, recorder.next_file_sequence), [])
    yield recorder
    recorder.close()


def test_without_limits_everything_stays(directory: Path) -> None:
    assert due(directory, KeepFiles(), None, "") is None


def test_bytes_are_kept_to_by_the_oldest_files(directory: Path) -> None:
    for count in range(1, FILES + 1):
        pruned = due(directory, KeepFiles(bytes=total(directory, count)), None, "")
        assert span(pruned) == ((1, FILES - count) if count < FILES else None)
    assert span(due(directory, KeepFiles(bytes=total(directory, 3) + 1), None, "")) == (1, 3)
    assert span(due(directory, KeepFiles(bytes=total(directory, 3) - 1), None, "")) == (1, 4)


def test_free_space_is_made(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = free_bytes(directory)
    monkeypatch.setattr("agent.recording.retention.free_bytes", lambda _: free)
    oldest = recordings(directory)[0][1].stat().st_size
    assert due(directory, KeepFiles(least_free_bytes=free), None, "") is None
    assert span(due(directory, KeepFiles(least_free_bytes=free + oldest), None, "")) == (1, 1)
    assert span(due(directory, KeepFiles(least_free_bytes=free + oldest + 1), None, "")) == (1, 2)


def test_by_age_one_goes_at_a_time(directory: Path) -> None:
    assert span(due(directory, KeepFiles(days=2.5), None, "")) == (1, 1)
    assert span(due(directory, KeepFiles(days=4.9), None, "")) == (1, 1)
    assert due(directory, KeepFiles(days=5.1), None, "") is None


def test_a_clock_that_jumped_ahead_costs_one_file_for_each_that_begins(directory: Path) -> None:
    with begun(directory, KeepFiles(days=0.001)) as recorder:
        for number in range(1, 4):
            for _ in range(3):
                recorder.look_for_pruning()
                if recorder.pruning is not None:
                    recorder.record(number, recorder.pruning, [])
            assert numbers(directory)[0] == 1 + number
            start = run_start(StandIn(CONFIG), number, recorder.next_file_sequence)
            recorder.record(number, start, [])


def test_what_is_not_published_stays_and_all_after_it(directory: Path) -> None:
    everything = KeepFiles(bytes=1)
    assert span(due(directory, everything, None, "fieldcal-000004.mcap")) == (1, 3)
    assert span(due(directory, everything, None, "fieldcal-000004.mcap.active")) == (1, 3)
    assert due(directory, everything, None, "fieldcal-000001.mcap") is None


def test_what_somebody_reads_or_pinned_stays_and_the_next_ones_go(directory: Path) -> None:
    everything = KeepFiles(bytes=1)
    pin = directory / "fieldcal-000001.mcap.lock"
    pin.touch()
    assert span(due(directory, everything, None, "")) == (2, FILES)
    with open_recording(directory / "fieldcal-000004.mcap"):
        assert span(due(directory, everything, None, "")) == (2, 3)
    assert span(due(directory, everything, None, "")) == (2, FILES)
    with open(directory / "fieldcal-000002.mcap", "rb") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        assert span(due(directory, everything, None, "")) == (3, FILES)


def test_files_go_once_the_event_is_on_the_disk(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with begun(directory, KeepFiles(bytes=total(directory, 4))) as recorder:
        recorder.look_for_pruning()
        pruned = recorder.pruning
        assert span(pruned) == (1, 3)  # the file being written counts as well
        assert pruned is not None
        assert numbers(directory) == [1, 2, 3, 4, 5, 6, 7]
        gone: list[str] = []
        unlink = Path.unlink

        def watched(path: Path, missing_ok: bool = False) -> None:
            assert recorder.path is not None
            *_, last = RecordingReader(recorder.path).steps()
            assert last.event == pruned
            gone.append(path.name)
            unlink(path, missing_ok)

        monkeypatch.setattr(Path, "unlink", watched)
        assert recorder.record(1, pruned, [])
        assert len(gone) == 3
        assert numbers(directory) == [4, 5, 6, 7]
        assert recorder.pruning is None


def test_a_file_that_somebody_began_to_read_stays_though_its_deletion_was_said(directory: Path) -> None:
    with begun(directory, KeepFiles(bytes=1)) as recorder:
        recorder.look_for_pruning()
        pruned = recorder.pruning
        assert pruned is not None
        with open_recording(directory / "fieldcal-000002.mcap"):
            recorder.record(1, pruned, [])
            assert numbers(directory) == [2, 7]
            assert recorder.pruning is None
        recorder.look_for_pruning()
        assert span(recorder.pruning) == (2, 2)


def test_where_nothing_can_be_recorded_room_is_made_and_said_later(directory: Path) -> None:
    with begun(directory, KeepFiles(least_free_bytes=free_bytes(directory) + (1 << 30))) as recorder:
        recorder._fail("No space left on device")
        pruned = recorder.pruning
        assert span(pruned) == (1, 6)
        assert pruned is not None
        assert not recorder.record(1, pruned, [])
        assert numbers(directory) == [7], "given up, but it was being written when this was seen"
        assert recorder.pruning is None, "not again as long as nothing is recorded"
        assert recorder.wants_rotation, "at once, now that there is room"
        assert recorder.record(2, run_start(StandIn(CONFIG), 2, recorder.next_file_sequence), [])
        assert numbers(directory) == [7, 8]
        assert recorder.pruning == pruned
        assert recorder.record(3, pruned, [])
        assert span(recorder.pruning) == (7, 7)
        assert recorder.path is not None
        assert [step.event for step in RecordingReader(recorder.path).steps()][1:] == [pruned]


def test_numbers_go_on_though_every_file_is_gone(tmp_path: Path) -> None:
    from agent.delivery.store import Store

    for number in (1, 2):
        store = Store(tmp_path, 0)
        recorder = Recorder(tmp_path, ["acc"], ["bridge-1"], ledger=store)
        assert recorder.next_file_sequence == number
        recorder.record(0, run_start(StandIn(CONFIG), 0, recorder.next_file_sequence), [])
        recorder.close()
        store.close()
        for _, path in recordings(tmp_path):
            path.unlink()


def test_a_disk_that_fails_is_asked_less_and_less_often(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "gone", [], [], retry_s=10.0)
    now_s, waits = 0, []
    for _ in range(8):
        start = run_start(StandIn(CONFIG), 0, 1, now_s * SECOND)
        assert not recorder.record(0, start, [])
        began_s = now_s
        while not recorder.wants_rotation:
            now_s += 10
            recorder._stamp(run_start(StandIn(CONFIG), 0, 1, now_s * SECOND))
        waits.append(now_s - began_s)
    assert waits == [10, 20, 40, 80, 160, 320, 320, 320]
    assert EPOCH_NS > 0
