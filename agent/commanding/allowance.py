"""How many may pass: some at once, then so many a second. What did not pass is counted."""

from __future__ import annotations


class Allowance:
    """`burst` at once, then `rate_hz`. Time comes from the caller, in s, and never goes back."""

    def __init__(self, burst: int, rate_hz: float) -> None:
        self._burst = burst
        self._rate_hz = rate_hz
        self._left = float(burst)
        self._asked_s = 0.0

    def passes(self, now_s: float) -> bool:
        """Whether one more may pass now; if so, it has."""
        self._left = min(self._burst, self._left + (now_s - self._asked_s) * self._rate_hz)
        self._asked_s = now_s
        if self._left < 1:
            return False
        self._left -= 1
        return True
