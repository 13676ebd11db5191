"""Seconds in which the arrivals of a device are late: its samples have the times that the others tell, and are used."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from agent.core.events import CalibrationUpdate, Event, Result, StatusChange, WindowReport
from benchmarks.online.node import RATE_HZ, Node, Stated, Timing, node
from benchmarks.online.runner import EPOCH_NS, Run, visits
from hw.block import SampleBlock

WINDOW_S, WINDOWS, LATE_S, LASTS_S = 30.0, 10, 0.05, 10.0
GUARD_S = 0.5  # at the begin of the first window
SINCE_S = np.array([131.0, 173.0, 204.0, 245.0])  # at the begin, in the middle and at the end of windows


def late(drawn: Node, device: str) -> Iterator[Event]:
    """The events of the building without a pause; for ten seconds again and again all arrivals of a device are late."""
    newest_ns = 0
    for event in visits(drawn.building, range(WINDOWS)):
        if isinstance(event, SampleBlock) and event.device == device:
            since_s = event.burst_t_monotonic_ns[:, None] * 1e-9 - SINCE_S
            by_ns = round(LATE_S * 1e9) * ((since_s >= 0.0) & (since_s < LASTS_S)).any(axis=1)
            arrival_ns = np.maximum.accumulate(np.maximum(event.burst_t_monotonic_ns + by_ns, newest_ns))
            newest_ns = int(arrival_ns[-1])
            yield replace(event, burst_t_monotonic_ns=arrival_ns, t_utc_ns=EPOCH_NS + newest_ns)
        else:
            yield event


@pytest.mark.parametrize("device", ["sensor", "reference"])
def test_every_window_is_used_right_and_tells_how_many_samples_were_late(device: str) -> None:
    drawn = node(3, all_axes=True, stated=Stated(lag_s=0.02), timing=Timing(WINDOW_S, 0.0, WINDOWS))
    run, results = Run(drawn.config), list[Result]()
    for event in late(drawn, device):
        results += run.feed(event)
    windows = [r for r in results if isinstance(r, WindowReport)]
    assert [w.used for w in windows] == [True] * len(windows)
    assert {r.status for r in results if isinstance(r, StatusChange)} <= {"UNCALIBRATED", "VALID"}
    name = "late_samples" if device == "sensor" else "reference_late_samples"
    told = np.array([w.numbers.get(name, 0.0) for w in windows])
    starts_s = GUARD_S + WINDOW_S * np.arange(len(windows))[:, None]
    within_s = np.minimum(starts_s + WINDOW_S, SINCE_S + LASTS_S) - np.maximum(starts_s, SINCE_S)
    np.testing.assert_allclose(
        told, RATE_HZ * within_s.clip(0.0).sum(axis=1), atol=3 * 32
    )  # a burst has 32 samples; up to four ends
    update = [r for r in results if isinstance(r, CalibrationUpdate)][-1]
    true = drawn.building.truth(run.now_s)
    error = np.append(update.sensitivity, update.offset) - np.append(true.sensitivity, true.offset_at_mean)
    assert np.max(np.abs(error) / update.standard_uncertainty) < 3.5  # 12 errors: beyond in one of 180 runs
