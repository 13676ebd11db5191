"""Poses against Eqs. (5)-(7) and (9)-(11) written out by hand, and the refusal of what is not a pose."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.geometry import along, at_rest, beside, clamp, on_axis

CLAMP = [(35.0, 30.0), (35.0, 210.0), (20.0, 0.0), (0.0, 45.0), (90.0, 135.0)]


@pytest.mark.parametrize(("theta", "alpha"), CLAMP)
@pytest.mark.parametrize("sign", [1, -1])
def test_clamp_is_equations_9_to_11(theta: float, alpha: float, sign: int) -> None:
    t, al, g, a_ref = math.radians(theta), math.radians(alpha), 9.81, 3.7
    pose = clamp(t, al, g, static_sign=sign)
    a = pose.direction[:, 0] * a_ref + pose.gravity_mps2
    expected = [
        -a_ref * math.sin(al) * math.cos(t) - sign * g * math.sin(t) * math.sin(al),
        -a_ref * math.cos(al) * math.cos(t) - sign * g * math.sin(t) * math.cos(al),
        a_ref * math.sin(t) - sign * g * math.cos(t),
    ]
    np.testing.assert_allclose(a, expected, rtol=0, atol=1e-14)
    assert (pose.theta_rad, pose.alpha_rad) == (t, al)


def test_clamp_without_gravity_is_equations_5_to_7() -> None:
    pose = clamp(math.radians(35), math.radians(45), gravity_mps2=0.0)
    np.testing.assert_allclose(pose.direction[:, 0], [-0.579228, -0.579228, 0.573576], atol=1e-6)
    np.testing.assert_array_equal(pose.gravity_mps2, 0.0)


def test_same_angles_are_the_same_position() -> None:
    names = {clamp(math.radians(35), math.radians(a)).position for a in (0.0, 30.0, 120.0, 210.0, 0.0)}
    assert len(names) == 4


def test_along_and_axis_and_rest() -> None:
    pose = along([0.6, 0.0, 0.8], [0.0, 0.0, 9.81])
    np.testing.assert_allclose(pose.direction, [[0.6], [0.0], [0.8]], atol=1e-15)
    np.testing.assert_array_equal(pose.gravity_mps2, [0.0, 0.0, 9.81])
    np.testing.assert_array_equal(on_axis("y").direction, [[0.0], [1.0], [0.0]])
    assert np.isnan(on_axis("y").gravity_mps2).all()
    rest = at_rest([0.0, -9.81, 0.0])
    assert rest.direction.shape == (3, 0)
    np.testing.assert_array_equal(rest.gravity_mps2, [0.0, -9.81, 0.0])


def test_direction_with_few_decimals_is_made_a_unit_vector() -> None:
    pose = along([0.577, 0.577, 0.577])
    assert math.isclose(float(np.linalg.norm(pose.direction)), 1.0, rel_tol=1e-15)


def test_rotation_with_few_decimals_is_made_a_rotation() -> None:
    pose = beside([[0.866, -0.5, 0], [0.5, 0.866, 0], [0, 0, 1]], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(pose.direction @ pose.direction.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(pose.direction[0, 0], math.sqrt(3) / 2, atol=1e-4)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: along([1.0, 1.0, 0.0]), r"unit vector, \(1, 1, 0\) has length 1\.41421"),
        (lambda: along([1.0, math.nan, 0.0]), r"direction must be finite, is \(1, nan, 0\)"),
        (lambda: along([1.0, 0.0]), "3 components, has 2"),
        (lambda: along([1.0, 0.0, 0.0], [0.0, math.inf, 0.0]), "gravity must be finite"),
        (lambda: on_axis("q"), "x, y or z, is 'q'"),
        (lambda: at_rest([math.nan, 0.0, 0.0]), "gravity must be finite"),
        (lambda: clamp(math.nan, 0.0), "must be finite"),
        (lambda: clamp(0.6, 0.0, static_sign=0), r"\+1 or -1, is 0"),
        (lambda: beside(np.eye(2)), "3 x 3, is 2 x 2"),
        (lambda: beside(-np.eye(3)), "determinant is -1"),
        (lambda: beside(1.01 * np.eye(3)), "must be a rotation matrix"),
        (lambda: beside(np.full((3, 3), math.nan)), "rotation must be finite"),
    ],
)
def test_what_is_not_a_pose_is_refused_with_its_value(make, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        make()
