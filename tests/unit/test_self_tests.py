"""The self-test of a device each night: the reader runs it, the core says what it shows, no window sees it."""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from agent.acquisition.reader import DeviceReader, EventQueue
from agent.acquisition.self_testing import PAIRS, SelfTesting
from agent.config import Config
from agent.config.channel import SelfTestPlan
from agent.config.reading import ConfigError, parse_config
from agent.core.events import DeviceChange, Event, Result, SelfTestReport, SelfTestRun, StatusChange, Tick, WatchReport
from agent.core.outcome import ResultSource
from agent.core.pipeline import Pipeline
from agent.core.self_tests import LONGEST_S, self_test_report
from agent.recording.messages import decode, encode, schema_of, topic_of
from agent.supervision.devices import DeviceWatch
from agent.supervision.health import SILENT_S
from agent.terminal.wording import result_lines
from hw.adxl345 import Adxl345, Adxl345Options
from hw.block import BlockFlags, DeviceInfo, SampleBlock
from hw.fifo_sensor import FifoSensor
from hw.lis3dh import Lis3dh, Lis3dhOptions
from hw.virtual.adxl345_twin import Adxl345Twin
from hw.virtual.kernel import I2CBus, installed
from hw.virtual.lis3dh_twin import Lis3dhTwin
from tests.scenarios.processes import wait_until

G = 9.80665
NS = 10**9
START = datetime(2026, 9, 1, 2, 59, 40, tzinfo=UTC)
START_NS = round(START.timestamp()) * NS
SOURCE = ResultSource("s", "chip", "count", 0)
Array = NDArray[np.float64]


class Bus(EventQueue):
    """A chip at 400 Hz, in time that its driver's sleep lets pass; events of its reader bear this time."""

    def __init__(self, twin: Any = Adxl345Twin, counts_per_g: float = 256.0, **more: Any) -> None:
        super().__init__(1)
        self.t_s, self.found, self._counts_per_g = 0.0, list[Event](), counts_per_g
        self.shaken_g: Callable[[Array], Array] = np.zeros_like
        self._random = np.random.default_rng(7)
        self.twin = twin(self._counts, lambda t: int(t * 400.0), lambda: self.t_s, **more)
        self.timing: dict[str, Any] = {"clock": self.clock, "sleep": self.sleep}

    def clock(self) -> tuple[int, int]:
        self.t_s += 2e-5
        return round(self.t_s * NS), START_NS + round(self.t_s * NS)

    def sleep(self, seconds: float) -> None:
        self.t_s += max(seconds, 0.0)

    def put(self, device: str, event: Event) -> None:
        if isinstance(event, DeviceChange | SelfTestRun):
            now_ns, utc_ns = self.clock()
            event = msgspec.structs.replace(event, t_monotonic_ns=now_ns, t_utc_ns=utc_ns)
        super().put(device, event)

    def night(self, sensor: FifoSensor, until: Callable[[], object], fast: float = 1.0) -> list[Event]:
        """The events of a reader until a condition holds; its clock of UTC goes `fast` times as fast."""
        plan = SelfTestPlan.model_validate({"at": "03:00"})
        testing = SelfTesting(plan, lambda: START + timedelta(seconds=fast * self.t_s))
        reader = DeviceReader("s", sensor, self, testing)

        def seen() -> object:
            while (event := self.get(0.0)) is not None:
                self.found.append(event)
            return until()

        with installed({"/dev/i2c-1": I2CBus({0x53: self.twin, 0x19: self.twin})}):
            reader.start()
            try:
                wait_until(seen, 120.0, "the self-test", 0.01)
            finally:
                reader.stop()
                reader.join(60.0)
        return self.found

    @property
    def runs(self) -> list[SelfTestRun]:
        return [event for event in self.found if isinstance(event, SelfTestRun)]

    def again(self) -> bool:
        """Whether a block came after the self-test."""
        at = [k for k, event in enumerate(self.found) if isinstance(event, SelfTestRun)]
        return len(at) == 2 and any(isinstance(event, SampleBlock) for event in self.found[at[1] :])

    def _counts(self, first: int, n: int) -> NDArray[np.int32]:
        t = (np.arange(first, first + n) / 400.0)[:, None] * np.ones(3)
        g = np.array([0.0, 0.0, 1.0]) + 0.003 * self._random.standard_normal((n, 3)) + self.shaken_g(t)
        return np.rint(self._counts_per_g * g).astype(np.int32)


class Quick(FifoSensor):
    """Its time is its own: an hour of blocks may come within a second."""

    def open(self) -> DeviceInfo:
        return replace(super().open(), own_clock=True)


