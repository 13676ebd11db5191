"""Knocks of the sensor alone cost their own samples and no others; what the reference shows as well is no knock."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from calib.excitation.front_end import Aligned, Settings, aligned, windows_of
from calib.excitation.knocks import knocks
from calib.excitation.window_verdict import DEFAULT_LIMITS, Limits
from calib.excitation.windows import Points, motion_windows
from calib.geometry import beside, clamp
from calib.model import Array
from calib.recorded.outcome import Outcome
from calib.signal.instrument import Instrument
from calib.signal.samples import Samples
from calib.signal.stamps import clock_from_stamps
from tests.stays import errors, in_batches, knocked, main_errors_pct, stays

RATE_HZ, SECONDS, MARGIN_S, NOISE = 200.0, 60.0, 2.0, 0.01
SPAN_S = (MARGIN_S, MARGIN_S + SECONDS)
SEEDS = range(3)


def rms(outcomes: list[Outcome]) -> float:
    return float(np.sqrt(np.mean([main_errors_pct(found) ** 2 for found in outcomes])))


@pytest.mark.thorough
def test_a_bench_with_knocks_is_as_good_as_without() -> None:
    """One knock of 20 ms a second, behind a clock that is 1.3 % off and stamps in batches of 32 with 2 ms of jitter.

    Spread by the filter, the knocks cost two to four of the four stays.
    """
    clean, struck = list[Any](), list[Any]()
    for seed in SEEDS:
        late_s = np.abs(np.random.default_rng(seed).normal(0.0, 2e-3, 2000))
        for outcomes, hits in ((clean, None), (struck, knocked(1.0))):
            of = stays(seed, rate_hz=1013.0, on_s=12.6, struck=hits)
            outcomes.append(of.calibrated(in_batches(of.time_s, 32, late_s[: len(of.time_s) // 32 + 1])))
    for whole, found in zip(clean, struck, strict=True):
        assert np.abs(errors(found) / found.expanded_uncertainty).max() < 1.0
        assert (found.expanded_uncertainty < 1.1 * whole.expanded_uncertainty).all()
        points, left_out = (sum(getattr(w, name) for w in found.windows if w.used) for name in ("points", "left_out"))
        assert points + left_out == sum(w.points for w in whole.windows if w.used)
        assert 0.005 < left_out / (points + left_out) < 0.03  # 2 % of the time on average
    assert rms(struck) < 1.5 * rms(clean)


class Made:
    """A sensor and a tri-axial reference that move together, 0.5 to 10 Hz; both feel `blows` besides."""

    def __init__(self, seed: int = 1, *, blows: Array | None = None, corner_hz: float = np.inf) -> None:
        self.random = np.random.default_rng(seed)
        self.n = round((SECONDS + 2.0 * MARGIN_S) * RATE_HZ)
        hz = np.fft.rfftfreq(self.n, 1.0 / RATE_HZ)
        lines = self.random.normal(size=(len(hz), 3)) + 1j * self.random.normal(size=(len(hz), 3))
        lines[(hz < 0.5) | (hz > 10.0)] = 0.0
        motion = np.fft.irfft(lines, self.n, axis=0)
        self.u = motion / motion.std() + (0.0 if blows is None else blows)
        passed = 1.0 / (1.0 + np.sqrt(2.0) * 1j * hz / corner_hz - (hz / corner_hz) ** 2)
        felt = np.fft.irfft(np.fft.rfft(self.u, axis=0) * passed[:, None], self.n, axis=0)
        self.V = felt + NOISE * self.random.normal(size=(self.n, 3))
        self.at_s = np.arange(self.n) / RATE_HZ

    def ring(self, begin_s: Array, size: float, lasts_s: float = 0.03, hz: float = 40.0) -> Array:
        """(n, 3) decaying rings that begin at these times, in random directions."""
        out = np.zeros((self.n, 3))
        for begin in begin_s:
            after = np.maximum(self.at_s - begin, 0.0)
            direction = self.random.normal(size=3)
            shape = np.exp(-after / lasts_s) * np.sin(2.0 * np.pi * hz * after) * (after > 0.0)
            out += np.outer(size * shape, direction / np.linalg.norm(direction))
        return out

    def samples(self, V: Array | None = None, u: Array | None = None) -> tuple[Samples, Samples]:
        clock = clock_from_stamps(self.at_s)
        return Samples("s", 0, self.V if V is None else V, clock), Samples("r", 0, self.u if u is None else u, clock)

    def found(self, V: Array | None = None, u: Array | None = None, **settings: object) -> Aligned:
        made = aligned(*self.samples(V, u), Instrument(), SPAN_S, settings=Settings(to_hz=15.0, **settings))  # type: ignore[arg-type]
        assert made is not None
        return made

    def flagged(self, V: Array) -> np.ndarray:  # type: ignore[type-arg]
        """Which samples are knocks."""
        du = np.gradient(self.u, 1.0 / RATE_HZ, axis=0)
        inside = (self.at_s >= SPAN_S[0]) & (self.at_s < SPAN_S[1])
        return knocks(np.hstack([V, self.u, du]), inside, RATE_HZ)[0]


def slopes(found: Aligned) -> Array:
    points = found.points
    whole = np.ones(len(points.V), dtype=bool) if points.struck is None else ~points.struck
    basis = np.column_stack([np.ones(len(points.V)), points.u, points.du])[whole]
    return np.linalg.lstsq(basis, points.V[whole], rcond=None)[0][1:4].T


def test_a_filter_spreads_no_knock_and_the_samples_of_the_sensor_stay_what_they_are() -> None:
    made = Made()
    hits = made.ring(np.array([10.0, 25.1, 25.4, 50.0]), 8.0)
    struck = made.V + hits
    before = struck.copy()
    clean, found = made.found(), made.found(struck)
    np.testing.assert_array_equal(struck, before)
    assert clean.points.struck is None
    assert found.points.struck is not None
    hit = np.abs(hits).max(axis=1) > 5.0 * NOISE
    at = np.round(found.points.time_s * RATE_HZ).astype(int)
    assert found.points.struck[hit[at]].all()
    assert found.points.struck.sum() < 2 * hit[at].sum()
    # What is not struck is as without knocks: the filter makes 0.004 of the noise.
    away = np.abs(found.points.V - clean.points.V)[~found.points.struck]
    assert away.max() < 0.03
    np.testing.assert_allclose(slopes(found), slopes(clean), rtol=0, atol=3e-4)
    assert made.found(struck, leave_out=False).points.struck is None


def test_knocks_beside_missing_samples_and_at_the_ends_of_the_stretch() -> None:
    """Holes are filled as without knocks; knocks just outside the stretch do not reach into it."""
    made = Made(2)
    begin_s = np.array([SPAN_S[0] - 0.05, 20.0, SPAN_S[1] - 0.02, SPAN_S[1] + 0.03])
    lost = made.random.choice(made.n, 60, replace=False)
    holes = made.V.copy()
    holes[lost] = np.nan
    holes[round(20.0 * RATE_HZ) + 1] = np.nan
    clean, found = made.found(holes), made.found(holes + made.ring(begin_s, 8.0))
    assert found.filled["filled_samples"] >= clean.filled["filled_samples"] - 2
    np.testing.assert_array_equal(found.points.time_s[[0, -1]], clean.points.time_s[[0, -1]])
    common = np.isin(found.points.time_s, clean.points.time_s)
    assert common.mean() > 0.99
    assert found.points.struck is not None
    ours = found.points.V[common & ~found.points.struck]
    theirs = clean.points.V[np.searchsorted(clean.points.time_s, found.points.time_s[common & ~found.points.struck])]
    assert np.abs(ours - theirs).max() < 0.03


def test_a_knock_of_which_the_reference_feels_a_part() -> None:
    made = Made(3)
    hits = made.ring(np.array([8.0, 21.0, 33.0, 47.0]), 8.0)
    u = made.u + 0.1 * hits
    clean, found = made.found(), made.found(made.V + hits, u)
    assert found.points.struck is not None
    np.testing.assert_allclose(slopes(found), slopes(clean), rtol=0, atol=1e-3)


@pytest.mark.parametrize("corner_hz", [np.inf, 50.0])
@pytest.mark.parametrize("hz", [15.0, 40.0])
def test_what_the_reference_feels_as_well_is_no_knock(corner_hz: float, hz: float) -> None:
    """Blows to the structure: the filter of the sensor, which nobody has taken out yet, makes the residual large."""
    begin_s = np.array([5.0, 17.0, 18.0, 40.0])
    made = Made(4, blows=Made(4).ring(begin_s, 20.0, 0.1, hz), corner_hz=corner_hz)
    assert not made.flagged(made.V).any()


def test_a_mount_that_rings_where_the_motion_is_strong_is_no_knock() -> None:
    """What rattles is refused or not as before: knocks at strong motion are the mount's."""
    made = Made(5)
    strong = np.flatnonzero(np.diff(np.abs(made.u[:, 0]) > 2.5, prepend=False) & (np.abs(made.u[:, 0]) > 2.5))
    begin_s = made.at_s[strong]
    assert 10 < len(begin_s) < 60
    assert not made.flagged(made.V + made.ring(begin_s, 2.0, 0.005)).any()
    elsewhere_s = made.random.uniform(0.0, made.at_s[-1], len(begin_s))
    assert made.flagged(made.V + made.ring(elsewhere_s, 2.0, 0.005)).any()


