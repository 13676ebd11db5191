"""The process of an engine of before 22 November 2026, 12:00, whose modules have other places.

At first every output of its pipeline is a result (until 21 November, 05:06), and no state outlives its run (05:42).

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
    """Answers by the modules in their places of that time."""

    def __init__(self) -> None:
        self._restore, self._pipeline = Pipeline.restore, None
        self._messages = SimpleNamespace(**{"recorded_ones": list} | vars(messages))

    def memories(self) -> list[bytes]:
        """What a later run of a gateway would begin with: at first the last calibration alone, which is no state."""
        return super().memories() if hasattr(Pipeline, "all_memories") else [b"memories"]


def main() -> None:
    """Serve the frames on standard input until it ends."""
    serving.main(Engine)
