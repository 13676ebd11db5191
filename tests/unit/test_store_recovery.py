"""A store that was lost or fell behind is made good from the recordings."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

import pytest

from agent.core.events import Result
from agent.delivery.evidence import evidence
from agent.delivery.history import FILE_NAME, History, StoredResult
from agent.delivery.schema import write_mark
from agent.delivery.store import Store
from agent.recording.continuation import UNKEPT_MAX
from agent.recording.files import RecordingFile, recordings
from agent.recording.scan import scan
from agent.recording.writer import Recorder
from tests.replay.stand_in import CONFIG, StandIn, happenings, record_run, run_start

ROTATE_AT = (9, 20)


def recorded(directory: Path) -> list[Result]:
    """A run of three files; all its results."""
    directory.mkdir(exist_ok=True)
    run = record_run(directory, blocks=12, rotate_at=ROTATE_AT)
    return [result for _, _, results in run for result in results]


def kept(store: Store) -> list[StoredResult]:
    with History(store.path) as history:
        return history.after(0, limit=1000)


def plain(result: Result) -> StoredResult:
    return StoredResult.of(result, recorded=True, recording="")


def payloads(records: list[StoredResult]) -> list[object]:
    return [record.fields for record in records]


@pytest.mark.parametrize("torn", [0, 1500])
def test_the_results_of_a_recording_are_found_without_its_data(tmp_path: Path, torn: int) -> None:
    results = recorded(tmp_path)
    _, last = recordings(tmp_path)[-1]
    os.truncate(last, last.stat().st_size - torn)
    found = [result for _, path in recordings(tmp_path) for result in scan(path).results]
    assert payloads([plain(r) for r in found]) == payloads([plain(r) for r in results])


def test_a_lost_store_is_made_again_whole(tmp_path: Path) -> None:
    results = recorded(tmp_path)
    store = Store(tmp_path, 0)
    assert (store.recovered.results, store.recovered.files, store.file_sequence()) == (len(results), 3, 3)
    records = kept(store)
    assert payloads(records) == payloads([plain(r) for r in results])
    assert [records[0].recording, records[-1].recording] == ["fieldcal-000001.mcap", "fieldcal-000003.mcap"]
    assert store.last_sequence() == results[-1].sequence + UNKEPT_MAX
    assert store.published() == 0, "what is not known to be out goes out again"
    with History(store.path) as history:
        assert history.in_force("bridge-1") is not None
        history.check()
    store.close()
    again = Store(tmp_path, 0)
    assert (again.recovered.results, kept(again)) == (0, records)
    again.close()


def test_a_damaged_store_is_set_aside_and_made_again(tmp_path: Path) -> None:
    results = recorded(tmp_path)
    (tmp_path / FILE_NAME).write_bytes(b"a store no more, and longer than a header" * 5)
    store = Store(tmp_path)
    assert store.set_aside == tmp_path / f"{FILE_NAME}.corrupt-1"
    assert len(kept(store)) == len(results)
    assert store.last_sequence() > 1_600_000_000_000
    store.close()


def test_what_a_crash_kept_from_the_store_is_fetched_at_the_next_start(tmp_path: Path) -> None:
    results = recorded(tmp_path / "recorded")
    store = Store(tmp_path / "data", 0)
    store.commit(map(plain, results[:-2]))
    os.close(store._lock)  # a killed process lets go of its lock and does no more
    for _, path in recordings(tmp_path / "recorded"):
        path.rename(tmp_path / "data" / path.name)
    after = Store(tmp_path / "data", 0)
    assert (after.set_aside, after.recovered.results) == (None, 2)
    assert after.last_sequence() == results[-1].sequence + UNKEPT_MAX
    assert payloads(kept(after)) == payloads([plain(r) for r in results])
    with History(after.path) as history:
        history.check()
    after.close()


def test_an_older_copy_of_the_store_gets_the_results_of_newer_recordings(tmp_path: Path) -> None:
    """A backup of yesterday. Its numbers would be given again, and consumers take such results for old ones."""
    results = recorded(tmp_path / "recorded")
    (tmp_path / "data").mkdir()
    files = recordings(tmp_path / "recorded")
    of_first = len(list(scan(files[0][1]).results))
    yesterday = Store(tmp_path / "data", 0)
    yesterday.commit(map(plain, results[:of_first]))
    yesterday.mark_file(files[0][0])
    yesterday.close()
    for _, path in files:
        path.rename(tmp_path / "data" / path.name)
    today = Store(tmp_path / "data", 0)
    assert today.recovered.results == len(results) - of_first > 0
    assert payloads(kept(today)) == payloads([plain(r) for r in results])
    assert today.last_sequence() == results[-1].sequence + UNKEPT_MAX
    today.mark_file(files[-1][0])
    today.close()
    again = Store(tmp_path / "data", 0)
    assert (again.recovered.results, again.last_sequence()) == (0, today.last_sequence())
    again.close()


def test_files_before_one_that_lacks_nothing_are_not_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded(tmp_path)
    Store(tmp_path, 0)._connection.close()
    read: list[str] = []

    def watched(path: Path) -> object:
        read.append(path.name)
        return scan(path)

    monkeypatch.setattr("agent.delivery.recovery.scan", watched)
    monkeypatch.setattr("agent.delivery.store.lock", lambda _: os.open(tmp_path, os.O_RDONLY))
    store = Store(tmp_path, 0)
    assert read == ["fieldcal-000003.mcap"]
    store.close()


def test_a_damaged_recording_gives_what_it_still_holds(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    results = recorded(tmp_path)
    _, first = recordings(tmp_path)[0]
    data = bytearray(first.read_bytes())
    data[len(data) // 2] ^= 1
    first.write_bytes(data)
    store = Store(tmp_path, 0)
    assert len(results) - 3 <= store.recovered.results <= len(results)
    assert store.recovered.results == len(results) or str(first) in caplog.text
    store.close()


def test_marks_are_those_that_the_newest_file_names(tmp_path: Path) -> None:
    store = Store(tmp_path, 0)
    recorder = Recorder(tmp_path, ["acc", "ref"], ["bridge-1"], ledger=store)
    pipeline = StandIn(CONFIG)
    start = run_start(pipeline, 0, recorder.next_file_sequence)
    events = [start, *happenings(12, seed=1)]
    for number, event in enumerate(events):
        results = pipeline.step(event)
        recorder.record(number, event, results)
        store.commit([StoredResult.of(r, recorded=True, recording="fieldcal-000001.mcap") for r in results])
    published = store.last_sequence() - 1
    store.mark_published(published)
    recorder.record(len(events), run_start(pipeline, len(events), recorder.next_file_sequence), [])
    recorder.close()
    store.close()
    before = kept(store)
    store.path.unlink()
    again = Store(tmp_path, 0)
    assert (again.published(), again.file_sequence()) == (published, 2)
    assert payloads(kept(again)) == payloads(before)
    again.close()


def test_the_number_of_a_file_without_an_event_is_used_again(tmp_path: Path) -> None:
    recorded(tmp_path)
    RecordingFile(tmp_path, run_start(StandIn(CONFIG), 0, 4), ["/events"], {}).abandon()  # killed before its RunStart
    store = Store(tmp_path, 0)
    recorder = Recorder(tmp_path, ["acc", "ref"], ["bridge-1"], ledger=store)
    recorder.close_torn()
    assert recorder.next_file_sequence == 4
    store.close()


def test_what_a_store_lacks_is_said_where_it_is_older_than_the_recordings(tmp_path: Path) -> None:
    recorded(tmp_path)
    store = Store(tmp_path, 0)
    store.close()
    for mark, said in ((3, []), (1, ["fieldcal-000002.mcap"])):
        with sqlite3.connect(tmp_path / FILE_NAME) as connection:
            write_mark(connection, "file", mark)
        with History(tmp_path / FILE_NAME) as history:
            told = evidence(history, [], tmp_path)
        assert [sentence.split()[6] for sentence in told] == said
        assert all("the next `fieldcal run` adds them" in sentence for sentence in told)
