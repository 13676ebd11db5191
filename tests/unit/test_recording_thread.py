"""The recording's thread: order, durability before delivery, flushing, rotation asked for once, faults that surface."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from agent.core.events import Pruned, Result
from agent.recording.reading import RecordingReader
from agent.recording.thread import RecordingThread
from agent.recording.writer import Recorder
from tests.replay.stand_in import CONFIG, SECOND, StandIn, block, happenings, run_start

PATIENCE_S = 10.0  # how long a test waits for another thread on a busy machine


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "the other thread did not do it"
        time.sleep(0.005)


def test_results_are_delivered_in_order_when_the_file_has_them(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, ["acc", "ref"], ["bridge-1"])
    delivered: list[tuple[int, list[Result]]] = []

    def deliver(number: int, results: Sequence[Result], recorded: bool, _: object) -> None:
        assert recorded
        assert recorder.path is not None
        *_, last = RecordingReader(recorder.path).steps()
        assert (last.event_sequence, len(last.results)) == (number, len(results))
        delivered.append((number, list(results)))

    thread = RecordingThread(recorder, deliver)
    pipeline = StandIn(CONFIG)
    expected = []
    for number, event in enumerate([run_start(pipeline, 0, 1), *happenings(9, seed=2)]):
        results = pipeline.step(event)
        thread.put(number, event, results)
        if results:
            expected.append((number, results))
    thread.close()
    assert repr(delivered) == repr(expected)
    assert len(delivered) > 3
    assert (tmp_path / "fieldcal-000001.mcap").exists()


def test_events_without_results_reach_the_disk_by_themselves(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, ["acc"], [])
    thread = RecordingThread(recorder, lambda *_: None, flush_s=0.05)
    thread.put(0, run_start(StandIn(CONFIG), 0, 1), [])
    rng = np.random.default_rng(1)
    thread.put(1, block("acc", 0, rng), [])
    path = tmp_path / "fieldcal-000001.mcap.active"
    wait_for(lambda: path.exists() and len(list(RecordingReader(path).steps())) == 2)
    thread.put(2, block("acc", 1, rng), [])
    wait_for(lambda: len(list(RecordingReader(path).steps())) == 3)
    thread.close()


def test_rotation_is_not_wanted_while_a_run_start_is_on_its_way(tmp_path: Path) -> None:
    go_on = threading.Event()
    recorder = Recorder(tmp_path, ["acc"], ["bridge-1"], max_bytes=1)
    thread = RecordingThread(recorder, lambda *_: assert_(go_on.wait(PATIENCE_S)))
    pipeline = StandIn(CONFIG)
    start = run_start(pipeline, 0, 1)
    thread.put(0, start, [])
    wait_for(lambda: thread.wants_rotation)
    status = pipeline.step(start)
    thread.put(1, block("acc", 0, np.random.default_rng(1)), status)  # delivery holds the thread up
    thread.put(2, run_start(pipeline, 2, 2, 6 * SECOND), [])
    assert not thread.wants_rotation
    go_on.set()
    wait_for(lambda: thread.wants_rotation)
    thread.close()


def test_a_deletion_is_due_once_until_it_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()
    due = Pruned(t_monotonic_ns=0, t_utc_ns=0, first_file=1, last_file=1, last_sha256="00" * 32, bytes=10)
    recorder = Recorder(tmp_path, [], [])
    recorder.pruning = due
    monkeypatch.setattr(recorder, "look_for_pruning", lambda: None)
    monkeypatch.setattr(recorder, "record", lambda *_: go_on.wait(PATIENCE_S))
    thread = RecordingThread(recorder, lambda *_: None)
    assert thread.take_pruning() == due
    thread.put(1, due, [])
    assert thread.take_pruning() is None
    go_on.set()
    wait_for(lambda: thread.take_pruning() == due)  # the next one
    thread.close()


def assert_(condition: bool) -> None:
    assert condition, "delivery"


def test_what_delivery_raises_comes_out_of_the_next_put(tmp_path: Path) -> None:
    thread = RecordingThread(Recorder(tmp_path, [], ["bridge-1"]), lambda *_: assert_(False))
    pipeline = StandIn(CONFIG)
    start = run_start(pipeline, 0, 1)
    thread.put(0, start, pipeline.step(start))
    final = tmp_path / "fieldcal-000001.mcap"
    wait_for(final.exists)
    with pytest.raises(AssertionError, match="delivery"):
        thread.put(1, block("acc", 0, np.random.default_rng(1)), [])
    with pytest.raises(AssertionError, match="delivery"):
        thread.close()
    assert len(list(RecordingReader(final).steps())) == 1


def test_results_that_could_not_be_recorded_are_delivered_as_such(tmp_path: Path) -> None:
    delivered: list[bool] = []
    recorder = Recorder(tmp_path / "gone", [], ["bridge-1"])
    thread = RecordingThread(recorder, lambda _, __, recorded, ___: delivered.append(recorded))
    pipeline = StandIn(CONFIG)
    start = run_start(pipeline, 0, 1)
    thread.put(0, start, pipeline.step(start))
    thread.close()
    assert delivered == [False]


def slow_fsync(monkeypatch: pytest.MonkeyPatch, hold: Callable[[], object]) -> None:
    fsync = os.fsync

    def slow(descriptor: int) -> None:
        hold()
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", slow)


def test_a_slow_disk_does_not_hold_up_the_end_and_no_result_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    slow_fsync(monkeypatch, lambda: time.sleep(0.05))
    delivered: list[tuple[int, int, bool]] = []
    thread = RecordingThread(
        Recorder(tmp_path, ["acc", "ref"], ["bridge-1"]),
        lambda number, results, recorded, _: delivered.append((number, len(results), recorded)),
        close_s=0.5,
    )
    pipeline, rng = StandIn(CONFIG), np.random.default_rng(1)
    expected = 0
    for number in range(200):
        event = run_start(pipeline, 0, 1) if number == 0 else block("acc", number, rng)
        results = pipeline.step(event)
        expected += len(results)
        thread.put(number, event, results)
    began_s = time.monotonic()
    assert thread.close()
    assert time.monotonic() - began_s < 9.0  # all of them would take 10 s
    assert sum(count for _, count, _ in delivered) == expected
    *recorded, (last, rest, was_recorded) = delivered
    assert (last, was_recorded) == (199, False)
    assert rest > 50
    assert all(was_recorded for _, _, was_recorded in recorded)
    *_, held = RecordingReader(tmp_path / "fieldcal-000001.mcap").steps()
    assert held.event_sequence >= recorded[-1][0]
    assert f"events {held.event_sequence + 1} to 199 are not in the recording" in caplog.text


def test_a_disk_that_does_not_answer_is_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    answer = threading.Event()
    slow_fsync(monkeypatch, lambda: answer.wait(PATIENCE_S))
    monkeypatch.setattr("agent.recording.thread.HANG_S", 0.1)
    thread = RecordingThread(Recorder(tmp_path, ["acc"], ["bridge-1"]), lambda *_: None, close_s=0.1)
    thread.put(0, run_start(StandIn(CONFIG), 0, 1), [])
    assert not thread.close()
    assert "does not respond" in caplog.text
    answer.set()
    thread._thread.join(PATIENCE_S)
    assert not thread._thread.is_alive()