@pytest.mark.parametrize("seed", range(3))
def test_a_residual_with_all_sizes_is_not_made_of_knocks(seed: int) -> None:
    """As a loose part that rings longer than from hit to hit, at a low rate: its strongest hits alone are no knocks."""
    made = Made(seed)
    V = made.V + 0.05 * made.random.standard_t(1.5, size=made.V.shape)
    assert not made.flagged(V).any()


@pytest.mark.parametrize("begin_s", [30.0, SPAN_S[1] - 1.5])
def test_a_slip_is_no_knock_and_a_knock_before_it_hides_none(begin_s: float) -> None:
    made = Made(6)
    slipped = made.V + np.where(made.at_s > begin_s, 0.5, 0.0)[:, None]
    assert not made.flagged(slipped).any()
    flagged = made.flagged(slipped + made.ring(np.array([begin_s]), 8.0))
    assert not flagged[made.at_s > begin_s + 0.2].any()


def test_more_knocks_than_a_window_may_have_refuse_it() -> None:
    made = Made(7)
    hits = made.ring(made.random.uniform(0.0, made.at_s[-1], 200), 8.0)
    [window] = windows_of(beside(np.eye(3)), *made.samples(made.V + hits), Instrument(), SPAN_S)
    assert not window.used


def test_peaks_of_a_sine_and_chance_are_no_knocks() -> None:
    """At a resolution of 0.05 m/s2 as well; and with an output that is twice the motion."""
    made = Made(8)
    tone = 5.0 * np.sin(2.0 * np.pi * 3.0 * made.at_s)[:, None] * np.array([1.0, 0.5, 0.2])
    made.u = tone
    for V in (tone, 2.0 * tone + NOISE * made.random.normal(size=tone.shape), np.round(tone / 0.05) * 0.05):
        assert not made.flagged(V).any()


