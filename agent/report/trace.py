"""One window point by point: the indications, the model S a + Q, and the residual between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.report.result import CalibrationResult
from calib.model import Array, Pose

PHASE_BINS = 24  # 15 deg each
SPECTRUM_POINTS = 2048  # a segment; 0.5 Hz lines at 1 kHz


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Points of a used window: times (n,) in s since the sensor's first sample, V (n, 3) in the output unit, the
    reference u and du/dt (n, m) in m/s2 and m/s3 (m = 0 at rest), and the pose."""

    time_s: Array
    indications: Array
    reference: Array
    reference_rate: Array
    pose: Pose


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Indications, model and residual (n, 3) of a window in the output unit, NaN on an axis that S does not cover.

    `centred`: means were taken off, since offset or gravity is not known. `frequency_hz` (mean) and `phase_rad` (n,)
    are those of the reference's motion.
    """

    time_s: Array
    indications: Array
    model: Array
    residual: Array
    position: str
    centred: bool
    frequency_hz: float | None
    phase_rad: Array | None

    @property
    def rate_hz(self) -> float:
        """Mean sampling rate."""
        return float((len(self.time_s) - 1) / (self.time_s[-1] - self.time_s[0]))

    @property
    def rms(self) -> Array:
        """(3,) root mean square of the residual."""
        return np.asarray(np.sqrt(np.mean(self.residual**2, axis=0)))


def residuals(trace: Trace, result: CalibrationResult) -> Residuals:
    """V against S a(t - lag) + Q (Eq. 8). The lag is corrected with the derivative, because it is only milliseconds."""
    pose = trace.pose
    felt = trace.reference[:, :, None] - trace.reference_rate[:, :, None] * result.lag_s  # (n, m, 3): by output axis
    a = np.einsum("jm,nmi->nij", pose.direction, felt)
    moves = np.abs(pose.direction).max(axis=1, initial=0.0) > 0
    centred = not (np.isfinite(pose.gravity_mps2).all() and np.isfinite(result.offset).all())
    if not centred:
        a = a + pose.gravity_mps2
        moves = moves | (pose.gravity_mps2 != 0)
    sensitivity = np.where(np.isnan(result.sensitivity) & ~moves, 0.0, result.sensitivity)
    model = np.einsum("ij,nij->ni", sensitivity, a)
    V = trace.indications
    if centred:
        model, V = model - model.mean(axis=0), V - V.mean(axis=0)
    else:
        model = model + result.offset
    frequency, phase = _phase(trace)
    return Residuals(trace.time_s, V, model, V - model, pose.position, centred, frequency, phase)


def _phase(trace: Trace) -> tuple[float | None, Array | None]:
    """Mean frequency in Hz, and phase (n,) in rad, of the channel of the reference with the most motion; 0 rad is at
    its maximum.

    The angle in the plane of u and du/dt: the phase of a sine, and for any other motion where in its swing it is.
    """
    u, rate = trace.reference, trace.reference_rate
    if not u.shape[1] or not u.var(axis=0).max() > 0:
        return None, None
    channel = int(np.argmax(u.var(axis=0)))
    omega = float(rate[:, channel].std() / u[:, channel].std())
    if not omega > 0:
        return None, None
    phase = np.arctan2(-rate[:, channel] / omega, u[:, channel] - u[:, channel].mean())
    return omega / (2 * np.pi), np.asarray(phase % (2 * np.pi))


def by_phase(phase_rad: Array, residual: Array) -> tuple[Array, Array, Array]:
    """Middles (B,) of bins of phase in rad; mean and standard error of the residual (n, 3) in them, (B, 3)."""
    edges = np.linspace(0, 2 * np.pi, PHASE_BINS + 1)
    bins = np.clip(np.digitize(phase_rad, edges) - 1, 0, PHASE_BINS - 1)
    count = np.bincount(bins, minlength=PHASE_BINS)
    held = count > 1
    means, errors = np.full((PHASE_BINS, 3), np.nan), np.full((PHASE_BINS, 3), np.nan)
    for b in np.flatnonzero(held):
        part = residual[bins == b]
        means[b], errors[b] = part.mean(axis=0), part.std(axis=0, ddof=1) / np.sqrt(len(part))
    return 0.5 * (edges[:-1] + edges[1:]), means, errors


def spectrum(residual: Array, rate_hz: float) -> tuple[Array, Array]:
    """Frequencies (F,) in Hz and amplitude spectral density (F, 3) in unit/sqrt(Hz): Welch, Hann, half overlapped."""
    size = min(SPECTRUM_POINTS, len(residual))
    window = np.hanning(size + 1)[:-1]
    starts = range(0, len(residual) - size + 1, max(1, size // 2))
    power = np.zeros((size // 2 + 1, residual.shape[1]))
    for start in starts:
        part = residual[start : start + size]
        power += np.abs(np.fft.rfft((part - part.mean(axis=0)) * window[:, None], axis=0)) ** 2
    density = 2 * power / len(starts) / (rate_hz * np.sum(window**2))
    return np.asarray(np.fft.rfftfreq(size, 1 / rate_hz)[1:]), np.asarray(np.sqrt(density[1:]))


def spans(time_s: Array, values: Array, columns: int) -> tuple[Array, Array, Array]:
    """Middles (B,), smallest and largest of values (n, 3) in at most `columns` intervals of time, as a plot shows
    them."""
    edges = np.linspace(0, len(time_s), min(columns, len(time_s)) + 1).astype(int)[:-1]
    count = np.diff(np.append(edges, len(time_s)))
    middle = np.add.reduceat(time_s, edges) / count
    return middle, np.minimum.reduceat(values, edges, axis=0), np.maximum.reduceat(values, edges, axis=0)
