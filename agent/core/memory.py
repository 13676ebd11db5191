"""State of a device that is kept for later runs."""

from __future__ import annotations

from dataclasses import dataclass

MOST_MEMORIES = 8  # states of devices that were used under one sensor name, one after the other; 2 MB each at most


@dataclass(frozen=True, slots=True)
class Memory:
    """State of the estimation on one device, after the result with the number `sequence`. It is kept for later runs."""

    sensor: str
    identity: str
    sequence: int
    state: bytes
