"""What makes U of any calibration: as its result says, or by replaying the recording in which it was made up to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from agent.core.events import CalibrationUpdate
from agent.core.memory import Memory
from agent.core.past import PastError, budget_in_force
from agent.core.pipeline import Pipeline
from agent.delivery.history import History
from agent.export.at_the_end import in_order_of
from agent.export.samples import ExportError, followed, start_of, steps_of
from agent.recording.files import recordings
from calib.state.sources import Sources


@dataclass(frozen=True, slots=True, eq=False)
class KnownBudget:
    """The result by which a calibration came into force first, and the sources of its U."""

    update: CalibrationUpdate
    sources: Sources


def budget_of(paths: Sequence[Path], number: int) -> KnownBudget:
    """That of the calibration with this number, from recordings of one gateway.

    Raises ExportError where they do not have it, PastError where windows do not tell it.
    """
    paths = in_order_of(paths)
    found = next(((path, update) for path in paths if (update := _update(path, number)) is not None), None)
    if found is None:
        raise ExportError(f"{paths[0]}: has no calibration with the number {number}; `fieldcal replay` lists its own")
    path, update = found
    if update.made_sequence:
        return budget_of(paths, update.made_sequence)
    return KnownBudget(update, budget_in_force(update, [] if update.budget else _memories_at(path, number)))


def budget_in(history: History, directory: Path, number: int) -> KnownBudget:
    """That of the calibration with this number, from the store and the recordings of a data directory.

    Raises ExportError where it is not kept, PastError where windows do not tell it, StoreError.
    """
    channels = [(sensor, what) for sensor, what in history.channels() if what == "calibration"]
    record = next(iter(history.after(number - 1, channels, limit=1)), None)
    update = None if record is None else record.result
    if record is None or record.sequence != number or not isinstance(update, CalibrationUpdate):
        raise ExportError(f"{directory}: no calibration with the number {number} is kept; `fieldcal show` lists them")
    if update.made_sequence:
        return budget_in(history, directory, update.made_sequence)
    try:
        return KnownBudget(update, budget_in_force(update, history.memories()))
    except PastError:  # another one is in force now
        there = {path.name.removesuffix(".active"): path for _, path in recordings(directory)}
        if (path := there.get(record.recording)) is None:
            name = record.recording or "in which it was made"
            raise PastError(f"the recording {name} does not exist any more") from None
        return budget_of([path], number)


def _update(path: Path, number: int) -> CalibrationUpdate | None:
    with followed(path):
        results = (result for step in steps_of(path, []) for result in step.results)
        return next((r for r in results if isinstance(r, CalibrationUpdate) and r.sequence == number), None)


def _memories_at(path: Path, number: int) -> list[Memory]:
    """The states after the event by which a calibration came into force."""
    start = start_of(path)
    with followed(path):
        pipeline = Pipeline.restore(start.config_json, start.snapshot)
        for step in steps_of(path, []):
            pipeline.step(step.event)
            if any(result.sequence == number for result in step.results if isinstance(result, CalibrationUpdate)):
                break
        return pipeline.all_memories()