class QuickAdxl345(Quick, Adxl345):
    pass


class QuickLis3dh(Quick, Lis3dh):
    pass


def chip(bus: Bus) -> FifoSensor:
    return QuickAdxl345("s", Adxl345Options(rate_hz=400.0), **bus.timing)


def config(**channel: Any) -> Config:
    raw = {"devices": [{"name": "s", "driver": "adxl345"}], "channels": [{"sensor": "s", "prior": {}, **channel}]}
    return parse_config(raw, "test")


def report(run: SelfTestRun, u_supply_pct: float = 1.0) -> SelfTestReport:
    return self_test_report(SOURCE, run, u_supply_pct)


def run_of(off: Any, on: Any, **more: Any) -> SelfTestRun:
    told = {"state": "done", "off_mps2": np.ravel(off).tolist(), "on_mps2": np.ravel(on).tolist()}
    limits = {"low_mps2": [0.5] * 3, "high_mps2": [9.0] * 3, "supply_exponent": [2.0, 2.0, 1.5]}
    return SelfTestRun(device="s", t_monotonic_ns=0, t_utc_ns=0, **{**told, **limits, **more})  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_device_tests_itself_at_the_stated_time_and_then_measures_as_before() -> None:
    factor = np.array([1.01, 1.02, 0.97])
    bus = Bus(electrostatic=lambda _: factor)
    found = bus.night(chip(bus), bus.again)
    begun, done = bus.runs
    assert (begun.state, done.state, done.message) == ("begun", "done", "")
    due_ns = START_NS + 20 * NS
    assert due_ns + 9.5 * NS <= begun.t_utc_ns < due_ns + 11 * NS  # ten seconds of samples show that nothing moves
    assert max(begun.motion_mps2) == pytest.approx(0.003 * G, rel=0.1)
    assert 12 * NS < done.t_utc_ns - begun.t_utc_ns < 20 * NS
    told = report(done)
    response = np.array(told.response_mps2) * 256.0 / G
    assert response == pytest.approx(factor * [200, -200, 300], abs=0.5)
    assert max(told.u_response_mps2) < 0.002
    assert (told.pairs, told.reason, told.faults) == (PAIRS, "", [])
    blocks = [event for event in found if isinstance(event, SampleBlock)]
    last = max(k for k, block in enumerate(blocks) if block.t_monotonic_ns < begun.t_monotonic_ns)
    assert blocks[last + 1].flags & BlockFlags.RESTART
    assert blocks[last + 1].t_monotonic_ns > done.t_monotonic_ns
    assert all(np.abs(block.indications - [0, 0, 256]).max() < 10 for block in blocks)


@pytest.mark.slow
def test_a_range_that_gravity_and_the_self_test_do_not_fit_is_left_for_the_self_test_alone() -> None:
    bus = Bus(Lis3dhTwin, 1000.0)
    sensor = QuickLis3dh("s", Lis3dhOptions(rate_hz=400.0, range_g=2, address=0x19), **bus.timing)
    bus.night(sensor, bus.again)
    assert bus.runs[1].state == "done"
    opened = [block.indications[:, 2].mean() for block in bus.found if isinstance(block, SampleBlock)]
    assert sensor._options.range_g == 2
    assert np.ptp(opened) < 2.0


@pytest.mark.thorough
def test_what_moves_too_much_is_told_and_nothing_is_stopped() -> None:
    bus = Bus()
    bus.shaken_g = lambda t: 0.02 * np.sin(2 * np.pi * 3.0 * t)
    found = bus.night(chip(bus), lambda: bus.runs, fast=60.0)
    (skipped,) = bus.runs
    assert skipped.state == "skipped"
    assert "03:00 UTC" in skipped.message
    assert "most_motion_mps2 0.1; last" in skipped.message
    assert max(skipped.motion_mps2) == pytest.approx(G * np.hypot(0.02 / np.sqrt(2.0), 0.003), rel=0.02)
    assert bus.t_s == pytest.approx(3620.0 / 60.0, abs=2.0)
    blocks = [event for event in found if isinstance(event, SampleBlock)]
    assert sum(bool(block.flags & BlockFlags.RESTART) for block in blocks) == 1
    told = report(skipped)
    assert told.reason == skipped.message
    assert np.isnan(told.response_mps2).all()


@pytest.mark.thorough
def test_it_waits_until_little_moves() -> None:
    bus = Bus()
    bus.shaken_g = lambda t: np.where(t < 40.0, 0.05 * np.sin(2 * np.pi * 3.0 * t), 0.0)
    bus.night(chip(bus), bus.again, fast=10.0)
    assert 50.0 <= (bus.runs[0].t_utc_ns - START_NS) / NS < 61.0


