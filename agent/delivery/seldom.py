"""Warnings that others can cause as often as they like: one is logged in a while."""

from __future__ import annotations

import logging
import math
import time

LOG_S = 10.0
_log = logging.getLogger("agent.delivery")


class Seldom:
    """Logs at most one warning each `apart_s` seconds, to `log`."""

    def __init__(self, log: logging.Logger = _log, apart_s: float = LOG_S) -> None:
        self._log, self._apart_s = log, apart_s
        self._silent_until = -math.inf

    def warning(self, text: str, *values: object) -> None:
        """Log a warning, unless one was logged just before."""
        if time.monotonic() >= self._silent_until:
            self._silent_until = time.monotonic() + self._apart_s
            self._log.warning(text, *values)
