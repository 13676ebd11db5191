"""How well an output fits the motion at any lag, from one cross-spectrum; the true lag is known."""

from __future__ import annotations

import weakref
from collections.abc import Iterator

import numpy as np
import pytest

from calib import calibrate
from calib.excitation.lag_search import correlated_lag, longest_in_time, minima, misfit_by_lag

RATE_HZ, SECONDS, NOISE = 100.0, 40.0, 0.05
S = np.array([[2.0, 0.02, -0.01], [0.01, 1.9, 0.03], [0.0, 0.02, 2.1]])


def motion(time_s: np.ndarray, seed: int, band_hz: tuple[float, float]) -> np.ndarray:
    """(n, 3) m/s2: forty sines in the band for each axis, rms 1."""
    rng = np.random.default_rng(seed)
    omega = 2.0 * np.pi * rng.uniform(*band_hz, (3, 40))
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, 40))
    return np.asarray(np.sqrt(2.0 / 40.0) * np.sin(time_s[:, None, None] * omega + phase).sum(axis=2))


def found(lag_s: float, seed: int, band_hz: tuple[float, float] = (0.5, 12.0), holes: bool = False) -> np.ndarray:
    """The minima of the misfit within 0.15 s, the deepest first, of outputs that come late by `lag_s`."""
    sample = np.arange(round(RATE_HZ * SECONDS))
    if holes:
        sample = np.delete(sample, np.r_[300:450, 2000:2003])
    time_s = sample / RATE_HZ
    expected = motion(time_s, seed, band_hz) @ S.T
    V = motion(time_s - lag_s, seed, band_hz) @ S.T + [3.0, -1.0, 9.8]
    V += NOISE * np.random.default_rng(seed + 1).normal(size=V.shape)
    return np.column_stack(minima(*misfit_by_lag(V, expected, sample, RATE_HZ, 0.15)))


@pytest.mark.one_case
@pytest.mark.parametrize("lag_s", [0.0, 0.0123, -0.0371, 0.1404, -0.1404])
@pytest.mark.parametrize("holes", [False, True])
def test_the_deepest_minimum_is_at_the_lag(lag_s: float, holes: bool) -> None:
    # u of the lag is the noise over the rms of dV/dt and the root of the number of values: 0.05 / (90 * 110) = 5 us.
    errors = [found(lag_s, seed, holes=holes)[0, 0] - lag_s for seed in range(3)]
    assert np.abs(errors).max() < 1e-4


def test_beside_the_lag_the_misfit_is_that_of_noise_alone() -> None:
    depths = [found(0.0125, seed)[:2, 1] for seed in range(3)]  # five lags of 2.5 ms
    values = 3.0 * RATE_HZ * SECONDS
    for deepest, next_one in depths:
        assert deepest == pytest.approx(values, rel=0.02)
        assert next_one > 100.0 * values  # the motion is 40 times the noise


def test_two_equal_lowest_values_are_one_minimum_between_them() -> None:
    at_s, depth = minima(1e-3 * np.arange(4.0), np.array([2.0, 1.0, 1.0, 2.0]))
    np.testing.assert_allclose(at_s, [1.5e-3])
    np.testing.assert_allclose(depth, [0.875])  # of the parabola through 2, 1, 1


def test_of_one_frequency_each_period_is_a_minimum() -> None:
    at_s = found(0.02, 1, (9.999, 10.001))[:3, 0]
    np.testing.assert_allclose(np.sort(at_s), [-0.08, 0.02, 0.12], atol=1e-3)


