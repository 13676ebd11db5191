"""What the reads of a chip's FIFO become: samples, and what of the bytes was none. Pure functions, no bus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class FifoSamples:
    """Whole samples of a run of FIFO words (what the chip stores at a time: an axis, a sample, a tagged sample).

    `counts` (N, 3) int32; `last` (N,) place of the word that ended each sample; `breaks` samples before which words
    were out of step (rising, may hold N); `dropped` words that belong to no sample; `rest` bytes of a sample that has
    only begun.
    """

    counts: NDArray[np.int32]
    last: NDArray[np.int64]
    breaks: list[int]
    dropped: int
    rest: bytes


def plain_samples(data: bytes, byte_order: str) -> FifoSamples:
    """Samples of three 16 bit numbers without any mark, `byte_order` "<" or ">"; their step is the reader's care."""
    counts = np.frombuffer(data, f"{byte_order}i2").astype(np.int32).reshape(-1, 3)
    return FifoSamples(counts, np.arange(len(counts)), [], 0, b"")


@dataclass(frozen=True, slots=True)
class Burst:
    """One read of a FIFO. `lost` tells that samples before it, how many is not known, are gone."""

    arrival_ns: int
    utc_ns: int
    data: bytes
    lost: bool
