"""Q that drifts while a sensor and its reference are turned together: what a link tells of it, against known truth."""

from __future__ import annotations

import numpy as np
import pytest

from calib.estimate.nuisances import Priors
from calib.model import Pose, Window
from calib.site_adjustment.link import Link, link
from tests.clamp_windows import sums_of

RESTS, SAMPLES, SEGMENTS = 25, 200, 10
SCATTER_MPS2, DRIFT_MPS2, NOISE_MPS2 = 0.002, 0.015, 0.005
OF_REFERENCE = np.array([np.full(3, 1e-3), np.full(3, 1e-2)])  # rms of its noise in u and du/dt
BESIDE = Pose("beside", np.eye(3), np.zeros(3))
S = np.array([[1.02, 0.01, 0.0], [0.0, 0.97, -0.02], [0.01, 0.0, 1.01]])
PRIORS = Priors({**Priors.none().values, "offset_mps2": SCATTER_MPS2})


def met(seed: int, drift_mps2: float, every_s: float = 20.0) -> tuple[Link, np.ndarray]:
    """A link of rests of 20 s each in drawn positions, and the true Q (W, 3) of each; it is 0 in the middle of all."""
    random = np.random.default_rng(seed)
    steps = drift_mps2 / np.sqrt(RESTS - 1) * random.normal(size=(RESTS, 3))
    walk = np.cumsum(steps, axis=0)
    walk -= walk[RESTS // 2]
    windows = []
    for k in range(RESTS):
        down = random.normal(size=3)
        a = np.tile(9.81 * down / np.linalg.norm(down), (SAMPLES, 1))
        V = a @ S.T + walk[k] + SCATTER_MPS2 * random.normal(size=3) + NOISE_MPS2 * random.normal(size=a.shape)
        u, du = OF_REFERENCE[:, None] * random.normal(size=(2, *a.shape))
        sums = sums_of(a + u, du, V, SEGMENTS)
        at_s = every_s * k
        windows.append(
            Window(at_s, at_s + 20.0, BESIDE, sums, True, "", SAMPLES, 0, kind="rest", reference_noise=OF_REFERENCE)
        )
    return link("s", "r", windows, PRIORS), walk


def u_of(found: Link) -> np.ndarray:
    """(12,) standard uncertainties of S and Q by the link alone."""
    return np.sqrt(np.diag(np.linalg.inv(found.rows.T @ found.rows)))


@pytest.mark.slow
def test_q_of_a_drifting_sensor_is_that_in_the_middle_and_its_u_covers_both_ends() -> None:
    """16 meetings. A constant Q would be off by the mean of the walk from the middle, of which the SD is known."""
    away, ends, u = [], [], []
    for seed in range(16):
        found, walk = met(seed, DRIFT_MPS2)
        away.append(found.mean[9:])
        u.append(u_of(found)[9:])
        ends += [np.abs(found.mean[9:] - walk[k]) <= 2.0 * u[-1] for k in (0, RESTS - 1)]
    n = RESTS // 2  # independent steps to each side
    constant = DRIFT_MPS2 / np.sqrt(RESTS - 1) * np.sqrt(2.0 * np.sum(np.arange(1, n + 1) ** 2)) / RESTS
    assert np.sqrt(np.mean(np.square(away))) < 0.6 * constant
    assert np.mean(ends) > 0.93
    assert np.median(u) == pytest.approx(DRIFT_MPS2 / np.sqrt(2.0), rel=0.15)  # from the middle to one end


@pytest.mark.thorough
def test_scatter_alone_shows_no_drift() -> None:
    """One meeting in a hundred may show one: of 150 these are 1.5, and more than 5 have a probability of 0.4 %."""
    u = np.array([np.sqrt(np.mean(u_of(met(seed, 0.0)[0])[9:] ** 2)) for seed in range(1000, 1150)])
    single = np.hypot(SCATTER_MPS2, NOISE_MPS2 / np.sqrt(SAMPLES)) / np.sqrt(RESTS)
    assert np.sum(u > 1.5 * np.median(u)) <= 5
    # Four unknowns of each output are found from 25 rests: their directions are not quite balanced.
    assert single < np.median(u) < 1.3 * single


def test_without_a_time_between_windows_there_is_no_drift() -> None:
    with_time, _ = met(1, DRIFT_MPS2)
    at_once, _ = met(1, DRIFT_MPS2, every_s=0.0)
    assert u_of(at_once)[9:].max() < 0.3 * u_of(with_time)[9:].min()
