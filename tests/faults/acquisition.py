"""Did reading go on? Told by the recordings, and by the port, which loses what nobody reads."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agent.core.events import Gap
from agent.recording.reading import RecordingReader
from hw.block import BlockFlags, SampleBlock
from tests.scenarios.processes import recordings

LONGEST_S = 1.0  # that reading may stop, besides what the machine gives nobody time


@dataclass(frozen=True, slots=True)
class Acquisition:
    """What the recordings tell of one device, in the order of events.

    `longest_pause_s` between two reads of the port, in real time; `missing` samples between blocks of one opening;
    `openings` how often an index did not go on in time; `dropped` blocks for which the agent had no room.
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
    """Of all recordings of one run on a sensor whose clock runs `speed` times as fast."""
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
