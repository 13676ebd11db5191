"""Avoids stalls of all threads while devices measure: the FIFO of an ADXL355 at 1 kHz holds only 32 ms of samples."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

import numpy.fft  # noqa: F401 - else numpy loads it at its first use, in the first window


@contextmanager
def few_objects() -> Iterator[None]:
    """Within this context, the garbage collector ignores the objects that existed before.

    The collector examines all objects without a pause each time a quarter of them is new. The 60,000 objects of the
    loaded modules take 10 to 30 ms; the objects that a run makes take 0.2 ms. Who has frozen objects before decides
    when the collector sees them again.
    """
    frozen_before = gc.get_freeze_count() > 0
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        if not frozen_before:
            gc.unfreeze()
