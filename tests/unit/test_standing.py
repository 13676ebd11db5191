"""When a sensor was turned: found where it was, and not where it only shook."""

from __future__ import annotations

import numpy as np
import pytest

from calib.excitation.standing import DEPARTURE_MPS2, KEPT, MEAN_S, USUAL, Standing, steady

G_MPS2 = 9.80665
RATE_HZ = 100
SIZE = round(MEAN_S * RATE_HZ)
NOISE_MPS2 = 0.02


def leaning(degrees: np.ndarray) -> np.ndarray:
    """Gravity (n, 3) in a frame that leans by (n,) degrees."""
    angle = np.deg2rad(degrees)
    return G_MPS2 * np.column_stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)])


def times(duration_s: float) -> np.ndarray:
    return np.arange(round(duration_s * RATE_HZ)) / RATE_HZ


def stretches(signal: np.ndarray, seed: int = 1) -> list[tuple[float, float | None]]:
    """(first, end) in s of the stretches found in a signal (n, 3); None for one that goes on."""
    noise = NOISE_MPS2 * np.random.default_rng(seed).normal(size=signal.shape)
    standing, found = Standing(), []
    for mean in (signal + noise).reshape(-1, SIZE, 3).mean(axis=1):
        first, cleared = standing.first, standing.cleared
        end = standing.update(mean)
        if end is not None:
            assert first is not None
            assert cleared <= end  # what was cleared stays so
            found.append((first * MEAN_S, end * MEAN_S))
    return found + ([] if standing.first is None else [(standing.first * MEAN_S, None)])


def test_a_turn_at_rest_is_found_to_two_means_on_both_sides() -> None:
    t = times(60.0)
    before, after = stretches(leaning(np.interp(t, [20.1, 23.1], [0.0, 15.0])))
    assert before[0] == 0.0
    assert before[1] is not None
    # Departing counts from 0.7 deg on, which this turn reaches after 0.14 s.
    assert 20.1 - MEAN_S <= before[1] <= 20.1 + 0.14 + MEAN_S
    assert 23.1 - 0.14 - MEAN_S <= after[0] <= 23.1 + 2 * MEAN_S
    assert after[1] is None


def test_a_step_of_one_degree_is_a_turn_at_rest_and_half_a_degree_is_none() -> None:
    t = times(40.0)
    assert len(stretches(leaning(np.where(t < 20.0, 0.0, 1.0)))) == 2
    assert len(stretches(leaning(np.where(t < 20.0, 0.0, 0.5)))) == 1


@pytest.mark.parametrize("phase", np.linspace(0.0, np.pi, 5))
@pytest.mark.parametrize("frequency_hz", [0.5, 0.7, 3.0])
def test_vibration_is_no_turn(frequency_hz: float, phase: float) -> None:
    t = times(40.0)
    shaking = 10.0 * np.sin(2 * np.pi * frequency_hz * t + phase)[:, None] * np.array([0.8, 0.0, 0.6])
    [(first, end)] = stretches(leaning(np.zeros_like(t)) + shaking)
    assert first == 0.0
    assert end is None


@pytest.mark.slow
@pytest.mark.parametrize("phase", np.linspace(0.0, np.pi, 5))
@pytest.mark.parametrize("frequency_hz", [0.17, 0.2, 0.3])
def test_slow_motion_is_no_turn(frequency_hz: float, phase: float) -> None:
    """Periods of 3 to 6 s: after 18 s the sensor is seen to stand, and a turn of 30 deg ends that."""
    t = times(100.0)
    slow = np.sin(2 * np.pi * frequency_hz * t + phase)[:, None] * np.array([0.8, 0.0, 0.6])
    [(first, end)] = stretches(leaning(np.zeros_like(t)) + slow)
    assert (first, end) == (0.0, None)
    before, after = stretches(leaning(np.interp(t, [50.0, 53.0], [0.0, 30.0])) + slow)
    assert before[1] is not None
    assert 44.0 <= before[1] <= 50.5  # half of the smoothing, 6 s, may be lost on both sides
    assert 52.5 <= after[0] <= 59.0
    assert after[1] is None


