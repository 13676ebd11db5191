"""One tone along all axes moves the sensor on an ellipse, in a plane: du/dt is a sum of the channels of u there."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from calib.adjustment.response_by_band import at_the_middles
from calib.geometry import beside
from calib.model import Array, Window
from calib.recorded.alignment import drift, u_common_lag_s
from calib.windows.condense import condense
from calib.windows.excited import excited, excited_together
from calib.windows.sums import window_sums

RATE_HZ, TONE_HZ, N, NOISE_MPS2, OF_SENSOR = 100.0, 6.6, 500, 0.01, 0.01
OMEGA = 2.0 * np.pi * TONE_HZ
S = np.array([[1.01, 0.02, 0.0], [0.0, 0.99, -0.01], [0.03, 0.0, 1.02]])
THIN = np.array([[1.0, 0.98, -0.95], [0.0, 0.22, -0.33]])  # in phase, and 90 deg ahead


def window(ellipse: Array, seed: int, lag_s: float = 0.0, start_s: float = 0.0, size_mps2: float = 0.07) -> Window:
    """Five seconds of a tone that rises and falls, beside a tri-axial reference; `ellipse` (2, 3) in phase and ahead.
    The sensor comes late by `lag_s`, and feels a rest at `size_mps2` 0."""
    random, phase = np.random.default_rng(seed), OMEGA * np.arange(N)[:, None] / RATE_HZ
    late, level = phase - OMEGA * lag_s, size_mps2 * np.hanning(N)[:, None] ** 0.25
    a, felt = (level * (np.sin(at) * ellipse[0] + np.cos(at) * ellipse[1]) for at in (phase, late))
    da = OMEGA * level * (np.cos(phase) * ellipse[0] - np.sin(phase) * ellipse[1])
    noise = np.array([NOISE_MPS2, 30.0 * NOISE_MPS2])
    u, du = (x + sd * random.normal(size=x.shape) for x, sd in zip((a, da), noise, strict=True))
    V = felt @ S.T + [0.1, -0.2, 9.81] + OF_SENSOR * random.normal(size=a.shape)
    sums = window_sums(u, du, V, np.arange(0, N + 1, 50))
    kind: Literal["motion", "rest"] = "motion" if size_mps2 else "rest"
    return Window(
        start_s, start_s + N / RATE_HZ, beside(np.eye(3)), sums, True, "", N, 0, kind,
        reference_noise=np.repeat(noise[:, None], 3, axis=1),
    )  # fmt: skip


def test_the_noise_of_a_rest_is_that_of_its_outputs() -> None:
    """Segments of a channel that does not move have one mean, but for rounding errors. Taken for motion, these made the
    noise of 5 of 8 rests a hundred thousand times too large, so that they told nothing."""
    rests = [window(THIN, seed, size_mps2=0.0) for seed in range(40)]
    noise = condense(excited_together(rests)[0]).type_a.noise
    assert np.all(np.abs(noise / OF_SENSOR - 1.0) < 0.16)  # 500 points tell an SD to 3.2 %, five of those


def test_rests_tell_nothing_of_the_scatter_of_slopes() -> None:
    """Ten rests beside two motions made the scatter of the slopes a fifth of what it is, and U half of it."""
    circle = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    moved = [window(circle, seed, size_mps2=0.3) for seed in range(2)]
    rests = [window(circle, 10 + seed, size_mps2=0.0) for seed in range(10)]
    alone, beside_rests = (condense(excited_together(own)[0]).type_a for own in (moved, [*moved, *rests]))
    # The unit of the scores is the noise of all windows; that of a motion has the reference's noise too: 1.4 times.
    told, by_rests = (np.diag(own.slopes).reshape(-1, 3)[:2, :2] for own in (alone, beside_rests))  # x and y, on both
    unit2, of_rests = (np.mean(own.noise[:, :2] ** 2, axis=0) for own in (alone, beside_rests))
    assert by_rests == pytest.approx(told * unit2 / of_rests, rel=0.05)


def test_such_a_window_has_no_lag_and_shows_no_drift_of_the_clock() -> None:
    """Three tones on other ellipses, 50 s apart, by a sensor that is 9 ms late: the lags of their own that they seem to
    have were taken for clocks that run apart by 60 ppm, and S was wrong by 8 u."""
    random = np.random.default_rng(1)
    made = [window(random.normal(size=(2, 3)), k, 9e-3, 50.0 * k, 0.5) for k in range(3)]
    assert all(u_common_lag_s(w) == np.inf for w in made)
    assert drift(made) is None


def test_a_tone_along_a_line_tells_its_lag() -> None:
    line = np.array([[0.6, -0.64, 0.48], [0.0, 0.0, 0.0]])
    made = [window(line, k, 2e-3, 50.0 * k, 2.0) for k in range(3)]
    found = drift(made)
    assert found is not None
    assert not found.significant
    assert found.lag_s == pytest.approx(2e-3, abs=6e-5)  # 30 us from noise


def test_a_thin_ellipse_is_a_line_and_what_it_surely_shares() -> None:
    """The live channel of a line indicates itself, whatever motion beside the line is added to it. Before, that motion
    counted in it too: lags of 5, 10 and 13 ms were found for 9 ms, and S was 2.6 times its u off."""
    found, ways = excited_together([window(THIN, seed) for seed in range(30)])
    assert ways.shape == (3, 1)
    along, ahead = [], []
    for own in found:
        (k,) = np.flatnonzero(own.live)
        assert own.pose.along is not None
        assert own.pose.along_rate_s is not None
        assert own.pose.along[k, k] == pytest.approx(1.0, abs=1e-12)
        assert own.pose.along_rate_s[k, k] == pytest.approx(0.0, abs=1e-15)
        if k == 0:
            along.append(own.pose.along[:, 0])
            ahead.append(OMEGA * own.pose.along_rate_s[:, 0])
    # Noise of 0.01 over 0.045 m/s2 and 500 points: 1.4 % for each of them with that of the live channel, four of those
    within = 4.0 * 0.014 / np.sqrt(len(along))
    assert np.mean(along, axis=0) == pytest.approx(THIN[0], abs=within)
    assert np.mean(ahead, axis=0) == pytest.approx(THIN[1], abs=within)


@pytest.mark.slow
@pytest.mark.parametrize("of_reference", [0.5, 1.0, 3.0])
def test_u_of_slopes_has_the_noise_of_channels_that_only_share(of_reference: float) -> None:
    """A tone along x, in 200 windows: what moves along y is known to the reference's noise there, beside that of V.
    Scores of residuals have none of it, so their scatter must not be told in units that have it."""
    made = []
    for seed in range(200):
        random, t = np.random.default_rng([9, seed]), np.arange(N) / RATE_HZ
        a, da = (size * np.outer(wave(OMEGA * t), [1.0, 0.02, 0.0]) for size, wave in ((1.0, np.sin), (OMEGA, np.cos)))
        sd = of_reference * OF_SENSOR
        u, du = a + sd * random.normal(size=a.shape), da + 30.0 * sd * random.normal(size=a.shape)
        V = a @ S.T + OF_SENSOR * random.normal(size=a.shape)
        sums = window_sums(u, du, V, np.arange(0, N + 1, 50))
        noise = np.array([np.full(3, sd), np.full(3, 30.0 * sd)])
        made.append(excited(Window(0.0, 5.0, beside(np.eye(3)), sums, True, "", N, 0, reference_noise=noise)))
        assert made[-1].live.tolist() == [True, False, False]
    data = condense(made)
    along = np.array([own.pose.along[:, 0] for own in made if own.pose.along is not None])
    away = data.slopes[:, 0] - data.root[:, 0, 0, None] * (along @ S.T)
    z = away / (data.type_a.noise * np.sqrt(np.diag(data.type_a.slopes)[:3]))
    # x: S_xx with the noise of its own channel. 400 squares: their mean is 1 within 3.3 times sqrt(2 / 400); S moves
    # the noise between axes by some per cent
    assert np.mean(np.square(z[:, 1:])) == pytest.approx(1.0, abs=0.25)


def test_a_tone_that_shows_in_two_bands_tells_no_slope_between_them() -> None:
    """At the common end of two bands it is motion at almost one frequency in both; the slope overflowed."""
    random = np.random.default_rng(3)
    at_hz = np.array([10.0, 10.0 + 1e-9, 12.0])
    left = np.exp(random.normal(size=(3, 3, 3))) + 0j
    told = at_the_middles(left, at_hz, np.array([9.4, 10.6, 12.0]))
    assert np.isfinite(told).all()
    np.testing.assert_array_equal(told[:2], left[:2])