@pytest.mark.slow
def test_a_device_that_goes_away_meanwhile_is_told_and_opened_again() -> None:
    bus = Bus()
    sleep = bus.timing["sleep"]

    def gone(seconds: float) -> None:
        if bus.t_s < 35.0 <= bus.t_s + seconds:
            bus.twin.fail(errno.ENXIO, 8)
        sleep(seconds)

    bus.timing["sleep"] = gone
    bus.night(chip(bus), lambda: len(bus.runs) == 2)
    begun, failed = bus.runs
    assert (begun.state, failed.state) == ("begun", "failed")
    assert "on /dev/i2c-1" in failed.message
    assert report(failed).reason == failed.message


@pytest.mark.slow
def test_the_response_and_its_uncertainty() -> None:
    rng = np.random.default_rng(3)
    responses, u2 = [], []
    for _ in range(6000):
        drift = np.linspace(0.0, 5.0, 13)[:, None]  # slow motion, the same for both
        phases = drift + 0.01 * rng.standard_normal((13, 3))
        told = report(run_of(phases[::2], 2.0 + phases[1::2]))
        responses.append(told.response_mps2)
        u2.append(np.square(told.u_response_mps2))
    assert np.mean(responses) == pytest.approx(2.0, abs=4 * 0.01 / np.sqrt(3 * 18_000))
    # 18,000 values each: the relative standard uncertainty of a variance is sqrt(2 / 18000) = 1.1 %, of u2 0.5 %.
    # Without the terms in 1/N the ratio is off by 5.6 % and 4.2 %.
    assert np.var(responses) / np.mean(u2) == pytest.approx(1.0, abs=0.036)


def test_what_a_report_says() -> None:
    off, on = np.zeros((3, 3)), np.array([[2.0, 0.1, -2.0], [2.01, 0.11, -2.01]])
    told = report(run_of(off, on, temperature_degc=21.5), 0.5)
    assert told.u_supply_pct == [1.0, 1.0, 0.75]
    assert [fault[:17] for fault in told.faults] == ["y changes by 0.11", "z changes by -2.0"]
    (line,) = result_lines(told, None)
    assert line.startswith("s: self-test: x 2.005 ± 0.0")
    assert "at 21.5 °C; y changes by 0.11 m/s2, the limits are 0.50 to 9.00 m/s2" in line
    for off_, on_ in (([1.0] * 6, [1.0] * 3), ([1.0] * 6, [1.0] * 6), ([], [])):  # a single pair, unequal, nothing
        odd = report(run_of(off_, on_))
        assert odd.reason == "too few phases"
        assert np.isnan(odd.response_mps2).all()


def play(events: list[Event], pipeline: Pipeline) -> list[Result]:
    found = []
    for event in events:
        found += [item for item in pipeline.step(event) if isinstance(item, Result)]
    return found


@pytest.fixture(scope="module")
def recorded() -> list[Event]:
    """A night with a self-test, a Tick each second among its events, and the hour after it."""
    bus = Bus()
    bus.night(chip(bus), lambda: bus.again() and bus.t_s > 140.0)
    whole = [event for event in bus.found if not isinstance(event, Tick)]
    ticks = [Tick(t_monotonic_ns=k * NS, t_utc_ns=START_NS + k * NS) for k in range(130)]
    return sorted([*whole, *ticks], key=lambda event: event.t_monotonic_ns)


@pytest.mark.thorough
def test_a_replay_gives_the_same_and_the_sensor_does_not_become_silent(recorded: list[Event]) -> None:
    plan = {"at": "03:00", "u_supply_pct": 0.25}
    pipeline = Pipeline.begin(config(self_test=plan), "run", 0, 0, {})
    half = next(k for k, e in enumerate(recorded) if isinstance(e, SelfTestRun)) + 6
    results = play(recorded[:half], pipeline)
    kept = pipeline.snapshot()
    results += play(recorded[half:], pipeline)
    (told,) = [result for result in results if isinstance(result, SelfTestReport)]
    assert told.reason == ""
    assert told.u_supply_pct[0] == pytest.approx(0.25 * np.log(1.77) / np.log(1.32))
    assert not [r for r in results if isinstance(r, StatusChange) and r.status == "INVALID"]
    through = [decode(schema_of(topic_of(e)), encode(k, e))[1] for k, e in enumerate(recorded)]
    again = Pipeline.restore(config(self_test=plan).model_dump_json(), kept)
    later = play(through[half:], again)  # type: ignore[arg-type]
    assert msgspec.json.encode(later) == msgspec.json.encode(results[-len(later) :])
    assert encode(1, decode(schema_of(topic_of(told)), encode(1, told))[1]) == encode(1, told)


