"""Computing in a process of its own: in the process that reads the devices it would delay the reading."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

NICE = 5
T = TypeVar("T")


class Aside:
    """Context in which `call` computes in the other process."""

    def __enter__(self) -> Aside:
        spawn = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(1, mp_context=spawn, initializer=_modest)
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def call(self, function: Callable[..., T], *arguments: object) -> T:
        """What the function returns, with copies of its arguments."""
        return self._pool.submit(function, *arguments).result()


def _modest() -> None:
    """Leave the processor to the reading of devices, and Ctrl-C to the process that has the session; end with it."""
    os.nice(NICE)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A parent that is killed cannot tell its processes to end."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
