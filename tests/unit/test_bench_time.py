"""Clocks and arrivals of the virtual bench."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from hw.virtual.bench import Bench
from hw.virtual.noise import NoiseStream
from hw.virtual.parameters import BenchParameters, SensorParameters
from hw.virtual.timebase import Bursts, Clock


def test_clock_has_the_stated_rate_offset_and_wander() -> None:
    clock = Clock(1000.0, rate_error=0.013, offset_s=0.25, wander=250e-6, wander_period_s=100.0)
    assert clock.times(0, 1)[0] == 0.25
    assert clock.rate_hz == pytest.approx(1013.0)
    # over whole thermal cycles the wander averages to zero, and its extremes are the stated ones
    t = clock.times(0, 101_301)
    assert t[-1] - t[0] == pytest.approx(100.0, abs=1e-9)
    change = np.diff(t) * 1013.0 - 1
    assert change.max() == pytest.approx(250e-6, rel=1e-4)
    assert change.min() == pytest.approx(-250e-6, rel=1e-4)


@given(
    rate_hz=st.floats(3.9, 4000.0),
    rate_error=st.floats(-0.05, 0.05),
    offset_s=st.floats(-1.0, 1.0),
    wander=st.floats(-1e-3, 1e-3),
    t_s=st.floats(0.0, 1e6),
)
def test_samples_due_are_exactly_those_taken(rate_hz, rate_error, offset_s, wander, t_s) -> None:
    clock = Clock(rate_hz, rate_error, offset_s, wander, wander_period_s=600.0)
    due = int(clock.due(t_s))
    if due:
        assert clock.times(due - 1, 1)[0] <= t_s
    assert clock.times(due, 1)[0] > t_s
    assert int(clock.due(clock.times(due, 1)[0])) == due + 1


def test_stamps_are_late_arrivals_never_early() -> None:
    bursts = Bursts(poll_s=0.016, least_late_s=80e-6, mean_late_s=200e-6, stall_probability=0.01, longest_stall_s=0.015)
    parameters = BenchParameters(sensor=SensorParameters(clock=Clock(1000.0, rate_error=0.013), bursts=bursts))
    recording = Bench(parameters, 1).recording(60.0)
    late = recording.sensor_stamp_s - recording.sensor_time_s
    assert late.min() >= 0.0
    assert late.max() < 0.016 + 0.015 + 0.01
    stamps, count = np.unique(recording.sensor_stamp_s, return_counts=True)
    assert np.all(np.diff(recording.sensor_stamp_s) >= 0)
    assert count.mean() == pytest.approx(16 * 1.013, rel=0.01)
    # delay of the reads against their plan: 3750 draws of 80 us + exponential(200 us) + 1 % * 9.75 ms
    read_late = stamps - 0.016 * np.arange(1, len(stamps) + 1)
    assert read_late.min() >= 80e-6 - 1e-12
    ordinary = read_late[read_late < 3e-3]
    # mean of about 3700 exponentials: 280 us +- 3.3 * 200 / sqrt(3700) = +- 11 us
    assert ordinary.mean() == pytest.approx(280e-6, abs=12e-6)
    assert 15 <= np.count_nonzero(read_late > 4e-3) <= 62  # binomial(3750, 0.01), 99.9 %


def test_spread_stamps_step_at_the_nominal_rate_within_a_burst() -> None:
    clock = Clock(500.0, rate_error=0.02)
    together = Bursts(poll_s=0.05)
    arrivals = together.arrivals(3, NoiseStream.SENSOR_ARRIVAL, 2.0)
    at_once, spread = together.stamps(clock, arrivals), replace(together, spread=True).stamps(clock, arrivals)
    last = np.flatnonzero(np.diff(at_once, append=np.inf))
    assert_allclose(spread[last], at_once[last], rtol=0, atol=1e-12)
    within = np.setdiff1d(np.arange(len(spread)), last)
    assert_allclose(np.diff(spread)[within], 1 / 500.0, atol=1e-12)


def test_without_bursts_stamps_are_true() -> None:
    recording = Bench(BenchParameters(), 1).recording(3.0)
    assert np.array_equal(recording.sensor_stamp_s, recording.sensor_time_s)
    assert len(recording.v) == len(recording.reference) == 3001
    assert [pose.stop_s for pose in recording.poses] == [3.0]


def test_arrivals_do_not_depend_on_how_long_one_records() -> None:
    bursts = Bursts(stall_probability=0.3, longest_stall_s=0.1)
    long, short = (bursts.arrivals(9, NoiseStream.SENSOR_ARRIVAL, until) for until in (100.0, 50.0))
    assert np.array_equal(short, long[: len(short)])
    assert len(short) > 3000
