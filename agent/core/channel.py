"""One sensor with its reference: how events change its state, and which results follow from them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec

from agent.config import Channel
from agent.core.clocks import Clocks
from agent.core.corrected import accelerations
from agent.core.driver_filters import DriverFilters
from agent.core.estimation import DAY_S, Estimation
from agent.core.events import CalibrationUpdate, Command, DeviceChange, Estimate, Output, Result, SelfTestRun, Tick
from agent.core.fault import description
from agent.core.identity import device_of, identity_of, nominal_of
from agent.core.kept import keep, kept_as, plain, restated, shelved, take_up, update_of
from agent.core.mean_watch import MeanWatch
from agent.core.operators import CommandError, answer, commanded_pose
from agent.core.outcome import (
    ResultSource,
    again,
    calibration_update,
    drift_report,
    estimate,
    status_change,
    window_report,
    with_budget,
)
from agent.core.references import References
from agent.core.run_time import RunTime
from agent.core.self_tests import SelfTestWatch, self_test_report
from agent.core.streams import JudgedWindow, Streams
from agent.core.watch import Hour, SensorWatch
from agent.core.watched import (
    DAY_NS,
    NOT_CALIBRATED,
    WATCHED,
    aged,
    date_utc_ns,
    in_force_since,
    is_newer,
    watch_report,
)
from agent.core.windows import refused
from calib.estimate.correction import Law
from calib.model import Calibration, Pose, Window
from calib.state.state import FIRST
from hw.block import SampleBlock

REFUSED_IN_A_ROW = 3


class ChannelState:
    """The state of one channel. Only events change it.

    The first status is published after the first event of the sensor. `kept` holds states of earlier devices by their
    identity: when such a device is connected again, its estimation continues from its kept state.
    """

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self.sensor = channel.sensor
        self.identity, self._device = "", ""  # the device is the identity without the settings of its filters
        self._filters = DriverFilters(channel)
        self._streams, self._unit = Streams(channel), ""
        self._nominal: float | None = None  # sensitivity by the data sheet of the device
        self._references = References(channel)
        self._estimation: Estimation | None = None
        self._in_force: CalibrationUpdate | None = None
        self._kept: dict[str, bytes] = {}
        self._first_day = 0.0  # days that the estimation had counted when this run began
        self._status = ""  # no status was published yet
        self._refused = 0  # how many windows in a row were refused
        self._clocks, self._time, self._self_tests = Clocks(), RunTime(), SelfTestWatch()
        self._watched, self._means = (SensorWatch() if channel.watched else None), MeanWatch()

    def begin(self, origin_ns: int, kept: Mapping[str, bytes]) -> None:
        """Begin a new run. Seconds count from `origin_ns`. `kept`: a state (`memory`) for each identity of a sensor."""
        self._time = RunTime(origin_ns)
        self._kept = dict(kept)
        self._streams.begin(origin_ns)

    # --- events

    def on_block(self, block: SampleBlock) -> list[Output]:
        """A block of the sensor or of its reference. Blocks of other devices do not concern this channel."""
        if block.device not in self._streams.by_device:
            return []
        self._time.update(block.t_monotonic_ns, block.t_utc_ns)
        self._streams.by_device[block.device].update(block)
        scale = 0.0 if self._estimation is None else self._estimation.state.scale
        wrong = self._streams.watch(block, scale, self._time.origin_utc_ns)
        results: list[Output] = [self._status_change(what) for what in wrong]
        if block.device == self.sensor and self._estimation is not None:
            if self._status == "INVALID":
                self._estimation.gate.regain("")
                results += self._say_status(f"{self.sensor} sends data again")
            self._streams.look_where(block, self._estimation)
            taken = self._streams.by_device[self.sensor], self._time.origin_utc_ns
            suspect = self._streams.suspect(block.device)
            law = self._law(self._estimation)
            sd = self._estimation.residual_sd
            results += accelerations(block, *taken, self._channel, law, sd, self._in_force, suspect)
            if self._watched is not None:
                results += self._end_hour(self._watched.update(block, suspect, law))
        return results + list(self._close_windows()) + self._clock_reports()

    def on_tick(self, tick: Tick) -> list[Result]:
        """Time passed: windows whose samples come too late are refused; a sensor without data becomes INVALID."""
        self._time.update(tick.t_monotonic_ns, tick.t_utc_ns)
        results = list(self._close_windows()) + self._watch_silence() + self._explain() + self._clock_reports()
        if self._watched is not None and self._estimation is not None:
            late_s, law = self._channel.late_horizon_s, self._law(self._estimation)
            results += self._end_hour(self._watched.tick(self._time.utc_ns, late_s, law))
        return results

    def on_device(self, change: DeviceChange) -> list[Result]:
        """A device of this channel was opened or lost."""
        if change.device not in self._streams.by_device:
            return []
        self._time.update(change.t_monotonic_ns, change.t_utc_ns)
        if change.state == "lost":
            if change.device != self.sensor:
                reason = f"the reference {change.device} is lost, S and Q stay as they are: {change.message}"
                return [self._status_change(reason)]
            return self._lose(f"{self.sensor} is lost: {change.message}")
        if self._estimation is not None:
            self._estimation.began(change.device)
        if change.device == self.sensor:
            return self._identify(change.info_json)
        return self._identify_reference(change.device, change.info_json)

    def on_self_test(self, run: SelfTestRun) -> list[Result]:
        """The sensor tests itself: it is silent meanwhile. A reference that does is no witness of anything here."""
        if run.device != self.sensor:
            return []
        self._time.update(run.t_monotonic_ns, run.t_utc_ns)
        self._self_tests.update(run, self._time.now_s)
        plan = self._channel.self_test
        if run.state == "begun" or plan is None:
            return []
        return [self_test_report(self._source(), run, plan.u_supply_pct)]

    def on_command(self, command: Command) -> list[Result]:
        """A command of an operator. A command that was refused before changes nothing."""
        if command.sensor != self.sensor or command.refused:
            return []
        self._time.update(command.t_monotonic_ns, command.t_utc_ns)
        if self._estimation is None:
            return [self._status_change(f"{command.verb} refused: {self.sensor} has not been connected in this run")]
        try:
            if command.verb == "pose":
                return self._turn(commanded_pose(command, self._channel))
            said, earlier = answer(command, self._estimation, self.identity)
        except CommandError as error:
            return [self._status_change(f"{command.verb} refused: {error}")]
        if said.refused:
            return [self._status_change(f"{command.verb} refused: {said.refused}")]
        results: list[Result] = [self._put_in_force(earlier)] if said.calibration is not None else []
        return [*results, *(self._say_status(said.reason) or [self._status_change(said.reason)])]

    # --- time and identity

    def _source(self) -> ResultSource:
        return ResultSource(self.sensor, self.identity, self._unit, self._time.utc_ns)

    def _identify(self, info_json: str) -> list[Result]:
        info, identity = json.loads(info_json), identity_of(info_json)
        reason, results = f"{self.sensor} opened", list[Result]()
        if self._estimation is None or identity != self.identity:
            belongs = ", ".join(sorted(self._kept))
            if self._estimation is not None:
                self._kept = shelved(self._kept, self.identity, self.memory())
                self._streams.forget_sensor()
                self._watched, self._means = (None if self._watched is None else SensorWatch()), MeanWatch()
                belongs, self._estimation = "", None
                reason = f"{self.sensor} is another device now: {identity} instead of {self.identity}"
            known_as = kept_as(self._kept, identity, device_of(info))
            if belongs and not known_as:
                reason = f"the stored calibration belongs to {belongs}, but this device is {identity}"
            self.identity, self._device, self._unit, self._in_force = identity, device_of(info), info["unit"], None
            results += self._hear_filters(self.sensor, info)
            self._status = "" if self._status == "INVALID" else self._status  # the silent device was another one
            try:
                self._nominal = nominal_of(info)
                self._estimation = Estimation(self._filters.channel, self._nominal)
            except ValueError as error:
                return self._change("INVALID", str(error))
            if known_as:
                found, reason = self._remember(self._kept.pop(known_as))
                results += found
            results += self._meet_references()
            if self._watched is not None:
                results += self._believe()
                reason += f"; {NOT_CALIBRATED if self._in_force is None else WATCHED}"
        else:
            results += self._hear_filters(self.sensor, info)
        if self._status == "INVALID":
            # An open port does not prove that the sensor sends data: the status stays INVALID until a block comes.
            self._estimation.gate.lose("")
        return results + self._say_status(reason)

    def _identify_reference(self, device: str, info_json: str) -> list[Result]:
        before, now, not_certified = self._references.identify(device, info_json)
        results = self._hear_filters(device, json.loads(info_json))
        if not before or before == now:
            return results + (
                [self._status_change(f"S and Q are not updated: {not_certified}")] if not_certified else []
            )
        self._streams.forget(device)
        reason = not_certified or f"the reference is another device now: {now} instead of {before}"
        return results + (self._say_status(reason) or [self._status_change(reason)])

    def _hear_filters(self, device: str, info: Mapping[str, Any]) -> list[Result]:
        """What the driver of a device that was opened states of its filters; other ones are another response."""
        before, told, changed = self._filters.channel, self._filters.hear(device, info), False
        if (now := self._filters.channel) is not before:
            self._streams.state(now)
            if self._estimation is not None:
                self._estimation, told, changed = restated(self._estimation, before, now, self._nominal, told)
        results = [self._status_change(told)] if told else []
        return [*results, *([self._put_in_force()] if changed else []), *self._meet_references()]

    def _meet_references(self) -> list[Result]:
        return [self._put_in_force()] if self._references.meet(self._estimation) else []

    def _clock_reports(self) -> list[Result]:
        return self._clocks.reports(self._source(), self._time.now_s, self._streams.by_device, self._estimation)

    def _lose(self, reason: str) -> list[Result]:
        if self._estimation is not None:
            self._estimation.gate.lose(reason)
        return self._change("INVALID", reason)

    def _watch_silence(self) -> list[Result]:
        newest_s = self._streams.by_device[self.sensor].newest_arrival_s
        silent_s = self._time.now_s - max(newest_s if newest_s is not None else 0.0, self._self_tests.until_s)
        if silent_s <= self._channel.silence_s:
            return []
        return self._lose(f"no block of {self.sensor} for more than {self._channel.silence_s:g} s")

    def _explain(self) -> list[Result]:
        if self._estimation is None:
            return []
        found = self._estimation.explain(self._first_day * DAY_S + self._time.now_s, self._time.utc_ns)
        return [self._status_change(found)] if found else []

    def _say_status(self, reason: str) -> list[Result]:
        return [] if self._estimation is None else self._change(self._estimation.gate.status, reason)

    def _change(self, status: str, reason: str) -> list[Result]:
        if status == self._status:
            return []
        before, self._status = self._status, status
        return [status_change(self._source(), status, before, reason)]

    def _status_change(self, reason: str) -> Result:
        return status_change(self._source(), self._status or "UNCALIBRATED", self._status, reason)

    # --- windows

    def _turn(self, pose: Pose) -> list[Result]:
        self._streams.turn(self._time.now_s, pose)
        return [self._status_change(f"an operator set the position: {pose.position}")]

    def _close_windows(self) -> Iterator[Result]:
        """The results of all windows that are due. After a fault of the program its window is reported and not used."""
        for piece in self._streams.due(self._time.now_s):
            place = self._streams.place
            if self._estimation is not None:
                day = self._first_day + self._time.now_s / DAY_S
                self._estimation.date_certificate(day, self._time.utc_ns, place)
            try:
                unusable = self._references.not_certified[place]
                for verdict in self._streams.verdicts(piece, self._first_day, self._estimation, unusable):
                    yield from self._results(verdict, place)
            except MemoryError:
                raise  # not caused by the data: a replay would not repeat it
            except Exception as error:
                fault = description(error)
                reason = f"a fault of the program, not of the data; please report it: {fault}"
                yield from self._refuse(refused(piece, reason), reason, fault)

    def _refuse(self, window: Window, reason: str, fault: str = "") -> Iterator[Result]:
        """Report a window that is not used. After a fault of the program, and after REFUSED_IN_A_ROW such windows,
        publish the status again with the reason, though the status does not change. The next window that is used
        publishes it once more."""
        yield window_report(self._source(), window, used=False, reason=reason, numbers={}, fault=fault)
        self._refused += 1
        if fault or self._refused == REFUSED_IN_A_ROW:
            yield self._status_change(f"S and Q are not updated: {reason}")

    def _results(self, verdict: JudgedWindow, place: int = FIRST) -> Iterator[Result]:
        """The results of a window beside the reference at a place."""
        window, judged, source = verdict.window, verdict.judged, self._source()
        if judged is None or self._estimation is None:
            yield from self._refuse(window, window.reason or f"{self.sensor} has not been connected in this run")
            return
        were_refused, self._refused = self._refused >= REFUSED_IN_A_ROW, 0
        decision = judged.decision
        used = decision.action in ("take", "adopt")
        numbers = {**decision.numbers, "lag_applied_s": verdict.lag_s}
        yield window_report(source, window, used=used, reason="" if used else decision.reason, numbers=numbers)
        if judged.news:
            yield self._status_change(judged.news)
        origin_utc_ns = self._time.utc_ns - round((self._first_day * DAY_S + self._time.now_s) * 1e9)
        for drift in judged.drift:
            yield drift_report(source, drift, self._channel.drift.false_alarms_a_year, origin_utc_ns)
        if decision.proposal is not None:
            yield estimate(source, decision.reason, self._update(decision.proposal, place))
        if decision.in_force:
            yield self._put_in_force(place=place)
        said = self._say_status(decision.reason)
        yield from [self._status_change(decision.reason)] if were_refused and used and not said else said

    def _put_in_force(self, earlier: CalibrationUpdate | None = None, place: int = FIRST) -> CalibrationUpdate:
        """The update that puts the estimation's calibration in force. `earlier` made it, if it was made before."""
        assert self._estimation is not None
        update = with_budget(self._update(self._estimation.in_force, place), self._estimation.budget)
        self._in_force = update if earlier is None else again(update, earlier)
        return self._in_force

    def _update(self, calibration: Calibration, place: int = FIRST) -> CalibrationUpdate:
        assert self._estimation is not None
        state, shares = self._estimation.state, self._estimation.shares_of(calibration, place)
        return calibration_update(self._source(), calibration, state, shares, self._references.certificate_of, place)

    # --- without a reference

    def _law(self, estimation: Estimation) -> Law:
        """S and Q in force over temperature. Without a reference U grows as the configured walks say."""
        if self._watched is None or self._in_force is None:
            return estimation.law
        return aged(estimation.law, self._channel, self._in_force, self._time.utc_ns)

    def _believe(self) -> list[Result]:
        """Put the calibration that the configuration states with its date in force, unless a newer one is."""
        assert self._estimation is not None
        stated = Estimation(self._filters.channel, self._nominal)
        if not is_newer(self._channel, stated.in_force, self._in_force):
            return []
        self._estimation = stated
        self._estimation.believe()
        made = date_utc_ns(self._channel)
        self._in_force = msgspec.structs.replace(self._update(self._estimation.in_force), made_utc_ns=made)
        return [self._in_force]

    def _end_hour(self, hour: Hour | None) -> list[Result]:
        """The result of an hour, before it once a day the calibration in force with its present U."""
        if hour is None or self._estimation is None:
            return []
        law, results = self._law(self._estimation), list[Result]()
        if self._in_force is not None and self._time.utc_ns // DAY_NS > self._in_force.t_utc_ns // DAY_NS:
            now = in_force_since(self._in_force, law, self._source())
            self._in_force = now
            results.append(now)
        return [*results, watch_report(self._source(), hour, self._in_force, law, self._means)]

    def number(self, results: Sequence[Result]) -> None:
        """Take the numbers that the results got, so that the calibration in force and waiting estimates have theirs."""
        for result in results:
            if isinstance(result, CalibrationUpdate):
                self._in_force = result
            elif isinstance(result, Estimate) and self._estimation is not None:
                self._estimation.gate.published(result.sequence)

    # --- state

    @property
    def taught(self) -> bool:
        """Whether the state of the device that is connected now holds more than its configuration states."""
        if self._estimation is None:
            return False
        taken = self._estimation.state.windows or self._in_force is not None
        return bool(taken or self._estimation.gate.on_hold)

    def memory(self) -> bytes:
        """State of the device that is connected now, for later runs."""
        assert self._estimation is not None
        day = self._first_day + self._time.now_s / DAY_S
        held = self._filters, self._device, self._estimation, self._in_force, self._nominal
        means = None if self._watched is None else self._means.snapshot()
        return keep(*held, day, self._time.utc_ns, means)

    def memories(self) -> dict[str, bytes]:
        """`memory` by identity: of the device that is connected now and of those that were connected before."""
        return shelved(self._kept, self.identity, self.memory()) if self.taught else dict(self._kept)

    def _remember(self, memory: bytes) -> tuple[list[Result], str]:
        kept = take_up(memory, self._filters, self._nominal)
        self._streams.state(self._filters.channel)
        self._estimation = kept.estimation
        if kept.means is not None:
            self._means.load(kept.means)
        self._estimation.gate.regain("")
        self._first_day = kept.first_day(self._time.utc_ns, self._time.now_s)
        if kept.in_force is None:
            return [], kept.reason
        if kept.moved:
            return [self._put_in_force()], kept.reason
        now = {"t_utc_ns": self._time.utc_ns, "identity": self.identity}
        self._in_force = again(msgspec.structs.replace(kept.in_force, **now), kept.in_force)
        return [self._in_force], kept.reason

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            **self._time.snapshot(),
            **self._streams.snapshot(),
            "unit": self._unit,
            "identity": self.identity,
            "device": self._device,
            "filters": self._filters.snapshot(),
            **self._references.snapshot(),
            "nominal": self._nominal,
            "estimation": None if self._estimation is None else self._estimation.snapshot(),
            "in_force": plain(self._in_force),
            "kept": dict(self._kept),
            "first_day": self._first_day,
            "status": self._status,
            "refused": self._refused,
            "watch": None if self._watched is None else self._watched.snapshot(),
            "means": None if self._watched is None else self._means.snapshot(),
            **self._clocks.snapshot(),
            **self._self_tests.snapshot(),
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._time.load(state)
        self._filters.load(state["filters"])
        self._streams.state(self._filters.channel)
        self._streams.load(self._time.origin_ns, state)
        self._unit, self.identity, self._device = state["unit"], state["identity"], state["device"]
        self._references.load(state)
        self._nominal, self._estimation = state["nominal"], None
        if state["estimation"] is not None:
            self._estimation = Estimation(self._filters.channel, self._nominal)
            self._estimation.load(state["estimation"])
        self._in_force = update_of(state["in_force"])
        self._kept = dict(state["kept"])
        self._first_day, self._status, self._refused = state["first_day"], state["status"], state["refused"]
        self._clocks.load(state)
        self._self_tests.load(state)
        if self._watched is not None and (watch := state.get("watch")) is not None:  # earlier states have none
            self._watched.load(watch)
            self._means.load(state["means"])
