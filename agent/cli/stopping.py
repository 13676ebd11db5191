"""Ends the agent when a signal asks for it, also while it still starts.

A start may read gigabytes: it checks the store, closes recordings, makes lost results again. It can be cut off at any
moment, as a power cut can. So a signal during the start ends the program at once, and not after the start.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LONGEST_S = 1.5  # s after which the process is ended where it hangs in a call that no signal interrupts


class StoppedAtStart(BaseException):
    """A signal came before the agent had begun."""


@contextmanager
def stopped_by_signals(begun: Callable[[], bool], stop: Callable[[], None]) -> Iterator[None]:
    """Within this context a signal calls `stop`; where the agent has not `begun` yet, it raises StoppedAtStart.

    If even that does not end the start within LONGEST_S, the process ends with status 0.
    """
    ended = threading.Event()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def take(*_: Any) -> None:
        if begun():
            stop()
        else:
            raise StoppedAtStart

    def watch() -> None:
        # Python calls `take` only between two of its own instructions; it writes to the pipe at once.
        while os.read(reading, 64):
            if not begun() and not ended.wait(LONGEST_S) and not begun():
                os._exit(0)
        os.close(reading)

    threading.Thread(target=watch, name="signals", daemon=True).start()
    before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    for number in STOP_SIGNALS:
        signal.signal(number, take)
    try:
        yield
    finally:
        ended.set()
        signal.set_wakeup_fd(before)
        os.close(writing)
