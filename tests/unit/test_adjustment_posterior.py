"""With something known of S and Q beforehand, every parameter has its posterior value and uncertainty.

The oracle shares no code with the adjustment: the posterior of a linear Gaussian model, from normal equations over all
points.
"""

from __future__ import annotations

import numpy as np
import pytest

from calib.adjustment.adjustment import Adjustment, adjust
from calib.estimate.nuisances import Priors
from calib.excitation.windows import Points, motion_windows
from calib.geometry import along
from calib.model import Array, Window

RATE_HZ, NOISE = 500.0, 0.02
S_TRUE = np.array([[1.03, 0.01, -0.02], [0.015, 0.97, 0.005], [-0.01, 0.02, 1.01]])
Q_TRUE = np.array([0.05, -0.08, 0.12])
U_MAIN, U_TRANSVERSE, U_OFFSET = 0.05, 0.02, 0.1
KNOWN = np.append(np.eye(3).ravel(), np.zeros(3))
U_KNOWN = np.append(np.where(np.eye(3).ravel() > 0, U_MAIN, U_TRANSVERSE), np.full(3, U_OFFSET))


def recorded(directions: list[Array], gravities: list[Array | None], seed: int) -> tuple[list[Window], Array, Array]:
    """Windows of these poses, and all their inputs (n, 3) and outputs (n, 3)."""
    rng, t = np.random.default_rng(seed), np.arange(4000) / RATE_HZ
    windows: list[Window] = []
    inputs, outputs = [], []
    for k, (d, g) in enumerate(zip(directions, gravities, strict=True)):
        phase = 2 * np.pi * np.array([3.0, 5.25]) * t[:, None]
        u, du = np.sin(phase).sum(axis=1), (2 * np.pi * np.array([3.0, 5.25]) * np.cos(phase)).sum(axis=1)
        a = np.outer(u, d) + (0.0 if g is None else g)
        V = a @ S_TRUE.T + Q_TRUE + NOISE * rng.normal(size=a.shape)
        windows += motion_windows(along(d, g, f"pose {k}"), Points(100.0 * k + t, V, u[:, None], du[:, None]))
        inputs.append(a)
        outputs.append(V)
    return windows, np.concatenate(inputs), np.concatenate(outputs)


def posterior(a: Array, V: Array, known: Array, u_known: Array) -> tuple[Array, Array]:
    """(12,) values and standard uncertainties of V = S a + Q with white noise and independent priors."""
    values, u = np.zeros(12), np.zeros(12)
    design = np.column_stack([a, np.ones(len(a))])
    for i in range(3):
        own = [3 * i, 3 * i + 1, 3 * i + 2, 9 + i]
        weight = np.diag(1.0 / u_known[own] ** 2)
        covariance = np.linalg.inv(design.T @ design / NOISE**2 + weight)
        values[own] = covariance @ (design.T @ V[:, i] / NOISE**2 + weight @ known[own])
        u[own] = np.sqrt(np.diag(covariance))
    return values, u


def told(found: Adjustment) -> tuple[Array, Array]:
    c = found.calibration
    return np.append(c.sensitivity.ravel(), c.offset), c.standard_uncertainty


def priors(u_offset: float = U_OFFSET) -> Priors:
    u = np.append(U_KNOWN[:9], np.full(3, u_offset))
    return Priors(Priors.none().values, KNOWN, np.diag(u**2))


@pytest.mark.parametrize("seed", range(5))
def test_a_direction_that_was_never_excited_has_its_posterior(seed: int) -> None:
    x, z, down = np.eye(3)[0], np.eye(3)[2], np.array([0.0, 0.0, -9.81])
    windows, a, V = recorded([x, z, x], [down, down, -down], seed)  # no motion and no gravity along y
    found = adjust(windows, priors())
    values, u = told(found)
    expected, u_expected = posterior(a, V, KNOWN, U_KNOWN)
    assert found.reasons == ()
    # Type A is the scatter of 48 segments: it is known to 10 %, and tells u where the prior does not.
    np.testing.assert_allclose(u[[1, 4, 7]], u_expected[[1, 4, 7]], rtol=1e-3)
    np.testing.assert_allclose(u, u_expected, rtol=0.4)
    np.testing.assert_allclose(values, expected, rtol=0, atol=0.5 * u_expected.min())
    assert found.calibration.determined.tolist() == [k not in (1, 4, 7) for k in range(12)]


def test_without_anything_known_it_stays_unknown() -> None:
    x, z, down = np.eye(3)[0], np.eye(3)[2], np.array([0.0, 0.0, -9.81])
    windows, _, _ = recorded([x, z, x], [down, down, -down], 1)
    found = adjust(windows, Priors.none())
    values, u = told(found)
    assert np.flatnonzero(np.isnan(values)).tolist() == np.flatnonzero(np.isnan(u)).tolist() == [1, 4, 7]


def test_with_only_the_nominal_sensitivity_an_offset_that_nothing_tells_stays_unknown() -> None:
    windows, _, _ = recorded([np.eye(3)[0]], [None], 1)
    found = adjust(windows, priors(np.inf))
    values, _ = told(found)
    assert np.isnan(values[9:]).all()
    np.testing.assert_allclose(values[[1, 4, 8]], KNOWN[[1, 4, 8]], atol=1e-6)


@pytest.mark.parametrize("u_offset", [0.01, 0.1, 10.0])
def test_at_a_mount_that_never_turned_q_comes_from_the_mean_output_alone(u_offset: float) -> None:
    """The mean output tells nothing of S there, so what was known of Q must not; the agent does the same."""
    down = np.array([0.0, 0.0, -9.81])
    windows, _, _ = recorded([np.eye(3)[0], np.eye(3)[2]], [down, down], 7)
    (without, u_without), (values, u) = (told(adjust(windows, priors(q))) for q in (np.inf, u_offset))
    known = np.isfinite(without)
    np.testing.assert_allclose(values[known], without[known], rtol=0, atol=1e-12)
    np.testing.assert_allclose(u[known], u_without[known], rtol=1e-12)
    assert np.isfinite(values).all()
    assert (np.abs(values - np.append(S_TRUE.ravel(), Q_TRUE)) <= 4.0 * u).all()
