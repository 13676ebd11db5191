"""The states of the estimation where recordings end, by replaying the one that ends last: its snapshot has the windows
of all before it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from agent.core.events import RunStart
from agent.core.memory import Memory
from agent.core.pipeline import Pipeline
from agent.export.samples import ExportError, followed, start_of, steps_of


def starts_of(paths: Sequence[Path]) -> dict[Path, RunStart]:
    """The first events of recordings. Raises ExportError, also where they are of several gateways."""
    starts = {path: start_of(path) for path in paths}
    gateways = {f"{start.site}/{start.gateway}" for start in starts.values()}
    if len(gateways) > 1:
        raise ExportError(
            f"{paths[0]}: the recordings are of several gateways, {', '.join(sorted(gateways))}; give those of one"
        )
    return starts


def memories_at_the_end(paths: Sequence[Path]) -> list[Memory]:
    """The states of all sensors after the last event of all recordings. Raises ExportError."""
    starts = starts_of(paths)
    path = max(paths, key=lambda path: (starts[path].t_utc_ns, starts[path].file_sequence))
    with followed(path):
        pipeline = Pipeline.restore(starts[path].config_json, starts[path].snapshot)
        for step in steps_of(path, []):
            pipeline.step(step.event)
        return pipeline.all_memories()
