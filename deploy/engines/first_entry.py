"""The process of an engine of 21 November 2026.

Its modules have other places, every output of its pipeline is a result, and no state outlives its run.

In the wheel of such an engine this file is agent/engine/entry.py, and the entry of today is agent/engine/serving.py.
"""

from __future__ import annotations

from types import SimpleNamespace

from agent.pipeline import Pipeline

from agent.engine import serving

try:
    from agent import messages  # until 02:42
except ImportError:
    from agent.recording import messages


class Engine(serving.Engine):
    """Answers by the modules in their places of that day."""

    def __init__(self) -> None:
        self._restore, self._pipeline = Pipeline.restore, None
        self._messages = SimpleNamespace(**vars(messages), recorded_ones=list)

    def memories(self) -> list[bytes]:
        """None: a run began with the last calibration alone."""
        return [b"memories"]


def main() -> None:
    """Serve the frames on standard input until it ends."""
    serving.main(Engine)
