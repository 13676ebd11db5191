"""Windows and their verdicts: each fault that a window may have is found, named and counted; a good one is whole."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from calib.excitation import detection
from calib.excitation.window_verdict import Limits, judge
from calib.excitation.windows import Points, motion_parts, motion_windows
from calib.geometry import along, beside, clamp
from calib.model import Window, WindowSums
from calib.signal.corner import with_integral

RATE_HZ = 500.0
S = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
POSE = clamp(np.radians(35), np.radians(30))


def sine(n: int, frequency_hz: float = 3.0, size: float = 5.0) -> tuple[np.ndarray, np.ndarray]:
    omega = 2 * np.pi * frequency_hz
    t = np.arange(n) / RATE_HZ
    return size * np.sin(omega * t)[:, None], size * omega * np.cos(omega * t)[:, None]


def points(seconds: float = 8.0, noise: float = 0.02, reference_noise: float = 0.002, seed: int = 1) -> Points:
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE_HZ)
    u, du = sine(n)
    V = (u @ POSE.direction.T + POSE.gravity_mps2) @ S.T + 0.1 + noise * rng.normal(size=(n, 3))
    return Points(100.0 + np.arange(n) / RATE_HZ, V, u + reference_noise * rng.normal(size=u.shape), du)


def only(windows: list[Window]) -> Window:
    assert len(windows) == 1, [(w.kind, w.start_s, w.stop_s) for w in windows]
    return windows[0]


def test_a_good_window_is_used_whole() -> None:
    data = points()
    window = only(motion_windows(POSE, data))
    assert window.used, window.reason
    assert (window.kind, window.points, window.left_out, window.reason) == ("motion", 4000, 0, "")
    assert (window.start_s, window.stop_s) == (data.time_s[0], data.time_s[-1])
    assert len(window.sums.count) == 16
    n = window.numbers
    assert n["reference_rms_mps2"] == pytest.approx(5 / np.sqrt(2), rel=0.02)
    assert n["reference_noise_mps2"] == pytest.approx(0.002 / np.sqrt(10), rel=0.1)
    assert n["coherence"] > 0.999
    assert n["drift_mps2"] < 0.02


def test_slow_motion_beside_an_engine_is_one_window_whatever_its_integral_does() -> None:
    """Waves of 9 s on a platform with an engine, beside an AC-coupled reference: its integral (calib.signal.corner)
    shows the waves alone, which are calm twice in a period. Before, the window was cut there."""
    t = np.arange(60 * 200) / 200.0
    waves, engine = 2.0 * np.pi / 9.0, 2.0 * np.pi * 25.0
    u = 0.05 * np.sin(waves * t) + 0.05 * np.sin(engine * t)
    du = 0.05 * waves * np.cos(waves * t) + 0.05 * engine * np.cos(engine * t)
    integral = -2.0 * np.pi * 0.05 / waves * np.cos(waves * t)
    V = u[:, None] * S[:, 0] + 1e-3 * np.random.default_rng(1).normal(size=(len(t), 3))
    beside_it = with_integral(along([1.0, 0.0, 0.0]))
    window = only(motion_windows(beside_it, Points(t, V, np.column_stack([u, integral]), np.column_stack([du, u]))))
    assert window.used, window.reason
    assert window.numbers["reference_rms_mps2"] == pytest.approx(0.05, rel=0.1)  # 0.3 with the integral


def knock(data: Points, at: int, size: float, length: int = 10) -> None:
    data.V[at : at + length] += size * np.sin(np.pi * np.arange(length) / length)[:, None]


def test_knocks_are_left_out_and_counted() -> None:
    data = points()
    for at in range(200, 3800, 400):
        knock(data, at, 6.0)
    window = only(motion_windows(POSE, data))
    assert window.used, window.reason
    assert 9 * 8 <= window.left_out <= 9 * 10 + 3
    assert window.points == 4000 - window.left_out
    assert window.numbers["left_out_pct"] == pytest.approx(100 * window.left_out / 4000)


def test_small_knocks_are_found_behind_large_ones() -> None:
    """Blows at every crest pull the first regression so far that a point 10 SD off hides in it."""
    data = points()
    crests = np.flatnonzero(data.u[:, 0] > 4.99)
    data.V[crests] += 300.0
    small = [500, 1234, 2345]
    data.V[small] += 0.25
    basis = np.column_stack([np.ones(len(data.u)), data.u, data.du])
    struck, _ = detection.knocked(data.V, basis, np.zeros(3))
    assert struck[crests].all()
    assert struck[small].all()
    assert struck.sum() <= len(crests) + len(small) + 1


def test_knocks_stay_in_plain_sums_but_not_in_the_verdict() -> None:
    data = points()
    knock(data, 1000, 15.0, 60)  # 4 m/s2 of drift in its half second, were it not left out
    window = only(motion_windows(POSE, data, leave_out=False))
    assert window.used, window.reason
    assert (window.points, window.left_out) == (4000, 0)
    assert window.sums.count.sum() == 4000


def test_white_noise_is_no_knock() -> None:
    # 5 robust SDs: 5.7e-7 of normal points a side and axis, so of 3 x 200 000 points 0.34 on average; 6 has p < 1e-5.
    V = np.random.default_rng(3).normal(size=(200_000, 3))
    struck, residual = detection.knocked(V, np.ones((len(V), 1)), detection.least_step(V))
    assert struck.sum() <= 6
    np.testing.assert_allclose(residual, V - V[~struck].mean(axis=0), atol=1e-12)


@pytest.mark.parametrize("pairs", [500, 501])
@pytest.mark.parametrize(("times", "knocks"), [(1.0 - 1e-9, 0), (1.0 + 1e-9, 2)])
def test_the_limit_is_exact(pairs: int, times: float, knocks: int) -> None:
    """A pair of opposite values just below or just beyond five robust SDs."""
    half = np.random.default_rng(pairs).normal(size=(pairs, 3))
    half[np.abs(half) > 3.0] = 1.0
    for _ in range(2):  # the pair itself counts in the median
        half[7, 1] = times * detection.KNOCK_SD * 1.4826 * np.median(np.abs(half[:, 1]))
    V = np.concatenate([half, -half])
    struck, _ = detection.knocked(V, np.ones((len(V), 1)), np.zeros(3))
    assert np.flatnonzero(struck).tolist() == [7, 7 + pairs][:knocks]


def test_counts_that_hardly_change_are_no_knocks() -> None:
    V = np.zeros((5000, 3))
    V[::100] = 1.0  # one in a hundred a count higher: the median deviation is 0
    struck, _ = detection.knocked(V, np.ones((len(V), 1)), detection.least_step(V))
    assert not struck.any()


def quantised(data: Points, step: float) -> Points:
    return data._replace(V=np.round(data.V / step) * step)


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("step", [1e-4, 0.04])
def test_clipping_is_found_at_any_resolution_and_quantisation_is_none(step: float, noise: float) -> None:
    good = quantised(points(noise=noise, reference_noise=1e-6), step)
    assert only(motion_windows(POSE, good)).used
    top = np.quantile(good.V[:, 1], 0.85)
    bad = good._replace(V=np.minimum(good.V, [np.inf, top, np.inf]))
    window = only(motion_windows(POSE, bad))
    assert not window.used
    assert window.reason.startswith("clipped: ")
    assert window.numbers["clipped_points"] >= 0.14 * 4000


@pytest.mark.parametrize("step", [0.1, 0.3, 0.7])
def test_coarse_counts_are_not_clipped(step: float) -> None:
    assert only(motion_windows(POSE, quantised(points(noise=0.0, reference_noise=1e-6), step))).used


def test_a_sweep_whose_residual_grows_with_the_motion_is_not_clipped() -> None:
    """The largest values of a sweep with constant displacement come at its end, where a filter takes most of them."""
    rate_hz, seconds = 200.0, 20.0
    t = np.arange(round(rate_hz * seconds)) / rate_hz
    times = 8.0 ** np.minimum(t / seconds, 0.9)  # the frequency over that at the beginning; its last 2 s are a tone
    level = (times / times[-1]) ** 2
    u = level * np.sin(2.0 * np.pi * 2.0 * np.cumsum(times) / rate_hz)
    V = 3.0 * np.column_stack([0.02 * u, u, 0.1 * u]) * (1.0 - 0.05 * level)[:, None]
    V += 0.003 * np.random.default_rng(4).standard_normal(V.shape)
    V = np.round(V / 0.01) * 0.01
    basis = np.column_stack([np.ones(len(t)), u, np.gradient(u, t)])
    finest = detection.least_step(V)
    assert (V[:, 1] == V[:, 1].max()).sum() >= 3
    _, residual = detection.knocked(V, basis, finest)
    assert detection.clipped(V, residual, finest) == 0
    flat = np.minimum(V, [np.inf, 0.97 * V[:, 1].max(), np.inf])
    _, residual = detection.knocked(flat, basis, finest)
    assert detection.clipped(flat, residual, finest) > 3


def dead(data: Points) -> Points:
    rng = np.random.default_rng(5)
    return data._replace(u=0.01 * rng.normal(size=data.u.shape), du=np.zeros_like(data.du))


def constant(data: Points) -> Points:
    return data._replace(u=np.full_like(data.u, 0.3), du=np.zeros_like(data.du))


def unrelated(data: Points) -> Points:
    other, slope = sine(len(data.u), 2.3)
    return data._replace(u=other, du=slope)


def turned(data: Points) -> Points:
    half = len(data.V) // 2
    return data._replace(V=data.V + np.where(np.arange(len(data.V)) > half, 1.5, 0.0)[:, None])


def shaken_out(data: Points) -> Points:
    rng = np.random.default_rng(6)
    out = rng.random(len(data.V)) < 0.08
    return data._replace(V=data.V + np.where(out, 5.0, 0.0)[:, None])


def short(data: Points) -> Points:
    return data.part(0, 20)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (dead, "the reference is silent"),
        (constant, "the reference is silent"),
        (unrelated, "the sensor does not follow the reference"),
        (turned, "the sensor's mean changes by"),
        (shaken_out, "of the points are knocks"),
        (short, "too few points: 20, 30 needed"),
    ],
)
def test_a_bad_window_is_refused_with_its_reason(spoil: Callable[[Points], Points], reason: str) -> None:
    windows = motion_windows(POSE, spoil(points()))
    assert windows
    for window in windows:
        assert not window.used
        assert reason in window.reason


def test_a_sensor_that_lags_still_follows() -> None:
    data = points()
    late = data._replace(V=np.roll(data.V, 5, axis=0))  # 10 ms, 11 deg at 3 Hz
    window = motion_windows(POSE, late)[0]
    assert window.used, window.reason
    assert window.numbers["coherence"] > 0.99


def test_missing_samples_part_windows() -> None:
    data = points()
    kept = np.r_[0:1500, 1700:4000]
    windows = motion_windows(POSE, data.at(kept))
    assert [w.points for w in windows] == [1500, 2300]
    assert all(w.used for w in windows)


def test_long_motion_is_cut_into_equal_windows() -> None:
    windows = motion_windows(POSE, points(150.0))
    assert [w.points for w in windows] == [25_000] * 3


def test_motion_that_begins_late_and_pauses() -> None:
    moving = np.ones(int(40 * RATE_HZ))
    for start, stop in ((0, 5), (15, 15.6), (20, 26)):
        moving[int(start * RATE_HZ) : int(stop * RATE_HZ)] = 0.0
    u, _ = sine(len(moving))
    u = u * moving[:, None] + 0.01 * np.random.default_rng(7).normal(size=u.shape)
    parts = motion_parts(u, RATE_HZ, detection.white_noise(u))
    assert [kind for kind, _, _ in parts] == ["quiet", "motion", "quiet", "motion"]
    edges = np.array([[a, b] for _, a, b in parts]) / RATE_HZ
    np.testing.assert_allclose(edges, [[0, 5], [5, 20], [20, 26], [26, 40]], atol=0.26)  # a frame


def test_weak_tri_axial_motion_half_of_it_calm() -> None:
    """Level 0.02 m/s2 rms and a reference noise of 0.006: the calm half is told apart though its noise is a third."""
    rng = np.random.default_rng(8)
    n = int(600 * RATE_HZ)
    level = np.where(np.arange(n) // int(100 * RATE_HZ) % 2 == 0, 1.0, 0.15)
    t = np.arange(n) / RATE_HZ
    u = np.zeros((n, 3))
    for f in (1.3, 2.1, 3.4, 5.2, 7.7):
        u += np.sin(2 * np.pi * f * t[:, None] + rng.uniform(0, 6.28, 3)) * 0.02 / np.sqrt(15 / 2) * level[:, None]
    shown = u + 0.006 / np.sqrt(3) * rng.normal(size=u.shape)
    parts = motion_parts(shown, RATE_HZ, detection.white_noise(shown))
    assert [kind for kind, _, _ in parts] == ["motion", "quiet"] * 3
    np.testing.assert_allclose([a / RATE_HZ for _, a, _ in parts], np.arange(0, 600, 100), atol=1.1)
    du = np.asarray(np.gradient(u, axis=0)) * RATE_HZ
    quiet = Points(t, u @ S.T, u, du).part(*parts[1][1:])
    window = motion_windows(beside(np.eye(3)), quiet._replace(u=quiet.u + 0.006 * rng.normal(size=quiet.u.shape)))[0]
    assert not window.used


def test_a_calm_part_is_not_used_though_it_would_do() -> None:
    level = np.where(np.arange(10_000) < 5000, 1.0, 0.2)[:, None]
    u, du = sine(10_000)
    V = u * level @ POSE.direction.T + 0.01 * np.random.default_rng(10).normal(size=(10_000, 3))
    loud, calm = motion_windows(POSE, Points(np.arange(10_000) / RATE_HZ, V, u * level, du * level))
    assert (loud.kind, loud.used) == ("motion", True)
    assert (calm.kind, calm.used, calm.reason) == ("quiet", False, "the reference is calm here")
    assert calm.numbers["coherence"] > 0.99


def test_vibration_above_the_slow_band_is_motion_too() -> None:
    u, du = sine(2000, 100.0)
    V = u @ along([1.0, 0.0, 0.0]).direction.T + 0.01 * np.random.default_rng(9).normal(size=(2000, 3))
    window = only(motion_windows(along([1.0, 0.0, 0.0]), Points(np.arange(2000) / RATE_HZ, V, u, du)))
    assert window.used, window.reason
    assert window.numbers["reference_rms_mps2"] == pytest.approx(5 / np.sqrt(2), rel=0.01)


def test_what_a_verdict_rests_on_stands_beside_it() -> None:
    sums = WindowSums(0, np.array([10.0]), np.zeros((1, 3)), np.zeros((1, 3, 3)))
    numbers = {
        "reference_rms_mps2": 2.0,
        "reference_noise_mps2": 0.1,
        "coherence": 0.9,
        "drift_mps2": 0.1,
        "clipped_points": 0.0,
        "stuck_axes": 0.0,
    }
    limits = Limits(least_points=5, least_level=4.0, most_drift_pct=20.0)
    verdict = judge(sums, np.zeros(10, dtype=bool), numbers, limits)
    assert verdict.used
    held = {name.removesuffix("_threshold") for name in verdict.numbers if name.endswith("_threshold")}
    judged = {"reference_rms_mps2", "coherence", "drift_mps2", "clipped_points", "stuck_axes"}
    assert held == {"points", "left_out_pct"} | judged
    assert verdict.numbers["reference_rms_mps2_threshold"] == pytest.approx(0.4)
    assert verdict.numbers["drift_mps2_threshold"] == pytest.approx(0.4)
    silent = judge(sums, np.zeros(10, dtype=bool), numbers | {"reference_rms_mps2": 0.39}, limits)
    assert not silent.used
    assert "silent" in silent.reason


def test_an_axis_that_never_changes_is_dead() -> None:
    random, t = np.random.default_rng(1), np.arange(2000) / 100.0
    u = np.sin(2 * np.pi * 2.0 * t)[:, None]
    V = np.column_stack([u[:, 0], np.full(len(t), 0.3), 0.2 * u[:, 0]]) + np.outer(
        random.normal(size=len(t)), [0.01, 0, 0.01]
    )
    pose = along([1.0, 0.0, 0.0], [0.0, 0.0, 9.8])
    (window,) = motion_windows(pose, Points(t, V, u, np.gradient(u[:, 0], t)[:, None]))
    assert not window.used
    assert window.reason == "dead: the output of 1 of the sensor's axes does not change at all"


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.0005, 1.0), longest_s=st.floats(0.01, 60.0))
@settings(max_examples=60)
@example(seed=0, share=0.0625, longest_s=0.0625)
def test_of_whatever_samples_are_left_windows_are_made(seed: int, share: float, longest_s: float) -> None:
    random = np.random.default_rng(seed)
    data = points()
    kept = np.flatnonzero(random.random(len(data.V)) < share)
    if len(kept) < 2:
        kept = np.array([0, len(data.V) - 1])
    left = data.at(kept)
    windows = motion_windows(POSE, left, Limits(longest_s=longest_s))
    assert sum(w.points + w.left_out for w in windows) <= len(kept)
    assert all(w.stop_s > w.start_s for w in windows)
