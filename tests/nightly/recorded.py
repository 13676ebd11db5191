"""What the agent recorded in the machine, as JSON: `python -m tests.nightly.recorded DATA_DIR`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from agent.events import DeviceChange, Gap
from agent.recording.reading import RecordingReader
from hw.block import SampleBlock
from tests.numbered import number
from tests.scenarios.processes import recordings


def summary(data_dir: Path) -> dict[str, Any]:
    """Gaps and losses in words; by device the number of each sample, the blocks' flags, bursts as (stamp, samples)."""
    found: dict[str, Any] = {"faults": [], "devices": {}}
    for file in recordings(data_dir):
        for step in RecordingReader(file).steps():
            match step.event:
                case SampleBlock() as block:
                    device = found["devices"].setdefault(block.device, {"numbers": [], "flags": [], "stamps_ns": []})
                    device["stamps_ns"] += [
                        (int(stamp_ns), len(device["numbers"]) + int(count))
                        for stamp_ns, count in zip(block.burst_t_monotonic_ns, block.burst_count, strict=True)
                    ]
                    device["numbers"] += number(block.indications).tolist()
                    device["flags"].append(int(block.flags))
                case Gap() as gap:
                    found["faults"].append(f"{gap.device}: {gap.dropped} {gap.unit}: {gap.reason}")
                case DeviceChange(state="lost") as change:
                    found["faults"].append(f"{change.device}: {change.message}")
    return found


if __name__ == "__main__":
    print(json.dumps(summary(Path(sys.argv[1]))))
