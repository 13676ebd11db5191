"""A recording replays bit for bit: whole, each file alone, files in sequence, torn files. Differences are reported."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from agent.audit.engines import Engines
from agent.audit.replaying import Replayed, ReplayedFile, Replayer, link
from agent.cli.replay import run_replay
from agent.core.events import CalibrationUpdate, Event, Result, RunStart, StatusChange, WindowReport
from agent.recording.comparison import OTHER_CPU
from agent.recording.files import recordings
from agent.recording.fingerprint import fingerprint
from agent.recording.messages import encode
from agent.recording.records import walk
from agent.recording.writer import Recorder
from tests.replay.stand_in import CONFIG, SECOND, Recorded, StandIn, happenings, here, record_run, run_start

BLOCKS = 14
ROTATIONS = (9, 20, 22)


def files_of(directory: Path) -> list[Path]:
    return [path for _, path in recordings(directory)]


def replayed(files: list[Path], restore: Callable[[str, bytes], StandIn] = StandIn.restore) -> list[Replayed]:
    replayer = Replayer(Engines(restore), here(), elsewhere=0.0)
    found = [replayer.run(path) for path in files]
    link(found)
    return found


def record_again(path: Path, recorded: list[Recorded], alter: Callable[[Recorded], Recorded]) -> Path:
    """Write a run again with altered content and correct CRCs."""
    path.mkdir()
    recorder = Recorder(path, ["acc", "ref"], ["bridge-1"])
    for entry in recorded:
        assert recorder.record(*alter(entry)), recorder.fault
    recorder.close()
    return path / "fieldcal-000001.mcap"


def test_a_run_replays_to_the_same_results(tmp_path: Path) -> None:
    recorded = record_run(tmp_path, blocks=BLOCKS)
    (replay,) = replayed(files_of(tmp_path))
    file = replay.file
    assert file.first_difference is None
    results = [result for _, _, results in recorded for result in results]
    assert (file.events, file.results, file.equal) == (len(recorded), len(results), True)
    windows = [result for result in results if isinstance(result, WindowReport)]
    calibrations = [result for result in results if isinstance(result, CalibrationUpdate)]
    assert [encode(0, window) for window in replay.windows] == [encode(0, window) for window in windows]
    assert [encode(0, update) for update in replay.calibrations] == [encode(0, update) for update in calibrations]
    assert calibrations


def test_each_file_alone_and_all_in_chain(tmp_path: Path) -> None:
    recorded = record_run(tmp_path, blocks=BLOCKS, rotate_at=ROTATIONS)
    files = files_of(tmp_path)
    assert len(files) == 1 + len(ROTATIONS)
    chain = [one.file for one in replayed(files)]
    assert [file.in_chain for file in chain] == [False, True, True, True]
    assert all(file.equal for file in chain)
    assert not any(file.notes for file in chain)
    alone = [replayed([path])[0].file for path in files]
    assert all(file.equal for file in alone)
    for counted in (chain, alone):
        assert sum(file.events for file in counted) == len(recorded)
        assert sum(file.results for file in counted) == sum(len(results) for _, _, results in recorded)


def test_restoring_equals_going_on_at_every_event(tmp_path: Path) -> None:
    total = len(record_run(tmp_path, blocks=8))
    for at in range(1, total):
        directory = tmp_path / str(at)
        directory.mkdir()
        record_run(directory, blocks=8, rotate_at=(at,))
        _, second = files_of(directory)
        assert replayed([second])[0].file.equal


def test_a_missing_file_is_told_and_the_next_starts_from_its_own_snapshot(tmp_path: Path) -> None:
    record_run(tmp_path, blocks=BLOCKS, rotate_at=ROTATIONS)
    first, _, third, _ = files_of(tmp_path)
    second = replayed([first, third])[1].file
    assert not second.in_chain
    assert second.equal
    assert second.notes == ["events 9 to 19 are in none of these files"]


def test_a_state_that_does_not_go_on_is_a_difference(tmp_path: Path) -> None:
    pipeline = StandIn(CONFIG)
    recorder = Recorder(tmp_path, ["acc", "ref"], ["bridge-1"])
    start = run_start(pipeline, 0, 1)
    recorder.record(0, start, pipeline.step(start))
    pipeline.sums[0, 0] = np.nextafter(0.0, 1.0)  # the state changes between the files without an event
    recorder.record(1, run_start(pipeline, 1, 2), [])
    recorder.close()
    first, second = (one.file for one in replayed(files_of(tmp_path)))
    assert (first.equal, second.equal) == (True, False)
    assert second.first_difference is not None
    assert second.first_difference.what == "snapshot"


def test_a_file_cut_anywhere_replays_up_to_its_last_good_record(tmp_path: Path) -> None:
    recorded = record_run(tmp_path, blocks=BLOCKS)
    (whole,) = files_of(tmp_path)
    data = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    seen = set()
    for size in range(0, len(data), 101):
        cut.write_bytes(data[:size])
        file = replayed([cut])[0].file
        assert file.fault is not None
        assert file.fault.kind == "torn"
        assert file.good_bytes <= size
        assert file.equal == (file.events > 0)
        seen.add(file.events)
    assert max(seen) == len(recorded)
    assert len(seen) > 4


def test_results_lost_with_the_tail_are_no_difference(tmp_path: Path) -> None:
    recorded = record_run(tmp_path, blocks=BLOCKS)
    at = max(number for number, _, results in recorded if results)
    kept = [(number, event, results if number < at else []) for number, event, results in recorded[: at + 1]]
    data = record_again(tmp_path / "again", kept, lambda entry: entry).read_bytes()
    torn, whole = tmp_path / "torn.mcap", tmp_path / "whole.mcap"
    torn.write_bytes(data[:-60])
    whole.write_bytes(data)
    assert replayed([torn])[0].file.equal
    assert not replayed([whole])[0].file.equal


def alter_number(entry: Recorded) -> Recorded:
    number, event, results = entry
    return number, event, [_turned(result) for result in results]


def _turned(result: Result) -> Result:
    if isinstance(result, WindowReport):
        return msgspec.structs.replace(result, stop_s=float(np.nextafter(result.stop_s, 9.0)))
    return result


def drop_result(entry: Recorded) -> Recorded:
    number, event, results = entry
    return number, event, [result for result in results if result.sequence != 5]


def alter_data(entry: Recorded) -> Recorded:
    number, event, results = entry
    if number == 6:
        event.indications[0, 0] += 1  # type: ignore[union-attr]
    return number, event, results


def add_result(entry: Recorded) -> Recorded:
    number, event, results = entry
    status = StatusChange(
        run_id="run-1", sequence=99, sensor="bridge-1", t_utc_ns=0, status="VALID", before="COLLECTING", reason=""
    )
    return number, event, [*results, status] if number == 1 else results


@pytest.mark.parametrize("alter", [alter_number, drop_result, add_result, alter_data])
def test_altered_recordings_with_sound_sums_do_not_pass(
    tmp_path: Path, alter: Callable[[Recorded], Recorded], capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = record_run(tmp_path, blocks=BLOCKS)
    path = record_again(tmp_path / "again", recorded, alter)
    assert run_replay([path], Engines(StandIn.restore), as_json=False) == 3
    assert "results differ after" in capsys.readouterr().out


def test_a_file_after_one_that_differs_is_judged_by_itself(tmp_path: Path) -> None:
    recorded = record_run(tmp_path, blocks=BLOCKS, rotate_at=(9,))
    record_again(tmp_path / "again", recorded, alter_data)
    found = replayed(files_of(tmp_path / "again"))
    assert [(one.file.equal, one.file.in_chain) for one in found] == [(False, False), (True, False)]


def test_a_recording_from_elsewhere_is_compared_within_the_tolerance(tmp_path: Path) -> None:
    recorded = record_run(tmp_path, blocks=BLOCKS)

    def elsewhere(entry: Recorded) -> Recorded:
        number, event, results = entry
        if isinstance(event, RunStart):
            event = msgspec.structs.replace(event, fingerprint=event.fingerprint | {"blas_kernel": "Other"})
        return number, event, [_turned(result) for result in results]

    path = record_again(tmp_path / "again", recorded, elsewhere)
    for tolerance, equal in ((OTHER_CPU, True), (0.0, False)):
        file = Replayer(Engines(StandIn.restore), fingerprint(), elsewhere=tolerance).run(path).file
        assert file.equal == equal
        assert "another blas_kernel" in file.notes[0]


def test_after_an_undecidable_decision_the_next_snapshot_leads_back(tmp_path: Path) -> None:
    """Where it was recorded, the first file's window was refused, just below the threshold; here it is just above."""
    directory = tmp_path / "again"
    directory.mkdir()
    recorder = Recorder(directory, ["acc", "ref"], ["bridge-1"])
    pipeline = StandIn(CONFIG)
    there = {"fingerprint": fingerprint() | {"blas_kernel": "Other"}}
    events: list[Event] = list(happenings(BLOCKS, seed=1))
    for number, event in enumerate([run_start(pipeline, 0, 1), *events[:18], None, *events[18:]]):
        if event is None or isinstance(event, RunStart):
            now_ns = 5 * SECOND + number
            event = msgspec.structs.replace(run_start(pipeline, number, 1 + (number > 0), now_ns), **there)
        results = pipeline.step(event)
        if 0 < number < 19:
            results = [refused_by_a_hair(r) if isinstance(r, WindowReport) else r for r in results]
        recorder.record(number, event, results)
    recorder.close()
    replayer = Replayer(Engines(OnTheEdge.restore), fingerprint(), elsewhere=OTHER_CPU)
    first, second = (replayer.run(path).file for path in files_of(directory))
    assert (first.undecidable, first.different, first.equal) == (1, 0, True)
    assert any("undecidable on this machine" in note for note in first.notes)
    assert (second.undecidable, second.different, second.equal) == (0, 0, True)
    assert second.results > 0


