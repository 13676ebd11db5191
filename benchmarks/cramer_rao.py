"""Cramér-Rao bound for white noise: least u of S, Q and a common lag from all points, directly from Eqs. (8)-(11)."""

from __future__ import annotations

import numpy as np

from benchmarks.torture_rows import NOISE_MPS2, REPETITIONS, S_TRUE
from hw.virtual.parameters import BenchParameters


def cramer_rao(parameters: BenchParameters) -> np.ndarray:
    """Standard uncertainties (12,) of S row by row and Q, on a bench whose only fault is noise."""
    rate_hz, omega = 1000.0, 2.0 * np.pi * float(parameters.motion.frequency_hz[0])
    size = float(np.abs(parameters.motion.amplitude_mps2[0, 0]))
    information = np.zeros((13, 13))
    for stand in parameters.schedule.stands:
        t = np.arange(round(stand.hold_s * rate_hz)) / rate_hz
        d, e = stand.frame[:, 0], stand.frame[:, 2]
        a = np.outer(size * np.sin(omega * t), d) + parameters.gravity_mps2 * e
        moving = np.outer(size * omega * np.cos(omega * t), S_TRUE @ d)
        for i in range(3):
            rows = np.zeros((len(t), 13))
            rows[:, 3 * i : 3 * i + 3], rows[:, 9 + i], rows[:, 12] = a, 1.0, -moving[:, i]
            information += REPETITIONS * rows.T @ rows / NOISE_MPS2**2
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information))[:12]))
