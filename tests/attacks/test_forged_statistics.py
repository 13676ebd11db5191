"""Nothing that a file says about its own statistics is believed: not on another CPU, and not by another version."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from agent.audit.engines import Engines
from agent.cli.audit import audit_files, run_audit
from agent.cli.given import GivenFiles
from agent.core.events import CalibrationUpdate, Output, Result, RunStart, WindowReport
from agent.core.pipeline import Pipeline
from agent.engine import identity
from agent.recording.reading import RecordingReader
from tests.replay.golden_files import FORMATS, RECORDING
from tests.replay.stand_in import Recorded, StandIn, record_run
from tests.replay.test_replay import record_again

FOREIGN = {"machine": "aarch64"}
THRESHOLD = 1e3


def forged(change: Callable[[WindowReport], WindowReport], scale: float = 1.1) -> Callable[[Recorded], Recorded]:
    """A forger's work: a foreign fingerprint, the first window changed, and all calibrations 10 % off."""
    done: list[int] = []

    def alter(entry: Recorded) -> Recorded:
        number, event, results = entry
        if isinstance(event, RunStart):
            event = msgspec.structs.replace(event, fingerprint=event.fingerprint | FOREIGN)
        return number, event, [one(result) for result in results]

    def one(result: Output) -> Any:
        if isinstance(result, WindowReport) and not done:
            done.append(1)
            return change(result)
        if isinstance(result, CalibrationUpdate):
            rows = [[scale * value for value in row] for row in result.sensitivity]
            return msgspec.structs.replace(result, sensitivity=rows)
        return result

    return alter


def edged(window: WindowReport, **other: Any) -> WindowReport:
    numbers = window.numbers | {"level_counts2": THRESHOLD, "level_counts2_threshold": THRESHOLD}
    return msgspec.structs.replace(window, numbers=numbers, **other)


def moved(window: WindowReport) -> WindowReport:
    """The threshold moved to where the statistic is."""
    level = window.numbers["level_counts2"]
    numbers = window.numbers | {"level_counts2_threshold": level}
    return msgspec.structs.replace(window, numbers=numbers, left_out=window.left_out + 1)


def invented(window: WindowReport) -> WindowReport:
    numbers = window.numbers | {"new": 1.0, "new_threshold": 1.0}
    return msgspec.structs.replace(window, numbers=numbers, used=not window.used)


@pytest.mark.parametrize(
    "change",
    [
        lambda window: edged(window, left_out=window.left_out + 1),
        lambda window: edged(window, used=not window.used),
        lambda window: edged(window, reason="so"),
        moved,
        invented,
        lambda window: msgspec.structs.replace(window, left_out=window.left_out + 1),
    ],
)
@pytest.mark.parametrize("strict", [False, True])
def test_a_statistic_set_to_its_threshold_does_not_pass(
    tmp_path: Path, change: Callable[[WindowReport], WindowReport], strict: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record_again(tmp_path / "again", record_run(tmp_path), forged(change))
    assert run_audit(GivenFiles([path]), Engines(StandIn.restore), as_json=False, strict=strict) == 3
    told = capsys.readouterr().out
    assert "passed" not in told
    [file] = audit_files(GivenFiles([path]), Engines(StandIn.restore))
    assert file.replay.undecidable == 0
    assert file.replay.different > 1, "the calibrations after it are compared too"
    assert file.reasons[0].startswith("the results do not follow from the data")


@pytest.mark.parametrize("statistic", ["none", "coherence", "clipped_points"])
def test_no_window_of_the_real_pipeline_is_on_the_edge_by_its_counts(tmp_path: Path, statistic: str) -> None:
    """Each real window has 0 clipped points, and 0 are allowed: no other CPU counts these otherwise."""

    def change(window: WindowReport) -> WindowReport:
        numbers = dict(window.numbers)
        if statistic != "none":
            numbers[statistic] = numbers[f"{statistic}_threshold"]
        return msgspec.structs.replace(window, left_out=window.left_out + 1, numbers=numbers)

    recorded: list[Any] = []
    for step in RecordingReader(FORMATS[-1] / RECORDING).steps():
        event, results = (
            [msgspec.structs.replace(item, engine=identity.name()) if isinstance(item, RunStart | Result) else item
             for item in items]
            for items in ([step.event], step.results)
        )  # fmt: skip
        recorded.append((step.event_sequence, event[0], results))
    path = record_again(tmp_path / "again", recorded, forged(change))
    [file] = audit_files(GivenFiles([path]), Engines(Pipeline.restore))
    assert file.replay.undecidable == 0, file.replay.notes
    assert file.replay.different == 4, "each of the forged calibrations is compared"
    assert file.reasons[0].startswith("the results do not follow from the data")


class JustAbove(StandIn):
    """The stand-in pipeline on a CPU on which the statistic of each window is a little above its threshold."""

    def step(self, event: Any) -> list[Any]:
        return [self._above(result) for result in super().step(event)]

    @staticmethod
    def _above(result: Any) -> Any:
        if not isinstance(result, WindowReport):
            return result
        return msgspec.structs.replace(result, numbers=result.numbers | {"level_counts2": THRESHOLD * (1 + 1e-10)})


def test_a_decision_on_the_edge_is_not_passed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def below(window: WindowReport) -> WindowReport:
        numbers = window.numbers | {"level_counts2": THRESHOLD * (1 - 1e-10)}
        return msgspec.structs.replace(window, used=not window.used, numbers=numbers)

    path = record_again(tmp_path / "again", record_run(tmp_path), forged(below))
    for strict in (False, True):
        assert run_audit(GivenFiles([path]), Engines(JustAbove.restore), as_json=False, strict=strict) == 3
        told = capsys.readouterr().out
        assert "passed" not in told
        assert "not decided: a decision is so close" in told
    assert run_audit(GivenFiles([path]), Engines(JustAbove.restore), as_json=True) == 3
    verdict = json.loads(capsys.readouterr().out)
    assert (verdict["ok"], verdict["undecidable"]) == (False, 1)
