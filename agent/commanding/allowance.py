"""A rate limit: a burst at once, then a number per second."""

from __future__ import annotations


class RateLimit:
    """Lets `burst` items pass at once, then `rate_hz` per second. The caller gives the time; it must not decrease."""

    def __init__(self, burst: int, rate_hz: float) -> None:
        self._burst = burst
        self._rate_hz = rate_hz
        self._left = float(burst)
        self._asked_s = 0.0

    def passes(self, now_s: float) -> bool:
        """Whether an item may pass at `now_s`; if True, the item is counted."""
        self._left = min(self._burst, self._left + (now_s - self._asked_s) * self._rate_hz)
        self._asked_s = now_s
        if self._left < 1:
            return False
        self._left -= 1
        return True
