"""Clock for played data: at real time or faster, and common to all devices that play together."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from typing import TypeVar
from weakref import WeakValueDictionary

from hw.sensor import Clock

T = TypeVar("T")


class DataClock:
    """CLOCK_MONOTONIC and UTC in ns; from now on both run `speed` times as fast as `clock`."""

    def __init__(self, clock: Clock, speed: float) -> None:
        self._clock = clock
        self._speed = speed
        self._zero_ns, self._utc_zero_ns = clock()

    def __call__(self) -> tuple[int, int]:
        passed_ns = round((self._clock()[0] - self._zero_ns) * self._speed)
        return self._zero_ns + passed_ns, self._utc_zero_ns + passed_ns

    def slowed(self, sleep: Callable[[float], None]) -> Callable[[float], None]:
        """Turn a `sleep` in real seconds into one in seconds of this clock."""
        return lambda seconds: sleep(seconds / self._speed)


_together: WeakValueDictionary[Hashable, object] = WeakValueDictionary()
_lock = threading.Lock()


def together(key: Hashable, build: Callable[[], T]) -> T:
    """Return the object of this process with this key; build it if nobody holds one."""
    with _lock:
        found = _together.get(key)
        if found is None:
            found = _together[key] = build()
    return found  # type: ignore[return-value]