def test_the_sensor_turned_before_and_after_the_stretch_is_left_as_it_is() -> None:
    made = Made(9)
    turned = made.V + np.where((made.at_s < SPAN_S[0]) | (made.at_s >= SPAN_S[1]), 3.0, 0.0)[:, None]
    assert not made.flagged(turned).any()
    flagged = made.flagged(turned + made.ring(np.array([30.0]), 8.0))
    assert flagged.any()
    assert not flagged[(made.at_s < 29.9) | (made.at_s > 30.5)].any()


@pytest.mark.parametrize("limits", [DEFAULT_LIMITS, DEFAULT_LIMITS.of_any_response])
def test_a_window_of_knocks_alone_is_refused(limits: Limits) -> None:
    """A piece between two knocks that lies within what both leave out; there is nothing that sums can be made of."""
    t = np.arange(400) / 100.0
    u = np.sin(2.0 * np.pi * 3.0 * t)[:, None]
    du = 6.0 * np.pi * np.cos(6.0 * np.pi * t)[:, None]
    points = Points(t, u * [0.6, 0.64, 0.48], u, du, np.ones(len(t), dtype=bool))
    found = motion_windows(clamp(0.5, 0.3), points, limits)
    assert found
    assert not any(window.used for window in found)
    assert "100.0 % of the points are knocks" in found[0].reason
