"""How a program is told to stop, and how it ends: after its exit handlers, before Python finalises the interpreter.

While the interpreter is finalised, Python up to 3.13 ends each other thread that comes back into it by `pthread_exit`
(CPython issue 87135). Where such a thread comes from Zenoh, functions in Rust are on its stack. These let no unwinding
pass, and the C library aborts the process: "FATAL: exception not rethrown" (rust-lang/rust issue 135929, PyO3 pull
request 4874). Later versions of Python can crash there too (CPython issue 124619).
Zenoh's own threads end only with the process, and they may call Python at any time; nobody can wait for them.
"""

from __future__ import annotations

import atexit
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

WAKES, WAKE_S = 300, 0.1  # how often, and after how many s each, a call that waits is interrupted after SIGINT


class ProcessEnd:
    """The end of this process. Python calls exit handlers in reverse order, so make this before there are others.

    `status`: the exit status, at first that of an uncaught exception.
    """

    def __init__(self) -> None:
        self.status = 1
        atexit.register(self._leave)

    def within(self, limit_s: float) -> None:
        """The process ends after `limit_s` at the latest, also where a thread or an exit handler waits for ever."""
        end = threading.Timer(limit_s, self._leave)
        end.daemon = True
        end.start()

    def _leave(self) -> None:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except (OSError, ValueError):  # nobody reads it, the disk is full, or it is closed
                self.status = self.status or 1
        os._exit(self.status)


def raise_every_interrupt() -> None:
    """From now on each SIGINT that this process handles by KeyboardInterrupt raises it. In the main thread.

    Python raises it before the next instruction of the main thread. Where the signal comes just before a system call
    that waits, there is none. Python also discards it in callbacks of its import system and in finalisers. So a thread,
    which the interpreter tells of each signal at once, interrupts such a call, and raises anew what was discarded.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    main, tell = threading.get_ident(), sys.unraisablehook
    discarded: list[signal.Signals] = []

    def watch() -> None:
        while number := os.read(reading, 1):
            for _ in range(WAKES if number[0] == signal.SIGINT else 0):
                time.sleep(WAKE_S)
                signal.pthread_kill(main, discarded.pop() if discarded else signal.SIGURG)

    def unraisable(told: sys.UnraisableHookArgs) -> None:
        if issubclass(told.exc_type, KeyboardInterrupt):
            discarded.append(signal.SIGINT)
        else:
            tell(told)

    signal.signal(signal.SIGURG, lambda *_: None)  # a signal without a handler interrupts no call
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    sys.unraisablehook = unraisable
    threading.Thread(target=watch, name="interrupts", daemon=True).start()


class StopRequest:
    """Whether this program is to stop, here and in processes to which this object is given: a pipe that is never read.

    A handler of signals may call `set` at any moment; an event of threads or processes has a lock, which the code that
    the signal interrupts may hold. It is also set where the process that made it has ended.
    """

    def __init__(self) -> None:
        self._ends: tuple[int, ...] = os.pipe()  # to read; to write, only with its maker

    @classmethod
    def by_signals(cls) -> StopRequest:
        """One that SIGINT and SIGTERM set from now on. In the main thread.

        The interpreter itself writes to the pipe. A handler in Python would wait for the next instruction of the main
        thread, and where a signal comes just before that thread begins to wait, there is none.
        """
        stop = cls()
        os.set_blocking(stop._ends[1], False)
        signal.set_wakeup_fd(stop._ends[1], warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        return stop

    def set(self) -> None:
        """Stop."""
        if not self.is_set():
            os.write(self._ends[1], b"x")

    def is_set(self) -> bool:
        """Whether to stop."""
        return self.wait(0.0)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for it, for so many s at most; returns whether to stop."""
        waiting = select.poll()
        waiting.register(self._ends[0], select.POLLIN)
        return bool(waiting.poll(None if timeout is None else 1000.0 * timeout))

    def __reduce__(self) -> tuple[Callable[..., StopRequest], tuple[object]]:
        from multiprocessing.reduction import DupFd  # only a program with several processes loads it

        return _received, (DupFd(self._ends[0]),)

    def __del__(self) -> None:
        for end in self._ends:
            os.close(end)


def _received(reader: Any) -> StopRequest:
    """A StopRequest in another process than that of its maker."""
    stop = StopRequest.__new__(StopRequest)
    stop._ends = (reader.detach(),)
    return stop
