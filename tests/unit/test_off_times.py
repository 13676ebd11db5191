"""Files of loggers that were off for a time: gaps are found first, each stretch has its rate, and a jump is a gap."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import calib
from calib.recorded.errors import InputError
from calib.recorded.streams import TableStream
from calib.signal.stamps import change_of_rate, clock_from_stamps, kind_of
from tests.stays import Array, errors, in_batches, main_errors_pct, stays

RATE_HZ = 1003.3
LOGGED = stays(4, rate_hz=RATE_HZ, on_s=12.6, off_s=40.0)
YEARS_S = 1.78e9


def by_stay(stamped: Callable[[Array], Array]) -> Array:
    """Stamps that are made anew in each stay, as a logger does that begins anew."""
    cuts = np.flatnonzero(np.diff(LOGGED.time_s) > 1.0) + 1
    return np.concatenate([stamped(part) for part in np.split(LOGGED.time_s, cuts)])


def jittery(time_s: Array) -> Array:
    return time_s + np.random.default_rng(5).exponential(3e-4, len(time_s))


@pytest.mark.one_case
@pytest.mark.parametrize(
    "stamp_s",
    [
        LOGGED.time_s,
        np.round(LOGGED.time_s, 6),
        np.round(LOGGED.time_s, 3),
        by_stay(lambda t: in_batches(t, 32)),
        by_stay(lambda t: in_batches(t, 256)),
        np.round(by_stay(lambda t: in_batches(t, 25)), 2),
        by_stay(jittery),
    ],
    ids=["exact", "us", "ms", "batches of 32", "batches of 256", "batches, 10 ms", "jitter"],
)
def test_a_logger_that_is_off_between_stays(stamp_s: Array) -> None:
    """On for 24 % of the time: the mean rate of the file is 240 Hz."""
    found = LOGGED.calibrated(stamp_s)
    assert found.rate_hz == pytest.approx(RATE_HZ, rel=1e-4)
    assert all(window.used for window in found.windows)
    assert np.abs(main_errors_pct(found)).max() < 0.05
    assert np.abs(errors(found) / found.expanded_uncertainty).max() < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("before", [3, 12000])
def test_a_clock_that_jumps_from_1970(before: int) -> None:
    """The samples before a time server set the clock are not beside the reference, all others are."""
    stamp_s = LOGGED.time_s + np.where(np.arange(len(LOGGED.time_s)) < before, 0.0, YEARS_S)
    found = LOGGED.calibrated(stamp_s, YEARS_S)
    assert found.rate_hz == pytest.approx(RATE_HZ, rel=1e-6)
    assert [window.used for window in found.windows if window.points] == [True] * (4 if before == 3 else 3 + 1)
    assert np.abs(main_errors_pct(found)).max() < 0.1


def test_a_few_samples_before_or_after_a_long_time_are_a_stretch() -> None:
    on_s = np.arange(5000) / RATE_HZ
    for parts in ([on_s[:2], on_s + 60.0], [on_s, on_s[:2] + 60.0]):
        stamp_s = np.concatenate(parts)
        clock = clock_from_stamps(stamp_s)
        assert np.abs(clock.time_of(np.arange(len(stamp_s))) - stamp_s).max() < 1e-6
        assert clock.u_offset_s < 1e-6
        np.testing.assert_array_equal(clock.gaps, [len(parts[0])])


@pytest.mark.parametrize("lost", [1, 2, 50])
def test_lost_samples_on_a_grid_leave_it_a_grid(lost: int) -> None:
    """Blocks that a link lost, one in a hundred or fewer, are no ends of bursts."""
    random = np.random.default_rng(1)
    kept = np.ones(20_000, dtype=bool)
    for first in random.integers(100, 19_900, 150 // lost):
        kept[first : first + lost] = False
    stamp_s = np.round(np.arange(20_000) / RATE_HZ, 6)[kept]
    assert kind_of(stamp_s) == "grid"
    clock = clock_from_stamps(stamp_s)
    assert np.abs(clock.time_of(np.arange(len(stamp_s))) - stamp_s).max() < 2e-6


def test_milliseconds_since_1970_are_a_grid() -> None:
    t = np.arange(20_000) / RATE_HZ
    stamp_s = np.round(YEARS_S + t, 3)
    assert kind_of(stamp_s) == "grid"
    assert np.abs(clock_from_stamps(stamp_s).time_of(np.arange(len(t))) - YEARS_S - t).max() < 50e-6


def test_a_gap_between_two_blocks_of_a_long_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calib.signal.stamps.BLOCK_ROWS", 10_000)
    t = np.arange(20_000) / RATE_HZ
    stream = TableStream("sensor", t + np.where(t < t[10_000], 0.0, 40.0), np.zeros((20_000, 3)))
    np.testing.assert_allclose(stream.off_s, [(t[9_999], t[10_000] + 40.0)], atol=1e-9)
    cut = stream.cut(-1.0, 30.0)
    assert cut is not None
    assert len(cut.values) == 10_000


@pytest.mark.parametrize("after", [2.0, 0.5, 1.15])
@pytest.mark.parametrize("off_s", [0.0, 30.0])
def test_two_rates_in_one_file_are_told(after: float, off_s: float) -> None:
    t = np.concatenate([np.arange(6000) / 100.0, 60.0 + off_s + np.arange(6000) / (100.0 * after)])
    with pytest.raises(InputError, match=rf"from 100 Hz to {100 * after:.4g} Hz.*cut the file here") as told:
        calib.calibrate((t, np.zeros((len(t), 3))), {"time_s": t, "a": np.zeros(len(t))}, [])
    assert told.value.row is not None
    assert abs(told.value.row - 6000) <= 200


def test_stamps_of_whole_milliseconds_are_no_other_rate() -> None:
    """At 400 Hz they are 2 or 3 ms apart, with jitter as often the one as the other: 40 files of 100 s."""
    random = np.random.default_rng(4)
    for jitter_s in (0.0, 0.2e-3, 0.5e-3, 1e-3):
        for ppm in np.linspace(-60.0, 60.0, 10):
            exact = np.arange(40_000) / 400.0 * (1.0 + 1e-6 * ppm)
            stamp_s = np.maximum.accumulate(np.round(exact + jitter_s * random.standard_normal(len(exact)), 3))
            assert change_of_rate(stamp_s) is None, (jitter_s, ppm)


@pytest.mark.thorough
def test_stalls_losses_and_a_slow_clock_are_no_other_rate() -> None:
    random = np.random.default_rng(2)
    t = np.arange(30_000) / 100.0
    stalled = np.maximum(t, np.where((t > 100.0) & (t < 103.0), 103.0, 0.0))
    lossy = t[random.uniform(size=len(t)) > np.where(t < 150.0, 0.0, 0.3)]
    drifting = t * (1.0 + 0.04 * t / t[-1])
    for stamp_s in (t, stalled, lossy, drifting, in_batches(t, 128), jittery(t)):
        TableStream("sensor", stamp_s, np.zeros((len(stamp_s), 3)))
        calib.calibrate((stamp_s, 9.8 + random.normal(size=(len(stamp_s), 3))), gravity=9.81)


def test_a_pose_with_an_off_time_gives_the_windows_on_both_sides() -> None:
    """Beside a tri-axial reference there is one pose, however often the logger was off."""
    random = np.random.default_rng(3)
    t, reference_s = np.arange(0.0, 120.0, 0.01), np.arange(-2.0, 122.0, 0.01)
    tones = 2.0 * np.pi * random.uniform(0.5, 8.0, (3, 30))
    phase = random.uniform(0.0, 6.3, (3, 30))

    def moved(time_s: Array) -> Array:
        return np.sin(time_s[:, None, None] * tones + phase).sum(axis=2) / 4.0 + [0.0, 0.0, 9.8]

    S = np.array([[1.02, 0.03, -0.02], [0.015, 0.98, 0.025], [-0.01, 0.02, 1.01]])
    on = t % 30.0 < 10.0
    V = moved(t[on]) @ S.T + 0.01 * random.normal(size=(on.sum(), 3))
    reference = dict(zip(("time_s", "ax", "ay", "az"), (reference_s, *moved(reference_s).T), strict=True))
    found = calib.calibrate((t[on], V), reference, rotation=np.eye(3))
    assert found.status == "valid", found.reasons
    assert [round(window.stop_s - window.start_s) for window in found.windows] == [10] * 4
    assert np.abs(found.sensitivity - S).max() < 1e-3


def test_rests_of_a_logger_that_is_off_between_them() -> None:
    random = np.random.default_rng(3)
    up = random.normal(size=(14, 3))
    up *= 9.80665 / np.linalg.norm(up, axis=1)[:, None]
    S, n = np.array([[1.02, 0.03, -0.02], [0.0, 0.98, 0.025], [0.0, 0.0, 1.01]]), int(4.0 * RATE_HZ)
    t = np.concatenate([44.0 * k + np.arange(n) / RATE_HZ for k in range(14)])
    V = np.repeat(up @ S.T, n, axis=0) + 0.05 * random.normal(size=(14 * n, 3))
    for since_s in (0.0, YEARS_S):
        found = calib.calibrate((np.round(t + np.where(t > 100.0, since_s, 0.0), 6), V))
        assert len(found.windows) == 14
        assert found.rate_hz == pytest.approx(RATE_HZ, rel=1e-6)
        assert np.abs(found.sensitivity - S).max() < 2e-3
