"""What S alone says: elements that no sensor has, exchanged and inverted axes, dead outputs and dead channels."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from calib.estimate.axes import axis_warnings, sensitivity_reasons
from calib.estimate.determined import determined
from calib.model import Calibration

NAN = float("nan")
SOUND = np.array([[26.1, 0.4, -0.3], [0.2, 25.7, 0.5], [-0.6, 0.1, 26.9]])


def found(S: object, u: float | np.ndarray = 0.01, told: np.ndarray | None = None) -> Calibration:
    """A calibration with this S and standard uncertainties; what is NaN is not determined."""
    values = np.append(np.ravel(np.asarray(S, dtype=float)), np.zeros(3))
    covariance = np.diag(np.append(np.broadcast_to(np.ravel(u), 9), np.full(3, 0.1)) ** 2)
    known = np.isfinite(values)
    covariance = np.where(np.outer(known, known), covariance, np.nan)
    known = known if told is None else told
    return Calibration(values[:9].reshape(3, 3), values[9:], covariance, known, np.inf, "")


def reasons(S: object, u: float | np.ndarray = 0.01, *, stated: bool = False) -> list[str]:
    return sensitivity_reasons(found(S, u), 2.0, stated=stated)


SIGNED = [
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
]


@pytest.mark.parametrize("place", SIGNED)
def test_every_signed_permutation_is_valid_and_all_but_one_are_told(place: np.ndarray) -> None:
    S = place @ SOUND
    assert reasons(S) == []
    assert bool(axis_warnings(S)) == (not np.array_equal(place, np.eye(3)))


def test_the_warning_says_which_sign_and_which_row() -> None:
    inverted = axis_warnings(np.diag([-33.1, 26.0, 26.0]))
    assert [line.split(":")[0] for line in inverted] == ["det S is negative (-2.24e+04)", "Sxx = -33.1"]
    turned = axis_warnings(np.array([[0.3, -265.0, 1.0], [264.0, 0.2, 2.0], [1.0, 2.0, 263.0]]))
    assert len(turned) == 1
    assert turned[0].startswith("the largest element of rows x and y is off the diagonal (Sxy = -265, Syx = 264)")
    assert axis_warnings(-SOUND)[0].startswith("det S is negative")
    turned_by_180 = axis_warnings(np.diag([-1.0, -1.0, 1.0]))
    assert [line.split(":")[0] for line in turned_by_180] == ["Sxx = -1, Syy = -1"]


def test_a_copied_output_is_one_and_two_are_two() -> None:
    (one,) = axis_warnings(SOUND[[0, 0, 2]])
    assert one.startswith("output y holds the samples of another output")
    (two,) = axis_warnings(SOUND[[0, 0, 0]])
    assert two.startswith("output y and z hold the samples of another output")


def test_a_column_that_is_not_known_leaves_the_others_to_be_judged() -> None:
    assert reasons([[26.0, 0.3, NAN], [0.2, 25.0, NAN], [0.1, 0.2, NAN]]) == []
    assert axis_warnings(np.array([[26.0, 0.3, NAN], [0.2, 25.0, NAN], [0.1, 0.2, NAN]])) == []
    one_column = np.array([[26.0, NAN, NAN], [0.4, NAN, NAN], [-0.3, NAN, NAN]])
    assert reasons(one_column) == axis_warnings(one_column) == []
    exchanged = np.array([[0.4, NAN, NAN], [26.0, NAN, NAN], [-0.3, NAN, NAN]])
    assert reasons(exchanged) == []
    (line,) = axis_warnings(exchanged)
    assert line.startswith("the largest element of row y is off the diagonal (Syx = 26)")


def test_a_sensor_turned_about_the_vertical_is_refused_unless_something_is_stated() -> None:
    turn = np.deg2rad(30.0)
    S = [[0.97, 0.80, NAN], [0.386, 0.62, NAN], [NAN, NAN, NAN]]
    (reason,) = reasons(S, 0.04)
    assert reason.startswith("Sxy is 82% of the largest sensitivity of row x, 0.97 (limit 20%)")
    c, s = np.cos(turn), np.sin(turn)
    assert "Sxy is 58%" in reasons(np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))[0]
    assert reasons(S, 0.04, stated=True) == []


@pytest.mark.parametrize(("angle_deg", "refused"), [(10.0, False), (12.5, True), (80.0, False), (77.0, True)])
def test_the_limit_is_a_fifth_of_the_row_from_any_permutation(angle_deg: float, refused: bool) -> None:
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    assert bool(reasons(26.0 * np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]), 1e-4)) == refused


def test_a_transverse_element_that_may_be_small_contradicts_nothing() -> None:
    S = np.eye(3) + 0.25 * np.eye(3)[[1, 0, 2]] * np.array([[1.0], [0.0], [0.0]])
    assert reasons(S, 0.05) == []  # 0.25 with U = 0.1
    assert reasons(S, 0.01) != []


def test_two_outputs_that_respond_to_one_direction_are_refused() -> None:
    assert "of row y" in reasons([[1.0, 0.01, 0.0], [0.9, 0.1, 0.0], [0.0, 0.0, 1.0]])[0]


def test_without_a_main_sensitivity_nothing_is_valid() -> None:
    (reason,) = reasons([[NAN, 0.8, NAN], [0.4, NAN, NAN], [NAN, NAN, NAN]])
    assert reason.startswith("no main sensitivity (Sxx, Syy, Szz) is determined; measure")


def test_an_uncertainty_above_the_main_sensitivity_is_refused() -> None:
    u = np.full((3, 3), 0.05)
    u[0, 1] = 508.5
    (reason,) = reasons([[1.0, -22.0, 0.0], [0.0, 1.1, 0.0], [0.0, 0.0, 0.9]], u)
    assert reason.startswith("U(Sxy) is 1.02e+03, above the largest main sensitivity, 1.1;")


def test_what_is_determined_and_no_number_is_refused() -> None:
    calibration = found(np.where(np.eye(3, dtype=bool), SOUND, NAN), told=np.ones(12, dtype=bool))
    (reason,) = sensitivity_reasons(calibration, 2.0, stated=True)
    assert reason.startswith("the estimate gives no number for Sxy, Sxz, Syx, Syz, Szx and Szy; measure")


def test_a_dead_channel_of_the_reference_is_no_dead_output() -> None:
    """Its noise is all that it has, so that the output along it seems 69 times as sensitive as the two good ones."""
    (reason,) = reasons([[1.0, 0.01, 0.3], [0.02, 0.98, 0.1], [0.3, 0.1, 69.0]])
    assert reason.startswith("Szz is 69, but outputs x and y have 1 and 0.98: the reference's channel along z is dead")


@pytest.mark.parametrize("S", [np.diag([1.0, 1e-3, 1.0]), [[1e-3, 1e-3, 0.02], [2e-3, 1e-3, 0.03], [0.0, 0.01, 1.0]]])
def test_dead_outputs_are_named(S: object) -> None:
    assert all("is dead: its largest" in reason for reason in reasons(S))
    assert reasons(S)


def test_cyclically_exchanged_axes_are_determined_as_sound_ones_are() -> None:
    S, u, free = np.append(SOUND.ravel(), np.zeros(3)), np.full(12, 1.0), np.full(12, np.inf)
    turned = np.append(SOUND[[1, 2, 0]].ravel(), np.zeros(3))
    seen = np.ones(12, dtype=bool)
    assert determined(S, u, free, seen).all()
    assert determined(turned, u, free, seen).all()


def test_a_wild_element_is_no_measure_for_others() -> None:
    """Szz is 6000 with u 4000: without it the limit is a tenth of 26.1, so that Sxy with u 500 is not known."""
    values, u = np.append(SOUND.ravel(), np.zeros(3)), np.full(12, 0.1)
    values[8], u[8], values[1], u[1] = 6000.0, 4000.0, -22.0, 500.0
    told = determined(values, u, np.full(12, np.inf), np.ones(12, dtype=bool))
    assert np.flatnonzero(~told).tolist() == [1, 8]


def test_a_sensor_of_one_axis_whose_samples_are_copied_is_valid_and_told() -> None:
    one = np.array([[7713.0, NAN, NAN]] * 3)
    assert reasons(one) == []
    (line,) = axis_warnings(one)
    assert line.startswith("output y and z hold the samples of another output")
    assert reasons([[7713.0, NAN, NAN], [7713.1, NAN, NAN], [10.0, NAN, NAN]]) != []
