"""A run begins with the states that the recordings before it left; an audit tells where it does not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from agent.config import recorded_config
from agent.core.events import DeviceChange, Event, Result, RunStart
from agent.core.pipeline import Pipeline
from agent.core.snapshot import pack, unpack
from agent.engine import identity
from agent.recording.reading import RecordingReader
from agent.recording.writer import Recorder
from tests import golden_site
from tests.replay.golden_files import PRESENT, RECORDING, start_of
from tests.replay.test_audit_engines import audited

Kept = dict[str, dict[str, bytes]]


def two_runs(directory: Path, change: Callable[[Kept], Kept], engine: str = "", unrecorded: int = 0) -> list[Path]:
    """Record the golden events, and a second run that begins with the states of the first one, changed.

    `unrecorded`: results between them that are in no recording.
    """
    directory.mkdir()
    golden = start_of(PRESENT / RECORDING)
    config = recorded_config(golden.config_json)
    events = [step.event for step in RecordingReader(PRESENT / RECORDING).steps()][1:]
    recorder = Recorder(directory, [golden_site.SENSOR, golden_site.REFERENCE], [golden_site.SENSOR])
    number = last = 0

    def record(event: Event) -> None:
        nonlocal number
        nonlocal last
        results = pipeline.step(event)
        assert recorder.record(number, event, results), recorder.fault
        number += 1
        last = max([last, *(result.sequence for result in results if isinstance(result, Result))])

    kept: Kept = {}
    of_runs: tuple[list[Event], ...] = (events, [e for e in events if isinstance(e, DeviceChange)])
    for run, of_run in enumerate(of_runs, start=1):
        pipeline = Pipeline.begin(config, f"run-{run}", 0, last + (unrecorded if kept else 0), kept)
        number = 0
        start = msgspec.structs.replace(
            golden, run_id=f"run-{run}", snapshot=pipeline.snapshot(), file_sequence=run,
            engine=engine if engine and run == 2 else identity.name(),
        )  # fmt: skip
        record(start)
        for event in of_run:
            record(event)
        recorder.close()
        recorder = Recorder(directory, [golden_site.SENSOR, golden_site.REFERENCE], [golden_site.SENSOR])
        by_device: Kept = {}
        for memory in pipeline.all_memories():
            by_device.setdefault(memory.sensor, {})[memory.identity] = memory.state
        kept = change(by_device)
    return sorted(directory.glob("*.mcap"))


def scaled(kept: Kept) -> Kept:
    """Every state with S x 1.05 somewhere in it."""

    def walk(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: walk(item) for name, item in value.items()}
        if isinstance(value, list):
            return [walk(item) for item in value]
        return value * 1.05 if hasattr(value, "dtype") and value.dtype.kind == "f" else value

    return {sensor: {i: pack(walk(unpack(state))) for i, state in of.items()} for sensor, of in kept.items()}


def test_two_runs_that_go_on_pass_in_any_order(tmp_path: Path) -> None:
    first, second = two_runs(tmp_path / "runs", lambda kept: kept)
    assert not start_of(second).continuation
    for given in ([first, second], [second, first], [tmp_path / "runs"]):
        status, said = audited(*given)
        assert (status, [Path(file["path"]).name for file in said["files"]]) == (0, [first.name, second.name]), said
        assert not any("begins with the states" in line for line in said["end"]["unproven"])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (scaled, "is not the one that the recordings before it left"),
        (lambda _: {}, "is missing, which the recordings before it left"),
        (lambda kept: {s: of | {"other": next(iter(of.values()))} for s, of in kept.items()}, "did not leave"),
    ],
)  # fmt: skip
def test_a_run_that_begins_with_other_states_fails(change: Callable[[Kept], Kept], reason: str, tmp_path: Path) -> None:
    first, second = two_runs(tmp_path / "runs", change)
    assert audited(second)[0] == 0  # for itself
    for given in ([first, second], [second, first], [tmp_path / "runs"]):
        status, said = audited(*given)
        assert status == 3
        assert any(reason in text for text in said["files"][1]["reasons"]), said["files"][1]["reasons"]


def test_states_that_another_engine_left_are_not_proven(tmp_path: Path) -> None:
    status, said = audited(*two_runs(tmp_path / "runs", scaled, engine="12-00000000deadbeef"))
    assert status == 4
    assert any("begins with the states" in line for line in said["end"]["unproven"])


def test_results_that_no_recording_has_are_no_fault_and_are_told(tmp_path: Path) -> None:
    """A disk was full at the end of the first run: its states are newer than its recording."""
    status, said = audited(*two_runs(tmp_path / "runs", scaled, unrecorded=3))
    assert status == 0
    assert any("are in no recording" in line for line in said["end"]["unproven"])


def test_files_on_several_cores_give_the_same(tmp_path: Path) -> None:
    given = [*two_runs(tmp_path / "runs", lambda kept: kept)]
    assert isinstance(start_of(given[0]), RunStart)
    one, many = (audited(*given, "--jobs", jobs) for jobs in (1, 4))
    assert one == many
