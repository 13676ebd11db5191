"""Recordings are deleted oldest first, said before they go, and never while somebody needs them."""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from agent.core.events import Pruned, Tick
from agent.recording.files import recordings
from agent.recording.reading import RecordingReader, open_recording
from agent.recording.retention import KeepFiles, Moment, Retention
from agent.recording.scan import metadata_of
from agent.recording.writer import Recorder
from tests.replay.stand_in import CONFIG, EPOCH_NS, SECOND, StandIn, record_run, run_start

FILES = 6


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    """Six files of one run, the last of them closed an hour before EPOCH_NS, each a day older than the next."""
    record_run(tmp_path, blocks=30, rotate_at=range(12, 12 * FILES, 12))
    files = recordings(tmp_path)
    assert len(files) == FILES
    for number, path in files:
        age_s = 3600 + 86400 * (FILES - number)
        os.utime(path, ns=(EPOCH_NS, EPOCH_NS - age_s * SECOND))
    return tmp_path


def numbers(directory: Path) -> list[int]:
    return [number for number, _ in recordings(directory)]


def total(directory: Path, count: int) -> int:
    """Bytes of the newest `count` files."""
    return sum(path.stat().st_size for _, path in recordings(directory)[-count:])


def next_one(pruned: Pruned | None) -> int | None:
    """The number of the recording that an event names."""
    assert pruned is None or pruned.first_file == pruned.last_file
    return pruned.last_file if pruned else None


def due(directory: Path, keep: KeepFiles, waiting: str = "") -> int | None:
    """The number of the recording that is due at EPOCH_NS."""
    return next_one(Retention(directory, keep).due(Moment(0, EPOCH_NS, waiting=waiting)))


def deleted_by(directory: Path, keep: KeepFiles, waiting: str = "") -> list[int]:
    """The recordings that go at EPOCH_NS, while no time passes."""
    gone: list[int] = []
    while (number := due(directory, keep, waiting)) is not None:
        gone.append(number)
        (directory / f"fieldcal-{number:06d}.mcap").unlink()
    return gone


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
    assert due(directory, KeepFiles()) is None


@pytest.mark.slow
@pytest.mark.parametrize("count", range(1, FILES + 1))
@pytest.mark.parametrize("more", [-1, 0, 1])
def test_bytes_are_kept_to_by_the_oldest_files(directory: Path, count: int, more: int) -> None:
    left = count - (more < 0)
    assert deleted_by(directory, KeepFiles(bytes=total(directory, count) + more)) == [*range(1, FILES - left + 1)]


def test_a_limit_of_bytes_is_kept_to_though_recordings_are_young(directory: Path) -> None:
    """It is the user's own limit, as `keep_days` is. `keep_at_least_days` holds against `least_free_bytes` only."""
    assert deleted_by(directory, KeepFiles(bytes=total(directory, 2), at_least_days=30.0)) == [1, 2, 3, 4]


def test_by_age_one_goes_at_a_time(directory: Path) -> None:
    assert due(directory, KeepFiles(days=4.9)) == 1
    assert due(directory, KeepFiles(days=5.1)) is None
    assert due(directory, KeepFiles(days=2.5, at_least_days=30.0)) == 1


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
    assert due(directory, everything, "fieldcal-000001.mcap") is None
    assert due(directory, everything, "fieldcal-000004.mcap.active") == 1
    assert deleted_by(directory, everything, "fieldcal-000004.mcap") == [1, 2, 3]


def test_what_somebody_reads_or_pinned_stays_and_the_next_ones_go(directory: Path) -> None:
    everything = KeepFiles(bytes=1)
    pin = directory / "fieldcal-000001.mcap.lock"
    pin.touch()
    with open(directory / "fieldcal-000002.mcap", "rb") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        assert due(directory, everything) == 3
    with open_recording(directory / "fieldcal-000004.mcap"):
        assert deleted_by(directory, everything) == [2, 3, 5, 6]
    assert deleted_by(directory, everything) == [4]
    assert numbers(directory) == [1]


