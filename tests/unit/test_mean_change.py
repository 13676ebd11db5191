"""What a change of the mean may be: simulated tilts, offsets and sensitivities of known size."""

from __future__ import annotations

import numpy as np
import pytest

from agent.core.mean_watch import MeanWatch
from agent.core.watch import Hour
from calib.drift.mean_change import MeanChange, mean_change
from calib.estimate.correction import Law, between
from calib.model import Array
from tests.unit.test_watched import Q_TRUE, S_TRUE

G = np.array([1.2, -0.4, 9.71])
C = np.diag([0.002, 0.002, 0.003]) ** 2
LEAN = np.array([0.004, 0.003, 0.0])  # rad


def less_z(share: float) -> Array:
    """The change of the mean where the sensitivity of output z is less by a share."""
    after = S_TRUE * np.array([1.0, 1.0, 1.0 - share])[:, None]
    return np.asarray(np.linalg.inv(S_TRUE) @ after @ G - G)


def seen(change: Array, seed: int = 1, gravity: Array = G) -> MeanChange:
    noise = np.random.default_rng(seed).multivariate_normal(np.zeros(3), C)
    found = mean_change(change + noise, C, gravity, S_TRUE)
    assert found is not None
    return found


def test_a_tilt_is_a_tilt_or_q_and_no_sensitivity() -> None:
    found = seen(np.cross(LEAN, G))
    assert found.significant
    assert found.tilt_rad is not None
    # what turns about gravity itself is not seen
    size = np.linalg.norm(np.cross(LEAN, G)) / np.linalg.norm(G)
    assert abs(found.tilt_rad[0] - size) < 4.0 * found.tilt_rad[1] < 0.2 * size
    assert found.sensitivity == {}
    assert "a tilt of the mount by 0.28°" in found.sentence


def test_a_sensitivity_of_the_upright_axis_is_that_or_q_and_no_tilt() -> None:
    found = seen(less_z(0.011))
    assert found.tilt_rad is None
    [(axis, (share, u))] = found.sensitivity.items()
    assert axis == "z"
    assert abs(share + 0.011) < 4.0 * u < 0.002
    assert "the sensitivity of z by -1.1 %" in found.sentence
    assert found.unseen == ("y",)


def test_an_offset_along_no_single_axis_is_nothing_else() -> None:
    found = seen(np.array([0.05, 0.05, 0.08]))
    assert (found.tilt_rad, found.sensitivity) == (None, {})
    assert "neither a tilt nor one axis" in found.sentence
    assert "Q by as much" in found.sentence


@pytest.mark.slow
def test_no_change_says_nothing_and_each_cause_is_named_as_often_as_stated() -> None:
    """4000 draws, seed 3: a sound mean is never told (chance 1e-6 each); a true tilt is missed in one of 1000."""
    rng = np.random.default_rng(3)
    draws = rng.multivariate_normal(np.zeros(3), C, 4000)
    assert not any(found.significant for d in draws if (found := mean_change(d, C, G, S_TRUE)) is not None)
    tilted = [mean_change(np.cross(LEAN, G) + d, C, G, S_TRUE) for d in draws[:1000]]
    missed = sum(found is None or found.tilt_rad is None for found in tilted)
    assert missed <= 6  # one is expected: more than 6 once in 12,000


def test_what_feels_no_gravity_or_has_no_scatter_says_nothing() -> None:
    assert mean_change(np.ones(3), C, np.array([0.0, 0.1, 0.0]), S_TRUE) is None
    assert mean_change(np.ones(3), np.zeros((3, 3)), G, S_TRUE) is None
    assert mean_change(np.array([np.nan, 0.0, 0.0]), C, G, S_TRUE) is None


def hour(mean: Array, degc: float, segments: int = 60) -> Hour:
    none = np.full(3, np.nan)
    bands = np.zeros((6, 0))
    return Hour(0, 3600.0, {}, (degc, 0.0), segments, mean, none, none, np.zeros(0), bands, bands[:3], bands[:3])


def law(u_per_k: float = 0.0) -> Law:
    covariance = np.zeros((15, 15))
    covariance[range(12, 15), range(12, 15)] = u_per_k**2
    return Law(np.concatenate([S_TRUE.ravel(), Q_TRUE, np.zeros(3)]), covariance, order=1)


def told(hours: int, change: Array, *, degrees: tuple[float, float] = (20.0, 20.0), u_per_k: float = 0.0) -> list[str]:
    """The sentences of so many hours; the change comes in the middle, and with it another temperature."""
    rng, watch, found = np.random.default_rng(5), MeanWatch(), list[str]()
    for k in range(hours):
        later = k >= hours // 2
        mean = G + 0.002 * rng.standard_normal(3) + (change if later else 0.0)
        copy = MeanWatch()
        copy.load(watch.snapshot())
        found.append(watch.update(hour(mean, degrees[later]), ("run", 7), law(u_per_k)))
        assert copy.update(hour(mean, degrees[later]), ("run", 7), law(u_per_k)) == found[-1]
    return found


def test_a_change_is_told_within_a_day_and_nothing_before() -> None:
    found = told(400, less_z(0.0051))
    assert set(found[:200]) == {""}
    assert all("sensitivity of z by -0.5" in sentence for sentence in found[224:])


@pytest.mark.slow
def test_a_change_with_the_temperature_is_told_only_beyond_what_the_temperature_may_do() -> None:
    assert set(told(400, np.array([0.0, 0.0, 0.05]), degrees=(20.0, 30.0), u_per_k=0.01)) == {""}
    assert told(400, np.array([0.0, 0.0, 0.05]), degrees=(20.0, 30.0), u_per_k=1e-4)[-1]


def test_another_calibration_and_hours_with_few_minutes_begin_anew_or_do_not_count() -> None:
    watch, rng = MeanWatch(), np.random.default_rng(6)
    for _ in range(200):
        watch.update(hour(G + 0.002 * rng.standard_normal(3), 20.0), ("run", 7), law())
    moved = G + np.array([0.0, 0.0, 0.1])
    assert watch.update(hour(moved, 20.0, segments=5), ("run", 7), law()) == ""
    for _ in range(200):
        assert watch.update(hour(moved + 0.002 * rng.standard_normal(3), 20.0), ("run", 9), law()) == ""


def test_the_temperature_part_of_the_mean_is_that_of_a_monte_carlo() -> None:
    """20,000 drawn coefficients, seed 8: variances within 5 standard errors (5 %)."""
    rng, u = np.random.default_rng(8), 0.01
    c = u * rng.standard_normal((20_000, 3))
    drawn = (c * 10.0) @ np.linalg.inv(S_TRUE).T
    assert between(law(u), 30.0, 20.0, G).diagonal() == pytest.approx(drawn.var(axis=0), rel=0.05)
