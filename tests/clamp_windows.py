"""Windows on the paper's clamp with known truth and stated faults, from Eqs. (8)-(11), for the estimator's tests.

The geometry is written out here a second time, so that calib's geometry and nuisances are not tested by themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calib.model import Pose, Window, WindowSums

G_MPS2 = 9.80665
S_TRUE = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
Q_TRUE = np.array([0.36, -0.06, 0.165])
TRUTH = np.concatenate([S_TRUE.ravel(), Q_TRUE])
RATE_HZ = 250.0  # of the windows, where nothing else is said
ALPHAS_DEG = (0.0, 30.0, 120.0, 210.0)


@dataclass(frozen=True)
class Faults:
    """What differs from the nominal bench. Angles in rad, the rest in SI; `noise` is white unless `phi` is given."""

    theta_rad: float = 0.0
    alpha_common_rad: float = 0.0
    alpha_rad: dict[float, float] = field(default_factory=dict)
    offset_mps2: float = 0.0  # SD between windows
    lag_s: float = 0.0
    noise_mps2: float = 0.02
    phi: float = 0.0


@dataclass(frozen=True)
class Points:
    """Samples of all windows: inputs as stated (N, 3), indications (N, 3), and the windows' sums."""

    a: np.ndarray
    V: np.ndarray
    windows: list[Window]


def frame(theta: float, alpha: float) -> tuple[np.ndarray, np.ndarray]:
    """d and e of Eqs. (9)-(11)."""
    d = np.array([-np.sin(alpha) * np.cos(theta), -np.cos(alpha) * np.cos(theta), np.sin(theta)])
    e = np.array([-np.sin(theta) * np.sin(alpha), -np.sin(theta) * np.cos(alpha), -np.cos(theta)])
    return d, e


def sums_of(u: np.ndarray, du: np.ndarray, V: np.ndarray, segments: int) -> WindowSums:
    """Sums of equal segments of one window."""
    parts = np.array_split(np.hstack([u, du, V]), segments)
    return WindowSums(
        u.shape[1],
        np.array([float(len(p)) for p in parts]),
        np.array([p.mean(axis=0) for p in parts]),
        np.array([(p - p.mean(axis=0)).T @ (p - p.mean(axis=0)) for p in parts]),
    )


def window_of(pose: Pose, u: np.ndarray, du: np.ndarray, V: np.ndarray, segments: int) -> Window:
    """A used window."""
    return Window(0.0, len(V) / RATE_HZ, pose, sums_of(u, du, V, segments), True, "", len(V), 0)


def clamp_points(
    random: np.random.Generator,
    faults: Faults | None = None,
    *,
    alphas_deg: tuple[float, ...] = ALPHAS_DEG,
    repetitions: int = 3,
    frequency_hz: float = 3.0,
    rate_hz: float = RATE_HZ,
    cycles: int = 6,
    S: np.ndarray = S_TRUE,
    Q: np.ndarray = Q_TRUE,
) -> Points:
    """The paper's session: six whole cycles of 10 m/s2 at theta 35 deg for every alpha."""
    faults = faults or Faults()
    theta, omega = np.deg2rad(35.0), 2.0 * np.pi * frequency_hz
    t = np.arange(round(cycles * rate_hz / frequency_hz)) / rate_hz
    u, du = 10.0 * np.sin(omega * t), 10.0 * omega * np.cos(omega * t)
    inputs, outputs, windows = [], [], []
    for _ in range(repetitions):
        for alpha_deg in alphas_deg:
            alpha = np.deg2rad(alpha_deg)
            d, e = frame(theta, alpha)
            off = faults.alpha_common_rad + faults.alpha_rad.get(alpha_deg, 0.0)
            d_true, e_true = frame(theta + faults.theta_rad, alpha + off)
            a = np.outer(10.0 * np.sin(omega * (t - faults.lag_s)), d_true) + G_MPS2 * e_true
            V = a @ S.T + Q + faults.offset_mps2 * random.normal(size=3) + _noise(random, faults, len(t))
            pose = Pose(f"alpha {alpha_deg:g}", d[:, None], G_MPS2 * e, theta, float(alpha))
            windows.append(window_of(pose, u[:, None], du[:, None], V, cycles))
            inputs.append(np.outer(u, d) + G_MPS2 * e)
            outputs.append(V)
    return Points(np.concatenate(inputs), np.concatenate(outputs), windows)


def _noise(random: np.random.Generator, faults: Faults, n: int) -> np.ndarray:
    """White noise, or AR(1) with the same SD, started in its stationary state."""
    white = faults.noise_mps2 * random.normal(size=(n, 3))
    if faults.phi == 0.0:
        return white
    coloured = np.empty_like(white)
    coloured[0] = white[0]
    for k in range(1, n):
        coloured[k] = faults.phi * coloured[k - 1] + np.sqrt(1.0 - faults.phi**2) * white[k]
    return coloured
