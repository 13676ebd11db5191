"""Ends `fieldcal run` when a signal asks for it, from its first line on.

A start may read gigabytes: it checks the store, closes recordings, makes lost results again. It can be cut off at any
moment, as a power cut can. So a signal during the start ends the program at once, and not after the start.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from subprocess import Popen

    from agent.acquisition.service import Service

STOP_SIGNALS = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)  # SIGHUP not where it is ignored
LONGEST_S = 1.5  # s after which the process is ended where it hangs in a call that no signal interrupts
TOLD = "stopped before the start was complete"


class StoppedAtStart(KeyboardInterrupt):
    """A signal came before the agent had begun. Of the kind that libraries let pass."""


def end_at_once_by_signals() -> None:
    """From now on a signal ends the process with status 0. For the time in which modules load, and nothing is written.

    An exception would not do: Python discards it in the callbacks of its import system, and some modules take it for a
    fault of what they import.
    """
    _handle(_end_at_once)


def _handle(handler: Callable[..., None] | signal.Handlers) -> None:
    for number in STOP_SIGNALS:
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # nohup ignores it
            signal.signal(number, handler)


def _end_at_once(*_: Any) -> None:
    with suppress(OSError):
        os.write(2, f"{TOLD}\n".encode())
    os._exit(0)


class StoppableRun:
    """What a signal does to a run: it stops the `service` that has begun, and otherwise raises StoppedAtStart once.

    `children`: processes that must not outlive this one.
    """

    def __init__(self) -> None:
        self.service: Service | None = None
        self.children: list[Popen[bytes]] = []
        self._told = False

    @property
    def begun(self) -> bool:
        """Whether the service has begun."""
        return self.service is not None and self.service.begun

    def take(self, *_: Any) -> None:
        """Handle a signal."""
        if self.service is not None and self.service.begun:
            self.service.stop()
        elif not self._told:  # a second one would cut off the closing of what is open
            self._told = True
            raise StoppedAtStart

    def end(self) -> None:
        """End this process where it is."""
        for child in self.children:
            child.terminate()
        os._exit(0)


@contextmanager
def stopped_by_signals() -> Iterator[StoppableRun]:
    """Within this context a signal stops the run, by StoppedAtStart while it starts. After it signals are ignored.

    If even that does not end the start within LONGEST_S, the process ends with status 0.
    """
    run, ended = StoppableRun(), threading.Event()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def watch() -> None:
        # Python calls `take` only between two of its own instructions; it writes to the pipe at once.
        while os.read(reading, 64):
            if not run.begun and not ended.wait(LONGEST_S) and not run.begun:
                run.end()
        os.close(reading)

    threading.Thread(target=watch, name="signals", daemon=True).start()
    before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    _handle(run.take)
    try:
        yield run
    finally:
        _handle(signal.SIG_IGN)
        ended.set()
        signal.set_wakeup_fd(before)
        os.close(writing)
