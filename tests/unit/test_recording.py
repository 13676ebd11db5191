"""The writer: what is on disk when, rotation, the chain of files, and disks that fail."""

from __future__ import annotations

import hashlib
import io
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from agent.core.events import Gap, Tick
from agent.recording.files import recordings
from agent.recording.integrity import check_integrity
from agent.recording.messages import encode
from agent.recording.reading import RecordedStep, RecordingReader
from agent.recording.records import FileRecord, FileRecordError, walk
from agent.recording.results_chain import FILE_METADATA
from agent.recording.writer import Recorder
from tests.replay.stand_in import CONFIG, EPOCH_NS, SECOND, StandIn, block, happenings, record_run, run_start

REPOSITORY = Path(__file__).parents[2]


def read(path: Path) -> list[RecordedStep]:
    return list(RecordingReader(path).steps())


def tick(second: int) -> Tick:
    return Tick(t_monotonic_ns=second * SECOND, t_utc_ns=EPOCH_NS + second * SECOND)


def begun(directory: Path, **options: float) -> Recorder:
    recorder = Recorder(directory, ["acc"], ["bridge-1"], **options)  # type: ignore[arg-type]
    assert recorder.record(0, run_start(StandIn(CONFIG), 0, recorder.next_file_sequence), [])
    return recorder


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def origin(path: Path) -> tuple[str, str]:
    """The file before, and its SHA-256, as a file names them."""
    with open(path, "rb") as file:
        metadata = next(make_reader(file).iter_metadata()).metadata
    return metadata["previous_file"], metadata["previous_sha256"]


def records(data: bytes) -> list[FileRecord]:
    """The records of a file that may end early."""
    found: list[FileRecord] = []
    with suppress(FileRecordError):
        found.extend(walk(io.BytesIO(data), len(data)))
    return found


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Writes beyond `size` bytes fail in the kernel, after a part of them was written."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_recording_holds_what_went_in(tmp_path: Path) -> None:
    recorded = record_run(tmp_path)
    steps = read(tmp_path / "fieldcal-000001.mcap")
    assert len(steps) == len(recorded)
    for step, (number, event, results) in zip(steps, recorded, strict=True):
        assert step.event_sequence == number
        assert encode(number, step.event) == encode(number, event)
        assert [encode(number, r) for r in step.results] == [encode(number, r) for r in results]
        assert step.complete


