"""An AC-coupled reference: its corner is no lag, is found where the integral stands beside it, and is undone."""

from __future__ import annotations

import numpy as np
import pytest

from calib.adjustment.adjustment import Adjustment, adjust
from calib.adjustment.slope_scatter import SlopeScatter
from calib.estimate.nuisances import Applied, Priors
from calib.model import Pose, Window
from calib.signal.corner import integral, with_integral, without_corner
from calib.windows.condense import condense
from calib.windows.record import Record
from tests.clamp_windows import ALPHAS_DEG, G_MPS2, S_TRUE, TRUTH, frame, window_of

RATE_HZ, SECONDS, CORNER_HZ = 200.0, 20.0, 0.16
LINES_HZ = np.array([0.5, 1.3, 2.9, 6.1])
PRIORS = Priors.none().with_values({"lag_s": 0.02, "reference_corner_hz": 0.05, "offset_mps2": 0.05})


def _motion(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """True acceleration and what a first-order high-pass filter leaves of it, both (n, 1), in the steady state."""
    amplitude = 4.0 * np.exp(1j * np.arange(len(LINES_HZ)))
    waves = np.exp(2j * np.pi * np.outer(t, LINES_HZ))
    passed = 1j * LINES_HZ / (CORNER_HZ + 1j * LINES_HZ)
    return (waves @ amplitude).real[:, None], (waves @ (amplitude * passed)).real[:, None]


def _derivative(x: np.ndarray) -> np.ndarray:
    return np.gradient(x, 1.0 / RATE_HZ, axis=0)


def test_the_filter_is_undone():
    t = np.arange(round(60.0 * RATE_HZ)) / RATE_HZ
    true, filtered = _motion(t)
    back = without_corner(filtered, RATE_HZ, CORNER_HZ)
    assert np.sqrt(np.mean((filtered - true) ** 2)) > 0.5
    # Steps of 5 ms: the trapezoidal rule leaves (omega T)^2 / 12 = 0.3 % of a share of 2.6 % at 6.1 Hz; the trend of
    # 30 cycles at 0.5 Hz leaves some mm/s2.
    assert np.sqrt(np.mean((back - true) ** 2)) < 0.03


def test_an_instrument_s_zero_does_not_run_away():
    t = np.arange(round(60.0 * RATE_HZ)) / RATE_HZ
    _, filtered = _motion(t)
    assert np.abs(integral(filtered + 0.3, RATE_HZ) - integral(filtered, RATE_HZ)).max() < 1e-9 * RATE_HZ * 60.0


def _session(seed: int, applied: Applied) -> Adjustment:
    random = np.random.default_rng(seed)
    t = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    true, filtered = _motion(t)
    u = without_corner(filtered, RATE_HZ, applied.reference_corner_hz)
    channels = np.hstack([u, integral(filtered, RATE_HZ)])
    theta, windows = np.deg2rad(35.0), []
    for alpha_deg in ALPHAS_DEG:
        d, e = frame(theta, np.deg2rad(alpha_deg))
        V = (true * d + G_MPS2 * e) @ S_TRUE.T + TRUTH[9:] + 0.02 * random.normal(size=(len(t), 3))
        pose = with_integral(Pose(f"{alpha_deg:g}", d[:, None], G_MPS2 * e, theta, float(np.deg2rad(alpha_deg))))
        inner = slice(200, -200)  # the derivative's ends
        windows.append(window_of(pose, channels[inner], _derivative(channels)[inner], V[inner], 18))
    return adjust(windows, PRIORS, applied)


def _corner(found: Adjustment) -> float:
    return next(n.value for n in found.nuisances if n.name == "reference_corner")


@pytest.mark.parametrize("taken_hz", [0.0, 0.10, 0.16])
def test_the_corner_is_found_in_total_whatever_was_taken_out(taken_hz):
    found = _session(60, Applied(reference_corner_hz=taken_hz))
    assert found.reasons == ()
    # To 2 %: the trend of ten cycles at 0.5 Hz and a derivative by differences are as good as that.
    assert _corner(found) == pytest.approx(CORNER_HZ, abs=0.003)
    assert abs(next(n.value for n in found.nuisances if n.name == "lag")) < 2e-4
    np.testing.assert_allclose(found.mean[:9], TRUTH[:9], rtol=0, atol=2e-3)


def _late(lag_s: float) -> Window:
    """A sensor that is late beside a reference with its integrals, whose derivatives are the channels themselves."""
    t, random = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ, np.random.default_rng(1)
    omega = 2.0 * np.pi * np.linspace(0.5, 6.1, 12)
    waves, amplitude = np.exp(1j * np.outer(t, omega)), np.exp(2j * np.pi * random.random((12, 3)))
    u, du, total = ((waves @ (amplitude * by[:, None])).real for by in (np.ones(12), 1j * omega, -1j / omega))
    felt = (waves @ (amplitude * np.exp(-1j * omega * lag_s)[:, None])).real
    V = felt @ S_TRUE.T + 0.02 * random.normal(size=u.shape)
    pose = with_integral(Pose("beside", np.eye(3), np.zeros(3)))
    return window_of(pose, np.hstack([u, total]), np.hstack([du, u]), V, 18)


def test_a_lag_moves_the_slopes_beside_integrals_as_its_scatter_counts_it():
    lag_s = 1e-5  # its second order is 4e-4 of the first one
    (before, after), condensed = (Record.of(_late(s), 0.0) for s in (0.0, lag_s)), condense([_late(0.0)])
    found = before.loadings[0] * lag_s * np.tile(before.noise, 12)
    moved = (after.slopes - before.slopes).ravel()
    np.testing.assert_allclose(found, moved, rtol=0, atol=2e-3 * np.abs(moved).max())
    by_files = SlopeScatter.of(condensed).lag[0] * lag_s * np.tile(condensed.type_a.noise[0], 12)
    np.testing.assert_allclose(by_files, found, rtol=0, atol=2e-3 * np.abs(moved).max())
