"""Results of reading the FIFO of a chip: samples, and the words that belong to no sample. Pure functions, no bus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class FifoSamples:
    """Complete samples in a sequence of FIFO words.

    A word is what the chip stores at a time: an axis, a sample, a tagged sample.

    - `counts` (N, 3): int32.
    - `last` (N,): position of the word that completed each sample.
    - `breaks`: samples that do not follow the sample before, because words between them were not usable (ascending, may
      hold N).
    - `dropped`: number of words that belong to no sample.
    - `rest`: bytes of an incomplete sample at the end.
    """

    counts: NDArray[np.int32]
    last: NDArray[np.int64]
    breaks: list[int]
    dropped: int
    rest: bytes


def plain_samples(data: bytes, byte_order: str) -> FifoSamples:
    """Samples of three 16-bit numbers without any marker, `byte_order` "<" or ">".

    `data` must begin with the first byte of a sample; this function cannot check it.
    """
    counts = np.frombuffer(data, f"{byte_order}i2").astype(np.int32).reshape(-1, 3)
    return FifoSamples(counts, np.arange(len(counts)), [], 0, b"")


@dataclass(frozen=True, slots=True)
class Burst:
    """Data of one FIFO read. `lost`: an unknown number of samples before these data is lost."""

    arrival_ns: int
    utc_ns: int
    data: bytes
    lost: bool
