"""Loads modules without pauses of the garbage collector."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def loading() -> Iterator[None]:
    """Within this context the garbage collector does not run.

    Modules are no garbage, but while they load the collector examines all of them again and again: a twentieth of the
    time that `fieldcal run` takes to start.
    """
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()
