"""Checks whether reading of the device went on, by the recordings and by the port, which loses unread data."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agent.core.events import Gap
from agent.recording.reading import RecordingReader
from hw.block import BlockFlags, SampleBlock
from tests.scenarios.processes import recordings

LONGEST_S = 1.0  # s that reading may pause, besides the time in which the machine runs no process of ours


@dataclass(frozen=True, slots=True)
class Acquisition:
    """How one device was read, according to the recordings.

    `longest_pause_s`: longest real time between two reads of the port. `missing`: samples missing between blocks while
    the device was open. `openings`: how often the sample index began anew. `dropped`: blocks that the agent dropped.
    """

    longest_pause_s: float
    missing: int
    openings: int
    dropped: int

    def __str__(self) -> str:
        return (
            f"reading paused {self.longest_pause_s:.2f} s at most, {self.missing} samples missing,"
            f" {self.dropped} blocks dropped"
        )


def acquisition(data_dir: Path, speed: int) -> Acquisition:
    """Read all recordings of one run. `speed`: how many times faster than real time the sensor's clock runs."""
    last_ns = expected = -1
    pause_ns = missing = openings = dropped = 0
    for event in _events(recordings(data_dir)):
        if isinstance(event, Gap) and event.unit == "blocks":
            dropped += event.dropped
        if not isinstance(event, SampleBlock):
            continue
        stamps = event.burst_t_monotonic_ns
        if event.flags & BlockFlags.RESTART:
            openings += 1
        else:
            missing += event.first_index - expected
        if last_ns >= 0:
            stamps = np.concatenate([[last_ns], stamps])
        pause_ns = max(pause_ns, int(np.diff(stamps).max(initial=0)))
        last_ns, expected = int(stamps[-1]), event.first_index + event.n
    return Acquisition(pause_ns * 1e-9 / speed, missing, openings, dropped)


def _events(paths: Iterable[Path]) -> Iterator[object]:
    for path in paths:
        for step in RecordingReader(path).steps():
            yield step.event
