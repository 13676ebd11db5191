"""The dialogue: says where to turn the sensor, watches it there, and asks again where something is wrong."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from agent.bench.capture import Capture
from agent.bench.measuring import StopInterval
from agent.bench.screen import BenchScreen, count, pair, u_text
from agent.bench.session import BenchSession, Outlook, StopFit
from agent.bench.stops import BenchStop
from agent.bench.thinking import Look, Thinking
from calib.model import Array

LOOK_S = 1.0  # from one look at the samples to the next
FIT_FROM_S = 2.0  # of samples; in fewer a slow motion tells no slopes
REST_TOLD_FROM_S = 8.0  # before that a rest cannot be told from slow motion
SETTLED_S = 1.0  # after a turn by hand a clamp vibrates for about a second
GAIN = 1.02  # a longer stay would reduce U by less than 2 %
BEFORE_S = 5.0  # of samples before a stop: for its clock, and for the ends of filters
NO_DIGITS = str.maketrans("", "", "0123456789.")  # a reason is said once, not with each new number
STALE_S = 3.0  # without samples of a device for so long the session says so


@dataclass(frozen=True, slots=True)
class StopStay:
    """How long to stay at a stop, s."""

    least_s: float = 5.0
    most_s: float = 60.0


@dataclass(slots=True)
class _Warnings:
    """What was said of the present stop: the reason why it cannot be used, and from how many knocks on it is said
    again."""

    reason: str = ""
    knocked: int = 0

    def of(self, look: Look, *, told: bool) -> Iterator[str]:
        """What is wrong and was not said yet. `told`: the stay is long enough for a reason."""
        if told and look.reason and (reason := look.reason.translate(NO_DIGITS)) != self.reason:
            self.reason = reason
            yield look.reason
        if look.left_out > self.knocked:
            self.knocked = 2 * look.left_out
            yield f"knocks: {look.left_out} of {look.points} samples are left out; do not touch the table"


class Dialogue:
    """Leads a person through a session. `taken` are the stops that are used.

    `screen` is what the person sees, and asks. `turn` turns a virtual sensor and gives the seconds that it takes; None
    where a person turns the sensor.
    """

    def __init__(
        self,
        mind: Thinking,
        capture: Capture,
        stay: StopStay,
        screen: BenchScreen,
        turn: Callable[[BenchStop], float] | None = None,
    ) -> None:
        self._mind, self._capture = mind, capture
        self._stay, self._screen, self._say, self._turn = stay, screen, screen.say, turn
        self.taken: list[StopInterval] = []
        self._refused: tuple[str, ...] = ()
        self._standing: BenchStop | None = None  # where the sensor was put last

    @property
    def _session(self) -> BenchSession:
        return self._mind.session

    def run(self) -> None:
        """Take stops until all is as wanted, or until the person ends the session."""
        self._begin()
        while not self._session.reached or not self.taken or self._refused:
            stop = self._next_stop()
            if stop is None:
                break
            self._take(stop)
        else:
            self._screen.outlook([f"reached after {count(len(self.taken))}: U {u_text(self._session.joint.expanded)}"])

    def _begin(self) -> None:
        wanted, (_, outlook) = self._session.wanted, self._mind.next_stop()
        self._say(f"wanted: U (k = 2) {pair(wanted.main, wanted.transverse)}, apart from the reference's own error")
        self._screen.outlook(self._outlook(outlook))

    def _outlook(self, outlook: Outlook) -> list[str]:
        if outlook.stops is not None:
            more = "" if outlook.mostly == outlook.stops else f"; {outlook.mostly} are enough in 19 of 20 sessions"
            return [f"this takes about {count(outlook.stops)}{more}"]
        lines = [f"this bench does not reach it: after 100 stops U would still be {pair(*outlook.best)}"]
        stops = self._session.stops
        if outlook.because:
            lines.append(
                f"the reason is {outlook.because}, which all stops share: U never becomes less than "
                f"{pair(*outlook.floor)}; state a smaller uncertainty of it if you know it better, or end with q"
            )
        elif len({s.pose.theta_rad for s in stops}) == 1 and stops[0].columns.get("theta_deg"):
            lines.append("one inclination does not tell theta from the sensitivities: add a second one with --thetas")
        return lines

    def _next_stop(self) -> BenchStop | None:
        """The stop that the person takes; None to end the session."""
        best, outlook = self._mind.next_stop()
        stop = self._session.stops[best.stop]
        self._screen.turn(len(self.taken) + 1, stop, best, self._session, outlook)
        while True:
            answer = self._screen.ask(
                f"  Enter when it stands ({stop.name}); another position as typed; u: undo; q: end > "
            )
            for line in self._capture.messages():
                self._screen.warn(line)
            if answer is None or answer == "q":
                return None
            if answer == "u":
                self._undo()
                return self._next_stop()
            if answer.startswith("hand ") and self._turn is not None:
                stood = self._session.stop_named(answer.removeprefix("hand "))
                if stood is not None:
                    self._put(stood)
                    return stop
            chosen = stop if answer == "" else self._session.stop_named(answer)
            if chosen is not None:
                if self._turn is not None:
                    self._put(chosen)
                return chosen
            self._say(f"  {answer!r} is no position; type it as {stop.name!r}")

    def _put(self, stop: BenchStop) -> None:
        """Turn the virtual sensor, unless it stands there already."""
        assert self._turn is not None
        if self._standing is None or self._standing.name != stop.name:
            time.sleep(self._turn(stop))
        self._standing = stop

    def _undo(self) -> None:
        if not self.taken:
            self._say("  no stop was taken yet")
            return
        gone = self.taken.pop()
        self._say(f"  stop {len(self.taken) + 1} ({gone.stop.name}) is not used")
        self._adjust()
        self._screen.show_stops(self._names, self._session.joint.expanded)

    def _take(self, stop: BenchStop) -> None:
        """Stay at a stop, and use it if it is sound."""
        while True:
            start_s = self._capture.now_s + SETTLED_S
            fit, stop_s = self._watch(stop, start_s)
            if fit is None:
                self._say("  this stop is not used")
                return
            if fit.fits:
                break
            answer = self._screen.ask(self._misfit(stop, fit))
            if answer == "y" and fit.instead is not None:
                stop = self._session.stops[fit.instead]
                break
            if answer == "k":
                break
            if answer == "c" and fit.earlier is not None:
                self._correct(*fit.earlier)
                break
            if answer is None or answer == "q":
                self._say("  this stop is not used")
                return
            if self._turn is not None:
                self._put(stop)
        self.taken.append(StopInterval(stop, start_s, stop_s))
        self._adjust()
        self._screen.took(self._names, self._session.joint.expanded)
        for line in self._session.doubts():
            self._screen.warn(line)
        for reason in self._refused:
            self._screen.warn(f"U is as wanted, but the result would be refused: {reason}")

    @property
    def _names(self) -> list[str]:
        return [each.stop.name for each in self.taken]

    def _adjust(self) -> None:
        self._screen.computing()
        self._refused = self._mind.take(self._capture.record(), self.taken)

    def _earlier(self, start_s: float) -> int:
        """The number of the stop in which a window began at this time."""
        return next(k for k, each in enumerate(self.taken) if each.start_s <= start_s <= each.stop_s)

    def _correct(self, start_s: float, instead: int) -> None:
        k = self._earlier(start_s)
        self.taken[k] = replace(self.taken[k], stop=self._session.stops[instead])

    def _misfit(self, stop: BenchStop, fit: StopFit) -> str:
        wrong = f"this does not look like {stop.name} (chi2 {fit.chi2:.4g}, {fit.limit:.4g} at most)"
        if fit.earlier is not None:
            start_s, instead = fit.earlier
            k, name = self._earlier(start_s), self._session.stops[instead].name
            other = f"stop {k + 1} ({self.taken[k].stop.name}) may be the wrong one: it looks like {name}"
            self._screen.warn(f"{wrong}; {other}")
            again = f"c: stop {k + 1} is at {name}, keep both; Enter: measure this one again"
            return f"  {again}; k: keep it as told; q: leave it out > "
        if fit.instead is None:
            self._screen.warn(f"{wrong}; it fits no position: is the sensor loose, or turned another way?")
            return "  Enter: measure again after turning it; k: keep it as told; q: leave it out > "
        like = self._session.stops[fit.instead]
        last = self.taken[-1].stop.name if self.taken else ""
        why = "the sensor was not turned" if like.name == last else "it looks turned"
        self._screen.warn(f"{wrong}; {why}: it stands as at {like.name}")
        return (
            f"  Enter: measure again after turning it; y: it is at {like.name}; k: keep it as told; q: leave it out > "
        )

    def _watch(self, stop: BenchStop, start_s: float) -> tuple[StopFit | None, float]:
        """How a stay fits its stop, None where it cannot be used; and when it ended. Says at once what is wrong."""
        warnings = _Warnings()
        told_from_s = REST_TOLD_FROM_S if self._session.expected.rms_mps2 == 0.0 else FIT_FROM_S
        while True:
            time.sleep(LOOK_S)
            now_s = self._capture.now_s
            stayed_s = now_s - start_s
            for line in self._capture.messages():
                self._screen.warn(line)
            if (dumb := self._capture.silent(self._mind.measuring.devices, now_s, STALE_S)) is not None:
                self._screen.warn(f"no samples of {dumb} for {STALE_S:g} s: check its cable")
                return None, now_s
            if stayed_s < FIT_FROM_S:
                self._show_stay(stop, max(stayed_s, 0.0), None)
                continue
            look = self._mind.look(self._capture.record(start_s - BEFORE_S), StopInterval(stop, start_s, now_s))
            for line in warnings.of(look, told=stayed_s >= told_from_s):
                self._screen.warn(line)
            self._show_stay(stop, stayed_s, look.expanded)
            if stayed_s > self._stay.most_s or self._is_enough(look, stayed_s):
                return look.fit, now_s

    def _is_enough(self, look: Look, stayed_s: float) -> bool:
        """Whether a stop that can be used needs no longer stay, or does not fit."""
        if look.fit is None:
            return False
        return not look.fit.fits or (stayed_s >= self._stay.least_s and look.gain < GAIN)

    def _show_stay(self, stop: BenchStop, stayed_s: float, u: Array | None) -> None:
        self._screen.stay(stop, stayed_s, self._stay.least_s, self._stay.most_s, u)