def test_other_readers_see_topics_times_and_numbers(tmp_path: Path) -> None:
    recorded = record_run(tmp_path)
    path = tmp_path / "fieldcal-000001.mcap"
    with open(path, "rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
        assert summary is not None
        assert {channel.topic for channel in summary.channels.values()} == {
            "/events",
            "/acc/raw",
            "/ref/raw",
            "/bridge-1/window",
            "/bridge-1/calibration",
            "/bridge-1/estimate",
            "/bridge-1/drift",
            "/bridge-1/status",
            "/bridge-1/clock",
            "/bridge-1/watch",
            "/bridge-1/self_test",
        }
        messages = list(make_reader(file, validate_crcs=True).iter_messages(topics="/acc/raw"))
    blocks = [(number, event) for number, event, _ in recorded if getattr(event, "device", "") == "acc"]
    blocks = [(number, event) for number, event in blocks if hasattr(event, "indications")]
    assert len(messages) == len(blocks)
    for (schema, _, message), (number, event) in zip(messages, blocks, strict=True):
        assert schema is not None
        assert (schema.name, schema.encoding) == ("fieldcal.v1.RawBlock", "protobuf")
        assert (message.sequence, message.log_time) == (number, event.t_utc_ns)  # type: ignore[union-attr]
        assert message.publish_time == event.t_monotonic_ns
    with open(path, "rb") as file:
        assert sum(1 for _ in StreamReader(file, validate_crcs=True).records) > len(recorded)


def test_events_without_utc_get_it_from_the_clocks_before(tmp_path: Path) -> None:
    recorder = begun(tmp_path)
    gap = Gap(device="acc", t_monotonic_ns=9 * SECOND, dropped=1, unit="lines", reason="garbage")
    recorder.record(1, gap, [])
    recorder.close()
    with open(tmp_path / "fieldcal-000001.mcap", "rb") as file:
        *_, (_, _, message) = make_reader(file).iter_messages()
    assert (message.log_time, message.publish_time) == (EPOCH_NS + 9 * SECOND, 9 * SECOND)


def test_results_are_on_disk_when_record_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: dict[int, int] = {}
    fsync = os.fsync

    def watched(descriptor: int) -> None:
        fsync(descriptor)
        status = os.fstat(descriptor)
        synced[status.st_ino] = status.st_size

    monkeypatch.setattr(os, "fsync", watched)
    recorder = begun(tmp_path)
    pipeline = StandIn(CONFIG)
    assert recorder.path is not None
    assert tmp_path.stat().st_ino in synced
    assert synced[recorder.path.stat().st_ino] == recorder.path.stat().st_size
    assert len(read(recorder.path)) == 1
    for number, event in enumerate(happenings(8, seed=1), start=1):
        results = pipeline.step(event)
        assert recorder.record(number, event, results)
        if results:
            on_disk = read(recorder.path)
            assert (on_disk[-1].event_sequence, len(on_disk[-1].results)) == (number, len(results))
            status = recorder.path.stat()
            assert synced[status.st_ino] == status.st_size
    recorder.close()


def test_sync_brings_events_without_results_to_the_disk(tmp_path: Path) -> None:
    recorder = begun(tmp_path)
    recorder.record(1, tick(6), [])
    assert recorder.path is not None
    assert len(read(recorder.path)) == 1
    recorder.sync()
    assert len(read(recorder.path)) == 2
    recorder.close()


def test_a_closed_file_has_its_final_name_and_the_next_names_its_hash(tmp_path: Path) -> None:
    record_run(tmp_path, rotate_at=(9, 20))
    files = [path for _, path in recordings(tmp_path)]
    assert [path.name for path in files] == [f"fieldcal-00000{k}.mcap" for k in (1, 2, 3)]
    previous = ("", "")
    for number, path in enumerate(files, start=1):
        with open(path, "rb") as file:
            found = check_integrity(file, path.stat().st_size)
        assert not found.faults
        assert found.metadata[FILE_METADATA] == {
            "file_sequence": str(number),
            "previous_file": previous[0],
            "previous_sha256": previous[1],
        }
        previous = (path.name, hashlib.sha256(path.read_bytes()).hexdigest())


def test_a_later_run_counts_on_and_names_the_last_file(tmp_path: Path) -> None:
    record_run(tmp_path)
    digest = hashlib.sha256((tmp_path / "fieldcal-000001.mcap").read_bytes()).hexdigest()
    for name in ("fieldcal-000007.mcap.active", "fieldcal-000009.mcap.bad", "fieldcal-x.mcap"):
        (tmp_path / name).touch()
    assert Recorder(tmp_path, [], []).next_file_sequence == 8
    (tmp_path / "fieldcal-000007.mcap.active").unlink()
    begun(tmp_path).close()
    with open(tmp_path / "fieldcal-000002.mcap", "rb") as file:
        metadata = next(make_reader(file).iter_metadata())
    assert metadata.metadata["previous_sha256"] == digest


def test_rotation_is_wanted_by_age_of_events_and_by_size(tmp_path: Path) -> None:
    recorder = begun(tmp_path, max_age_s=10.0, max_bytes=30_000)
    recorder.record(1, tick(14), [])
    assert not recorder.wants_rotation
    recorder.record(2, tick(15), [])  # ten seconds after the RunStart
    assert recorder.wants_rotation
    recorder.record(3, run_start(StandIn(CONFIG), 3, 2, 15 * SECOND), [])
    assert not recorder.wants_rotation
    rng = np.random.default_rng(1)
    assert recorder.path is not None
    for number in range(4, 20):
        recorder.record(number, block("acc", 20 + number, rng, n=500), [])
        recorder.sync()
        assert recorder.wants_rotation == (recorder.path.stat().st_size >= 30_000)
    assert recorder.wants_rotation
    recorder.close()


def test_a_full_disk_ends_the_file_and_a_later_run_start_begins_another(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recorder = begun(tmp_path, retry_s=10.0)
    path = recorder.path
    assert path is not None
    pipeline = StandIn(CONFIG)
    with largest_file(path.stat().st_size + 100):
        results = pipeline.step(block("acc", 0, np.random.default_rng(1)))
        status = pipeline.step(run_start(pipeline, 0, 1))
        assert not recorder.record(1, block("acc", 0, np.random.default_rng(1)), results + status)
    assert not recorder.recording
    assert "File too large" in recorder.fault
    assert len(caplog.records) == 1
    left = path.read_bytes()
    *_, last = records(left)
    kept = last.end
    assert not recorder.record(2, tick(7), [])
    recorder.sync()
    recorder.close()
    assert path.read_bytes() == left  # nothing is written after a fault, where it would tear the file inside
    assert [step.event_sequence for step in read(path)] == [0]
    assert not recorder.wants_rotation
    recorder.record(3, tick(16), [])
    assert recorder.wants_rotation
    assert recorder.record(4, run_start(pipeline, 4, recorder.next_file_sequence), [])
    assert recorder.fault == ""
    recorder.close()
    assert read(tmp_path / "fieldcal-000002.mcap")[0].event_sequence == 4
    closed = tmp_path / "fieldcal-000001.mcap"  # what was given up is closed before the next begins
    assert closed.read_bytes()[:kept] == left[:kept]
    assert origin(tmp_path / "fieldcal-000002.mcap") == (closed.name, sha256(closed))


@pytest.mark.parametrize("room", [0, 100, 1000])
def test_a_disk_that_stays_full_leaves_no_file_at_each_attempt(tmp_path: Path, room: int) -> None:
    recorder = begun(tmp_path)
    with largest_file(room):
        for _ in range(3):
            assert not recorder.record(1, run_start(StandIn(CONFIG), 1, recorder.next_file_sequence), [])
            assert str(tmp_path) in recorder.fault
    assert [path.name for _, path in recordings(tmp_path)] == ["fieldcal-000001.mcap.active"]
    assert recorder.record(1, run_start(StandIn(CONFIG), 1, recorder.next_file_sequence), [])
    recorder.close()
    assert origin(tmp_path / "fieldcal-000002.mcap") == (
        "fieldcal-000001.mcap",
        sha256(tmp_path / "fieldcal-000001.mcap"),
    )


def test_after_a_failed_file_the_next_names_it_closed(tmp_path: Path) -> None:
    recorder = begun(tmp_path)
    recorder.record(1, run_start(StandIn(CONFIG), 1, 2), [])
    assert recorder.path is not None
    with largest_file(recorder.path.stat().st_size):
        recorder.record(2, tick(6), [])
        recorder.sync()
    assert not recorder.recording
    recorder.record(3, run_start(StandIn(CONFIG), 3, 3), [])
    recorder.close()
    failed = tmp_path / "fieldcal-000002.mcap"
    assert origin(tmp_path / "fieldcal-000003.mcap") == (failed.name, sha256(failed))
    assert [step.event_sequence for step in read(failed)] == [1]


def test_no_file_is_ever_overwritten(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "fieldcal-000001.mcap.active").write_bytes(b"kept")
    recorder = Recorder(tmp_path, [], [])
    assert not recorder.record(0, run_start(StandIn(CONFIG), 0, 1), [])
    assert "File exists" in recorder.fault
    assert "fieldcal-000001" in caplog.text
    assert (tmp_path / "fieldcal-000001.mcap.active").read_bytes() == b"kept"


def test_an_event_that_has_no_form_ends_the_file_properly(tmp_path: Path) -> None:
    recorder = begun(tmp_path)
    odd = Gap(device="acc", t_monotonic_ns=0, dropped=1, unit="lines", reason="\udcff")
    assert not recorder.record(1, odd, [])
    assert "event 1 cannot be recorded" in recorder.fault
    path = tmp_path / "fieldcal-000001.mcap"
    with open(path, "rb") as file:
        assert not check_integrity(file, path.stat().st_size).faults
    assert recorder.record(2, run_start(StandIn(CONFIG), 2, 2), [])
    recorder.close()


def test_a_missing_directory_is_a_fault_and_no_exception(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    recorder = Recorder(tmp_path / "gone", [], [])
    for _ in range(3):
        assert not recorder.record(0, run_start(StandIn(CONFIG), 0, 1), [])
    assert "No such file" in recorder.fault
    assert len(caplog.records) == 1  # said once, not every ten seconds


KILLED = """
import os, signal, sys
from pathlib import Path
from tests.replay.stand_in import record_run
record_run(Path(sys.argv[1]), blocks=12, close=False)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_after_kill_9_all_that_was_synced_is_there(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], cwd=REPOSITORY, timeout=60, check=False)
    assert done.returncode == -signal.SIGKILL
    (tmp_path / "again").mkdir()
    recorded = record_run(tmp_path / "again", blocks=12)
    reader = RecordingReader(tmp_path / "fieldcal-000001.mcap.active")
    steps = list(reader.steps())
    assert [step.event_sequence for step in steps] == [number for number, _, _ in recorded]
    assert msgspec.structs.asdict(recorded[-1][1]) == msgspec.structs.asdict(steps[-1].event)  # type: ignore[arg-type]
    assert reader.fault is not None
    assert reader.fault.kind == "torn"
    assert reader.good_bytes == reader.path.stat().st_size
