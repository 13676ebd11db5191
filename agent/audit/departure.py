"""How far results that one engine recorded depart from those that another engine computes from the same events.

A value with an uncertainty is compared in units of its expanded uncertainty U, the smaller of the recorded and the
computed one. Decisions must be the same, at the same event. All else must nearly agree: otherwise a forged value could
hide behind the name of another engine.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import msgspec

from agent.core.events import CalibrationUpdate, Output
from agent.recording.comparison import THRESHOLD, differences, empty_fields, plain
from agent.recording.messages import topic_of

NEAR = 0.1  # of U: the largest departure that still is the same result
NEAR_U = 0.1  # relative: uncertainties, and values that have none, that differ by more are another statement
NEAR_S = 1.0  # s: two engines may cut a window at other samples
COVERAGE_FACTOR = 2.0  # of a value whose result states none
_DECISIONS = frozenset({"used", "status", "before", "verdict", "determined", "parameter", "position"})
_WORDS = frozenset({"reason", "fault", "method"})  # texts, which each engine words in its own way
_TIME = re.compile(r"\w+_utc_ns|start_s|stop_s")


class Departure(msgspec.Struct, kw_only=True):
    """What differs in a file between the recorded results and those of another engine.

    `largest_in_u`: of all values with an uncertainty, in units of U; `where`: its place. `decision`, `other`: the first
    decision, and the first other value, that differ; "" where none does. `calibrations`: how many were compared.
    """

    largest_in_u: float = 0.0
    where: str = ""
    decision: str = ""
    other: str = ""
    calibrations: int = 0

    @property
    def near(self) -> bool:
        """Whether the results are the same within what their uncertainties allow."""
        return self.largest_in_u <= NEAR and not self.decision and not self.other

    def __str__(self) -> str:
        largest = f"its values differ by at most {self.largest_in_u:.2g} U"
        largest += f" ({self.where})" if self.largest_in_u > NEAR else ""
        decision = f"a decision differs ({self.decision})" if self.decision else "no decision differs"
        return f"{largest}, {decision}" + (f", and another value ({self.other})" if self.other else "")

    def add(self, event_sequence: int, recorded: Sequence[Output], computed: Sequence[Output], complete: bool) -> None:
        """Compare the results of one event. Where `complete` is false the recording may end before the last results."""
        kinds = [[topic_of(result) for result in results] for results in (recorded, computed)]
        if kinds[0] != (kinds[1] if complete else kinds[1][: len(kinds[0])]):
            self._differ("decision", f"event {event_sequence}: recorded {kinds[0]}, here {kinds[1]}")
            return
        for before, now in zip(recorded, computed, strict=False):
            self.calibrations += isinstance(before, CalibrationUpdate)
            a, b = plain(before), plain(now)
            for name in empty_fields(before):  # the engine that recorded may not have had them
                b.pop(name, None)
                a.pop(name, None)
            for path, x, y in differences(a, b, 0.0):
                place = f"event {event_sequence}, {topic_of(before)}, {path}: recorded {x!r:.40}, here {y!r:.40}"
                self._weigh(place, _tokens(path), (x, y), (a, b))

    def _weigh(self, place: str, path: list[str], pair: tuple[Any, Any], results: tuple[Any, Any]) -> None:
        """Count two values at the same `path` of two results that differ."""
        x, y = pair
        if path[-1] in _WORDS or (path[0] == "numbers" and (None in pair or path[-1].endswith(THRESHOLD))):
            return
        if _DECISIONS & set(path):
            self._differ("decision", place)
        elif not all(isinstance(value, float | int) and math.isfinite(value) for value in pair):
            self._differ("other", place)
        elif all(u := [_uncertainty(result, path) for result in results]):
            factor = min(_coverage_factor(result) for result in results)
            in_u = abs(x - y) / (factor * min(u))
            if in_u > self.largest_in_u:
                self.largest_in_u, self.where = in_u, place
        elif abs(x - y) > _allowed(path, pair, results):
            self._differ("other", place)

    def _differ(self, kind: str, place: str) -> None:
        if not getattr(self, kind):
            setattr(self, kind, place)


def _tokens(path: str) -> list[str]:
    """Names and indices of a path such as `response[2].sensitivity_re[0][1]`."""
    return re.findall(r"[^.\[\]]+", path)


def _split(result: dict[str, Any], path: list[str]) -> tuple[Any, str, list[int]]:
    """(what holds the last name of a path, this name, the indices after it)."""
    last = max((i for i, token in enumerate(path) if not token.isdecimal()), default=0)
    holder: Any = result
    for token in path[:last]:
        holder = holder[int(token)] if token.isdecimal() else holder[token]
    return holder, path[last], [int(token) for token in path[last + 1 :]]


def _uncertainty(result: dict[str, Any], path: list[str]) -> float:
    """The standard uncertainty of the value at a path; 0 where it has none."""
    holder, name, indices = _split(result, path)
    u = holder.get(f"u_{name}") if isinstance(holder, dict) else None
    if u is None and isinstance(holder, dict) and name.startswith(("sensitivity", "offset")):
        u = holder.get("standard_uncertainty")
        if u is not None and len(u) == 12:  # S row by row, then Q
            indices = [3 * indices[0] + indices[1]] if len(indices) == 2 else [9 + i for i in indices]
    try:
        for index in indices:
            u = u[index]  # type: ignore[index]
    except (IndexError, TypeError):
        return 0.0
    return float(u) if isinstance(u, float) and math.isfinite(u) and u > 0.0 else 0.0


def _coverage_factor(result: dict[str, Any]) -> float:
    stated = result.get("calibration", result).get("coverage_factor", COVERAGE_FACTOR)
    return float(stated) if stated > 0.0 else COVERAGE_FACTOR


def _allowed(path: list[str], pair: tuple[float, float], results: tuple[dict[str, Any], dict[str, Any]]) -> float:
    """By how much two values without an uncertainty may differ."""
    holder, name, indices = _split(results[0], path)
    if _TIME.fullmatch(name):
        return NEAR_S * (1e9 if name.endswith("_ns") else 1.0)
    if name in ("sequence", "made_sequence"):
        return 0.0
    if name == "covariance":
        i, j = indices
        return 2.0 * NEAR_U * math.sqrt(abs(holder[name][i][i] * holder[name][j][j]))
    return NEAR_U * max(map(abs, pair))
