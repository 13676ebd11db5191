"""What must hold for any data: units scale, axes permute, order and chunks do not matter."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.geometry import clamp
from calib.model import Pose, Window
from calib.paper.method3 import solve
from calib.windows.sums import merge, pool, window_sums

Points = list[tuple[Pose, np.ndarray, np.ndarray, np.ndarray]]


@st.composite
def recordings(draw: st.DrawFn) -> Points:
    """Three or more well spread positions, each with a random motion of random length and any S and Q."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    theta = math.radians(draw(st.floats(15, 70)))
    first, count = draw(st.floats(0, 360)), draw(st.integers(3, 6))
    S = np.eye(3) * draw(st.floats(0.5, 300.0)) @ (np.eye(3) + rng.uniform(-0.1, 0.1, (3, 3)))
    Q = rng.normal(size=3)
    points = []
    for k in range(count):
        pose = clamp(theta, math.radians(first + 360 * k / count), 9.81)
        n = draw(st.integers(20, 200))
        u, du = rng.normal(0, 4, (n, 1)), rng.normal(0, 50, (n, 1))
        V = (u @ pose.direction.T + pose.gravity_mps2) @ S.T + Q + 0.01 * rng.normal(size=(n, 3))
        points.append((pose, u, du, V))
    return points


def windows(points: Points, step: int = 50) -> list[Window]:
    out = []
    for pose, u, du, V in points:
        n = len(u)
        sums = window_sums(u, du, V, np.append(np.arange(0, n, step), n))
        out.append(Window(0.0, 1.0, pose, sums, True, "", n, 0))
    return out


def close(a: np.ndarray, b: np.ndarray, scale: float) -> None:
    # The geometries drawn have condition numbers below 200: rounding of 1e-16 grows to 1e-12 at most.
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-11 * scale)


@given(recordings(), st.floats(1e-3, 1e6))
@settings(max_examples=40, deadline=None)
def test_units_of_the_output_scale(points: Points, factor: float) -> None:
    one = solve(windows(points))
    other = solve(windows([(p, u, du, factor * V) for p, u, du, V in points]))
    size = factor * np.abs(one.sensitivity).max() * 10
    close(other.sensitivity, factor * one.sensitivity, size)
    close(other.offset, factor * one.offset, size)
    # The residual is a difference of scatters up to 1e11 times its size: 1e-16 of rounding leaves 1e-5 of it.
    np.testing.assert_allclose(other.standard_uncertainty, factor * one.standard_uncertainty, rtol=1e-4)


@given(recordings(), st.permutations(range(3)))
@settings(max_examples=40, deadline=None)
def test_axes_permute(points: Points, order: list[int]) -> None:
    one = solve(windows(points))
    other = solve(
        windows(
            [
                (Pose(p.position, p.direction[order], p.gravity_mps2[order]), u, du, V[:, order])
                for p, u, du, V in points
            ]
        )
    )
    size = np.abs(one.sensitivity).max() * 10
    close(other.sensitivity, one.sensitivity[np.ix_(order, order)], size)
    close(other.offset, one.offset[order], size)


@given(recordings(), st.randoms(use_true_random=False), st.integers(1, 60))
@settings(max_examples=40, deadline=None)
def test_order_and_chunks_do_not_matter(points: Points, random, step: int) -> None:
    one = solve(windows(points))
    shuffled = windows(points, step)
    random.shuffle(shuffled)
    other = solve(shuffled)
    size = np.abs(one.sensitivity).max() * 10
    close(other.sensitivity, one.sensitivity, size)
    close(other.offset, one.offset, size)


@given(recordings(), st.randoms(use_true_random=False))
@settings(max_examples=40, deadline=None)
def test_merging_is_the_same_in_any_order_and_grouping(points: Points, random) -> None:
    parts = [w.sums for w in windows(points, 17)]
    whole = pool(merge(parts))
    random.shuffle(parts)
    grouped = pool(merge([pool(merge(parts[:2])), pool(merge(parts[2:]))]))
    np.testing.assert_allclose(grouped.count, whole.count)
    scale = np.sqrt(np.diagonal(whole.scatter, axis1=1, axis2=2)[0])
    np.testing.assert_allclose(grouped.mean, whole.mean, rtol=0, atol=1e-12 * scale.max())
    np.testing.assert_allclose(
        grouped.scatter / np.outer(scale, scale), whole.scatter / np.outer(scale, scale), atol=1e-12
    )
