"""One sensor's S and Q on-line: state, gate and drift test, window by window (docs/online.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from typing import Any

import numpy as np

from agent.config import Channel
from agent.config.knowledge import Prior
from agent.core.exchanges import Explained, exchanged, explanation
from agent.core.explaining import explained, most_likely, motion_across
from agent.core.gate import PROPOSALS_KEPT, Decision, Evidence, Gate, fields_of
from agent.core.hypotheses import Devices, confirmed, possible_jump, rescaled, shape_of_change, tilt_rad
from agent.core.noise_watch import NoiseWatch
from agent.core.time_shift import Anew, LagWatch
from agent.core.windows import StretchWindows
from calib.drift.drift import DriftTest, DriftVerdict
from calib.drift.net_changes import NetChanges
from calib.estimate.axes import LEAST_S, silent_directions
from calib.estimate.correction import Law
from calib.estimate.estimate import Estimate
from calib.estimate.innovation import Innovation
from calib.estimate.physics import WITHIN_U
from calib.estimate.reference_share import ReferenceShare
from calib.estimate.statements import Step
from calib.model import PARAMETERS, Array, Calibration, Window, WindowSums, own_channels
from calib.state.sources import Sources
from calib.state.state import FIRST, State
from calib.windows.record import Record

DAY_S = 86400.0
STATED = "stated by the configuration"  # the method of a calibration that it states with its date
SAME_BUDGET = 1e-9  # of a variance: to which the squares of a budget add up
NEAR = 0.1  # of its largest element, to which S is about another one
TELLS_LAG = 0.3  # of what the clocks leave open of a window's lag: with less, its own slopes tell it
SAME = 1e-6  # standard uncertainties: what rounding moves when the windows are taken again


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """The result for a window: the decision of the gate, the innovation, and drift verdicts that changed.

    `news` for the operator: that the noise has grown, that the time between sensor and reference has shifted, or which
    band and frequency are settled; otherwise "".
    """

    decision: Decision
    innovation: Innovation
    drift: Sequence[DriftVerdict]
    news: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """An estimate whose windows the state did not take: these windows, the steps that were supposed, and what the
    calibration owes to the references."""

    calibration: Calibration
    records: Sequence[Record]
    steps: Sequence[Step]
    shares: Sequence[ReferenceShare]

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            "calibration": fields_of(self.calibration), "records": [record.snapshot() for record in self.records],
            "steps": [asdict(step) for step in self.steps], "shares": [asdict(share) for share in self.shares],
        }  # fmt: skip

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> Proposal:
        """The proposal whose snapshot this is."""
        records = [Record.load(record) for record in state["records"]]
        shares = [ReferenceShare.load(share) for share in state["shares"]]
        return cls(Calibration(**state["calibration"]), records, [Step(**step) for step in state["steps"]], shares)


@dataclass(frozen=True, eq=False)
class TrialWindow:
    """A window tried on the state: what it says; `after` is the state that has taken it."""

    window_sums: WindowSums
    record: Record
    innovation: Innovation
    taken: Callable[[], State]

    @cached_property
    def after(self) -> State:
        """Made when it is first asked for."""
        return self.taken()


@dataclass(frozen=True, slots=True, eq=False)
class Jump:
    """What held windows ask for together: the state to adopt, None if they do not agree; which device has changed, for
    the operator; and whether outputs were exchanged or rescaled, which is told at once."""

    state: State | None
    who: str = ""
    at_once: bool = False


class Estimation:
    """The state, the calibration in force and the held windows. `judge` and commands of an operator change them."""

    def __init__(self, channel: Channel, nominal: float | None) -> None:
        """`nominal` is the device's own sensitivity by its data sheet.

        Raises ValueError where nothing tells a sensitivity to begin with.
        """
        self._channel = channel
        self._beside = channel.by_reference
        mean, fixed = channel.prior.mean(nominal), channel.fixed_mount
        u = channel.prior.standard_uncertainty(mean)
        priors, *check = (beside.priors(fixed_mount=fixed) for beside in self._beside)
        walks, temperature = channel.wander(), channel.temperature_model()
        band_hz = channel.band_hz
        self.state = State(mean, u, priors, walks, temperature, fixed=fixed, check=check, band_hz=band_hz)
        self.in_force, self.law = self.state.result(), self.state.law()
        self.residual_sd = self.state.residual_sd
        self.gate = Gate(channel.gate.filled(self.state.scale, fixed_mount=fixed), self.in_force)
        self.noise = NoiseWatch()
        self.drift, self.net_changes = DriftTest(channel.drift.settings()), NetChanges(channel.drift.of_one_test)
        self._held: list[Record] = []
        self._proposed: list[Proposal] = []
        self.budget: Sources | None = None  # of the calibration in force, where the whole was solved for it
        self._tried: TrialWindow | None = None  # the newest window, for what is asked of it next
        self._lag_watches = [LagWatch(beside, k, self.gate.limit) for k, beside in enumerate(self._beside)]
        self._exchanged = False  # held windows show exchanged or rescaled outputs, and this was told
        self._explain_s: float | None = None  # time of the next explanation of held windows; None where none are held

    def _devices(self, place: int) -> Devices:
        own = self._beside[place]
        others = [beside.reference for other, beside in enumerate(self._beside) if other != place]
        other = (others[0] or "") if others else ""
        return Devices(own.reference or "", other, own.certificate.stability_pct / 100.0, place)

    def lag_watch(self, place: int) -> LagWatch:
        """The watch of the lag behind the reference at a place."""
        return self._lag_watches[place]

    def began(self, device: str) -> None:
        """A device or its line began anew: it may be late by another time from now on."""
        for beside, watch in zip(self._beside, self._lag_watches, strict=True):
            if device in (beside.sensor, beside.reference):
                watch.began(self.state, device)

    def _record(self, window: Window, day: float, lag_s: float, temperature_degc: float, place: int) -> Record:
        made = Record.of(window, day, lag_s, temperature_degc, self.state.reference(place), self.state.motion_to_hz)
        return self.state.with_body(made)

    def date_certificate(self, day: float, utc_ns: int, place: int = FIRST) -> None:
        """Tell the state the date of the certificate of the reference at a place. `utc_ns` is the UTC of `day`."""
        dated = self._beside[place].certificate.date
        before_s = None if dated is None else utc_ns * 1e-9 - dated.timestamp()
        self.state.date_certificate(None if before_s is None else day - before_s / DAY_S, place)

    def after(self, windows: Sequence[Window], day: float, lag_s: float, temperature_degc: float, place: int) -> State:
        """The state once these windows beside the reference at a place, made with `lag_s` taken out, were taken."""
        trial = self._tried_of(windows[0], day, lag_s, temperature_degc, place).after
        for window in windows[1:]:
            _, trial = trial.with_window(self._record(window, day, lag_s, temperature_degc, place))
        return trial

    def contradicted(self, found: StretchWindows, day: float, lag_s: float, place: int) -> bool:
        """Whether a window, made with `lag_s` taken out, contradicts the state, or does not follow the reference."""
        for window in found.windows:
            if not window.used:
                if window.numbers.get("coherence", 1.0) < window.numbers.get("coherence_threshold", 0.0):
                    return True
                continue
            tried = self._tried_of(window, day, lag_s, found.temperature_degc, place)
            if tried.innovation.statistic > self.gate.limit(tried.innovation.degrees_of_freedom):
                return True
        return False

    def own_lag_s(self, found: StretchWindows, day: float, lag_s: float, place: int, trial: State) -> float:
        """The lag of windows that were made with `lag_s` taken out: that of a state `trial`, or their own.

        The clocks leave `u_lag_s` of each window's own lag open. The slopes of the longest window tell it where their
        noise leaves a small part of that open, and no lag that is further away than the clocks allow.
        """
        common_s = trial.lag_s(place)
        window = max(found.used, key=lambda window: window.points)
        left_s, u_s = self._tried_of(window, day, lag_s, found.temperature_degc, place).record.lag_left_s
        if u_s > TELLS_LAG * window.u_lag_s or abs(lag_s + left_s - common_s) > WITHIN_U * window.u_lag_s:
            return common_s
        return lag_s + left_s

    def judge(
        self,
        window: Window,
        day: float,
        lag_s: float,
        temperature_degc: float,
        anew: Anew | None = None,
        place: int = FIRST,
    ) -> Judged:
        """Take, hold or refuse one used window beside the reference at a place. `anew`: the search that found its lag,
        if there was one."""
        told, whole = self._before_window(day)
        if anew is not None:
            self._use_lag(anew, place)
            record = self._record(window, day, lag_s, temperature_degc, place)
            tried = TrialWindow(window.sums, record, *self.state.tried(record, at_its_lag=True))
        else:
            tried = self._tried_of(window, day, lag_s, temperature_degc, place)
        self._tried = None
        noise_news, earlier, followed = self.noise.update(tried.record, self.state.scale), self.state, ""
        candidate = tried.after.result(place)
        held = [*self._held, tried.record][-self._channel.gate.confirm_windows :]
        jump = self._jump(held, place)
        proposed = None if jump.state is None else jump.state.result(place)
        decision = self.gate.judge(self._evidence(window, day, tried), candidate, proposed)
        if decision.action == "take":
            self.state = tried.after
        elif decision.action == "adopt":
            decision, whole = self._adopt(jump, decision, held[0].day, tried, place)
        self._hold(held if decision.action == "hold" else self._held, day * DAY_S, at_once=jump.at_once)
        if decision.action in ("take", "hold"):
            told += self._drifted(day, tried.innovation)
            if not self.gate.held:  # else it is for windows that agree to confirm it
                followed = self._follow(tried.record, place)
        if decision.in_force:
            self.residual_sd = self.state.residual_sd
            self._update_in_force(place, whole, tried.record if decision.action == "take" else None)
        if decision.action == "hold":
            self._propose(decision, tried.after if decision.proposal is candidate else jump.state, place)
            why = self._lag_watches[place].beyond or most_likely(tried.innovation, self.state.scale, self.gate.limit)
            decision = replace(decision, reason=f"{decision.reason}; {why}")
        news = (noise_news, self._news(earlier, place) if decision.action in ("take", "adopt") else "", followed)
        return Judged(decision, tried.innovation, told, "; ".join(filter(None, news)))

    def _use_lag(self, anew: Anew, place: int) -> None:
        """Take the state in which a search has found the lag of the newest window."""
        if anew.shifted:
            self._lag_watches[place].shifted(self.state)
            self.state = anew.base
            self.gate.dismiss()  # windows held before were made with another lag
            self._held = []

    def _evidence(self, window: Window, day: float, tried: TrialWindow) -> Evidence:
        """What the gate needs of a window."""
        same = not self._held or any(record.reference == tried.record.reference for record in self._held)
        return Evidence(
            day * DAY_S, tried.innovation.statistic, tried.innovation.degrees_of_freedom, dismisses=same,
            enough=tried.after.windows > 1 or window.stop_s - window.start_s >= LEAST_S,
            still="" if self.gate.calibrated else silent_directions(tried.after.unexcited),
        )  # fmt: skip

    def _jump(self, held: Sequence[Record], place: int) -> Jump:
        """What as many held windows as confirm a jump ask for; the newest one is beside the reference at a place.
        Outputs that were exchanged or rescaled are looked for until they are found."""
        limit = self.gate.limit
        if len(held) < self._channel.gate.confirm_windows or self._lag_watches[place].beyond:
            return Jump(None)
        adopted, who = confirmed(self.state, held, self._devices(place), limit)
        if self._exchanged or (found := exchanged(self.state, held, limit)) is None:
            return Jump(adopted, who)
        if motion_across(self.state, held):
            return Jump(adopted, who)
        if found.scale is not None:
            adopted = rescaled(self.state, held, found.scale, limit, place) or adopted
        return Jump(adopted, who, at_once=True)

    def _adopt(
        self, jump: Jump, decision: Decision, day: float, tried: TrialWindow, place: int
    ) -> tuple[Decision, Estimate]:
        """Go on with the state that held windows ask for, the first of which is of a day. Returns the decision with
        what the change looks like, and the whole solved anew."""
        assert jump.state is not None
        self.state = jump.state
        whole = self.state.solve()
        self.drift.restart(tried.innovation.information > 0.0)
        self.net_changes.restart()
        shape = "" if jump.at_once else self._shape(day, tried.record, place)
        return replace(decision, reason="; ".join(filter(None, (f"{decision.reason}{jump.who}", shape)))), whole

    def _hold(self, held: Sequence[Record], now_s: float, *, at_once: bool) -> None:
        """Keep as many of the held windows as the gate does, and note when they are explained next."""
        self._held = list(held[-self.gate.held :]) if self.gate.held else []
        if self._held and (at_once or self._explain_s is None):
            self._explain_s = now_s + (0.0 if at_once else self._channel.gate.explain_after_s)
        self._exchanged |= at_once
        if self._exchanged and not self.gate.held:  # the exchange is over: what it showed is no drift
            self._exchanged = False
            self.drift.restart(np.ones(12, dtype=bool))

    def _drifted(self, day: float, innovation: Innovation) -> list[DriftVerdict]:
        """The verdicts on drift that changed with a window."""
        changed = self.drift.update(day * DAY_S, innovation.score, innovation.information)
        return [v for v in changed if v.verdict != "stable" or v.parameter not in self.net_changes.drifting]

    def _propose(self, decision: Decision, made: State | None, place: int) -> None:
        """Keep the proposal of a decision, if it has one, with the state from which it was made."""
        if decision.proposal is not None:
            assert made is not None
            proposal = Proposal(decision.proposal, *made.beyond(self.state), made.shares(place))
            self._proposed = [*self._proposed, proposal][-PROPOSALS_KEPT:]

    def _news(self, earlier: State, place: int) -> str:
        """What the newest window, which was taken, has changed besides S and Q."""
        return "; ".join(filter(None, (self._lag_watches[place].taken(self.state), self.state.settled_since(earlier))))

    def _before_window(self, day: float) -> tuple[list[DriftVerdict], Estimate | None]:
        """Old records are merged; at the first window of a day, net changes of S and Q are judged before. Returns what
        was found, and the solution if the whole was solved anew."""
        told: list[DriftVerdict] = []
        if self.state.begins_day(day):
            told = self.net_changes.update(self.state.shown())
            self.state.widen(self.net_changes.widened)
        if (whole := self.state.merge_old(day)) is not None:
            self._tried = None
        return told, whole

    def explain(self, now_s: float, utc_ns: int) -> str:
        """What explains the held windows, once in each `explain_after_s` while there are any, and at once where outputs
        were exchanged or rescaled; else "".

        `now_s` counts as the days of `judge`, `utc_ns` is UTC then.
        """
        if not self.gate.held or not self._held:
            self._explain_s = None
        if self._explain_s is None or now_s < self._explain_s:
            return ""
        self._explain_s = now_s + self._channel.gate.explain_after_s
        if beyond := self._lag_watches[FIRST].beyond:
            return f"the held windows show another lag: {beyond}"
        if across := motion_across(self.state, self._held):
            return across
        if (found := exchanged(self.state, self._held, self.gate.limit)) is not None:
            return self._exchange(found, utc_ns * 1e-9 - now_s)
        jump, number = possible_jump(self.state, self._held), self._acceptable()
        return explained(self.state, self._held, jump, self.gate, self._channel, number)

    def _exchange(self, found: Explained, origin_utc_s: float) -> str:
        """Outputs that were exchanged or rescaled, in words. `origin_utc_s`: UTC where the days of `judge` begin."""
        first, number = self._held[0], None
        if found.scale is not None:
            number = self._acceptable(found.scale * self.state.result().sensitivity)
        since = datetime.fromtimestamp(origin_utc_s + first.day * DAY_S, UTC).strftime("%Y-%m-%d %H:%M UTC")
        beside = self._beside[self.state.statements.places.get(first.reference, 0)]
        return explanation(found, beside, since, len(self._held), number)

    def _acceptable(self, near: Array | None = None) -> int | None:
        """The number of the newest estimate from held windows that an operator can accept, None if there is none. If
        `near` (3, 3) is named, S must be about as it says."""
        days = {record.day for record in self._held}
        for made in reversed(self._proposed):
            S = made.calibration.sensitivity
            alike = near is None or float(np.abs(S - near).max()) <= NEAR * float(np.abs(near).max())
            if alike and days & {record.day for record in made.records}:
                return self.gate.number_of(made.calibration)
        return None

    def _tried_of(self, window: Window, day: float, lag_s: float, temperature_degc: float, place: int) -> TrialWindow:
        """The window tried on the state; the newest one is not tried again."""
        tried = self._tried
        if tried is None or tried.window_sums is not window.sums or tried.record.lag_s != lag_s:
            record = self._record(window, day, lag_s, temperature_degc, place)
            self._tried = tried = TrialWindow(window.sums, record, *self.state.tried(record))
        return tried

    def shares_of(self, calibration: Calibration, place: int) -> Sequence[ReferenceShare]:
        """What a calibration, of which U is beside the reference at a place, owes to the references, where that is
        known."""
        if np.array_equal(self.state.covariance(place), calibration.covariance):
            return self.state.shares(place)
        proposal = self._proposal_of(calibration)
        return () if proposal is None else proposal.shares

    def _proposal_of(self, calibration: Calibration) -> Proposal | None:
        same = (p for p in self._proposed if np.array_equal(p.calibration.covariance, calibration.covariance))
        return next(same, None)

    def accept(self, calibration: Calibration) -> None:
        """An operator put a proposal in force. The state takes its windows, after the steps that it supposed."""
        if (proposal := self._proposal_of(calibration)) is not None:  # else the state has taken them already
            self.state.take_also(proposal.records, proposal.steps)
            self._forget()
        self._put_in_force(calibration)

    def roll_back(self, calibration: Calibration, day: float | None = None) -> None:
        """An operator put an earlier calibration in force on a day; None is that of the newest window. The state
        continues from it, if it differs from the state.

        How its errors depend on the references is not known any more, so that the state is less certain than it.
        """
        now = self.state.result()
        if not (
            np.array_equal(now.sensitivity, calibration.sensitivity) and np.array_equal(now.offset, calibration.offset)
        ):
            self.state.put(calibration, day)
            self._forget()
        self._put_in_force(calibration)

    def believe(self) -> None:
        """The prior is an earlier calibration of the sensor, and is in force. Nothing is known of Q where nothing is
        stated of it."""
        unknown = Prior.model_fields["u_offset_mps2"].default
        told_Q = np.broadcast_to(self._channel.prior.u_offset_mps2, 3) < unknown
        told = np.append(np.ones(9, dtype=bool), told_Q)
        stated = replace(self.in_force, determined=told, method=STATED)
        self.gate.believe(stated)
        self._put_in_force(stated)

    def _forget(self) -> None:
        """S and Q were replaced: what windows told of a drift of them before is none."""
        self.drift.restart(np.ones(12, dtype=bool))
        self.net_changes.restart()

    def _put_in_force(self, calibration: Calibration) -> None:
        law = self.state.law()  # the dependence of S and Q on the temperature is that of the state
        mean, covariance = law.mean.copy(), law.covariance.copy()
        mean[:12] = np.append(calibration.sensitivity.ravel(), calibration.offset)
        covariance[:12, :12] = calibration.covariance
        self.in_force, self.budget = calibration, None
        self.law = replace(law, mean=mean, covariance=covariance, determined=calibration.determined)
        self._held, self._proposed = [], []

    def meet(self, reference: str, calibrated: str, sensitivity: float, place: int = FIRST) -> bool:
        """The reference that is connected now at a place, and its certificate (see State.meet).

        Held windows of another reference are dropped. Returns whether the calibration in force changed.
        """
        before, follows = self.state.reference(place), self.follows_state(place)
        if changed := self.state.meet(reference, calibrated, sensitivity, place):
            self.net_changes.restart()
        if before not in ("", self.state.reference(place)):
            self.gate.dismiss()
            self._lag_watches[place].forget()
            self._held, self._proposed = [], []
        return changed and follows and self._update_in_force(place)

    def restate(self, gravity_mps2: tuple[float, float] | None, *, remounted: bool, size: float | None = None) -> bool:
        """After `load` of a state that was made with another configuration: see State.restate.

        `remounted`: the stated poses changed. `size`: other filters are known, and those of the sensor pass so many
        times what they did. Returns whether the calibration in force changed.
        """
        follows = self.follows_state()
        if size is not None:
            u_S = (size - 1.0) * self.state.result().sensitivity.ravel()
            for place in range(len(self._beside)):
                u = np.append(u_S, np.zeros(3))
                self.state.step(self.state.changes(u, place=place, line=True, another_filter=np.inf))
                u_S = np.zeros(9)
            self._held = []
        if remounted:
            self.state.remount()
            self._held = []
        changed = self.state.restate(gravity_mps2) or size is not None
        if changed or remounted:
            self.net_changes.restart()
        return changed and follows and self._update_in_force()

    def follows_state(self, place: int = FIRST) -> bool:
        """Whether the calibration in force is that of the state beside the reference at a place, but for rounding."""
        now, u = self.state.result(place), self.in_force.standard_uncertainty
        moved = np.append(now.sensitivity - self.in_force.sensitivity, now.offset - self.in_force.offset)
        return self.gate.calibrated and bool(np.all(np.abs([moved, now.standard_uncertainty - u]) <= SAME * u))

    def _update_in_force(self, place: int = FIRST, whole: Estimate | None = None, record: Record | None = None) -> bool:
        """Put the state's S and Q beside the reference at a place in force. `whole`: the solution from which they
        follow, before `record` if that is named.

        Their budget is known where the two say the same. They do not where `record` has unknowns of its own, or moved
        the estimate so far that the state linearised all windows again: then the calibration has no budget.
        """
        self.in_force, self.law, self.budget = self.state.result(place), self.state.law(place=place), None
        whole = whole.with_window(record) if whole is not None and record is not None else whole
        if whole is not None:
            found, variances = self.state.budget(whole, place), self.in_force.covariance.diagonal()
            if np.allclose(found.standard_uncertainty**2, variances, rtol=SAME_BUDGET, atol=0.0):
                self.budget = found
        return True

    def _shape(self, day: float, newest: Record, place: int) -> str:
        """What the change of S since the windows of a day looks like. With two references windows of both tell which
        device has changed, and none is named by one of them."""
        count = own_channels(newest.channels) if len(self._beside) == 1 else 0
        return shape_of_change(self.state, day, newest.pose.direction[:, :count], self.gate.limit, place)

    def _follow(self, newest: Record, place: int) -> str:
        """Steps so small that each window alone was consistent, and drifts: the state may follow them. Returns what the
        change of S looks like, "" where nothing is followed or nothing can be said.

        A drift has made S or Q wrong since its onset. U covers this, and the rate becomes unknown. What looks like a
        change of S may be another filter, so that the response over frequency may have changed by as much at the
        frequency of S, or one of the reference, which may then have changed by as much.
        """
        loose, rate = np.zeros(12), np.zeros(12)
        for k, verdict in enumerate(self.drift.result()):
            if verdict.verdict == "stable" or verdict.statistic <= verdict.threshold:
                continue
            if verdict.verdict == "drifting":
                rate[k] = np.hypot(verdict.rate, verdict.u_rate)
            loose[k] = np.hypot(verdict.change, verdict.u_change)
        shape = ""
        if loose[:9].any():
            since_s = min(own.onset_s for own, size in zip(self.drift.result(), loose[:9], strict=False) if size)
            shape = self._shape(since_s / DAY_S, newest, place)
        if loose.any():
            leaning_rad, of_S = tilt_rad(loose[9:], self.state.scale), float(loose[:9].max()) / self.state.scale
            u = self.state.changes(loose, leaning_rad, place=place, u_rate=rate, another_filter=of_S)
            self.state.step(u | self._of_reference(loose, place))
            self.drift.restart(loose > 0.0)
        return shape

    def _of_reference(self, loose: Array, place: int) -> dict[str, float]:
        """By how much the reference may have changed in place of S, by key; nothing if it is stated not to."""
        found: dict[str, float] = {}
        if (now := self.state.shown().get(self.state.reference(place))) is not None:
            for p in np.flatnonzero(loose[:9]).tolist():
                for key, (moves, _) in now.makers[p].items():
                    if key != PARAMETERS[p]:
                        found[key] = max(found.get(key, 0.0), float(loose[p]) * moves)
        return found

    # --- state

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            "state": self.state.snapshot(),
            "gate": self.gate.snapshot(),
            "drift": self.drift.snapshot(),
            "walks": self.net_changes.snapshot(),  # the name in states of earlier versions
            "noise": self.noise.snapshot(),
            "held": [record.snapshot() for record in self._held],
            "proposed": [proposal.snapshot() for proposal in self._proposed],
            "in_force": fields_of(self.in_force),
            "law": {name: getattr(self.law, name) for name in Law.__slots__},
            "residual_sd": self.residual_sd,
            "lag_watches": [watch.snapshot() for watch in self._lag_watches],
            "exchanged": self._exchanged,
            "explain_s": self._explain_s,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        if state["state"] is None:  # of a version before 9
            self.gate.load(state["gate"])
            self.roll_back(Calibration(**state["in_force"]), state["day"])
            return
        self.state.load(state["state"])
        self.gate.load(state["gate"])
        self.drift.load(state["drift"])
        self.net_changes.load(state["walks"])
        self.noise.load(state["noise"])
        self._held = [Record.load(record) for record in state["held"]]
        self._proposed = [Proposal.load(proposal) for proposal in state["proposed"]]
        self.in_force, self.law = Calibration(**state["in_force"]), Law(**state["law"])
        self.residual_sd = np.array(state["residual_sd"])
        self._exchanged, self._explain_s = state["exchanged"], state["explain_s"]
        for watch, kept in zip(self._lag_watches, state["lag_watches"], strict=False):
            watch.load(kept)
