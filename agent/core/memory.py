"""What of a device outlives a run."""

from __future__ import annotations

from dataclasses import dataclass

MOST_MEMORIES = 8  # devices that stood in one place, one after the other; 0.1 MB each


@dataclass(frozen=True, slots=True)
class Memory:
    """What outlives a run of the estimation on one device: its state after the result with this number."""

    sensor: str
    identity: str
    sequence: int
    state: bytes
