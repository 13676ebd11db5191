"""Natural frequencies of a site: told where several sensors see them move, and by nothing else."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.model import Array
from calib.site_watch.day import FEWEST_HOURS, Hours, Visits, day_of
from calib.site_watch.frequencies import moved_bands
from calib.site_watch.together import DIRECTIONS, JointChange
from calib.site_watch.verdicts import SiteVerdicts, _means, result
from calib.site_watch.watch import SiteWatch, pooled

BANDS_HZ = 10.0 ** (np.arange(0, 6) / 10.0)
N, BEGAN, CHANGED = 6, 20_000, 20_050
GATEWAY: NDArray[Any] = np.arange(N) // 2
PLACES = np.array(
    [0.03, -0.02, 0.05, -0.1, 0.02, 0.04]
)  # log of the peak over the centre; the fourth nearly at an edge


class Frequencies:
    """Days of sensors with one mode in each window: it follows the temperature, and scatters at all of them alike."""

    def __init__(self, seed: int) -> None:
        self.random, self.number = np.random.default_rng(seed), BEGAN
        self.value = self.random.normal(0.0, 0.3, (N, len(BANDS_HZ), 6))

    def day(self, fallen: Array | float = 0.0, shift: Array | float = 0.0) -> tuple[Hours, Array]:
        """A day of 24 equal hours. `fallen` (n, B): what the frequencies have fallen by; `shift` (n, B, 3): of the log
        amplitude."""
        degc = 10.0 + 8.0 * np.sin(self.number / 20.0) + self.random.normal(0.0, 2.0)
        T = (degc - 10.0) / 10.0
        common = PLACES - 0.004 * T + 0.001 * T * T + self.random.normal(0.0, 0.001, len(BANDS_HZ))
        own = common - fallen + self.random.normal(0.0, 0.0003, (N, len(BANDS_HZ)))
        a = self.value[..., :3] + shift + self.random.normal(0.0, 0.004, (N, len(BANDS_HZ), 3))
        rho = 0.1 + self.random.normal(0.0, 0.004, a.shape)
        cross = rho * np.exp(a[..., [0, 0, 1]] + a[..., [1, 2, 2]])
        hours = 24.0 * self.number + np.arange(24.0)
        day = [np.broadcast_to(each, (24, *np.shape(each))) for each in
               (np.exp(2.0 * a), cross, np.full((N, 3), 1e-9), np.full(N, degc))]  # fmt: skip
        peak = np.broadcast_to(own[None, :, :, None], (24, N, len(BANDS_HZ), 3))
        self.number += 1
        return Hours(hours, day[0], day[1], day[2], day[3], None, peak), own


@cache
def _quiet(seed: int) -> tuple[Frequencies, SiteWatch]:
    site, watch = Frequencies(seed), SiteWatch(GATEWAY, BANDS_HZ)
    for _ in range(CHANGED - BEGAN):
        watch.update(day_of(site.day()[0], BANDS_HZ))
    return site, watch


def fifty_days(seed: int = 1) -> tuple[Frequencies, SiteWatch]:
    """A site and its watch after 50 days without a change."""
    return copy.deepcopy(_quiet(seed))


def after(days: int, fallen: Array | float = 0.0, shift: Array | float = 0.0, seed: int = 1) -> SiteVerdicts:
    """So many days after a change of this size, which came when 50 days had passed."""
    site, watch = fifty_days(seed)
    for _ in range(days):
        watch.update(day_of(site.day(fallen, shift)[0], BANDS_HZ))
    return result(watch)


def in_window(band: int, by: float, sensors: slice = slice(None)) -> Array:
    fallen = np.zeros((N, len(BANDS_HZ)))
    fallen[sensors, band] = by
    return fallen


@pytest.mark.slow
@pytest.mark.parametrize("band", [1, 3])
def test_a_frequency_that_falls_at_all_sensors_is_the_structure(band: int) -> None:
    found = after(10, in_window(band, 0.02))
    (told,) = found.frequencies
    assert found.site == told
    assert (told.kind, told.what.split(", ")[1]) == ("structure", "at 6 of 6 sensors")
    assert told.hz == pytest.approx(BANDS_HZ[band] * np.exp(PLACES[band]), rel=0.01)
    assert abs(told.size + 0.02) <= told.U < 0.008
    assert told.earliest <= CHANGED <= told.latest
    assert all(one.kind == "none" for one in found.sensors)
    assert not found.gateways


@pytest.mark.one_case
@pytest.mark.parametrize(("by_night", "by_day", "told"), [(0.02, 0.02, 1), (0.01, 0.03, 0), (0.04, 0.0, 0)])
def test_what_moves_in_loud_hours_otherwise_than_in_quiet_ones_is_no_mode(
    by_night: float, by_day: float, told: int
) -> None:
    """Where two modes share a window, their mixture follows what excites them, so a lane that is closed moves it."""
    night = (np.arange(24) < 12)[:, None, None, None]
    site, watch = Frequencies(3), SiteWatch(GATEWAY, BANDS_HZ)
    for k in range(60):
        hours, _ = site.day()
        level = np.where(night, 0.5, 1.0)
        fallen = np.where(night, by_night, by_day) * (np.arange(len(BANDS_HZ)) == 2)[:, None] * (k >= 50)
        assert hours.frequency is not None
        moved = hours.frequency - fallen
        watch.update(
            day_of(replace(hours, power=level * hours.power, cross=level * hours.cross, frequency=moved), BANDS_HZ)
        )
    assert len(result(watch).frequencies) == told


@pytest.mark.thorough
def test_sound_frequencies_follow_the_temperature_and_are_not_told() -> None:
    assert [len(after(40, seed=seed).frequencies) for seed in range(2)] == [0, 0]


@pytest.mark.slow
def test_frequencies_that_do_not_scatter_at_all_are_not_told() -> None:
    """As of days that were copied: their variance is 0."""
    hours, watch = Frequencies(1).day()[0], SiteWatch(GATEWAY, BANDS_HZ)
    for k in range(60):
        watch.update(
            replace(day_of(replace(hours, frequency=np.zeros_like(hours.frequency)), BANDS_HZ), number=BEGAN + k)
        )
    assert (pooled(*watch.frequencies.rest(), (N, len(BANDS_HZ), 3)) == 0.0).all()
    with np.errstate(divide="raise", invalid="raise"):
        assert not result(watch).frequencies


def test_what_one_sensor_sees_alone_is_not_the_structure() -> None:
    assert not after(20, in_window(2, 0.05, slice(0, 1))).frequencies
    assert not after(20, in_window(2, 0.05, slice(0, 2))).frequencies


@pytest.mark.one_case
@pytest.mark.parametrize("see", [2, 3])
def test_a_frequency_that_fewer_than_three_sensors_see_is_not_told(see: int) -> None:
    site, watch = Frequencies(8), SiteWatch(GATEWAY, BANDS_HZ)
    for k in range(60):
        hours, _ = site.day(in_window(2, 0.03) if k >= 50 else 0.0)
        assert hours.frequency is not None
        peak = hours.frequency.copy()
        peak[:, see:, 2] = np.nan
        watch.update(day_of(replace(hours, frequency=peak), BANDS_HZ))
    assert len(result(watch).frequencies) == (see >= 3)


@pytest.mark.thorough
def test_sensors_that_see_another_mode_in_the_window_do_not_hide_the_change() -> None:
    """Of six, four see a mode that falls by 2 %, and two another one 9 % below it that stays."""
    site, watch = Frequencies(7), SiteWatch(GATEWAY, BANDS_HZ)
    for k in range(60):
        fallen = in_window(2, 0.09, slice(4, 6)) + in_window(2, 0.02 if k >= 50 else 0.0, slice(0, 4))
        watch.update(day_of(site.day(fallen)[0], BANDS_HZ))
    (told,) = result(watch).frequencies
    assert told.what.endswith("at 4 of 4 sensors")
    assert abs(told.size + 0.02) <= told.U


def test_what_bands_do_since_a_frequency_has_changed_is_told_of_no_sensor() -> None:
    """Amplitudes of a sensor that change on the day of the frequency, of all bands alike."""
    shift = np.zeros((N, len(BANDS_HZ), 3))
    shift[2] = -0.03
    assert after(10, 0.0, shift).sensors[2].kind == "sensitivity"
    found = after(10, in_window(0, 0.02), shift)
    assert len(found.frequencies) == 1
    assert [one.kind for one in found.sensors] == ["none"] * N


@pytest.mark.thorough
def test_a_sensor_that_changes_at_another_time_is_still_named() -> None:
    site, watch = fifty_days()
    shift = np.zeros((N, len(BANDS_HZ), 3))
    for k in range(50, 90):
        shift[2] = -0.03 if k >= 75 else 0.0
        watch.update(day_of(site.day(in_window(0, 0.02), shift)[0], BANDS_HZ))
    found = result(watch)
    assert (found.site.kind, found.sensors[2].kind) == ("structure", "sensitivity")
    assert found.least_detectable[0, 0] > after(40).least_detectable[0, 0], "two bands do not count"


@pytest.mark.thorough
def test_a_visit_does_not_touch_frequencies() -> None:
    site, watch = Frequencies(3), SiteWatch(GATEWAY, BANDS_HZ)
    for k in range(60):
        hours, _ = site.day(in_window(1, 0.02) if k >= 50 else 0.0)
        visits = Visits.unknown(np.full(N, k == 45))
        watch.update(day_of(hours, BANDS_HZ), visits)
    assert len(result(watch).frequencies) == 1


@pytest.mark.thorough
def test_days_of_results_without_frequencies_are_silent_on_them() -> None:
    site, watch = Frequencies(4), SiteWatch(GATEWAY, BANDS_HZ)
    for k in range(80):
        hours, _ = site.day(in_window(1, 0.02) if k >= 70 else 0.0)
        watch.update(day_of(hours if k >= 30 else replace(hours, frequency=None), BANDS_HZ))
        if k == 29:
            assert np.isfinite(watch.steps.beta).all()
            assert not result(watch).frequencies
    assert len(result(watch).frequencies) == 1


def test_the_frequency_of_a_day_needs_hours_and_clips_outliers() -> None:
    hours, own = Frequencies(5).day()
    assert hours.frequency is not None
    peak = hours.frequency.copy()
    peak[:, 0] += 0.001 * np.arange(24.0)[:, None, None] - 0.0115
    peak[3, 0] = 0.2
    peak[FEWEST_HOURS - 1 :, 1] = np.nan
    found = day_of(replace(hours, frequency=peak), BANDS_HZ).frequency
    assert found is not None
    assert found[0] == pytest.approx(np.repeat(own[0][:, None], 3, axis=1), abs=0.002)
    assert np.isnan(found[1]).all()
    assert found[2] == pytest.approx(np.repeat(own[2][:, None], 3, axis=1), abs=1e-12)


@pytest.mark.slow
def test_a_watch_of_frequencies_goes_on_from_its_snapshot() -> None:
    site, watch = Frequencies(6), SiteWatch(GATEWAY, BANDS_HZ)
    for _ in range(40):
        watch.update(day_of(site.day()[0], BANDS_HZ))
    again = SiteWatch.loaded(watch.snapshot())
    for _ in range(10):
        day = day_of(site.day(in_window(1, 0.02))[0], BANDS_HZ)
        watch.update(day)
        again.update(day)
    (told,), (other,) = result(watch).frequencies, result(again).frequencies
    assert (told.hz, told.size, told.U, told.statistic) == (other.hz, other.size, other.U, other.statistic)


def test_only_bands_that_a_mode_reaches_are_left_out() -> None:
    for hz, bands in ((2.0, [3]), (1.12, [0, 1]), (2.3, [3, 4]), (30.0, [])):
        found = moved_bands(BANDS_HZ, [type("Change", (), {"hz": hz})()])  # type: ignore[list-item]
        assert np.flatnonzero(found).tolist() == bands


def test_sensors_whose_bands_differ_say_nothing_of_their_gateway() -> None:
    """One of two sensors of the middle gateway shows +2 %; it moves the gateway only where it counts."""
    size, there = np.zeros((1, N, len(DIRECTIONS))), np.ones(N, dtype=bool)
    size[:, 2] = 0.02
    none = np.zeros((1, N, 1, 6))
    factor, pair = np.ones((1, 1, len(DIRECTIONS))), np.zeros(1, dtype=bool)
    left, freedom = np.zeros((1, N)), np.zeros((1, N), dtype=int)
    joint = JointChange(size, np.full_like(size, 0.002), none, none, size / 0.002, factor, pair, left, freedom)
    assert _means(joint, GATEWAY, there)[0][0] == pytest.approx([0.0, 0.01, 0.0])
    there[2] = False
    mean, u, fits = _means(joint, GATEWAY, there)
    assert mean[0] == pytest.approx([0.0, 0.0, 0.0])
    assert fits.all()
    assert u[0, 1] > u[0, 0]
