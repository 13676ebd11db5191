"""Clocks from a file's stamps: every way of stamping the same samples leads to their true times."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from calib.signal import stamps as stamps_module
from calib.signal.stamps import arrivals_from_stamps, clock_from_stamps, counted
from tests.unit.test_timing import polled, sample_times

TRUE, NEWEST, ARRIVAL = polled(100.0, 1013.0, 0.016, seed=1, wander=50e-6)
TRUE = TRUE[: NEWEST[-1] + 1]
EQUAL = np.repeat(ARRIVAL, np.diff(NEWEST, prepend=-1))
AGE = np.repeat(NEWEST, np.diff(NEWEST, prepend=-1)) - np.arange(len(TRUE))
RNG = np.random.default_rng(2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stamps", "kind", "limit_s"),
    [
        (EQUAL, "bursts", 100e-6),
        (EQUAL - 5e-6 * AGE, "bursts", 100e-6),
        (EQUAL - 1e-3 * AGE, "spread", 50e-6),
        (TRUE + RNG.exponential(1e-3, len(TRUE)), "jittery", 50e-6),
        (TRUE + RNG.normal(0.0, 2e-3, len(TRUE)), "jittery", 300e-6),
        (TRUE, "grid", 5e-6),
        (np.round(TRUE, 6), "grid", 5e-6),
    ],
)
def test_true_times_from_any_stamps(stamps: np.ndarray, kind: str, limit_s: float) -> None:
    assert arrivals_from_stamps(stamps).kind == kind
    error = clock_from_stamps(stamps).time_of(np.arange(len(TRUE))) - TRUE
    assert np.abs(error).max() < limit_s


@pytest.mark.parametrize("rate_hz", [10.0, 204.8, 1000.0])
@pytest.mark.parametrize("decimals", [6, 9])
def test_exact_grids_are_left_alone(rate_hz: float, decimals: int) -> None:
    t = 5.0 + np.arange(20_000) / rate_hz
    clock = clock_from_stamps(np.round(t, decimals))
    assert np.abs(clock.time_of(np.arange(len(t))) - t).max() < 1e-6
    np.testing.assert_allclose(clock.rate_hz, rate_hz, rtol=1e-7)


def test_rounding_to_milliseconds_averages_out() -> None:
    t = np.arange(6000) / 204.8
    assert np.abs(clock_from_stamps(np.round(t, 3)).time_of(np.arange(6000)) - t).max() < 20e-6


@pytest.mark.parametrize(("missing", "stamped"), [(3, "exact"), (300, "exact"), (700, "bursts")])
def test_missing_samples_are_found(missing: int, stamped: str) -> None:
    kept = np.r_[0:50_000, 50_000 + missing : len(TRUE)]
    clock = clock_from_stamps((TRUE if stamped == "exact" else EQUAL)[kept])
    error = np.abs(clock.time_of(np.arange(len(kept))) - TRUE[kept])
    near = np.abs(np.arange(len(kept)) - 50_000) < 20  # the burst in which samples were lost may stand on either side
    assert error[~near].max() < 100e-6
    assert len(clock.gaps) >= 1
    assert np.abs(clock.gaps - 50_000).max() < 20
    if stamped == "exact":
        np.testing.assert_array_equal(clock.gaps, [50_000])


def test_a_stall_is_no_gap() -> None:
    assert len(clock_from_stamps(EQUAL).gaps) == 0
    assert len(clock_from_stamps(TRUE + RNG.normal(0.0, 2e-3, len(TRUE))).gaps) == 0


def test_an_hour_with_thermal_wander() -> None:
    t = sample_times(3600.0, 100.3)
    error = clock_from_stamps(t + RNG.exponential(1e-3, len(t))).time_of(np.arange(len(t))) - t
    assert np.abs(error).max() < 100e-6


def test_blocks_of_a_long_file_join(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = clock_from_stamps(EQUAL)
    monkeypatch.setattr(stamps_module, "BLOCK_ROWS", 30_000)
    blocks = clock_from_stamps(EQUAL)
    assert len(blocks.knot_index) > len(whole.knot_index)
    rows = np.arange(len(EQUAL))
    assert np.abs(blocks.time_of(rows) - TRUE).max() < 100e-6
    kept = np.r_[0:50_000, 50_300 : len(TRUE)]
    np.testing.assert_array_equal(clock_from_stamps(TRUE[kept]).gaps, [50_000])


@pytest.mark.parametrize("n", [2, 3, 5, 30])
def test_few_rows(n: int) -> None:
    t = np.arange(n) / 50.0
    np.testing.assert_allclose(clock_from_stamps(t).time_of(np.arange(n)), t, atol=1e-9)


@pytest.mark.parametrize("make", [lambda: np.zeros(10), lambda: -np.arange(10.0), lambda: np.zeros(1)])
def test_time_that_does_not_pass_is_refused(make: Callable[[], np.ndarray]) -> None:
    with pytest.raises(ValueError, match="time must pass"):
        clock_from_stamps(make())


def drawn_stamps(seed: int) -> tuple[float, float, float, float, float, int]:
    """Rate, duration, rounding, share of rounded and of repeated stamps, and the seed of what is drawn from them."""
    random = np.random.default_rng([seed, 31])
    return (
        float(np.exp(random.uniform(np.log(50.0), np.log(1000.0)))),
        float(random.uniform(5.0, 200.0)),
        float(random.choice([0.5e-3, 1e-3])),
        float(random.choice([0.001, 0.005, 0.02, 0.3, 0.7, 1.0])),
        float(random.choice([0.0, 0.0, 0.001, 0.02])),
        seed,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate_hz", "seconds", "rounding_s", "rounded", "repeated", "seed"),
    [
        (242.0, 6.0, 1e-3, 1.0, 0.02, 0),
        (50.0, 200.0, 1e-3, 0.02, 0.0, 1),
        (125.0, 150.0, 0.5e-3, 0.02, 0.0, 1),
        (50.003, 90.0, 1e-3, 0.02, 0.0, 2),
        *map(drawn_stamps, range(60)),
    ],
)
def test_stamps_some_of_which_are_rounded_or_repeated(
    rate_hz: float, seconds: float, rounding_s: float, rounded: float, repeated: float, seed: int
) -> None:
    """A repeated stamp is that of the sample before. Times are hardly off by more than what displaced a stamp.

    The edge of a group of stamps is extrapolated by the gap between its earliest two: that may add half as much again.
    """
    random = np.random.default_rng(seed)
    true = random.uniform(0.0, 10.0) + np.arange(round(seconds * rate_hz)) / rate_hz
    stamps = np.round(true, 6)
    some = random.random(len(true)) < rounded
    stamps[some] = np.round(stamps[some] / rounding_s) * rounding_s
    again = np.flatnonzero(random.random(len(true) - 1) < repeated)
    stamps[again + 1] = stamps[again]
    clock, rows, numbers = counted(clock_from_stamps(stamps))
    assert (rows.tolist(), numbers.tolist()) == ([0], [0])
    times_s = clock.time_of(np.arange(len(true)))
    assert (np.diff(times_s) > 0).all()
    assert np.abs(times_s - true).max() < 1.5 * (rounding_s + (1.0 / rate_hz if repeated else 0.0)) + 1e-6


@pytest.mark.parametrize("every_s", [40.0, 100.0])
def test_bursts_that_come_less_than_once_a_minute(every_s: float) -> None:
    t = np.arange(round(30 * 2.0 * every_s)) / 2.0
    stamps = np.ceil((t + 1e-3) / every_s) * every_s
    error = clock_from_stamps(stamps).time_of(np.arange(len(t))) - t
    assert np.ptp(error) < 0.6  # a sample's period: the newest of a burst may be as old as that


def test_a_device_slower_than_a_sample_a_minute() -> None:
    t = np.arange(30) * 100.0
    np.testing.assert_allclose(clock_from_stamps(t).time_of(np.arange(30)), t, atol=1e-6)
