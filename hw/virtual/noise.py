"""Random numbers that depend only on seed, stream and block, so that they do not depend on the order of the calls."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BLOCK = 2048  # samples per block: 2 s at 1 kHz, long enough to make the fixed cost of a block small


class NoiseStream(IntEnum):
    """Purpose of a random number."""

    SENSOR = 1
    SENSOR_COLOURED = 2
    SENSOR_COLOURED_START = 3
    SENSOR_ARRIVAL = 4
    REFERENCE = 5
    REFERENCE_ARRIVAL = 6
    KNOCK = 7
    WINDOW_OFFSET = 8
    PRESET = 9
    BUILDING_MOTION = 10
    BUILDING_HARM = 11
    CHECK_REFERENCE = 12
    CHECK_REFERENCE_ARRIVAL = 13


def generator(seed: int, stream: NoiseStream, block: int = 0) -> np.random.Generator:
    """The generator of one block: Philox with seed and stream as its key and the block in the high word of its counter.

    Raises ValueError if the seed is not an unsigned 64-bit number.
    """
    if not 0 <= seed < 2**64:
        raise ValueError(f"the seed must be a whole number from 0 to 2^64 - 1, got {seed}")
    return np.random.Generator(np.random.Philox(key=[seed, int(stream)], counter=[0, 0, 0, block]))


class ColouredNoise:
    """Stationary AR(1) noise with standard deviation 1, x_k = phi x_(k-1) + sqrt(1 - phi^2) w_k, three axes, by blocks.

    The state at the start of a block depends on all blocks before it. Asking for the next block is fast; asking for an
    earlier block starts again at the first one.
    """

    def __init__(self, seed: int, phi: float) -> None:
        if not 0 < phi < 1:
            raise ValueError(f"the AR(1) coefficient must lie between 0 and 1, got {phi}")
        self._seed, self._phi = seed, phi
        # a triangular matrix makes 32 steps at a time
        step = np.arange(32)
        self._kernel = np.tril(phi ** np.abs(step[:, None] - step[None, :])) * np.sqrt(1 - phi**2)
        self._decay = phi ** (step[:, None] + 1.0)
        self._next = 0
        self._state = self._start()

    def block(self, block: int) -> Array:
        """The values (BLOCK, 3) of one block."""
        if block < self._next:
            self._next, self._state = 0, self._start()
        while self._next < block:
            self._advance()
        return self._advance()

    def _start(self) -> Array:
        return np.asarray(generator(self._seed, NoiseStream.SENSOR_COLOURED_START).normal(size=3))

    def _advance(self) -> Array:
        white = generator(self._seed, NoiseStream.SENSOR_COLOURED, self._next).normal(size=(BLOCK // 32, 32, 3))
        values = self._kernel @ white
        for part in values:
            part += self._decay * self._state
            self._state = part[-1].copy()
        self._next += 1
        return np.asarray(values.reshape(BLOCK, 3))