def refused_by_a_hair(report: WindowReport) -> WindowReport:
    numbers = report.numbers | {"level_counts2": 1e3 * (1 - 1e-10)}
    return msgspec.structs.replace(report, used=False, reason="too quiet", numbers=numbers)


class OnTheEdge(StandIn):
    """The stand-in pipeline, with windows of the first file that are just above the threshold of use."""

    first_file = False

    @classmethod
    def restore(cls, config_json: str, snapshot: bytes) -> OnTheEdge:
        pipeline = super().restore(config_json, snapshot)
        assert isinstance(pipeline, OnTheEdge)
        pipeline.first_file = not pipeline.blocks
        return pipeline

    def step(self, event: Event) -> list[Result]:
        return [self._edge(result) for result in super().step(event)]

    def _edge(self, result: Result) -> Result:
        if not isinstance(result, WindowReport) or not self.first_file:
            return result
        return msgspec.structs.replace(result, numbers=result.numbers | {"level_counts2": 1e3 * (1 + 1e-10)})


class WithNumpy(StandIn):
    """The stand-in pipeline, with numpy's scalars in its results."""

    def step(self, event: Event) -> list[Result]:
        return [self._numpy(result) for result in super().step(event)]

    @staticmethod
    def _numpy(result: Result) -> Result:
        if not isinstance(result, WindowReport):
            return result
        return msgspec.structs.replace(result, points=np.int64(result.points), stop_s=np.float64(result.stop_s))


