"""Summary of the agent's recording in the machine, as JSON: `python -m tests.nightly.recorded DATA_DIR`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from agent.core.events import DeviceChange
from agent.recording.reading import RecordingReader
from hw.block import BlockFlags, SampleBlock
from tests.numbered import number
from tests.scenarios.processes import recordings

TOLD = BlockFlags.GAP | BlockFlags.RESTART


def summary(data_dir: Path) -> dict[str, Any]:
    """Losses as text; and by device its samples, bursts and breaks.

    Of each device: the number of each sample; the bursts as (stamp, samples so far); the number of breaks in the sample
    numbers that the blocks report (the first block included), and the number that they do not report.
    """
    losses: list[str] = []
    devices: dict[str, dict[str, Any]] = {}
    for file in recordings(data_dir):
        for step in RecordingReader(file).steps():
            if isinstance(step.event, SampleBlock):
                _add(
                    devices.setdefault(step.event.device, {"numbers": [], "stamps_ns": [], "told": 0, "untold": 0}),
                    step.event,
                )
            elif isinstance(step.event, DeviceChange) and step.event.state == "lost":
                losses.append(f"{step.event.device}: {step.event.message}")
    return {"losses": losses, "devices": devices}


def _add(device: dict[str, Any], block: SampleBlock) -> None:
    numbers = number(block.indications).tolist()
    told = bool(block.flags & TOLD)
    device["told"] += told
    follows = [] if told else [*device["numbers"][-1:], numbers[0]]
    device["untold"] += int((np.diff(follows) != 1).sum() + (np.diff(numbers) != 1).sum())
    device["stamps_ns"] += [
        (int(stamp_ns), len(device["numbers"]) + int(count))
        for stamp_ns, count in zip(block.burst_t_monotonic_ns, block.burst_count, strict=True)
    ]
    device["numbers"] += numbers


if __name__ == "__main__":
    print(json.dumps(summary(Path(sys.argv[1]))))
