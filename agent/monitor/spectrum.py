"""The last minute of a corrected stream: its course, and its power spectral density.

The density is estimated by Welch's method (P. D. Welch, IEEE Trans. Audio Electroacoust. 15, 1967): the mean over half
overlapping segments, each without its mean and weighted by a Hann window; one-sided, so that its integral over
frequency is the variance. It agrees with scipy.signal.welch(scaling="density").
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.core.events import Acceleration

LENGTH_S = 60.0
SEGMENT_S = 10.0  # a resolution of 0.1 Hz
SEGMENT_MAX = 4096  # samples of a segment: the density has half as many lines
COURSE = 600  # intervals of the minute of which the page gets minimum and maximum
SAMPLES_MAX = 1 << 18  # of the minute, at whatever rate a stranger states
BANDWIDTH_BINS = 1.5  # noise bandwidth of a Hann window (Harris, Proc. IEEE 66, 1978, table 1)
Array = NDArray[np.float64]


class LastMinute:
    """The newest samples without a gap, at most LENGTH_S. `begun_anew`: how often lost samples ended what was there."""

    def __init__(self) -> None:
        self.begun_anew = 0
        self._blocks: list[Acceleration] = []

    def add(self, block: Acceleration) -> None:
        """The next block."""
        last = self._blocks[-1] if self._blocks else None
        if last is not None and not _follows(last, block):
            self.begun_anew += 1
            self._blocks.clear()
        self._blocks.append(block)
        while len(self._blocks) > 1 and self._count - len(self._blocks[0].acceleration) >= self._most(block):
            del self._blocks[0]

    def as_object(self) -> dict[str, Any]:
        """The course and the density as JSON can hold them. Without `segments` there is no density yet."""
        block = self._blocks[-1]
        values = np.vstack([each.acceleration for each in self._blocks])[-self._most(block) :]
        seconds = len(values) / block.rate_hz
        length = min(round(SEGMENT_S * block.rate_hz), SEGMENT_MAX)
        enough = 8 <= length <= len(values)
        hz, density = density_of(values, block.rate_hz, length) if enough else (np.zeros(0), np.zeros((0, 3)))
        return {
            "t_utc_ns": block.t_utc_ns + round(1e9 * len(block.acceleration) / block.rate_hz), "seconds": seconds,
            "rate_hz": block.rate_hz, "begun_anew": self.begun_anew, "course": _course(values),
            "segment_s": length / block.rate_hz, "segments": segments_in(len(values), length) if enough else 0,
            "resolution_hz": BANDWIDTH_BINS * block.rate_hz / length if length else 0.0,
            "frequency_hz": _rounded(hz), "density": [_rounded(axis) for axis in density.T],
        }  # fmt: skip

    @property
    def _count(self) -> int:
        return sum(len(block.acceleration) for block in self._blocks)

    @staticmethod
    def _most(block: Acceleration) -> int:
        return max(1, min(round(LENGTH_S * block.rate_hz), SAMPLES_MAX))


def usable(block: Acceleration) -> bool:
    """Whether the block, which a stranger may have sent, can be computed with."""
    rate_ok = np.isfinite(block.rate_hz) and 0.01 <= block.rate_hz <= 1e6
    return bool(rate_ok and len(block.acceleration) and np.isfinite(block.acceleration).all())


def segments_in(count: int, length: int) -> int:
    """How many half overlapping segments of `length` samples there are in `count`."""
    return (count - length) // (length - length // 2) + 1


def density_of(values: Array, rate_hz: float, length: int) -> tuple[Array, Array]:
    """Frequencies (F,) in Hz and the density (F, C) of the columns of `values` (n, C), in their unit squared over Hz.

    `length`: samples of a segment, of at least 8 and at most n.
    """
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
    step, total = length - length // 2, np.zeros((length // 2 + 1, values.shape[1]))
    count = segments_in(len(values), length)
    for k in range(count):
        part = values[k * step : k * step + length]
        lines = np.fft.rfft(window[:, None] * (part - part.mean(axis=0)), axis=0)
        total += np.abs(lines) ** 2
    density: Array = total / (count * rate_hz * (window**2).sum())
    density[1 : (length + 1) // 2] *= 2.0  # all but 0 Hz and half the rate stand for two lines
    return np.fft.rfftfreq(length, 1.0 / rate_hz).astype(np.float64), density


def _follows(last: Acceleration, block: Acceleration) -> bool:
    return (
        block.first_index == last.first_index + len(last.acceleration)
        and block.rate_hz * 0.999 < last.rate_hz < block.rate_hz * 1.001
    )


def _course(values: Array) -> Mapping[str, list[list[float]]]:
    """Minimum and maximum of each axis in at most COURSE intervals of the same length."""
    edges = np.linspace(0, len(values), min(COURSE, len(values)) + 1).astype(np.int64)[:-1]
    low, high = np.minimum.reduceat(values, edges), np.maximum.reduceat(values, edges)
    return {"low": [_rounded(axis) for axis in low.T], "high": [_rounded(axis) for axis in high.T]}


def _rounded(values: Array) -> list[float]:
    """With five digits, which a plot does not show."""
    return [float(f"{value:.5g}") for value in values.tolist()]
