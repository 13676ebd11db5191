"""A window in which the sensor slips is refused at the level of the stated uncertainties; noise and knocks are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agent.core.events import WindowReport
from benchmarks.online import bench
from benchmarks.online.clamp import bench_events
from benchmarks.online.runner import Run
from calib.excitation.steadiness import step
from calib.excitation.window_verdict import Limits
from calib.excitation.windows import Points, motion_windows, rest_window
from calib.geometry import along, at_rest
from calib.model import Array, Window
from hw.virtual.bench import Bench
from hw.virtual.parameters import Slip
from hw.virtual.schedule import STANDARD_GRAVITY_MPS2

RATE_HZ, SECONDS = 200.0, 24
STATED = Limits.of(0.05, np.deg2rad(0.2))  # the defaults: a step of 0.121 m/s2 at most
SLIP_MPS2 = STANDARD_GRAVITY_MPS2 * np.sin(np.deg2rad(35.0)) * np.deg2rad(1.5)  # 0.147: alpha at theta = 35 deg


def moved(added: Array, seed: int = 1) -> Window:
    """A window of 2 m/s2 at 3 Hz, with `added` (n,) on the output x."""
    t = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    u, du = 2.0 * np.sin(6.0 * np.pi * t), 12.0 * np.pi * np.cos(6.0 * np.pi * t)
    V = np.outer(u, [0.6, 0.8, 0.1]) + 0.01 * np.random.default_rng(seed).normal(size=(len(t), 3))
    V[:, 0] += added
    (window,) = motion_windows(along([0.6, 0.8, 0.0], [0.0, 0.0, 9.8]), Points(t, V, u[:, None], du[:, None]), STATED)
    return window


def stepped(share: float, size_mps2: float) -> Array:
    """A step after this share of the window."""
    n = round(SECONDS * RATE_HZ)
    return np.where(np.arange(n) < share * n, 0.0, size_mps2)


@pytest.mark.parametrize("share", [0.06, 0.12, 0.5, 0.8, 0.95])
def test_a_slip_anywhere_in_a_window_refuses_it(share: float) -> None:
    """Also where the shorter part looks like knocks, which would be left out by whole segments."""
    window = moved(stepped(share, SLIP_MPS2))
    assert not window.used
    assert "from one part of the window to the other, 0.121 m/s2 at most" in window.reason
    assert window.numbers["step_mps2"] == pytest.approx(SLIP_MPS2, rel=0.1)


def test_a_step_within_what_is_stated_is_none() -> None:
    assert moved(stepped(0.5, 0.1)).used


def test_noise_and_knocks_are_no_slip() -> None:
    random = np.random.default_rng(2)
    for seed in range(20):
        knocks = np.zeros(round(SECONDS * RATE_HZ))
        knocks[random.integers(0, len(knocks), 40)] = random.uniform(1.0, 8.0, 40)  # all in one direction
        window = moved(knocks, seed)
        assert window.used, window.reason
        assert window.numbers["step_mps2"] < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [5, 24])
def test_a_step_of_noise_is_as_large_as_its_uncertainty_says(blocks: int) -> None:
    """2000 windows of white noise, each divided where its step is largest: some 1.5 u, and hardly ever five."""
    random, over = np.random.default_rng(3), []
    for _ in range(2000):
        size, u = step(random.normal(size=(blocks * 20, 3)), 20.0)
        over.append(size / u)
    assert 1.1 < np.median(over) < 1.7
    # Five blocks have four differences to know their noise from; the limit of a step is for windows of any length.
    assert np.mean(np.array(over) > 5.0) <= 0.001


def test_a_slip_at_rest_refuses_the_rest_and_a_steady_one_is_taken() -> None:
    """The data hold no motion: a clamp that gives way between two rests of one position."""
    t = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    pose, noise = at_rest([0.0, 0.0, 9.8]), 0.01 * np.random.default_rng(4).normal(size=(len(t), 3))
    steady = noise + np.array([0.0, 0.0, 9.8])
    assert rest_window(pose, t, steady, STATED).used
    steady[:, 0] += stepped(0.5, 0.2)
    slipped = rest_window(pose, t, steady, STATED)
    assert not slipped.used
    assert "from one part of the window to the other" in slipped.reason


@pytest.mark.parametrize(("theta_deg", "alpha_deg"), [(0.0, 1.5), (-1.5, 0.0)])
def test_the_agent_refuses_the_window_in_which_the_clamp_slips(theta_deg: float, alpha_deg: float) -> None:
    """A bench day (benchmarks.online.bench) with stated times: the clamp slips 7 s into the first position."""
    world = bench.world(3, 200.0)
    p = world.parameters
    slip = Slip(p.schedule.start_s + 7.0, theta_deg, alpha_deg)
    slipping = Bench(replace(p, slip=slip), 3)
    poses = [
        {"start_s": q.start_s, "stop_s": q.stop_s, "theta_deg": q.theta_deg, "alpha_deg": q.alpha_deg}
        for q in world.poses[:1]
    ]
    for made, taken in ((slipping, False), (world, True)):
        run = Run(bench.config(made, positions=[], poses=poses))
        recorded = made.recording(p.schedule.start_s + bench.HOLD_S + bench.AFTER_S)
        said = [r for event in bench_events(made, recorded) for r in run.feed(event) if isinstance(r, WindowReport)]
        assert [window.used for window in said] == [taken]