def test_numpy_scalars_in_results_are_no_difference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record_run(tmp_path, blocks=BLOCKS)
    assert run_replay(files_of(tmp_path), Engines(WithNumpy.restore), as_json=True) == 0
    assert json.loads(capsys.readouterr().out)["equal"]


@pytest.mark.parametrize("field", ["config_json", "snapshot"])
def test_a_run_start_that_does_not_restore_is_refused_with_its_reason(
    tmp_path: Path, field: str, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = record_run(tmp_path, blocks=2)

    def spoil(entry: Recorded) -> Recorded:
        number, event, results = entry
        if isinstance(event, RunStart):
            event = msgspec.structs.replace(event, **{field: b"\xff" if field == "snapshot" else "{}"})
        return number, event, results

    path = record_again(tmp_path / "again", recorded, spoil)
    assert run_replay([path], Engines(StandIn.restore), as_json=False) == 3
    assert "cannot be replayed: no pipeline can be made from its configuration and snapshot" in capsys.readouterr().out


def test_json_says_all_and_is_all_of_the_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorded = record_run(tmp_path, blocks=BLOCKS, rotate_at=(9,))
    assert run_replay(files_of(tmp_path), Engines(StandIn.restore), as_json=True) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["equal"], said["first_difference"], said["runs"], said["torn"]) == (True, None, ["run-1"], [])
    assert said["events"] == len(recorded)
    assert said["results"] == sum(len(results) for _, _, results in recorded)
    assert [update["sequence"] for update in said["calibrations"]] == [5, 8]
    assert len(said["calibrations"][0]["covariance"]) == 12
    assert len(said["windows"]) == 4
    assert set(said["files"][0]) == {field.name for field in msgspec.structs.fields(ReplayedFile)}


@pytest.mark.parametrize("content", [None, b"", b"not a recording", b"\x89MCAP0\r\n"])
def test_what_is_no_recording_is_bad_input(
    tmp_path: Path, content: bytes | None, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.mcap"
    if content is not None:
        path.write_bytes(content)
    assert run_replay([path], Engines(StandIn.restore), as_json=False) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert str(path) in said.err
    assert run_replay([tmp_path], Engines(StandIn.restore), as_json=True) == 2


def test_damage_inside_is_a_refusal_and_a_torn_tail_is_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record_run(tmp_path, blocks=BLOCKS)
    (path,) = files_of(tmp_path)
    data = bytearray(path.read_bytes())
    path.write_bytes(data[:-2000])
    assert run_replay([path], Engines(StandIn.restore), as_json=False) == 0
    assert "ends early at byte" in capsys.readouterr().out
    chunk = [record for record in walk(io.BytesIO(data), len(data)) if record.name == "Chunk"][2]
    data[chunk.end - 20] ^= 1
    path.write_bytes(data)
    assert run_replay([path], Engines(StandIn.restore), as_json=False) == 3
    assert f"damaged at byte {chunk.offset} (Chunk)" in capsys.readouterr().out
