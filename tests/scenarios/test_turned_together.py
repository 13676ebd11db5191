"""A sensor and a DC-coupled tri-axial reference on one board, put down in one position after the other."""

from __future__ import annotations

import numpy as np
import pytest

from tests.imu_pair import Array, Session, calibrated

RATE_HZ, REST_S, TURN_S = 62.5, 22.0, 2.0
G = 9.80665
S_TRUE = 200.0 * np.array([[1.02, 0.01, -0.008], [0.012, 0.97, 0.006], [-0.005, 0.009, 1.01]])
Q_TRUE = np.array([40.0, -25.0, 60.0])
U_MAIN = 0.01  # U of the main sensitivities, k = 2, that twenty rests must reach


def board(seed: int, rests: int) -> tuple[Array, Array]:
    """Times (n,), and the acceleration (n, 3) of a board that is turned by hand between rests in random positions."""
    random = np.random.default_rng(seed)
    up = random.normal(size=(rests, 3))
    up *= G / np.linalg.norm(up, axis=1)[:, None]
    still, turning = round(REST_S * RATE_HZ), round(TURN_S * RATE_HZ)
    parts = []
    for before, after in zip(up, [*up[1:], up[-1]], strict=True):
        way = 0.5 - 0.5 * np.cos(np.pi * np.arange(turning) / turning)[:, None]
        between = before + way * (after - before)
        between *= G / np.linalg.norm(between, axis=1)[:, None]
        hands = random.normal(scale=0.5, size=between.shape).cumsum(axis=0) * 0.1
        parts += [np.tile(before, (still, 1)), between + hands - way * hands[-1]]
    a = np.concatenate(parts)
    return np.arange(len(a)) / RATE_HZ + 1.0, a


def session(seed: int, rests: int) -> Session:
    time_s, a = board(seed, rests)
    random = np.random.default_rng([seed, 1])
    V = np.round(a @ S_TRUE.T + Q_TRUE + 4.0 * random.normal(size=a.shape))
    reference = a + 0.02 * random.normal(size=a.shape)
    return calibrated(time_s, V, reference, np.eye(3), 200.0, RATE_HZ)


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.thorough) for k in (1, 2))])
def test_rests_beside_the_reference_determine_s_and_q(seed: int) -> None:
    found = session(seed, 20)
    assert sum(window.used for window in found.windows) >= 18
    _, update = found.calibrations[-1]
    S, Q, u = np.array(update.sensitivity), np.array(update.offset), np.array(update.standard_uncertainty)
    off = np.append(S.ravel() - S_TRUE.ravel(), Q - Q_TRUE)
    assert np.abs(off / u).max() < 3.5  # of twelve that share one reference
    assert (2.0 * u[[0, 4, 8]] / 200.0 < U_MAIN).all()
    assert all(update.determined)


def test_a_board_that_is_never_turned_tells_nothing_of_s() -> None:
    """One rest of two minutes: the means tell Q + S g alone, and the windows say nothing else."""
    found = session(5, 1)
    for _, update in found.calibrations:
        assert not any(update.determined[:9])