def test_a_file_goes_once_the_event_is_on_the_disk(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with begun(directory, KeepFiles(bytes=total(directory, 4))) as recorder:
        gone: list[str] = []
        unlink = Path.unlink

        def watched(path: Path, missing_ok: bool = False) -> None:
            assert recorder.path is not None
            *_, last = RecordingReader(recorder.path).steps()
            assert last.event == pruned
            gone.append(path.name)
            unlink(path, missing_ok)

        monkeypatch.setattr(Path, "unlink", watched)
        for number in (1, 2, 3):  # the file being written counts as well
            pruned = recorder.pruning
            assert pruned is not None
            assert numbers(directory)[0] == next_one(pruned) == number
            assert recorder.record(number, pruned, [])
            assert len(gone) == number
        assert numbers(directory) == [4, 5, 6, 7]
        assert recorder.pruning is None


def test_a_file_that_somebody_began_to_read_stays_though_its_deletion_was_said(directory: Path) -> None:
    with begun(directory, KeepFiles(bytes=1)) as recorder:
        pruned = recorder.pruning
        assert next_one(pruned) == 1
        assert pruned is not None
        with open_recording(directory / "fieldcal-000001.mcap"):
            recorder.record(1, pruned, [])
            assert numbers(directory) == [*range(1, FILES + 2)]
            assert next_one(recorder.pruning) == 2
        recorder.record(2, recorder.pruning, [])  # type: ignore[arg-type]
        assert next_one(recorder.pruning) == 1


class Disk:
    """Free bytes as a test says them, and what the retention of `directory` does at each moment."""

    def __init__(self, directory: Path, keep: KeepFiles, monkeypatch: pytest.MonkeyPatch) -> None:
        self.free, self.now_s = 10 << 30, 0.0
        self.retention = Retention(directory, keep)
        self._directory = directory
        monkeypatch.setattr("agent.recording.retention.free_bytes", lambda _: self.free)

    def passes(self, seconds: float, *, helps: bool = True, quota: bool = False) -> list[tuple[float, int]]:
        """(seconds since the beginning, number) of what goes in this time. `helps`: its space is free then."""
        gone = []
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += 1.0
            before = self.retention.notice
            at = Moment(int(self.now_s * SECOND), EPOCH_NS, quota=quota)
            if (pruned := self.retention.due(at)) is not None:
                assert before, "nothing is lost before it was said"
                gone.append((self.now_s, pruned.last_file))
                (self._directory / f"fieldcal-{pruned.last_file:06d}.mcap").unlink()
                self.free += pruned.bytes * helps
        return gone


LEAST = 512 << 20


def test_deleting_that_cannot_reach_the_limit_deletes_nothing(
    directory: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Another program fills the disk to 400 MiB free; all recordings together have less than a MiB."""
    disk = Disk(directory, KeepFiles(least_free_bytes=LEAST), monkeypatch)
    assert disk.passes(60) == []
    disk.free = 400 << 20
    assert disk.passes(1000) == []
    assert "nothing is deleted before less than 67.1 MB are free" in disk.retention.notice
    assert [record.getMessage() for record in caplog.records] == [disk.retention.notice]
    disk.free = LEAST
    assert disk.passes(1) == []
    assert disk.retention.notice == ""


@pytest.mark.slow
def test_a_lack_of_space_must_last_and_then_one_goes_at_a_time(
    directory: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    sizes = [path.stat().st_size for _, path in recordings(directory)]
    disk = Disk(directory, KeepFiles(least_free_bytes=LEAST), monkeypatch)
    for _ in range(20):  # a program that fills the disk for four minutes, again and again
        disk.free = LEAST - sum(sizes[:3])
        assert disk.passes(240) == []
        disk.free = LEAST
        assert disk.passes(60) == []
    disk.free = LEAST - sum(sizes[:3])
    began_s = disk.now_s
    assert disk.passes(301) == [(began_s + 301, 1)]
    assert disk.passes(600) == [(began_s + 311, 2), (began_s + 321, 3)]
    assert "if this lasts 300 s, the oldest recordings are deleted, one at a time" in caplog.text


@pytest.mark.slow
def test_young_recordings_go_only_where_the_agent_itself_needs_the_space(
    directory: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    sizes = [path.stat().st_size for _, path in recordings(directory)]
    disk = Disk(directory, KeepFiles(least_free_bytes=LEAST, at_least_days=3.5), monkeypatch)
    disk.free = LEAST - sum(sizes[:2]) - 1  # files 1 and 2 are older than 3.5 days
    assert disk.passes(1000) == []
    disk.free, began_s = disk.free + 1, disk.now_s  # now deleting helps, and this is said first
    assert disk.passes(1000) == [(began_s + 31, 1), (began_s + 41, 2)]
    assert "younger" not in caplog.text
    disk.free, began_s = (64 << 20) - 1, disk.now_s
    assert disk.passes(1000) == [(began_s + 31, 3)]
    assert "fieldcal-000003.mcap is deleted though it is younger than recording.keep_at_least_days (3.5)" in caplog.text


def test_a_lack_of_seconds_costs_nothing_though_the_disk_is_all_full(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(directory, KeepFiles(least_free_bytes=LEAST), monkeypatch)
    for _ in range(20):
        disk.free = 0
        assert disk.passes(29) == []
        disk.free = 10 << 30
        assert disk.passes(5) == []


def test_where_deleting_gives_no_space_the_next_one_waits(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A snapshot of the file system holds the blocks, or another program takes them at once."""
    disk = Disk(directory, KeepFiles(least_free_bytes=LEAST), monkeypatch)
    disk.free = 0
    assert disk.passes(700, helps=False) == [(31.0, 1), (331.0, 2), (631.0, 3)]


def test_a_quota_that_is_used_up_is_no_free_space(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(directory, KeepFiles(least_free_bytes=LEAST), monkeypatch)
    assert disk.passes(50, quota=True) == [(31.0, 1), (41.0, 2)]
    assert "the disk quota of the agent is used up" in disk.retention.notice
    assert disk.passes(600) == []


def test_without_a_limit_for_free_space_nothing_goes_for_it(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(directory, KeepFiles(days=365.0), monkeypatch)
    disk.free = 0
    assert disk.passes(1000) == []


def test_where_nothing_can_be_recorded_room_is_made_and_the_next_recording_says_it(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk: 10 MiB are needed to go on, and each deleted recording gives 4 MiB."""
    second_sha256 = hashlib.sha256((directory / "fieldcal-000002.mcap").read_bytes()).hexdigest()
    left = numbers(directory)
    free = {"more": 0}
    monkeypatch.setattr("agent.recording.retention.free_bytes", lambda at: room(at))
    monkeypatch.setattr("agent.recording.writer.free_bytes", lambda at: room(at))

    def room(at: Path) -> int:
        return free["more"] + (len(left) - len([n for n in numbers(at) if n in left])) * (4 << 20)

    free["more"] = 100 << 20
    with begun(directory, KeepFiles(least_free_bytes=LEAST)) as recorder:
        free["more"] = 0
        recorder.sync()
        assert recorder.fault.startswith("No space left on device")
        begun_s = run_start(StandIn(CONFIG), 0, 1).t_monotonic_ns // SECOND
        event, gone, second = 1, [], begun_s
        while not recorder.recording:
            second += 1
            recorder.record(event, Tick(t_monotonic_ns=second * SECOND, t_utc_ns=EPOCH_NS + second * SECOND), [])
            recorder.look_for_pruning()
            if recorder.pruning is not None:
                assert recorder.space.startswith("less than 67.1 MB are free: after 30 s the oldest")
                gone.append((second, next_one(recorder.pruning)))
                assert not recorder.record(event, recorder.pruning, [])
            if recorder.wants_rotation:
                start = run_start(StandIn(CONFIG), event, recorder.next_file_sequence, second * SECOND)
                recorder.record(event, start, [])
            assert second < 120
        assert gone == [(begun_s + 30, 1), (begun_s + 40, 2)]
        assert numbers(directory) == [3, 4, 5, 6, 7, 8]
        assert recorder.path is not None
        assert metadata_of(recorder.path)["fieldcal.pruned"]["recordings"] == f"1-2 - - {second_sha256}"


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


@pytest.mark.slow
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
