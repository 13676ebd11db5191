"""The time of a run, from the events themselves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class RunTime:
    """Monotonic time and UTC of the newest event. Seconds of a run count from its origin (monotonic)."""

    def __init__(self, origin_ns: int = 0) -> None:
        self.origin_ns = origin_ns
        self._now_ns = origin_ns
        self._utc_minus_monotonic_ns = 0

    def update(self, t_monotonic_ns: int, t_utc_ns: int) -> None:
        """Take the times of an event.

        Blocks of two devices may arrive in the wrong order, by up to one read. The time never decreases.
        """
        if t_monotonic_ns >= self._now_ns:
            self._now_ns = t_monotonic_ns
            self._utc_minus_monotonic_ns = t_utc_ns - t_monotonic_ns

    @property
    def now_s(self) -> float:
        """Seconds since the origin of the run."""
        return (self._now_ns - self.origin_ns) * 1e-9

    @property
    def utc_ns(self) -> int:
        """UTC now."""
        return self._now_ns + self._utc_minus_monotonic_ns

    @property
    def origin_utc_ns(self) -> int:
        """UTC of the origin, by the newest event."""
        return self.origin_ns + self._utc_minus_monotonic_ns

    def snapshot(self) -> dict[str, Any]:
        """State for `load`."""
        return {
            "origin_ns": self.origin_ns,
            "now_ns": self._now_ns,
            "utc_minus_monotonic_ns": self._utc_minus_monotonic_ns,
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self.origin_ns, self._now_ns = state["origin_ns"], state["now_ns"]
        self._utc_minus_monotonic_ns = state["utc_minus_monotonic_ns"]
