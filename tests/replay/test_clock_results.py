"""Clock results in recordings follow from the data; a recording made before they existed still passes the audit."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from agent.audit.engines import Engines
from agent.cli.audit import run_audit
from agent.cli.given import GivenFiles
from agent.core.events import ClockReport, Result, RunStart, Tick
from agent.core.pipeline import Pipeline
from agent.delivery.history import FILE_NAME, History
from agent.recording.files import recordings
from agent.recording.reading import RecordingReader
from tests.replay.golden_files import FORMATS, RECORDING
from tests.replay.stand_in import Recorded
from tests.replay.test_replay import record_again
from tests.unit.recorded_bench import record


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data directory of 62 s on the virtual bench."""
    directory = tmp_path_factory.mktemp("run")
    record(directory, 62.0)
    return directory


def entries(run: Path) -> list[Recorded]:
    ((_, path),) = recordings(run)
    return [(step.event_sequence, step.event, list(step.results)) for step in RecordingReader(path).steps()]  # type: ignore[arg-type]


def audit(path: Path) -> int:
    return run_audit(GivenFiles([path]), Engines(Pipeline.restore), as_json=False)


def test_clock_results_are_recorded_stored_and_follow_from_the_data(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = [result for _, _, results in entries(run) for result in results if isinstance(result, ClockReport)]
    assert [report.device for report in recorded] == ["reference", "mems"]
    with History(run / FILE_NAME) as history:
        assert [record.result.sequence for record in history.newest("mems", "clock", limit=9)] == [
            report.sequence for report in reversed(recorded)
        ]
    ((_, path),) = recordings(run)
    assert audit(path) == 0, capsys.readouterr().out


def test_a_clock_result_that_does_not_follow_from_the_data_is_found(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def better(entry: Recorded) -> Recorded:
        number, event, results = entry
        return number, event, [_halved(result) for result in results]

    path = record_again(tmp_path / "forged", entries(run), better)
    assert audit(path) == 3
    assert "/mems/clock, jitter_s" in capsys.readouterr().out


def _halved(result: Result) -> Result:
    return msgspec.structs.replace(result, jitter_s=result.jitter_s / 2) if isinstance(result, ClockReport) else result


@pytest.mark.parametrize("directory", [f for f in FORMATS if f.name == "format-1"], ids=lambda path: path.name)
def test_a_run_of_the_first_format_goes_on_without_clock_results(directory: Path) -> None:
    events = [step.event for step in RecordingReader(directory / RECORDING).steps()]
    start, last = events[0], events[-1]
    assert isinstance(start, RunStart)
    pipeline = Pipeline.restore(start.config_json, start.snapshot)
    ticks = [tick(last.t_monotonic_ns + s * 10**9) for s in range(1, 200)]
    assert not any(isinstance(r, ClockReport) for event in [*events, *ticks] for r in pipeline.step(event))


def tick(t_monotonic_ns: int) -> Tick:
    return Tick(t_monotonic_ns=t_monotonic_ns, t_utc_ns=1_790_000_000_000_000_000 + t_monotonic_ns)
