"""The dialogue of a visit: what is wrong with the clamp, how long to stay, and when to go on."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from agent.bench.capture import Capture
from agent.bench.clamp_words import as_object, findings
from agent.bench.dialogue import BEFORE_S, GAIN, SETTLED_S, STALE_S
from agent.bench.measuring import StopInterval
from agent.bench.screen import Person, u_text
from agent.bench.stops import BenchStop
from agent.bench.visiting import Ahead, Visiting, VisitLook
from calib.visit.clamping import Clamping

CLAMP_FROM_S = 15.0  # of samples, in which a clamp can be judged
LEAST_STAY_S = 30.0  # before that the spread of the noise itself is hardly known
LOOK_S = 5.0  # from one look to the next, or twice the time that a look takes
Ending = Literal["measured", "left out", "quit"]


@dataclass(frozen=True, slots=True)
class VisitStay:
    """How long to stay beside a sensor at least and at most, s."""

    least_s: float
    most_s: float


@dataclass(frozen=True, slots=True)
class Visited:
    """How a visit ended: `taken` None where nothing was measured; the last look; whether U is as wanted.

    `promised_s`: how long it would take, as first told; None if that was never told.
    """

    ending: Ending
    taken: StopInterval | None = None
    look: VisitLook | None = None
    reached: bool = False
    promised_s: float | None = None
    found: tuple[tuple[str, str], ...] = ()

    @property
    def clamp(self) -> dict[str, Any] | None:
        """The members of the JSON object on the clamp; None where too little was seen of it."""
        clamp = None if self.look is None else self.look.clamp
        return None if clamp is None else as_object(clamp, dict(self.found))


class VisitDialogue:
    """Leads one visit.

    `clamp` clamps a virtual reference as the answer says; None where a person does.
    """

    def __init__(
        self,
        visiting: Visiting,
        capture: Capture,
        stay: VisitStay,
        person: Person,
        clamp: Callable[[str], None] | None = None,
    ) -> None:
        self._visiting, self._capture, self._stay = visiting, capture, stay
        self._ask, self._say, self._progress, self._clamp = person.ask, person.say, person.progress, clamp
        self._promised_s: float | None = None
        self._warned: set[str] = set()

    def run(self, stop: BenchStop) -> Visited:
        """One visit at a sensor."""
        prompt = "  Enter when it is clamped and nobody touches it; s: leave this sensor out; q: end > "
        kept, visited = False, Visited("left out")
        while True:
            answer = self._ask(prompt)
            for line in self._capture.messages():
                self._say(f"  {line}")
            if answer is None or answer == "q":
                return Visited("quit")
            if answer == "s":
                return visited
            if self._clamp is not None and answer != "k":
                self._clamp(answer)
            kept = kept or answer == "k"
            visited, wrong = self._watch(stop, kept)
            if not wrong:
                return visited
            prompt = "  Enter: measure anew; k: measure with the clamp as it is; s: leave this sensor out; q: end > "

    def _watch(self, stop: BenchStop, kept: bool) -> tuple[Visited, bool]:
        """How a stay ended, and whether the clamp is wrong so that the person must decide."""
        start_s = self._capture.now_s + SETTLED_S
        self._promised_s, wait_s = None, LOOK_S
        self._warned.clear()
        while True:
            time.sleep(wait_s)
            now_s = self._capture.now_s
            for line in self._capture.messages():
                self._say(f"  {line}")
            if (dumb := self._capture.silent(self._visiting.measuring.devices, now_s, STALE_S)) is not None:
                self._say(f"  no samples of {dumb} for {STALE_S:g} s: check its cable")
                return Visited("left out"), True
            if now_s - start_s < CLAMP_FROM_S:
                self._progress(f"  {now_s - start_s:3.0f} s: looking at the clamp")
                continue
            taken = StopInterval(stop, start_s, now_s)
            look = self._visiting.look(self._capture.record(start_s - BEFORE_S), taken)
            wait_s = max(LOOK_S, 2.0 * (self._capture.now_s - now_s))
            found = {} if look.clamp is None else findings(look.clamp, stop.name)
            if self._wrong(found) and not kept:
                return Visited("left out", None, look, found=tuple(found.items())), True
            ended = self._goes_on(taken, look, found)
            if ended is not None:
                return ended, False

    def _wrong(self, found: dict[str, str]) -> bool:
        """Say what is new, and whether the clamp must be changed: to wait is of no use."""
        for kind, told in found.items():
            if kind not in self._warned:
                self._say(f"  {told}")
                self._warned.add(kind)
        return bool({"loose", "turned"} & set(found))

    def _goes_on(self, taken: StopInterval, look: VisitLook, found: dict[str, str]) -> Visited | None:
        """How the visit ends; None to stay."""
        stayed_s, later = taken.stop_s - taken.start_s, look.ahead
        over = stayed_s >= self._stay.most_s
        if later is None:
            for reason in look.reasons:
                if over:
                    self._say(f"  {reason}")
            self._progress(f"  {stayed_s:3.0f} s: no U yet")
            ended = over
            reached = False
        else:
            reached = later.needed_s <= stayed_s
            self._tell(later, look.clamp, stayed_s)
            gained = float(np.max(later.now / np.maximum(later.at_last, 1e-12))) < GAIN
            ended = over or (stayed_s >= self._stay.least_s and (reached or gained))
        if not ended:
            return None
        if later is not None:
            how = "as wanted" if reached else "not as wanted"
            self._say(f"  after {_span(stayed_s)}: U is {u_text(later.now)}, {how}")
        else:
            self._say(f"  after {_span(stayed_s)}: no result")
        return Visited("measured", taken, look, reached, self._promised_s, tuple(found.items()))

    def _tell(self, later: Ahead, clamp: Clamping | None, stayed_s: float) -> None:
        """Say once how long it takes, and then show how it goes on."""
        moved = "" if clamp is None else f" at this motion ({1e3 * float(clamp.moved_mps2.max()):.3g} mm/s2 rms)"
        if self._promised_s is None and "time" not in self._warned:
            self._warned.add("time")
            if np.isinf(later.needed_s):
                self._say(
                    f"  what is wanted cannot be reached however long you stay: U never becomes less than "
                    f"{u_text(later.at_last)}, because of {later.because}"
                )
            else:
                self._promised_s = later.needed_s
                if later.needed_s > stayed_s:
                    self._say(f"  stay for {_span(later.needed_s)} in all{moved}")
                if later.needed_s > self._stay.most_s:
                    self._say(
                        f"  that is longer than the {_span(self._stay.most_s)} of this visit: more motion shortens "
                        "it, and --minutes allows more"
                    )
        left_s = max(later.needed_s - stayed_s, 0.0)
        ahead = "" if np.isinf(left_s) else f"; as wanted in {_span(left_s)}"
        self._progress(f"  {stayed_s:3.0f} s: U is {u_text(later.now)}{ahead}")


def forbidden(u_reference: float, wanted_main: float) -> str:
    """Why this reference cannot give what is wanted, whatever the visit; "" if it can. Both are relative U (k = 2)."""
    if u_reference < wanted_main:
        return ""
    return (
        f"{100.0 * wanted_main:.3g} % cannot be reached with this reference: its own U is {100.0 * u_reference:.3g} % "
        "(certificate and drift since then); have it calibrated better, or want less"
    )


def _span(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.0f} h"
