"""The states of the estimation where recordings end, by replaying the one that ends last: its snapshot has the windows
of all before it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from agent.core.memory import Memory
from agent.core.pipeline import Pipeline
from agent.export.samples import ExportError, followed, start_of, steps_of
from agent.recording.in_order import OrderError, of_one_gateway


def in_order_of(paths: Sequence[Path]) -> list[Path]:
    """Recordings of one gateway, the oldest first. Raises ExportError."""
    try:
        return of_one_gateway([(path, start_of(path)) for path in paths])
    except OrderError as error:
        raise ExportError(str(error)) from None
    except OSError as error:
        raise ExportError(f"{error.filename}: {error.strerror}") from None


def memories_at_the_end(paths: Sequence[Path]) -> list[Memory]:
    """The states of all sensors after the last event of all recordings. Raises ExportError."""
    path = in_order_of(paths)[-1]
    with followed(path):
        start = start_of(path)
        pipeline = Pipeline.restore(start.config_json, start.snapshot)
        for step in steps_of(path, []):
            pipeline.step(step.event)
        return pipeline.all_memories()
