"""Rate of false alarms of the sequential test in calib.drift.onsets, and the threshold for a given rate.

After every window the test compares the largest Z^2 / 2 over all onsets with a threshold. Z is the standard normal
sum of all scores since the onset. For independent scores the mean number of windows between false alarms is, with
b = sqrt(2 threshold) (Siegmund and Venkatraman, Annals of Statistics 23 (1995) 255, Theorem 1, both signs):

    1 / rate = sqrt(2 pi) exp(b^2 / 2) / (b * integral of x nu(x)^2 dx)

The integral runs over x = b / sqrt(windows since the onset); nu is the overshoot of a Gaussian random walk.
benchmarks/drift_test.py measures the rate by simulation.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

# Each iteration for the threshold divides the error by about b^2.
SETTLED, MOST_ITERATIONS = 1e-9, 12

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)


def false_alarm_rate(threshold: float, fewest: int, most: int) -> float:
    """False alarms per window of one parameter; onsets lie `fewest` to `most` windows back."""
    b = math.sqrt(2.0 * threshold)
    return b * math.exp(-threshold) / math.sqrt(2.0 * math.pi) * _overshoots(b, fewest, most)


@lru_cache(maxsize=64)
def false_alarm_threshold(rate: float, fewest: int, most: int) -> float:
    """The threshold that has this `false_alarm_rate` (per window, for one parameter; below 1e-2)."""
    b = 5.0
    for _ in range(MOST_ITERATIONS):
        before = b
        b = math.sqrt(2.0 * math.log(b * _overshoots(b, fewest, most) / (math.sqrt(2.0 * math.pi) * rate)))
        if abs(b - before) < SETTLED:
            break
    return b * b / 2.0


def _overshoots(b: float, fewest: int, most: int) -> float:
    low, high = b / math.sqrt(most), b / math.sqrt(fewest)
    x = low + (high - low) * (_NODES + 1.0) / 2.0
    values = [value * _nu(value) ** 2 for value in x.tolist()]
    return float(_WEIGHTS @ values) * (high - low) / 2.0


def _nu(x: float) -> float:
    """The function nu(x) to within 1 % (Siegmund and Yakir, The Statistics of Gene Mapping, 2007, section 5.1)."""
    half = math.erf(x / math.sqrt(8.0)) / 2.0  # Phi(x / 2) - 1 / 2
    density = math.exp(-x * x / 8.0) / math.sqrt(2.0 * math.pi)
    return (2.0 / x) * half / ((x / 2.0) * (half + 0.5) + density)
