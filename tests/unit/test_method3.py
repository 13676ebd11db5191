"""Plain Method 3 from sums against numpy.linalg.lstsq over all points, its covariance, and its rank."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from calib.geometry import along, at_rest, beside, clamp, on_axis
from calib.model import Pose, Window
from calib.paper.method3 import fit, solve
from calib.windows.sums import window_sums

S_TRUE = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
Q_TRUE = np.array([0.36, -0.06, 0.165])
G = 9.81


def motion(n: int, m: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(n)[:, None] / 1000.0
    omega, phase = 2 * math.pi * rng.uniform(2, 7, m), rng.uniform(0, 2 * math.pi, m)
    return 5 * np.sin(omega * t + phase), 5 * omega * np.cos(omega * t + phase)


def make(
    pose: Pose, rng: np.random.Generator, n: int = 2000, noise: float = 0.02
) -> tuple[Window, np.ndarray, np.ndarray]:
    """A window with its points: input accelerations (n, 3) and indications (n, 3)."""
    m = pose.direction.shape[1]
    u, du = motion(n, m, rng)
    a = u @ pose.direction.T + np.nan_to_num(pose.gravity_mps2)
    V = a @ S_TRUE.T + Q_TRUE + noise * rng.normal(size=(n, 3))
    sums = window_sums(u, du, V, np.append(np.arange(0, n, 300), n))
    return Window(0.0, n / 1000, pose, sums, True, "", n, 0), a, V


def on_clamp(*alphas: float, theta: float = 35.0) -> list[Pose]:
    return [clamp(math.radians(theta), math.radians(a), G) for a in alphas]


@pytest.mark.parametrize(
    "poses",
    [
        on_clamp(0, 30, 120, 210),
        on_clamp(0, 5, 10),
        on_clamp(0, 120, 240),
        [beside(np.eye(3), [0.0, 0.0, G])],
        [at_rest(G * s * np.eye(3)[i]) for i in range(3) for s in (1, -1)],
        [*on_clamp(30, 200), at_rest([0.0, 0.0, -G]), along([0.6, 0.0, 0.8], [G, 0.0, 0.0])],
    ],
)
def test_sums_give_the_least_squares_solution_over_all_points(poses: list[Pose]) -> None:
    rng = np.random.default_rng(3)
    windows, a, V = zip(*(make(p, rng, noise=1e-3) for p in poses), strict=True)
    points = np.hstack([np.concatenate(a), np.ones((sum(map(len, a)), 1))])
    expected, *_ = np.linalg.lstsq(points, np.concatenate(V), rcond=None)
    result = fit(windows)
    largest = np.abs(expected).max()  # 1e-10 of the largest parameter is what the issue asks; 0/5/10 deg reaches 4e-13
    np.testing.assert_allclose(result.calibration.sensitivity, expected[:3].T, rtol=0, atol=1e-10 * largest)
    np.testing.assert_allclose(result.calibration.offset, expected[3], rtol=0, atol=1e-10 * largest)
    rest = np.concatenate(V) - points @ expected
    np.testing.assert_allclose(
        result.residual_sd, np.sqrt((rest**2).sum(axis=0) / (len(rest) - 4)), rtol=1e-7
    )  # V / noise squared is 1e8, of 1e-16
    assert (result.rank, result.points) == (4, len(points))
    assert result.calibration.degrees_of_freedom == len(points) - 4


def test_covariance_is_that_of_the_regression() -> None:
    rng = np.random.default_rng(4)
    windows, a, V = zip(*(make(p, rng) for p in on_clamp(0, 120, 240)), strict=True)
    points = np.hstack([np.concatenate(a), np.ones((6000, 1))])
    solution, *_ = np.linalg.lstsq(points, np.concatenate(V), rcond=None)
    rest = np.concatenate(V) - points @ solution
    cov = np.kron(rest.T @ rest / 5996, np.linalg.inv(points.T @ points))  # order: output, then (x, y, z, 1)
    order = [4 * i + j for i in range(3) for j in range(3)] + [4 * i + 3 for i in range(3)]
    np.testing.assert_allclose(solve(windows).covariance, cov[np.ix_(order, order)], rtol=1e-8, atol=1e-16)


@pytest.mark.slow
def test_white_noise_covers() -> None:
    # 400 recordings, 12 parameters: z-scores have unit variance; chi-squared over 4800 (correlated within a recording,
    # at worst 400 * 3 independent): 99.9 % band of 1200 degrees of freedom is 0.871..1.139.
    rng = np.random.default_rng(5)
    z = []
    for _ in range(400):
        c = solve([make(p, rng, n=500, noise=0.1)[0] for p in on_clamp(0, 120, 240)])
        z.append(
            (np.append(c.sensitivity.ravel(), c.offset) - np.append(S_TRUE.ravel(), Q_TRUE)) / c.standard_uncertainty
        )
    assert 0.871 < np.mean(np.square(z)) < 1.139


@pytest.mark.parametrize(
    ("poses", "rank"),
    [
        (on_clamp(30), 2),
        (on_clamp(0, 90), 3),
        (on_clamp(30, 210), 3),
        (on_clamp(0, 180), 3),
        (on_clamp(0, 5, 10), 4),
        ([at_rest([0.0, 0.0, G])], 1),
    ],
)
def test_rank(poses: list[Pose], rank: int) -> None:
    rng = np.random.default_rng(6)
    result = fit([make(p, rng)[0] for p in poses])
    assert result.rank == rank
    assert math.isfinite(result.condition) == (rank == 4)


def test_condition_is_that_of_the_known_geometries() -> None:
    rng = np.random.default_rng(7)
    small, large = (fit([make(p, rng)[0] for p in on_clamp(*al)]).condition for al in ((0, 120, 240), (0, 5, 10)))
    assert small < 20
    assert 1e3 < large < 2e4


@pytest.mark.parametrize(
    ("pose", "determined"),
    [
        (lambda: on_axis("x", [0.0, 0.0, 0.0]), [(0, 0), (1, 0), (2, 0), "Q"]),
        (lambda: on_axis("z"), [(0, 2), (1, 2), (2, 2)]),
        (lambda: beside(np.eye(3)), [(i, j) for i in range(3) for j in range(3)]),
    ],
)
def test_only_what_was_excited_is_given(pose: Callable[[], Pose], determined: list) -> None:
    window, _, _ = make(pose(), np.random.default_rng(8))
    c = solve([window])
    seen = np.isfinite(c.sensitivity)
    assert sorted(zip(*np.nonzero(seen), strict=True)) == sorted(p for p in determined if p != "Q")
    assert np.isfinite(c.offset).all() == ("Q" in determined)
    np.testing.assert_allclose(c.sensitivity[seen], S_TRUE[seen], atol=2e-3)  # 10 u
    np.testing.assert_array_equal(c.determined, np.append(seen.ravel(), np.isfinite(c.offset)))
    assert np.isnan(c.covariance[~c.determined]).all()
    assert np.isfinite(c.covariance[np.ix_(c.determined, c.determined)]).all()


def test_unknown_gravity_does_not_touch_what_the_motion_says() -> None:
    rng = np.random.default_rng(9)
    known, *_ = make(along([0.6, 0.0, 0.8], [G, 0.0, 0.0]), rng)
    unknown = Window(0, 2, along([0.6, 0.0, 0.8]), known.sums, True, "", 2000, 0)
    others = [make(p, rng)[0] for p in on_clamp(0, 120, 240)]
    c = solve([*others, unknown])
    assert c.determined.all()
    assert c.degrees_of_freedom == 8000 - 1 - 4


def test_a_parameter_that_noise_swamps_is_not_given() -> None:
    rng = np.random.default_rng(10)
    c = solve([make(p, rng, n=300, noise=100.0)[0] for p in on_clamp(0, 120, 240)])
    assert not c.determined.any()
    assert np.isnan(c.sensitivity).all()


def test_without_points_to_spare_nothing_is_given() -> None:
    rng = np.random.default_rng(11)
    four = [
        make(p, rng, n=1)[0] for p in (at_rest([G, 0, 0]), at_rest([0, G, 0]), at_rest([0, 0, G]), at_rest([0, 0, -G]))
    ]
    assert not solve(four).determined.any()


def test_unused_windows_are_not_used() -> None:
    rng = np.random.default_rng(12)
    good = [make(p, rng)[0] for p in on_clamp(0, 120, 240)]
    bad, *_ = make(clamp(0.1, 0.2, 3.0), rng)
    refused = Window(0, 2, bad.pose, bad.sums, False, "clipped", 2000, 0)
    np.testing.assert_array_equal(solve([*good, refused]).sensitivity, solve(good).sensitivity)
    with pytest.raises(ValueError, match="no window is used"):
        solve([refused])


def test_points_without_noise_have_an_uncertainty_all_the_same() -> None:
    rng = np.random.default_rng(5)
    windows = [make(pose, rng, noise=0.0)[0] for pose in on_clamp(0, 30, 120, 210)]
    assert np.all(solve(windows).standard_uncertainty < 1e-9)
