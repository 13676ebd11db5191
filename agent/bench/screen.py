"""What a person sees of a session: lines on the terminal, and the guide on the page of the monitor."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from agent.bench.session import BenchSession, Outlook
from agent.bench.stops import AXES, BenchStop
from agent.delivery.guide import (
    LINES_MAX,
    STOPS_MAX,
    Ending,
    Expanded,
    Guide,
    MadeFile,
    NextStop,
    Staying,
    TakenStop,
    Warned,
    clipped,
)
from calib.model import Array
from calib.rounding import plus_minus
from calib.visit.next_stop import MAIN, POWER, Suggestion, WantedUncertainty

NAME_MAX = 63


@dataclass(frozen=True)
class Person:
    """Who is led, at a terminal. `ask` gives the answer to a question, None at the end of input."""

    ask: Callable[[str], str | None]
    say: Callable[[str], None]
    progress: Callable[[str], None]


class BenchScreen:
    """Says each thing to both. `publish` takes the guide."""

    def __init__(
        self, sensor: str, wanted: WantedUncertainty, person: Person, publish: Callable[[Guide], None]
    ) -> None:
        self._ask, self.say, self._progress, self._publish = person.ask, person.say, person.progress, publish
        self._stop = 1
        target = Expanded(100.0 * wanted.main, 100.0 * wanted.transverse)
        self._guide = Guide(t_utc_ns=0, sensor=sensor, stage="planning", wanted=target)
        self._show()

    def _show(self, **changed: Any) -> None:
        self._guide = structs.replace(self._guide, **changed, t_utc_ns=time.time_ns())
        self._publish(self._guide)

    def warn(self, line: str) -> None:
        """Something is wrong."""
        self.say(f"  {line}")
        warned = Warned(self._stop, clipped(line))
        self._show(warnings=[*self._guide.warnings, warned][-LINES_MAX:])

    def ask(self, prompt: str) -> str | None:
        """The answer to a question, None at the end of input."""
        question = clipped(prompt.strip().removesuffix(">").rstrip())
        self._show(stage="turn" if self._guide.stage == "turn" else "question", prompt=question)
        answer = self._ask(prompt)
        self._show(prompt="")
        return answer

    def outlook(self, lines: Sequence[str]) -> None:
        """Say how far it is."""
        for line in lines:
            self.say(line)
        self._show(outlook=[clipped(line) for line in lines][:LINES_MAX])

    def turn(self, number: int, stop: BenchStop, best: Suggestion, session: BenchSession, ahead: Outlook) -> None:
        """Say which position comes next, why, and what U will be after it."""
        before, more = session.joint.expanded, None if ahead.stops is None else max(ahead.stops - 1, 0)
        why = _most_improved(before, best.expanded, session.wanted)
        self._stop = number
        self.say(f"stop {number}: {stop.told}")
        self.say(f"  it tells most of {why}")
        then = f"; {count(more)} more then to what is wanted" if more else ""
        self.say(f"  U will be {u_text(best.expanded)}{then}")
        after = _expanded(best.expanded)
        coming = NextStop(number, clipped(stop.name, NAME_MAX), clipped(stop.told), clipped(why), after, more)
        self._show(stage="turn", next=coming, staying=None, expanded=_expanded(before))

    def stay(self, stop: BenchStop, stayed_s: float, least_s: float, most_s: float, u: Array | None) -> None:
        """Show how the present position goes on. `u` (9,): U with it, None as long as it is not known."""
        if u is not None:
            self._progress(f"  {stayed_s:3.0f} s: U will be {u_text(u)}")
        now = None if u is None else _expanded(u)
        self._show(stage="measuring", staying=Staying(clipped(stop.name, NAME_MAX), stayed_s, least_s, most_s, now))

    def computing(self) -> None:
        """All stops are being adjusted."""
        self._show(stage="computing")

    def took(self, names: Sequence[str], u: Array) -> None:
        """The newest of these stops is used, and U (9,) is what is known now."""
        self.say(f"  stop {len(names)}, {names[-1]}: U is now {u_text(u)}")
        self.show_stops(names, u)

    def show_stops(self, names: Sequence[str], u: Array) -> None:
        """These stops are used, of which the last or a name was changed."""
        now = _expanded(u)
        known = [each.expanded for each in self._guide.taken] + [now]
        taken = [TakenStop(clipped(name, NAME_MAX), e) for name, e in zip(names, known, strict=False)]
        self._show(taken=taken[-STOPS_MAX:], expanded=now, staying=None)

    def show_end(self, output: Path | None, status: int) -> None:
        """The session is over; `output` has the result, `status` is the exit status of the program."""
        self._show(stage="ended", next=None, staying=None, prompt="", ending=_ending(output, status))


def _most_improved(before: Array, after: Array, wanted: WantedUncertainty) -> str:
    """The element of S of which a stop tells most, by what the plan compares stops with, and its U."""
    cost = (before / wanted.by_parameter) ** POWER - (after / wanted.by_parameter) ** POWER
    k = int(np.argmax(cost))
    return f"S{AXES[k // 3]}{AXES[k % 3]}: its U falls from {100.0 * before[k]:.2g} % to {100.0 * after[k]:.2g} %"


def _ending(output: Path | None, status: int) -> Ending:
    """What the files of the result say."""
    path = None if output is None else output / "result.json"
    if path is None or output is None or not path.exists():
        return Ending("no result", [])
    found = json.loads(path.read_text())
    made = sorted((output / "certificate").glob("*"))
    files = [
        MadeFile(clipped(str(each.relative_to(output.parent))), hashlib.sha256(each.read_bytes()).hexdigest())
        for each in [path, *made]
    ]
    reasons = [clipped(reason) for reason in found["reasons"]][:LINES_MAX]
    values, k = _values(found)
    return Ending("valid" if status == 0 else "refused", reasons, values, k, files[:LINES_MAX])


def _values(found: dict[str, Any]) -> tuple[list[list[str]], float | None]:
    """S and Q with U as text, row by row, and the coverage factor; ([], None) where the result has none."""
    S, Q, u = found.get("sensitivity"), found.get("offset"), found.get("expanded_uncertainty")
    if not (S and u):
        return [], None
    rows = [
        [plus_minus(value, expanded) for value, expanded in zip([*s, q], [*u_s, u_q], strict=True)]
        for s, q, u_s, u_q in zip(S, Q or [None] * 3, u["sensitivity"], u["offset"] or [None] * 3, strict=True)
    ]
    return rows, u["coverage_factor"]


def _expanded(u: Array) -> Expanded:
    return Expanded(100.0 * float(u[MAIN].max()), 100.0 * float(u[~MAIN].max()))


def count(stops: int) -> str:
    """So many stops, in words."""
    return f"{stops} stop{'' if stops == 1 else 's'}"


def pair(main: float, transverse: float) -> str:
    """Relative U of main and transverse sensitivities, as text."""
    return f"{100.0 * main:.2g} % (main), {100.0 * transverse:.2g} % (transverse)"


def u_text(expanded: Array) -> str:
    """U (9,) as text."""
    return pair(float(expanded[MAIN].max()), float(expanded[~MAIN].max()))