def outputs(
    lag_s: np.ndarray, seed: int = 1, size: np.ndarray | float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(V, expected, time) where each sample has a lag of its own and S is `size` times what is expected."""
    time_s = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    V = size * (motion(time_s - lag_s, seed, (0.5, 12.0)) @ S.T)
    noise = NOISE * np.random.default_rng(seed).normal(size=V.shape)
    return V + noise, motion(time_s, seed, (0.5, 12.0)) @ S.T, time_s


time_of_all_s = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ


@pytest.mark.slow
@pytest.mark.parametrize("lag_s", [0.05, -0.05, 0.01])
@pytest.mark.parametrize(
    ("off_s", "longest_s"), [((0.0, 10.0), (10.0, 40.0)), ((14.5, 24.5), (24.5, 40.0)), ((31.0, 40.0), (0.0, 31.0))]
)
def test_the_longest_part_without_another_lag_is_found(
    lag_s: float, off_s: tuple[float, float], longest_s: tuple[float, float]
) -> None:
    since_s, until_s = off_s
    V, expected, time_s = outputs(np.where((time_of_all_s >= since_s) & (time_of_all_s < until_s), lag_s, 0.0))
    found = longest_in_time(V, expected, time_s, 0.15, 50.0)
    assert found is not None
    assert longest_s[0] <= found[0] <= longest_s[0] + 4.0  # two stretches of 2 s at the most
    assert longest_s[1] - 4.0 <= found[1] <= longest_s[1]


def test_where_all_or_nothing_is_in_time_there_is_no_part() -> None:
    assert longest_in_time(*outputs(np.zeros(len(time_of_all_s))), 0.15, 50.0) is None
    assert longest_in_time(*outputs(np.full(len(time_of_all_s), 0.05)), 0.15, 50.0) is None


def test_another_sensitivity_a_knock_and_a_stuck_output_are_no_other_lag() -> None:
    middle = (time_of_all_s >= 14.5) & (time_of_all_s < 24.5)
    assert (
        longest_in_time(*outputs(np.zeros(len(time_of_all_s)), size=np.where(middle, 1.05, 1.0)[:, None]), 0.15, 50.0)
        is None
    )
    V, expected, time_s = outputs(np.zeros(len(time_of_all_s)))
    knocked = V + 20.0 * np.exp(-np.abs(time_of_all_s - 20.0) / 0.02)[:, None]
    assert longest_in_time(knocked, expected, time_s, 0.15, 50.0) is None
    stuck = np.where(middle[:, None], V[1450], V)
    assert longest_in_time(stuck, expected, time_s, 0.15, 50.0) is None


def stretches(number: int, rate: float, lag_s: float, kept: list[weakref.ref[np.ndarray]]) -> Iterator[tuple]:
    """Stretches of SECONDS whose outputs come late by `lag_s` in the middle of all, and by `rate` more each second."""
    middle_s = 0.5 * number * SECONDS
    for k in range(number):
        time_s = k * SECONDS + np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
        u = motion(time_s, 3 * k, (0.5, 12.0))
        V = motion(time_s - lag_s - rate * (time_s - middle_s), 3 * k, (0.5, 12.0)) @ S.T
        kept.append(weakref.ref(V))
        yield time_s, V, u
        del V, u


@pytest.mark.two_cases
@pytest.mark.parametrize(("rate", "lag_s"), [(0.0, -0.09), (1.5e-4, 0.05), (-5e-5, 0.0)])
def test_clocks_that_run_apart_are_found_by_correlation_without_holding_all_samples(rate: float, lag_s: float) -> None:
    kept: list[weakref.ref[np.ndarray]] = []
    number, omega = 30, 2.0 * np.pi * 7.0
    alive = []

    def watched() -> Iterator[tuple]:
        for one in stretches(number, rate, lag_s, kept):
            alive.append(sum(ref() is not None for ref in kept))
            yield one

    told = correlated_lag(watched(), number * SECONDS, 0.12, 2e-4, omega)
    assert told is not None
    found_s, change, at_s = told
    ends_s = np.array([0.0, number * SECONDS])
    errors_s = found_s + change * (ends_s - at_s) - lag_s - rate * (ends_s - ends_s.mean())
    assert np.abs(errors_s).max() < 0.25 * np.pi / omega + 1.0 / RATE_HZ  # an eighth of a period, and a sample
    assert max(alive) <= 2


@pytest.mark.parametrize("rate", [0.0, 6e-5])
def test_beside_turns_against_gravity_clocks_that_run_apart_are_found(rate: float) -> None:
    """Eight stays of 20 s, turned in each: gravity makes 20 times the motion, and is the same at all these lags."""
    stay_s, stays, omega = 20.0, 8, 2.0 * np.pi * 20.0
    gravity_mps2 = 9.81 * np.random.default_rng(3).standard_normal((stays + 1, 3))

    def shown(time_s: np.ndarray, k: int) -> np.ndarray:
        turned = 0.5 - 0.5 * np.cos(np.pi * np.clip((time_s / stay_s - k - 0.45) / 0.08, 0.0, 1.0))
        turns = gravity_mps2[k] + turned[:, None] * (gravity_mps2[k + 1] - gravity_mps2[k])
        return np.asarray(0.5 * motion(time_s, 3 * k, (12.0, 28.0)) + turns)

    def parts() -> Iterator[tuple]:
        for k in range(stays):
            time_s = k * stay_s + np.arange(round(RATE_HZ * stay_s)) / RATE_HZ
            yield time_s, shown(time_s - 0.01 - rate * (time_s - 80.0), k) @ S.T, shown(time_s, k)

    told = correlated_lag(parts(), stays * stay_s, 0.12, 2e-4, omega)
    assert told is not None
    found_s, change, at_s = told
    ends_s = np.array([0.0, stays * stay_s])
    errors_s = found_s + change * (ends_s - at_s) - 0.01 - rate * (ends_s - 80.0)
    assert (
        np.abs(errors_s).max() < 0.125 * np.pi / omega + 0.25 / RATE_HZ
    )  # of a period a sixteenth, of a sample a quarter


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("upper", "lag_s", "noise_mps2", "bursts"), [(1.6, 0.017, 0.01, True), (3.0, 0.0125, 0.035, False)]
)
def test_of_two_tones_the_lag_is_not_that_of_an_inverted_sensor(
    upper: float, lag_s: float, noise_mps2: float, bursts: bool
) -> None:
    """Tones of 16.2 Hz and 1.6 or 3 times that, on each axis in turn. From a lag of 0 windows lead to half a period of
    both: there a sensor seems to be inverted, and with odd multiples it fits as well."""
    random = np.random.default_rng(6)
    time_s = np.arange(6 * 3000) / 200.0
    S = np.eye(3) + 0.02 * random.standard_normal((3, 3))
    phase = random.uniform(0.0, 2.0 * np.pi, (2, 6))

    def moved(at_s: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        stay = np.clip(at_s // 15.0, 0, 5).astype(int)
        level = 0.1 + np.clip(np.sin(2.0 * np.pi * at_s / 7.0), 0.0, 1.0) if bursts else np.ones_like(at_s)
        tones = [
            share * np.sin(2.0 * np.pi * 16.2 * times * at_s + own[stay])
            for share, times, own in zip((1.0, 0.8), (1.0, upper), phase, strict=True)
        ]
        return np.asarray((level * sum(tones))[:, None] * np.eye(3)[stay % 3])

    V = moved(time_s - lag_s) @ S.T + noise_mps2 * random.standard_normal((len(time_s), 3))
    u = moved(time_s) + 0.1 * noise_mps2 * random.standard_normal(V.shape)
    reference = {"time_s": time_s, "ax": u[:, 0], "ay": u[:, 1], "az": u[:, 2]}
    known = {"sensor_filter": ["flat"], "reference_filter": ["flat"]}
    found = calibrate((time_s, V), reference, rotation=np.eye(3), **known)
    assert found.status == "valid", found.reasons
    assert found.lag_s == pytest.approx(lag_s, abs=2e-4)
    assert np.abs((found.sensitivity - S) / found.standard_uncertainty[:9].reshape(3, 3)).max() < 4.0
