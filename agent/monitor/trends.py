"""What the page shows of a sensor's history: its main sensitivities thinned, their change with U, and its verdicts."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from agent.monitor.database import DAY_NS, Database
from agent.monitor.fleet import MAIN, Fleet, Place
from agent.monitor.onset import Array, Since, since
from calib.model import PARAMETERS

PCT_DIGITS = 5  # behind the point of a change in %; more would only make the answers larger
THINNED = 60  # points of a small plot
POINTS = 400  # of the history to which a change is fitted
YEAR_DAYS = 366
KEPT_FOR_S, KEPT_MAX = 60.0, 2000  # for so long, and of so many sensors, what was found is used again
SECOND_NS = 1_000_000_000  # a window is longer
STATUSES = 200  # changes of status that are looked at
WINDOWS = 400  # windows among which those that are held are looked for, the newest
ESTIMATES = 12  # that are shown beyond the calibration in force
# Source of a budget that results of one reference share (calib.estimate.quantities).
OF_REFERENCE = "reference sensitivity"
Shape = Literal["drifting", "stepped"]
_ACCEPTED = re.compile(r"(?:estimate [0-9]+ accepted|rolled back) by ")  # as agent.core.gate says it


class Trends:
    """What is found of the sensors of a database. May be used by several threads."""

    def __init__(self, database: Database, fleet: Fleet) -> None:
        self._database, self._fleet = database, fleet
        self._kept: dict[tuple[Place, str], tuple[float, dict[str, Any]]] = {}

    def of(self, place: Place) -> dict[str, Any]:
        """`t_utc_ns` (n) and `main_pct` (3, n): a year of the main sensitivities as changes since the calibration of
        `accepted_utc_ns`; `changes`: of each parameter its change and U of that; `budget`: what makes u of the main
        sensitivities (3), by source; `found`: of each verdict what the history tells; `held_utc_ns`: since when the
        status is what it is; `adopted_utc_ns`: when a jump last came into force since then; `beside`: Fleet.beside,
        since the change began or the sensor is held.
        Where the status is HELD also `refused_utc_ns`: when a window since then was not used, thinned; and `estimates`:
        the newest ones after the calibration in force, each with `t_utc_ns`, `main_pct` (3), `values` and `u` (12).

        {} where no calibration is known.
        """
        verdicts = self._fleet.verdicts(place)
        key = place, str([self._fleet.status(place), *((v["parameter"], v["verdict"]) for v in verdicts)])
        kept_s, found = self._kept.get(key, (-KEPT_FOR_S, {}))
        if time.monotonic() - kept_s >= KEPT_FOR_S:
            found = self._compute(place, verdicts)
            if len(self._kept) >= KEPT_MAX:
                self._kept.pop(next(iter(self._kept)), None)
            self._kept[key] = time.monotonic(), found
        return found

    def _compute(self, place: Place, verdicts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        history = self._database.spread(*place, "calibration", POINTS if verdicts else THINNED)
        if not history:
            return {}
        statuses = self._database.history(*place, "status", STATUSES)
        accepted = _newest(statuses, _accepts) or 0
        from_then = [c for c in history if c["t_utc_ns"] >= accepted] or history[-1:]
        first, last = from_then[0], history[-1]
        ends = self._with_budget(place, first), self._with_budget(place, last)
        held = _held_since(statuses)
        windows = self._database.history(*place, "window", WINDOWS) if verdicts or held is not None else []
        fitted = _used_times(history, windows)
        found = {v["parameter"]: _trend(v, from_then, ends, fitted) for v in verdicts}
        begun = [trend["began_utc_ns"][0] for trend in found.values()] + ([] if held is None else [held])
        shown = _plotted(history, first) | _compared(*ends)
        shown |= {
            "accepted": accepted > 0,
            "accepted_utc_ns": first["t_utc_ns"],
            "held_utc_ns": _lasting(statuses),
            "adopted_utc_ns": _adopted_since(statuses, accepted),
            "certificate_utc_ns": _certificate_since(history),
            "found": found,
            "beside": self._fleet.beside(place, min(begun, default=0)),
        }
        return shown if held is None else shown | self._beyond(place, held, first, last, windows)

    def _beyond(
        self,
        place: Place,
        held_utc_ns: int,
        first: Mapping[str, Any],
        last: Mapping[str, Any],
        windows: Sequence[Mapping[str, Any]],
    ) -> dict[str, Any]:
        """What a sensor that is held says beyond its calibration in force, the `last` one."""
        refused = [w["t_utc_ns"] for w in windows if not w["used"] and w["t_utc_ns"] >= held_utc_ns]
        told = [e["calibration"] for e in self._database.history(*place, "estimate", ESTIMATES)]
        return {
            "refused_utc_ns": [refused[k] for k in _thinned(len(refused))],
            "estimates": [
                {
                    "t_utc_ns": c["t_utc_ns"], "main_pct": [_pct(first, c, i) for i in MAIN],
                    "values": [value_of(c, i) for i in range(len(PARAMETERS))], "u": c["standard_uncertainty"],
                }
                for c in told if c["t_utc_ns"] > last["t_utc_ns"]
            ],
        }  # fmt: skip

    def _with_budget(self, place: Place, calibration: dict[str, Any]) -> dict[str, Any]:
        """The calibration with the budget of its day, which the first one of the day has."""
        day = self._database.first_of_day(*place, "calibration", calibration["t_utc_ns"])
        return calibration if day is None else calibration | {"budget": day.get("budget", {})}


def change_of(first: Mapping[str, Any], last: Mapping[str, Any], i: int) -> dict[str, float | None]:
    """Of parameter `i` from one calibration to another: `change` and its `U` (k = 2), in its unit.

    What both owe to the sensitivity of the same references cancels, as far as their budgets tell it; the rest counts as
    if it were independent, which is at most too much: the later one also knows the windows of the earlier one.
    """
    a, b = value_of(first, i), value_of(last, i)
    one, other = first["standard_uncertainty"][i], last["standard_uncertainty"][i]
    if a is None or b is None or one is None or other is None:
        return {"change": None, "U": None}
    same = first["references"] == last["references"] and _certificates(first) == _certificates(last)
    shared = [c.get("budget", {}).get(OF_REFERENCE, [0.0] * 12)[i] or 0.0 for c in (first, last)]
    common = min(2.0 * shared[0] * shared[1], one**2 + other**2) if same and first is not last else 0.0
    return {"change": b - a, "U": 2.0 * math.sqrt(one**2 + other**2 - common)}


def _thinned(count: int) -> list[int]:
    """At most THINNED positions, evenly, the last among them."""
    return sorted({round(k * (count - 1) / max(THINNED - 1, 1)) for k in range(THINNED)}) if count else []


def value_of(calibration: Mapping[str, Any], i: int) -> float | None:
    """Parameter `i` of PARAMETERS; None where it is not known."""
    value: float | None = calibration["sensitivity"][i // 3][i % 3] if i < 9 else calibration["offset"][i - 9]
    return value


def _pct(first: Mapping[str, Any], last: Mapping[str, Any], i: int) -> float | None:
    a, b = value_of(first, i), value_of(last, i)
    return round(100.0 * (b - a) / abs(a), PCT_DIGITS) if a and b is not None else None


def _certificates(calibration: Mapping[str, Any]) -> list[str]:
    return [shared["certificate_sha256"] for shared in calibration.get("shared_errors", [])]


def _certificate_since(history: Sequence[Mapping[str, Any]]) -> int | None:
    """Since when the certificates of the newest calibration are in use, as far as the history goes back."""
    own = _certificates(history[-1])
    same = [c["t_utc_ns"] for c in history if _certificates(c) == own]
    return same[0] if any(own) else None


def _plotted(history: Sequence[Mapping[str, Any]], first: Mapping[str, Any]) -> dict[str, Any]:
    """The main sensitivities of the newest year, thinned, as changes since the calibration `first`."""
    year = [c for c in history if c["t_utc_ns"] > history[-1]["t_utc_ns"] - YEAR_DAYS * DAY_NS]
    shown = [year[k] for k in _thinned(len(year))]
    return {
        "t_utc_ns": [c["t_utc_ns"] for c in shown],
        "main_pct": [[_pct(first, c, i) for c in shown] for i in MAIN],
    }


def _compared(first: Mapping[str, Any], last: Mapping[str, Any]) -> dict[str, Any]:
    """The change of each parameter from one calibration to another, and the budget of the main sensitivities."""
    return {
        "changes": [change_of(first, last, i) for i in range(len(PARAMETERS))],
        "budget": {source: [u[i] for i in MAIN] for source, u in last.get("budget", {}).items()},
    }


def _newest(statuses: Sequence[Mapping[str, Any]], is_so: Callable[[Mapping[str, Any]], bool]) -> int | None:
    """When a status came last for which `is_so` holds; None where there is none."""
    return max((status["t_utc_ns"] for status in statuses if is_so(status)), default=None)


def _used_times(history: Sequence[Mapping[str, Any]], windows: Sequence[Mapping[str, Any]]) -> list[int]:
    """The times of calibrations and of windows that were used, in order."""
    return sorted([c["t_utc_ns"] for c in history] + [w["t_utc_ns"] for w in windows if w["used"]])


def _held_since(statuses: Sequence[Mapping[str, Any]]) -> int | None:
    """Since when the status is HELD; None where it is another."""
    return _lasting(statuses) if statuses and statuses[-1]["status"] == "HELD" else None


def _accepts(status: Mapping[str, Any]) -> bool:
    """Whether an operator accepted an estimate, or went back to an earlier one."""
    return _ACCEPTED.match(status["reason"]) is not None


def _adopted_since(statuses: Sequence[Mapping[str, Any]], accepted_utc_ns: int) -> int | None:
    """When a jump last came into force, if that was not before the calibration was accepted."""
    newest = _newest(statuses, _adopts)
    return newest if newest is not None and newest >= accepted_utc_ns else None


def _lasting(statuses: Sequence[Mapping[str, Any]]) -> int | None:
    """Since when the status is what it is."""
    lasting = None
    for told in reversed(statuses):
        if told["status"] != statuses[-1]["status"]:
            break
        lasting = told["t_utc_ns"]
    return lasting


def _adopts(status: Mapping[str, Any]) -> bool:
    """Whether a jump came into force."""
    return bool(status["status"] == "RECALIBRATING" and status["before"] != "RECALIBRATING")


def change_in(days: Array, values: Array, verdict: Mapping[str, Any]) -> tuple[Shape, Since | None]:
    """The change that the history shows, and whether it is a drift or a step.

    A test of steps also finds a part of a drift. So the other shape than that of the verdict counts where it leaves
    less than half of the squares, and goes as far in the same direction.
    """
    told: Shape = verdict["verdict"]
    other: Shape = "stepped" if told == "drifting" else "drifting"
    own, instead = since(days, values, told), since(days, values, other)
    if instead is None or instead.size * math.copysign(1.0, verdict["change"]) < 0.5 * abs(verdict["change"]):
        return told, own
    return (other, instead) if own is None or instead.squares < 0.5 * own.squares else (told, own)


def _began(verdict: Mapping[str, Any], shape: Shape, change: Since | None, fitted: Sequence[int]) -> tuple[int, int]:
    """Between which times (UTC, ns) a change began: the last window without it, from which on values are uncertain, and
    the first one with it.

    The agent tells the first window of a step. The history of S and Q in force does not: they follow a step when it is
    adopted. Elsewhere the onset of the history counts, with its U.
    """
    if change is None or shape == verdict["verdict"] == "stepped":
        onset: int = verdict["onset_utc_ns"]
        return max((t for t in fitted if t < onset - SECOND_NS), default=onset), onset
    return round((change.day - 2 * change.u_day) * DAY_NS), round((change.day + 2 * change.u_day) * DAY_NS)


def _trend(
    verdict: Mapping[str, Any],
    history: Sequence[Mapping[str, Any]],
    ends: tuple[Mapping[str, Any], Mapping[str, Any]],
    fitted: Sequence[int],
) -> dict[str, Any]:
    """The parameter of a verdict over time, and the `change` that its history shows; None where it shows none.

    `began_utc_ns` (2): between which times it began (`_began`); `fitted`: times of windows that fitted, rising.

    The values of a history lie on a smooth line even where all of them are wrong: a drift that the agent does not know
    yet makes them late. So u of size and rate contain that of the change from the first to the last one, the `ends`.
    """
    i = PARAMETERS.index(verdict["parameter"])
    known = [(c["t_utc_ns"], v, c["standard_uncertainty"][i]) for c in history if (v := value_of(c, i)) is not None]
    t_utc_ns = [t for t, _, _ in known]
    days, values = np.array(t_utc_ns, dtype=float) / DAY_NS, np.array([v for _, v, _ in known])
    rising = np.append(True, np.diff(days) > 0) if len(days) else np.zeros(0, dtype=bool)
    shape, change = change_in(days[rising], values[rising], verdict)
    began, thin = _began(verdict, shape, change, fitted), _thinned(len(known))
    u_between = 0.5 * (change_of(*ends, i)["U"] or 0.0)
    u_a_day = u_between / max(float(days[-1]) - change.day, 1.0) if change and change.rate else 0.0
    return {
        "t_utc_ns": [known[k][0] for k in thin],
        "values": [known[k][1] for k in thin],
        "u": [known[k][2] for k in thin],
        "began_utc_ns": began,
        "scale": value_of(history[-1], 4 * (i // 3 if i < 9 else i - 9)),  # the main sensitivity of its output
        "change": change
        and {
            "shape": shape, "onset_utc_ns": began[1] if shape == "stepped" else round(change.day * DAY_NS),
            "u_onset_days": change.u_day,
            "size": change.size, "u_size": math.hypot(change.u_size, u_between), "rate": change.rate,
            "u_rate": math.hypot(change.u_rate, u_a_day),
        },
    }  # fmt: skip
