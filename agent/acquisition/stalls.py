"""What would hold all threads up while devices measure, done before: the FIFO of an ADXL355 at 1 kHz holds 32 ms."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

import numpy.fft
import numpy.ma  # noqa: F401 - numpy loads both at their first use, which would be in the first window


@contextmanager
def few_objects() -> Iterator[None]:
    """Within, the garbage collector leaves alone what was made before.

    It looks at all objects each time a quarter of them is new, in one go: 60,000 of them, most of them modules, take
    10 to 30 ms, what a run makes 0.2 ms.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
