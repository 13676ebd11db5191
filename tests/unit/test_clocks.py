"""The result `clock` against simulated devices whose rate, lateness, scatter and lag are known."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable

import numpy as np
import pytest

from agent.core.clocks import Clocks
from agent.core.events import ClockReport, Event
from agent.core.outcome import ResultSource
from agent.core.pipeline import Pipeline
from agent.core.snapshot import pack, unpack
from agent.core.stream import DeviceStream
from agent.delivery.history import StoredResult
from calib.distributions import chi2_quantile
from hw.block import BlockFlags, SampleBlock
from tests.unit.test_pipeline import EPOCH_NS, SECOND, felt, lost, motion, opened, pipeline, tick

BLOCK_S = 0.5
CONSTANT_S = 2e-3  # from a sample to the earliest arrival of its burst


def blocks(
    device: str, rate_hz: float, nominal_hz: float, duration_s: float, late_s: np.ndarray, lag_s: float = 0.0
) -> list[SampleBlock]:
    """A device that sends each sample on its own, `late_s` (n,) after CONSTANT_S; the sensor `s` is on the clamp."""
    n, size = int(duration_s * rate_hz), int(BLOCK_S * rate_hz)
    taken_s = np.arange(n) / rate_hz
    arrivals_ns = ((taken_s + CONSTANT_S + late_s[:n]) * SECOND).astype(np.int64)
    shown = felt(taken_s - lag_s) if device == "s" else motion(taken_s)[:, None]
    found = []
    for a in range(0, n - size + 1, size):
        arrived = arrivals_ns[a : a + size]
        found.append(
            SampleBlock(
                device, "boot", EPOCH_NS + int(arrived[-1]), a, nominal_hz, arrived,
                np.arange(1, size + 1, dtype=np.int32), np.ascontiguousarray(shown[a : a + size]),
            )
        )  # fmt: skip
    return found


def in_order(*devices: list[SampleBlock]) -> list[Event]:
    """Openings, then all blocks in order of time."""
    sent = sorted((block for device in devices for block in device), key=lambda block: block.t_monotonic_ns)
    return [opened("s", 0.0), opened("r", 0.0, axes=1), *sent]


def clocks(found: Pipeline, events: Iterable[Event]) -> list[ClockReport]:
    return [r for event in events for r in found.step(event) if isinstance(r, ClockReport)]


def both(duration_s: float, seed: int = 1) -> list[Event]:
    """Both devices, the sensor 5 ms behind the reference."""
    rng = np.random.default_rng(seed)
    late_s = rng.exponential(1e-4, (2, round(110 * duration_s)))
    return in_order(
        blocks("s", 101.3, 100.0, duration_s, late_s[0], 5e-3), blocks("r", 99.7, 100.0, duration_s, late_s[1])
    )


@pytest.mark.slow
def test_rate_lateness_and_scatter_are_those_of_the_simulated_devices() -> None:
    """Four runs of a minute, seeds 0 to 3: a sensor 1.3 % off what its driver states, a reference 0.01 % off."""
    rates_hz, scale_s = {"s": 101.3, "r": 199.98}, 4e-4
    deviations = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        late_s = {"s": rng.normal(0.0, 3e-4, 6300), "r": rng.exponential(scale_s, 12400)}
        events = in_order(*(blocks(d, rates_hz[d], n, 61.5, late_s[d]) for d, n in (("s", 100.0), ("r", 200.0))))
        reference, sensor = clocks(pipeline(reference=True, rate_hz=100.0), events)
        assert (reference.device, reference.role, reference.nominal_rate_hz) == ("r", "reference", 200.0)
        assert (sensor.device, sensor.role, sensor.nominal_rate_hz) == ("s", "sensor", 100.0)
        deviations += [(c.rate_hz - rates_hz[c.device]) / c.u_rate_hz for c in (reference, sensor)]
        assert max(c.u_rate_hz / c.rate_hz for c in (reference, sensor)) < 1e-5
        # Of an exponential distribution the median is scale ln 2, and the median deviation from that 0.4812 scale.
        assert abs(reference.offset_s - scale_s * math.log(2.0)) < 4.0 * reference.u_offset_s < 2e-5
        assert abs(reference.jitter_s / (1.4826 * 0.4812 * scale_s) - 1.0) < 0.08  # 6 u of a median of 8192
        assert abs(sensor.jitter_s / 3e-4 - 1.0) < 0.08  # 5 u of a median of 6100
        assert (reference.arrivals, sensor.arrivals) == (8192, 6100)  # the most a clock model keeps; a minute and more
    assert chi2_quantile(0.001, 8) < np.sum(np.square(deviations)) < chi2_quantile(0.999, 8)


@pytest.mark.slow
@pytest.mark.parametrize("lag_s", [0.0, 5e-3, -12e-3])
def test_the_lag_is_that_of_the_sensor_behind_the_reference(lag_s: float) -> None:
    late_s = np.random.default_rng(1).exponential(1e-4, (2, 6500))
    events = in_order(blocks("s", 101.3, 100.0, 62.0, late_s[0], lag_s), blocks("r", 99.7, 100.0, 62.0, late_s[1]))
    reference, sensor = clocks(pipeline(reference=True, rate_hz=100.0), events)
    assert abs(sensor.lag_s - lag_s) < 2.0 * sensor.u_lag_s
    assert sensor.u_lag_s < 5e-4  # 0.5 ms may lie between two windows (lag_window_s), and there are three
    assert math.isnan(reference.lag_s)
    assert math.isnan(reference.u_lag_s)


def test_a_lag_that_no_window_told_is_unknown() -> None:
    late_s = np.zeros(6500)
    alone: list[Event] = [opened("s", 0.0), *blocks("s", 101.3, 100.0, 62.0, late_s)]
    silent = in_order(blocks("s", 101.3, 100.0, 62.0, late_s), [])
    for found, events in ((pipeline(reference=False, rate_hz=100.0), alone), (pipeline(True, 100.0), silent)):
        [report] = clocks(found, list(events))
        assert (report.device, math.isnan(report.lag_s), math.isnan(report.u_lag_s)) == ("s", True, True)


@pytest.mark.slow
def test_each_device_that_speaks_is_reported_once_a_minute_of_the_run() -> None:
    found = pipeline(reference=True, rate_hz=100.0)
    reports = clocks(found, both(190.0))
    assert [r.device for r in reports] == ["r", "s"] * 3
    times_s = [(r.t_utc_ns - EPOCH_NS) / SECOND for r in reports]
    assert all(60.0 * (k // 2 + 1) <= t < 60.0 * (k // 2 + 1) + 2 * BLOCK_S for k, t in enumerate(times_s))
    # Both fall silent: a last report of what came after 180 s, and no more, though time passes.
    assert [r.device for r in clocks(found, [tick(240.0)])] == ["r", "s"]
    assert clocks(found, [tick(t_s) for t_s in np.arange(241.0, 400.0)]) == []


def test_minutes_in_which_nothing_happens_are_not_made_up_for() -> None:
    found = pipeline(reference=True, rate_hz=100.0)
    awake = [e for e in both(333.0) if not 70.0 < e.t_monotonic_ns / SECOND < 330.0]
    assert [r.device for r in clocks(found, awake)] == ["r", "s"] * 2  # after 60 s and after 330 s


def test_a_device_in_place_of_another_is_not_reported_by_the_clock_before() -> None:
    found = pipeline(reference=True, rate_hz=100.0)
    clocks(found, both(59.0))
    swapped: list[Event] = [lost("r", 59.5), opened("r", 59.6, axes=1, serial_number="other"), tick(61.0)]
    assert [r.device for r in clocks(found, list(swapped))] == ["s"]


@pytest.mark.slow
def test_the_same_events_give_the_same_reports_also_from_a_snapshot() -> None:
    events = both(125.0)
    once = pipeline(reference=True, rate_hz=100.0)
    expected = [once.step(event) for event in events]
    found = pipeline(reference=True, rate_hz=100.0)
    config_json = found._config.model_dump_json()
    for k, event in enumerate(events):
        if k % 37 == 0:
            found = Pipeline.restore(config_json, found.snapshot())
        assert repr(found.step(event)) == repr(expected[k])  # NaN equals NaN
    assert found.snapshot() == once.snapshot()


def test_a_run_that_began_without_clock_results_goes_on_without() -> None:
    found = pipeline(reference=True, rate_hz=100.0)
    config_json = found._config.model_dump_json()
    state = unpack(found.snapshot())
    assert state["channels"]["s"].pop("clock_due_s") == 60.0
    restored = Pipeline.restore(config_json, pack(state))
    assert restored.snapshot() == pack(state)
    assert clocks(restored, both(62.0)) == []
    assert "clock_due_s" not in unpack(restored.snapshot())["channels"]["s"]


def test_sample_numbers_that_make_no_clock_are_no_fault() -> None:
    stream = DeviceStream("s", 0)
    for k in range(3000):  # 0, 1, 0, 1, ..
        arrival = np.array([k * SECOND // 50], dtype=np.int64)
        stream.update(SampleBlock("s", "boot", 0, k % 2, 50.0, arrival, np.ones(1, np.int32), np.zeros((1, 3))))
    assert stream.clock() is None
    assert Clocks().reports(ResultSource("s", "", "", 0), 60.0, {"s": stream}, None) == []


def test_numbers_that_are_unknown_are_null_in_json() -> None:
    events = in_order(blocks("s", 101.3, 100.0, 62.0, np.zeros(6500)), [])
    [report] = clocks(pipeline(reference=True, rate_hz=100.0), events)
    fields = json.loads(StoredResult.of(report, recorded=True, recording="f").payload)
    assert (fields["lag_s"], fields["u_lag_s"], fields["device"], fields["role"]) == (None, None, "s", "sensor")


def test_a_break_is_from_the_end_of_the_last_sample_to_the_first_one_after_it() -> None:
    stream, rate_hz, n = DeviceStream("s", 0), 100.0, 50
    for begins_s, flags in ((1.0, BlockFlags.RESTART), (1.5, BlockFlags.NONE), (4.0, BlockFlags.RESTART)):
        first = round(begins_s * rate_hz)
        count = np.arange(10, n + 1, 10, dtype=np.int32)
        arrivals = np.round((first + count) / rate_hz * SECOND).astype(np.int64)
        stream.update(SampleBlock("s", "boot", 0, first, rate_hz, arrivals, count, np.zeros((n, 3)), flags=flags))
    [(ended_s, began_s)] = stream.breaks(0.0, 10.0)
    assert (ended_s, began_s) == pytest.approx((2.0, 4.0), abs=0.02)
    stream.forget_before(3.0)
    assert stream.breaks(0.0, 10.0) == []
