"""What must hold of the adjustment for any session on the clamp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.adjustment.adjustment import adjust
from calib.estimate.nuisances import Priors
from calib.model import Window
from tests.clamp_windows import Faults, clamp_points

SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=6, deadline=None)
ORDINARY = Faults(theta_rad=0.003, offset_mps2=0.05, lag_s=0.001)
# The search ends at a thousandth of a standard uncertainty, from where the next step is smaller still: what changes
# nothing in exact arithmetic may move the result by about a millionth of u, and differently so.
PART_OF_U = 1e-3


def _windows(seed: int, **options: object) -> list[Window]:
    return clamp_points(np.random.default_rng(seed), ORDINARY, rate_hz=60.0, **options).windows  # type: ignore[arg-type]


def _same(one: np.ndarray, other: np.ndarray, u: np.ndarray) -> None:
    assert np.all(np.abs(one - other) <= PART_OF_U * u)


@FEW
@given(seed=SEEDS, alphas=st.lists(st.floats(0.0, 360.0), min_size=4, max_size=6, unique_by=lambda a: round(a / 15.0)))
def test_priors_at_zero_give_plain_method_3(seed, alphas):
    points = clamp_points(np.random.default_rng(seed), ORDINARY, rate_hz=60.0, alphas_deg=tuple(alphas))
    found = adjust(points.windows, Priors.none()).mean[:12]
    solution = np.linalg.lstsq(np.column_stack([points.a, np.ones(len(points.a))]), points.V, rcond=None)[0]
    plain = np.concatenate([solution[:3].T.ravel(), solution[3]])
    np.testing.assert_allclose(found, plain, rtol=0, atol=1e-9 * np.abs(plain).max())


@pytest.mark.slow
@FEW
@given(seed=SEEDS, unit=st.floats(1e-3, 1e5))
def test_the_output_s_unit_scales_s_q_and_u(seed, unit):
    windows = _windows(seed)
    scaled = [replace(w, sums=replace(w.sums, mean=_times(w.sums.mean, unit), scatter=_scatter(w.sums.scatter, unit)))
              for w in windows]  # fmt: skip
    one, other = adjust(windows), adjust(scaled)
    u = np.sqrt(np.diag(one.covariance)[:12])
    _same(one.mean[:12], other.mean[:12] / unit, u)
    np.testing.assert_allclose(np.sqrt(np.diag(other.covariance)[:12]) / unit, u, rtol=1e-6)
    assert one.reasons == other.reasons == ()


@pytest.mark.slow
@FEW
@given(seed=SEEDS, order=st.permutations(range(3)))
def test_output_axes_permute(seed, order):
    windows = _windows(seed)
    swap = [0, 1, *(2 + i for i in order)]
    permuted = [
        replace(w, sums=replace(w.sums, mean=w.sums.mean[:, swap], scatter=w.sums.scatter[:, swap][:, :, swap]))
        for w in windows
    ]
    one, other = adjust(windows), adjust(permuted)
    rows = [3 * i + j for i in order for j in range(3)] + [9 + i for i in order]
    u = np.sqrt(np.diag(one.covariance)[:12])
    _same(one.mean[rows], other.mean[:12], u[rows])
    np.testing.assert_allclose(np.sqrt(np.diag(other.covariance)[:12]), u[rows], rtol=1e-6)


@pytest.mark.slow
@FEW
@given(seed=SEEDS, random=st.randoms(use_true_random=False))
def test_the_order_of_windows_does_not_matter(seed, random):
    windows = _windows(seed)
    shuffled = list(windows)
    random.shuffle(shuffled)
    one, other = adjust(windows), adjust(shuffled)
    u = np.sqrt(np.diag(one.covariance)[:12])
    _same(one.mean[:12], other.mean[:12], u)
    np.testing.assert_allclose(np.sqrt(np.diag(other.covariance)[:12]), u, rtol=1e-6)


@pytest.mark.slow
@FEW
@given(seed=SEEDS)
def test_more_of_the_same_data_never_widens_type_a(seed):
    """The same windows twice: type A shrinks; what the angles cost, which more of it cannot mend, stays."""
    windows, free_lag = _windows(seed), replace(Priors.none(), lag_s=0.02)
    once, twice = adjust(windows, free_lag), adjust(windows * 2, free_lag)
    # By sqrt(2) where the correlation of segments is judged alike; twice the data may judge it more sharply.
    assert np.all(twice.contributions["type A"] < 0.9 * once.contributions["type A"])
    once, twice = adjust(windows), adjust(windows * 2)
    assert np.all(np.diag(twice.covariance)[:12] <= np.diag(once.covariance)[:12])
    largest = once.contributions["alpha by position"].max()
    assert twice.contributions["alpha by position"].max() > 0.9 * largest


@pytest.mark.slow
@FEW
@given(seed=SEEDS, factor=st.floats(1.5, 10.0))
def test_wider_priors_never_narrow_the_result(seed, factor):
    windows = _windows(seed)
    narrow, wide = Priors(), replace(Priors(), angle_rad=factor * Priors().angle_rad)
    before, after = (np.sqrt(np.diag(adjust(windows, p).covariance)[:12]) for p in (narrow, wide))
    # The weights are white ones and the scatter is estimated anew: a few per cent either way are the estimate's own.
    assert np.all(after >= 0.95 * before)


def _times(mean: np.ndarray, unit: float) -> np.ndarray:
    return mean * np.array([1.0, 1.0, unit, unit, unit])


def _scatter(scatter: np.ndarray, unit: float) -> np.ndarray:
    one = np.array([1.0, 1.0, unit, unit, unit])
    return scatter * np.outer(one, one)
