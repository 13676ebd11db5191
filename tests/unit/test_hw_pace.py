"""The count of samples against the clock: a sample that is taken out is told, and nothing else is.

The device that is simulated here has a rate that is off by up to 2 % and drifts, and its polls come late.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from hw.pace import Pace
from hw.sensor import GOLDEN

LATE_POLLS, LATE_S = 0.02, 0.005  # part of the polls that the operating system delays, and by how much on average


def polls(rate_hz: float, seconds: float, seed: int) -> Iterator[tuple[float, float, int]]:
    """Time of each poll, half the time of its transfer, both in s, and the samples made until then."""
    rng = np.random.default_rng(seed)
    true_hz = rate_hz * (1 + rng.uniform(-0.02, 0.02))
    interval_s = min(16 / rate_hz, max(0.02, min(2 / rate_hz, 0.1)))
    t_s, phase = rng.uniform(), 0.0
    while t_s < seconds:
        phase = (phase + GOLDEN) % 1.0
        t_s += interval_s + phase / rate_hz + (rng.exponential(LATE_S) if rng.random() < LATE_POLLS else 0.0)
        half_s = rng.exponential(1e-4)
        read_s = t_s + rng.uniform(-half_s, half_s)
        yield t_s, half_s, int(true_hz * (read_s + 1e-6 * read_s**2 / 2))  # drifts by 0.1 % in a quarter of an hour


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [31.25, 62.5, 125.0, 500.0, 1000.0, 4000.0])
@pytest.mark.parametrize("seed", range(10))
def test_one_sample_that_is_taken_is_told_within_two_seconds(rate_hz: float, seed: int) -> None:
    pace, taken_s, before = Pace(rate_hz), 8.0 + seed / 10, 0
    for t_s, half_s, made in polls(rate_hz, 12.0, seed):
        have = made - (t_s > taken_s)
        pace.add(round(t_s * 1e9), round(half_s * 1e9), have - before)
        before = have
        if t_s > taken_s and pace.missing:
            break
    assert taken_s < t_s < taken_s + 2.0


@pytest.mark.two_cases
@pytest.mark.parametrize("rate_hz", [3.90625, 125.0, 1000.0])
def test_nothing_is_told_of_a_device_that_drifts_and_a_machine_that_is_late(rate_hz: float) -> None:
    pace, before, count = Pace(rate_hz), 0, 0
    for t_s, half_s, made in polls(rate_hz, 900.0, 1):
        pace.add(round(t_s * 1e9), round(half_s * 1e9), made - before)
        before, count = made, count + 1
        assert count % 25 or not pace.missing, f"at {t_s:.1f} s"


def test_a_poll_whose_transfer_was_held_up_tells_nothing_wrong() -> None:
    # The count was read at the beginning of a transfer of 60 ms: at its middle 30 more samples exist.
    pace, before = Pace(1000.0), 0
    for k, (t_s, half_s, made) in enumerate(polls(1000.0, 4.0, 2)):
        have = made - 30 if k == 150 else made
        pace.add(round(t_s * 1e9), 30_000_000 if k == 150 else round(half_s * 1e9), have - before)
        before = have
    assert not pace.missing


def test_proof_needs_a_count_that_does_not_lag() -> None:
    pace = Pace(100.0)
    for k in range(50):
        pace.add(round((0.02 * k + 0.001) * 1e9), 0, 2)
    for k in range(50, 60):  # every phase of a sample period
        pace.add(round((0.02 * k + 0.001 * (k - 50)) * 1e9), 0, 2)
    assert not pace.proved  # the last count was read 8 ms after its sample: a missing one would look the same
    pace.add(round(1.2005e9), 0, 2)
    assert pace.proved
