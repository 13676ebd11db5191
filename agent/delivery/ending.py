"""Ends the process after its exit handlers, and before Python finalises the interpreter.

While the interpreter is finalised, Python up to 3.13 ends each other thread that comes back into it by `pthread_exit`
(CPython issue 87135). Where such a thread comes from Zenoh, functions in Rust are on its stack. These let no unwinding
pass, and the C library aborts the process: "FATAL: exception not rethrown" (rust-lang/rust issue 135929, PyO3 pull
request 4874). Later versions of Python can crash there too (CPython issue 124619).
Zenoh's own threads end only with the process, and they may call Python at any time; nobody can wait for them.
"""

from __future__ import annotations

import atexit
import os
import sys


class ProcessEnd:
    """The end of this process. Python calls exit handlers in reverse order, so make this before there are others.

    `status`: the exit status, at first that of an uncaught exception.
    """

    def __init__(self) -> None:
        self.status = 1
        atexit.register(self._leave)

    def _leave(self) -> None:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except (OSError, ValueError):  # nobody reads it, the disk is full, or it is closed
                self.status = self.status or 1
        os._exit(self.status)