@pytest.mark.slow
def test_a_sensor_that_stays_away_after_its_self_test_is_silent(recorded: list[Event]) -> None:
    """Also where it never ends."""
    for last, silent_s in (("begun", LONGEST_S + 5.0), ("done", 5.0)):
        at = next(k for k, e in enumerate(recorded) if isinstance(e, SelfTestRun) and e.state == last) + 1
        pipeline = Pipeline.begin(config(self_test={"at": "03:00"}), "run", 0, 0, {})
        play(recorded[:at], pipeline)
        ended_ns = recorded[at - 1].t_monotonic_ns
        told = {}
        for k in range(1, 90):
            for result in play([Tick(t_monotonic_ns=ended_ns + k * NS, t_utc_ns=START_NS)], pipeline):
                if isinstance(result, StatusChange):
                    told[k] = result.status
        assert told == {int(silent_s) + 1: "INVALID"}


@pytest.mark.slow
def test_no_minute_of_the_watch_has_a_self_test_in_it(recorded: list[Event]) -> None:
    """The deflection by the self-test is 0.8 g, and noise 3 mg."""
    pipeline = Pipeline.begin(config(self_test={"at": "03:00"}), "run", 0, 0, {})
    results = play(recorded, pipeline)
    end_ns = recorded[-1].t_monotonic_ns
    results += play([Tick(t_monotonic_ns=end_ns + 3600 * NS, t_utc_ns=START_NS + end_ns + 3600 * NS)], pipeline)
    hour = next(result for result in reversed(results) if isinstance(result, WatchReport) and result.segments)
    assert np.sqrt(max(hour.band_power)) < 0.01 * G


@pytest.mark.slow
def test_the_health_of_a_device_that_tests_itself(recorded: list[Event]) -> None:
    watch, faults = DeviceWatch(), []
    for event in recorded:
        if isinstance(event, SampleBlock):
            watch.on_block(event)
        elif isinstance(event, SelfTestRun):
            watch.on_self_test(event)
        elif isinstance(event, Tick):
            faults.append(watch.fault(event.t_monotonic_ns, SILENT_S))
        else:
            watch.on_change(event)  # type: ignore[arg-type]
    assert not any("silent" in fault for fault in faults)


def test_when_it_is_due() -> None:
    now = [datetime(2026, 9, 1, 3, 0, 1, tzinfo=UTC)]
    testing = SelfTesting(SelfTestPlan.model_validate({"at": "03:00"}), lambda: now[0])

    def asked() -> list[str]:
        block = SampleBlock("s", "b", 0, 0, 10.0, np.array([0]), np.array([50], np.int32), np.zeros((50, 3)))
        return [testing.update(block, 1.0) for _ in range(3)]

    assert asked() == ["wait"] * 3  # the time has passed when the run begins
    now[0] += timedelta(days=1)
    assert asked() == ["wait", "test", "wait"]
    now[0] += timedelta(days=3)  # the clock was set forward, or no samples came
    assert asked() == ["wait"] * 3
    now[0] += timedelta(days=1)
    assert asked() == ["wait", "test", "wait"]
    now[0] -= timedelta(days=400)  # the clock was set back
    assert asked() == ["wait"] * 3
    now[0] += timedelta(days=1)
    assert "test" in asked()


@pytest.mark.parametrize(
    ("driver", "plan", "said"),
    [
        ("virtual", {"at": "03:00"}, "channels.0.self_test: the driver of 's' knows no self-test; remove it"),
        ("adxl345", {"at": "25:00"}, "channels.0.self_test.at"),
        ("adxl345", {"at": "03:00+02:00"}, "at is a time of UTC without a zone"),
        ("adxl345", {"at": "03:00", "most_motion_mps2": 0}, "channels.0.self_test.most_motion_mps2"),
    ],
)
def test_a_plan_that_cannot_be_carried_out(driver: str, plan: dict[str, Any], said: str) -> None:
    options = {"role": "sensor"} if driver == "virtual" else {}
    raw = {
        "devices": [{"name": "s", "driver": driver, "options": options}],
        "channels": [{"sensor": "s", "prior": {}, "self_test": plan}],
    }
    with pytest.raises(ConfigError) as error:
        parse_config(raw, "test")
    assert said in str(error.value)
