"""What S and Q owe to the errors of their reference: derivatives, corrections, and differences of two children."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.adjustment.adjustment import Adjustment, adjust
from calib.estimate.nuisances import Priors
from calib.estimate.reference_share import shared_covariance
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Array
from calib.state.state import State
from calib.windows.record import Record
from tests.building_windows import building_window
from tests.clamp_windows import Faults, clamp_points
from tests.unit.test_exchange import HOUR, MEAN, STATED, STEADY, U

REFERENCES, SEED = 60, 15
U_REFERENCE = STATED["reference"]


def child(
    random: np.random.Generator,
    error: float | np.ndarray,
    *,
    u: float = U_REFERENCE,
    windows: int = 1,
    drift: float = 0.0,
) -> State:
    """A sensor after some windows of an hour beside reference A, whose indications are (1 + `error`) of the motion."""
    priors = Priors(dict(Priors.none().values) | STATED | {"reference": u, "reference_drift": drift})
    walks = Wander(STEADY | {"reference_drift": drift / np.sqrt(365.25)})
    found = State(MEAN, U, priors, walks, TemperatureModel(), fixed=False)
    found.meet("A")
    found.date_certificate(-365.25)
    for k in range(windows):
        window = building_window(random, level_mps2=(0.3, 0.3, 0.3), reference_error=error)
        found.update(Record.of(window, k * HOUR, 0.0, np.nan, "A"))
    return found


def parameters(found: State) -> np.ndarray:
    result = found.result()
    return np.append(result.sensitivity.ravel(), result.offset)


@pytest.mark.parametrize(("step", "u"), [(0.02, U_REFERENCE), (-0.004, 1e-3), (0.0, 0.01), (0.01, 1e-9)])
def test_a_corrected_state_is_that_of_the_same_data_with_the_other_certificate(step: float, u: float) -> None:
    found = child(np.random.default_rng(1), 0.0, windows=3, drift=2e-3)
    expected = child(np.random.default_rng(1), 1.0 / (1.0 + step) - 1.0, u=u, windows=3, drift=2e-3)
    (share,) = found.shares()
    is_constant = np.array([not name.startswith("reference_drift") for name in share.unknowns])
    assert (share.reference, is_constant.sum(), (~is_constant).sum()) == ("A", 3, 3)
    stated, u_stated = (
        np.where(is_constant, step, share.stated),
        np.where(is_constant, u * (1.0 + step), share.u_stated),
    )
    values, covariance = share.corrected(parameters(found), found.result().covariance, stated, u_stated)
    # The problem is not linear, so that products of two small numbers are left: 2 % of u at a step of seven u.
    u_expected = expected.result().standard_uncertainty
    np.testing.assert_array_less(np.abs(values - parameters(expected)), 0.02 * u_expected)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), u_expected, rtol=0.03)


@pytest.mark.slow
def test_the_difference_of_two_children_of_one_reference_has_the_u_that_is_stated() -> None:
    random = np.random.default_rng(SEED)
    parts: dict[str, list[Array]] = {"shared": [], "alone": []}
    for _ in range(REFERENCES):
        error = random.normal(0.0, U_REFERENCE, 3)
        one, other = (child(random, error) for _ in range(2))
        cross = np.diag(shared_covariance(one.shares(), other.shares()))[[0, 4, 8]]
        off = (parameters(one) - parameters(other))[[0, 4, 8]]
        both = (one.result().standard_uncertainty ** 2 + other.result().standard_uncertainty ** 2)[[0, 4, 8]]
        parts["shared"] += (off / np.sqrt(both - 2.0 * cross)).tolist()
        parts["alone"] += (off / np.sqrt(both)).tolist()
    # Mean squared z of 180 draws: its SD is 0.105, and 3.3 of them are the 99.9 % band.
    assert 0.65 < np.mean(np.square(parts["shared"])) < 1.35
    assert np.mean(np.square(parts["alone"])) < 0.1


def adjusted(factor: float, u: float) -> Adjustment:
    """A clamp with a reference that indicates `factor` of the motion, with `u` stated of its sensitivity."""
    found = []
    for window in clamp_points(np.random.default_rng(4), Faults(noise_mps2=0.01)).windows:
        scale = np.append(np.full(2 * window.sums.reference_channels, factor), np.ones(3))
        sums = replace(window.sums, mean=window.sums.mean * scale, scatter=window.sums.scatter * np.outer(scale, scale))
        found.append(replace(window, sums=sums))
    return adjust(found, Priors(reference=u))


@pytest.mark.parametrize(("step", "u"), [(0.01, 1e-3), (0.0, 4e-3), (-0.003, 5e-4)])
def test_a_corrected_adjustment_is_that_of_the_same_files_with_the_other_certificate(step: float, u: float) -> None:
    found, expected = adjusted(1.0, 1e-3), adjusted(1.0 / (1.0 + step), u)
    assert found.share is not None
    assert found.share.unknowns == ("reference",)
    stated, u_stated = np.array([step]), np.array([u * (1.0 + step)])
    before = np.append(found.calibration.sensitivity.ravel(), found.calibration.offset)
    values, covariance = found.share.corrected(before, found.calibration.covariance, stated, u_stated)
    after = np.append(expected.calibration.sensitivity.ravel(), expected.calibration.offset)
    u_expected = expected.calibration.standard_uncertainty
    known = np.arange(12) < 11  # Qz is not determined
    np.testing.assert_array_less(np.abs(values - after)[known], 0.03 * u_expected[known])  # the largest step is ten u
    # The scatter between windows is estimated anew from files.
    np.testing.assert_allclose(np.sqrt(np.diag(covariance))[known], u_expected[known], rtol=0.04)


def test_without_a_stated_error_of_the_reference_there_is_no_share() -> None:
    assert adjusted(1.0, 0.0).share is None