@pytest.mark.parametrize("seed", range(4))
def test_knocks_are_no_turn(seed: int) -> None:
    random, t = np.random.default_rng(seed), times(60.0)
    signal = leaning(np.zeros_like(t))
    for start_s in random.uniform(8.0, 60.0, 10):
        blow = random.normal(size=3)
        half_sine = np.sin(np.pi * np.clip((t - start_s) / 0.02, 0.0, 1.0))
        signal += 8.0 * half_sine[:, None] * blow / np.linalg.norm(blow)
    assert len(stretches(signal, seed)) == 1


def test_ringing_after_a_turn_is_part_of_neither_stretch() -> None:
    t = times(60.0)
    ringing = np.where(t > 23.0, 5.0 * np.exp(-(t - 23.0) / 0.5) * np.sin(2 * np.pi * 2.3 * t), 0.0)
    before, after = stretches(leaning(np.interp(t, [20.0, 23.0], [0.0, 30.0])) + ringing[:, None])
    assert before[1] is not None
    assert 19.5 <= before[1] <= 20.5
    # Its means fall below the limit after a second; nothing after 4 s is thrown away.
    assert 23.0 <= after[0] <= 27.0


@pytest.mark.parametrize("rate_deg_per_s", [0.05, 0.2, 1.0])
def test_slow_turning_ends_a_stretch_before_it_leans_by_more_than_the_limit_to_both_sides(
    rate_deg_per_s: float,
) -> None:
    t = times(90.0)
    degrees = rate_deg_per_s * np.clip(t - 20.0, 0.0, 50.0)
    found = stretches(leaning(degrees))
    assert len(found) >= 2
    for first_s, end_s in found:
        within = (t >= first_s) & (t < (90.0 if end_s is None else end_s))
        assert np.ptp(degrees[within]) < 2 * 0.75


@pytest.mark.parametrize("seed", range(6))
def test_a_turn_while_it_shakes_leaves_no_stretch_that_holds_any_of_it(seed: int) -> None:
    random, t = np.random.default_rng(seed), times(80.0)
    start_s, apart_deg = random.uniform(25.0, 35.0), random.choice([-1.0, 1.0]) * random.uniform(8.0, 60.0)
    degrees = np.interp(t, [start_s, start_s + 2.0], [0.0, apart_deg])
    shaking = 10.0 * np.sin(2 * np.pi * 0.7 * t + random.uniform(0, 6))[:, None] * np.array([0.8, 0.0, 0.6])
    (_, end_s), (again_s, _) = stretches(leaning(degrees) + shaking, seed)
    assert end_s is not None
    # Half of the smoothing, 2 s, may hide what is smaller than twice the limit, 9 deg of this vibration.
    assert np.abs(degrees[t < end_s - 0.5]).max() < 9.0
    assert np.abs(degrees[t > again_s + 0.5] - apart_deg).max() < 9.0
    assert start_s - 4.0 < end_s
    assert again_s < start_s + 2.0 + 6.0


def test_missing_means_end_a_stretch() -> None:
    standing = Standing()
    for _ in range(steady(USUAL) + 3):
        standing.update(np.array([0.0, 0.0, G_MPS2]))
    assert standing.interrupt() == steady(USUAL) + 3
    assert standing.first is None
    assert standing.interrupt() is None
    for _ in range(steady(USUAL)):
        assert standing.first is None
        standing.update(np.array([0.0, 0.0, G_MPS2 + 2.0 * DEPARTURE_MPS2]))
    assert standing.first == steady(USUAL) + 3


def test_memory_is_bounded_and_the_state_is_all() -> None:
    random = np.random.default_rng(3)
    one, other = Standing(), Standing()
    for k in range(600):
        mean = leaning(np.array([30.0 * (k // 90)]))[0] + 0.02 * random.normal(size=3)
        restored = Standing()
        restored.load(other.snapshot())
        other = restored
        assert one.update(mean) == other.update(mean)
        assert (one.first, one.cleared, one.oldest) == (other.first, other.cleared, other.oldest)
        assert len(one.snapshot()["means"]) <= KEPT
