"""The statistics that a window in motion is judged by (calib.excitation.window_verdict)."""

from __future__ import annotations

import numpy as np

from calib.excitation import detection
from calib.excitation.window_verdict import DRIFT_SD, Limits
from calib.model import Array, WindowSums
from calib.signal.order_statistics import median
from calib.windows.sums import factor


def motion_numbers(
    sums: WindowSums, basis: Array, V: Array, rate_hz: float, stepped: tuple[float, float], limits: Limits, noise: Array
) -> dict[str, float]:  # fmt: skip
    """Statistics for the verdict: level, noise and coherence in the band of the motion, drift and step of the mean.

    `basis` (n, 1 + 2 m) is [1, u, du]; `stepped` is a step and its standard uncertainty in output unit. `noise` (k,) is
    the SD of the white noise in u of the reference's own channels. A motion that fills the spectrum looks like white
    noise: what of it the sensor shows as well is none.
    """
    numbers, scale = _in_band(basis, V, rate_hz, noise)
    if numbers["reference_rms_mps2"] <= limits.least_level * numbers["reference_noise_mps2"]:
        incoherent = detection.incoherent(basis[:, 1 : 1 + len(noise)], V)
        numbers, scale = _in_band(basis, V, rate_hz, np.minimum(noise, incoherent))
    drifted, u_drift = _drift(sums)
    changes = {"drift_mps2": drifted, "step_mps2": stepped[0], "u_step_mps2": stepped[1]}
    if scale > 0 and DRIFT_SD * u_drift > limits.most_drift_mps2 * scale:  # else it changes no verdict
        changes["u_drift_mps2"] = u_drift
    return numbers | {name: change / scale if scale > 0 else np.inf for name, change in changes.items()}


def _in_band(basis: Array, V: Array, rate_hz: float, noise: Array) -> tuple[dict[str, float], float]:
    """Level of the reference, its `noise` (k,) and the coherence, after averages that leave most of the motion; and the
    largest sensitivity of V to it, in output unit per m/s2."""
    m = len(noise)
    u = basis[:, 1 : 1 + m]
    width = detection.band_width(u, rate_hz, noise)
    slow, slow_v = detection.averaged(basis, width), detection.averaged(V, width)
    solution, *_ = np.linalg.lstsq(slow, slow_v, rcond=None)
    total = float(np.sum((slow_v - slow_v.mean(axis=0)) ** 2))
    rest = float(np.sum((slow_v - slow @ solution) ** 2))
    numbers = {
        "reference_rms_mps2": float(np.sqrt(np.sum(np.var(slow[:, 1 : 1 + m], axis=0)))),
        # A constant channel has only rounding errors as level and as noise: it must count as silent.
        "reference_noise_mps2": float(np.sqrt(np.sum(noise**2) / width) + 1e-12 * np.abs(u).max()),
        "coherence": 1.0 - rest / total if total > 0 else 0.0,
    }
    return numbers, float(np.linalg.norm(solution[1 : 1 + m], 2))


def _drift(sums: WindowSums) -> tuple[float, float]:
    """Largest difference between a segment's mean and its value by the window's own regression, in output unit; and the
    standard uncertainty that noise gives such a difference, from those of neighbours, which drift hardly apart."""
    m = sums.reference_channels
    part = factor(sums, derivative=True)
    solution, *_ = np.linalg.lstsq(part.r, part.rhs, rcond=1e-12)
    whole = sums.count >= 0.5 * sums.count.max()
    basis = np.hstack([np.ones((len(sums.count), 1)), sums.mean[:, : 2 * m]])
    away = (sums.mean[:, 2 * m :] - basis @ solution)[whole]
    apart = np.abs(np.diff(away, axis=0))
    u = 1.4826 * float(np.max(median(apart.T))) / np.sqrt(2.0) if len(apart) else 0.0
    return float(np.abs(away).max()), float(u)
