"""What a recording leaves in memory: it is stepped through once more, and the states at its end are taken."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from agent.core.events import Event, Output, RunStart
from agent.core.memory import Memory
from agent.recording.messages import recorded_ones
from agent.recording.reading import RecordingReader

_log = logging.getLogger(__name__)


class Remembering(Protocol):
    """What is stepped: agent.core.pipeline.Pipeline."""

    def step(self, event: Event) -> list[Output]: ...
    def all_memories(self) -> list[Memory]: ...


def memories_of(path: Path, restore: Callable[[str, bytes], Remembering]) -> list[Memory]:
    """The states where a recording ends, or is torn; what does not replay is told, and leaves none.

    `restore(config_json, snapshot)` makes the pipeline. All that its snapshot kept of runs before is among the states.
    """
    pipeline: Remembering | None = None
    try:
        for step in RecordingReader(path).steps():
            if isinstance(step.event, RunStart):
                pipeline = restore(step.event.config_json, step.event.snapshot)
            assert pipeline is not None  # the reader lets nothing come before a RunStart
            before = [] if step.complete else pipeline.all_memories()
            outputs = recorded_ones(pipeline.step(step.event))
            if not step.complete and len(outputs) > len(step.results):
                return before  # the tear took results of this event: nobody ever had them
    except Exception as error:  # whatever stands in the file: a hostile snapshot may raise anything
        _log.warning("%s: does not replay, what it knows of a calibration is lost: %s", path, error)
        return []
    return [] if pipeline is None else pipeline.all_memories()
