"""Window sums against numpy on all points: values, conditioning, chunks, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from calib.windows.sums import BLOCK_SAMPLES, factor, merge, pool, window_sums


def data(n: int, m: int, seed: int = 1, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u, du = rng.normal(size=(n, m)), rng.normal(size=(n, m))
    V = offset + u @ rng.normal(size=(m, 3)) + 0.3 * du @ rng.normal(size=(m, 3)) + 0.1 * rng.normal(size=(n, 3))
    return u, du, V


@pytest.mark.parametrize("m", [0, 1, 3])
@pytest.mark.parametrize("n", [7, BLOCK_SAMPLES, 2 * BLOCK_SAMPLES + 5])
def test_sums_are_those_of_all_points(n: int, m: int) -> None:
    u, du, V = data(n, m)
    z = np.hstack([u, du, V])
    sums = window_sums(u, du, V, [0, 3, n])
    for k, part in enumerate((z[:3], z[3:])):
        assert sums.count[k] == len(part)
        np.testing.assert_allclose(sums.mean[k], part.mean(axis=0), rtol=1e-13, atol=1e-14)
        centred = part - part.mean(axis=0)
        np.testing.assert_allclose(sums.scatter[k], centred.T @ centred, rtol=1e-12, atol=1e-11)


def test_a_large_offset_costs_no_digits() -> None:
    # Offset over noise 1e9: uncentred sums of squares would keep no digit at all; what is left is the input's rounding.
    u, du, V = data(20_000, 1)
    near, far = (pool(window_sums(u, du, V + shift, [0, 5000, 20_000])) for shift in (0.0, 1e8))
    np.testing.assert_allclose(far.scatter, near.scatter, rtol=1e-6)


def test_pooling_segments_and_chunks_is_the_whole() -> None:
    u, du, V = data(9000, 3, offset=50.0)
    whole = window_sums(u, du, V, [0, 9000])
    chunks = [window_sums(u[a:b], du[a:b], V[a:b], [0, b - a]) for a, b in ((0, 1), (1, 4097), (4097, 9000))]
    pooled = pool(merge(chunks))
    np.testing.assert_allclose(pooled.mean, whole.mean, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(pooled.scatter, whole.scatter, rtol=1e-12, atol=1e-10)
    assert pooled.count[0] == 9000


@pytest.mark.parametrize("derivative", [False, True])
@pytest.mark.parametrize("m", [0, 1, 3])
def test_factor_carries_the_sum_of_squares_of_all_points(m: int, derivative: bool) -> None:
    u, du, V = data(500, m, offset=9.0)
    basis = np.hstack([np.ones((500, 1)), u, du] if derivative else [np.ones((500, 1)), u])
    part = factor(window_sums(u, du, V, [0, 100, 500]), derivative=derivative)
    X = np.random.default_rng(2).normal(size=(basis.shape[1], 3))
    rest, points = part.rhs - part.r @ X, V - basis @ X
    np.testing.assert_allclose(rest.T @ rest + part.residual, points.T @ points, rtol=1e-11)
    solution, *_ = np.linalg.lstsq(basis, V, rcond=None)
    np.testing.assert_allclose(np.linalg.solve(part.r, part.rhs), solution, rtol=1e-11, atol=1e-12)


def test_a_direction_without_motion_gives_rows_of_zeros() -> None:
    u, du, V = data(400, 3)
    u[:, 1] = 0.0
    u[:, 2] = 2.0 * u[:, 0]
    part = factor(window_sums(u, du, V, [0, 400]))
    assert np.linalg.matrix_rank(part.r, tol=1e-6) == 2
    solution, *_ = np.linalg.lstsq(part.r, part.rhs, rcond=1e-9)
    expected, *_ = np.linalg.lstsq(np.hstack([np.ones((400, 1)), u]), V, rcond=1e-9)
    np.testing.assert_allclose(solution, expected, atol=1e-9)


def test_an_empty_segment_is_dropped() -> None:
    u, du, V = data(10, 1)
    np.testing.assert_array_equal(window_sums(u, du, V, [0, 4, 4, 10]).count, [4, 6])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda u, du, V, e: (u, du[:-1], V, e), "shapes do not fit"),
        (lambda u, du, V, e: (u, du, V[:, :2], e), "shapes do not fit"),
        (lambda u, du, V, e: (u, du, V + np.nan, e), "must be finite"),
        (lambda u, du, V, _: (u, du, V, [0, 11]), r"rise within 0\.\.10"),
        (lambda u, du, V, _: (u, du, V, [0, 6, 5]), "rise"),
        (lambda u, du, V, _: (u, du, V, [4, 4]), "at least one sample"),
    ],
)
def test_bad_input_is_refused(change, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        window_sums(*change(*data(10, 1), [0, 10]))


def test_sums_on_different_bases_do_not_merge() -> None:
    one, three = (window_sums(*data(10, m), [0, 10]) for m in (1, 3))
    with pytest.raises(ValueError, match="different bases"):
        merge([one, three])
