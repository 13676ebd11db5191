"""Gets the states of the estimation at the end of a recording, by replaying the recording."""

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
    """The methods needed of the pipeline that is replayed; agent.core.pipeline.Pipeline has them."""

    def step(self, event: Event) -> list[Output]: ...
    def all_memories(self) -> list[Memory]: ...


def memories_of(path: Path, restore: Callable[[str, bytes], Remembering]) -> list[Memory]:
    """The states of the estimation where a recording ends, or where a power cut tore it.

    `restore(config_json, snapshot)` makes the pipeline. The states include those of earlier runs in its snapshot.
    A recording that cannot be replayed gives no states; a warning in the log says why.
    """
    pipeline: Remembering | None = None
    try:
        for step in RecordingReader(path).steps():
            if isinstance(step.event, RunStart):
                pipeline = restore(step.event.config_json, step.event.snapshot)
            assert pipeline is not None  # the reader ensures that the first event is a RunStart
            before = [] if step.complete else pipeline.all_memories()
            outputs = recorded_ones(pipeline.step(step.event))
            if not step.complete and len(outputs) > len(step.results):
                return before  # results of this event are not in the file, so they were never published: leave it out
    except Exception as error:  # a damaged or forged snapshot may raise any exception
        _log.warning("%s: does not replay; the states of the estimation in it are not restored: %s", path, error)
        return []
    return [] if pipeline is None else pipeline.all_memories()
