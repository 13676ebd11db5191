"""With a store that is made good from the recordings comes the calibration that was in force, and its estimation."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from agent.audit.recalling import memories_of
from agent.core.events import CalibrationUpdate, Event, Result, RunStart
from agent.core.memory import Memory
from agent.core.pipeline import Pipeline
from agent.core.snapshot import unpack
from agent.delivery.history import History, StoredResult
from agent.delivery.store import Store
from agent.recording.files import recordings
from agent.recording.reading import RecordingReader
from agent.recording.writer import Recorder
from tests.replay.stand_in import record_run
from tests.unit.test_pipeline import EPOCH_NS, OFFSET, POSE_S, SENSITIVITY, block, opened, pipeline

G_MPS2 = np.array([[0, 0, 9.8], [9.8, 0, 0], [0, 9.8, 0], [0, -9.8, 0]])
RATE_HZ, BLOCK = 100.0, 50
RECALL = partial(memories_of, restore=Pipeline.restore)


def rests() -> Iterator[Event]:
    """A sensor that is turned through four rests."""
    noise = np.random.default_rng(1)
    yield opened("s", 0.0, serial_number="A")
    for first in range(0, round((4 * POSE_S + 3.0) * RATE_HZ), BLOCK):
        pose = np.minimum((first + np.arange(BLOCK)) / RATE_HZ // POSE_S, 3).astype(int)
        values = G_MPS2[pose] @ SENSITIVITY.T + OFFSET + noise.normal(0, 1e-3, (BLOCK, 3))
        yield block("s", first, values, nominal_hz=RATE_HZ, true_hz=RATE_HZ)


def recorded(directory: Path, rotate_at: Sequence[int]) -> tuple[list[Result], list[Memory]]:
    """A run on those, with a new file before these event numbers; its results, and the memories it left, in order."""
    found, recorder = pipeline(False, RATE_HZ), Recorder(directory, ["s"], ["s"])
    results: list[Result] = []
    memories: list[Memory] = []
    number = 0

    def feed(event: Event) -> None:
        nonlocal number
        outputs = [output for output in found.step(event) if isinstance(output, Result)]
        assert recorder.record(number, event, outputs)
        results.extend(outputs)
        memories.extend(found.memories(outputs))
        number += 1

    def start(t_monotonic_ns: int) -> RunStart:
        return RunStart(
            run_id="run", site="site", gateway="gateway", boot_id="boot", t_monotonic_ns=t_monotonic_ns,
            t_utc_ns=EPOCH_NS + t_monotonic_ns, config_json=found._config.model_dump_json(), versions={},
            fingerprint={}, snapshot=found.snapshot(), file_sequence=recorder.next_file_sequence,
            event_sequence=number, continuation=number > 0,
        )  # fmt: skip

    feed(start(0))
    for event in rests():
        if number in rotate_at:
            feed(start(event.t_monotonic_ns))
        feed(event)
    recorder.close()
    return results, memories


def behind(directory: Path, results: Sequence[Result], memory: Memory) -> None:
    """A store beside the recordings as a killed process leaves it: with the results up to a state, and that state."""
    elsewhere = directory / "elsewhere"
    store = Store(elsewhere, 0)
    known = [StoredResult.of(r, recorded=True, recording="") for r in results if r.sequence <= memory.sequence]
    store.commit(known, [memory])
    os.close(store._lock)  # a killed process lets go of its lock and does no more
    for path in elsewhere.glob("state.sqlite*"):
        path.rename(directory / path.name)


def kept(store: Store) -> dict[str, Memory]:
    return {memory.identity: memory for memory in store.states if memory.sensor == "s"}


def begun_with(state: bytes) -> list[Result]:
    """What the next run says when the device opens."""
    found = Pipeline.begin(pipeline(False, RATE_HZ)._config, "next", 0, 1000, {"s": {identity(): state}})
    return [r for r in found.step(opened("s", 0.0, serial_number="A")) if isinstance(r, Result)]


def identity() -> str:
    found = pipeline(False, RATE_HZ)
    found.step(opened("s", 0.0, serial_number="A"))
    return found._channels[0].identity


def values(update: Result) -> tuple[object, ...]:
    assert isinstance(update, CalibrationUpdate)
    return update.sensitivity, update.offset, update.covariance, update.identity


# The last file: all of the run, its second half, and one without a window, which has all from its snapshot.
@pytest.mark.slow
@pytest.mark.parametrize("rotate_at", [(), (25,), (25, 39)])
def test_a_lost_store_comes_back_with_what_the_estimation_knew(tmp_path: Path, rotate_at: Sequence[int]) -> None:
    results, memories = recorded(tmp_path, rotate_at)
    last = [r for r in results if isinstance(r, CalibrationUpdate)][-1]
    store = Store(tmp_path, 0, recall=RECALL)
    (memory,) = kept(store).values()
    store.close()
    assert store.recovered.memories == 1
    assert (memory.identity, memory.sequence) == (identity(), results[-1].sequence)
    assert repr(unpack(memory.state)["estimation"]) == repr(unpack(memories[-1].state)["estimation"])
    first = next(r for r in begun_with(memory.state) if isinstance(r, CalibrationUpdate))
    assert values(first) == values(last)


def test_a_store_that_fell_behind_catches_up(tmp_path: Path) -> None:
    results, memories = recorded(tmp_path, (25,))
    behind(tmp_path, results, memories[-2])
    again = Store(tmp_path, 0, recall=RECALL)
    (memory,) = kept(again).values()
    again.close()
    assert (again.set_aside, again.recovered.results) == (None, results[-1].sequence - memories[-2].sequence)
    assert memory.sequence == results[-1].sequence
    assert repr(unpack(memory.state)["estimation"]) == repr(unpack(memories[-1].state)["estimation"])


def test_a_state_that_is_newer_than_the_recordings_stays(tmp_path: Path) -> None:
    results, memories = recorded(tmp_path, ())
    newer = Memory("s", identity(), results[-1].sequence + 5, b"not recorded, since the disk was full")
    behind(tmp_path, results[: memories[-2].sequence], newer)
    again = Store(tmp_path, 0, recall=RECALL)
    assert (again.set_aside, again.recovered.results > 0) == (None, True)
    assert kept(again) == {identity(): newer}
    again.close()


@pytest.mark.slow
def test_wherever_a_recording_is_torn_the_state_is_that_of_the_last_result_in_it(tmp_path: Path) -> None:
    recorded(tmp_path, ())
    ((_, path),) = recordings(tmp_path)
    whole = path.read_bytes()
    seen = set()
    for size in range(len(whole) // 8, len(whole), len(whole) // 16):
        path.write_bytes(whole[:size])
        held = [result for step in RecordingReader(path).steps() for result in step.results]
        updates = [r for r in held if isinstance(r, CalibrationUpdate)]
        states = [unpack(memory.state)["in_force"] for memory in RECALL(path, None) or ()]
        known = [state["sequence"] for state in states if state is not None]
        assert known == [r.sequence for r in updates][-1:]
        seen.add(known[0] if known else None)
    assert len(seen) >= 2


def test_an_event_whose_results_were_torn_off_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    recorded(tmp_path / "whole", ())
    ((_, path),) = recordings(tmp_path / "whole")
    steps = list(RecordingReader(path).steps())
    (last,) = [k for k, step in enumerate(steps) for r in step.results if isinstance(r, CalibrationUpdate)]
    before = [result.sequence for step in steps[:last] for result in step.results if isinstance(result, Result)]
    (tmp_path / "torn").mkdir()
    recorder = Recorder(tmp_path / "torn", ["s"], ["s"])
    for step in steps[:last]:
        recorder.record(step.event_sequence, step.event, step.results)
    recorder.record(last, steps[last].event, [])
    recorder.sync()
    ((_, torn),) = recordings(tmp_path / "torn")
    memories = RECALL(torn, None)
    assert memories is not None
    (memory,) = memories
    recorder.close()
    assert (memory.sequence, unpack(memory.state)["in_force"]) == (before[-1], None)


def test_what_does_not_replay_costs_its_memory_and_no_start(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    recorded(tmp_path, ())

    def hostile(*_: object) -> Pipeline:
        raise RuntimeError("of another version")

    store = Store(tmp_path, 0, recall=partial(memories_of, restore=hostile))
    assert store.recovered.results > 0
    assert kept(store) == {}
    store.close()
    assert "fieldcal-000001.mcap: does not replay" in caplog.text
    assert "of another version" in caplog.text


def test_devices_that_the_newest_file_does_not_know_are_looked_for_where_they_last_were(tmp_path: Path) -> None:
    record_run(tmp_path, blocks=24, rotate_at=(20, 40))
    asked: list[str] = []
    known = {"fieldcal-000003.mcap": [Memory("other", "B", 1, b"newest")],
             "fieldcal-000002.mcap": [],  # does not replay
             "fieldcal-000001.mcap": [Memory("bridge-1", "ADXL355 0123", 10**6, b"oldest")]}  # fmt: skip

    def recall(path: Path, keys: object) -> Sequence[Memory]:
        assert keys is None
        asked.append(path.name)
        return known[path.name]

    store = Store(tmp_path, 0, recall=recall)
    with History(store.path) as history:
        calibrated = {record.recording for record in history.newest("bridge-1", "calibration", limit=9)}
    assert {m.sensor: m.state for m in store.states} == {"bridge-1": b"oldest", "other": b"newest"}
    store.close()
    assert calibrated == known.keys()
    assert asked == sorted(known, reverse=True)
    store = Store(tmp_path, 0, recall=recall)
    store.close()
    assert len(asked) == 3, "where nothing is missing nothing is replayed"
