"""The advice when to look again at a sensor and its references, from the database of the monitor."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from agent.monitor.database import Database
from agent.monitor.fleet import Fleet, Place
from agent.monitor.interval import DAY_NS, Advice, Trend, advise, daily, spread_of_rates, trend
from calib.model import PARAMETERS

POINTS = 400  # calibrations that are looked at, evenly from the whole history
PEERS_MAX = 12  # sensors of the same kind that are looked at
PEERS_FOR_S = 3600.0  # s for which what was found of a peer is kept
REFERENCE_SENSITIVITY = "reference sensitivity"  # kind of unknown, calib.estimate.quantities


class Advisor:
    """Advice for the sensors of a database. May be used by several threads."""

    def __init__(self, database: Database, fleet: Fleet) -> None:
        self._database, self._fleet = database, fleet
        self._of_peers: dict[Place, tuple[float, dict[str, Trend]]] = {}

    def advice(self, place: Place) -> list[dict[str, Any]]:
        """Rows of subject, interval_days, due_utc_ns and reason: the sensor with its shortest interval, references."""
        history = self._database.spread(*place, "calibration", POINTS)
        if not history:
            return []
        peers = [self._peer(peer) for peer in self._fleet.peers(place, PEERS_MAX)]
        own, newest = trends(history), history[-1]
        found: list[tuple[str, Advice]] = []
        for i, name in enumerate(PARAMETERS):
            u = newest["standard_uncertainty"][i]
            if u is None or u <= 0 or not newest["determined"][i]:
                continue
            unit = newest["output_unit"] + (" per m/s²" if name.startswith("S") else "")
            spread = spread_of_rates([peer[name] for peer in peers if name in peer])
            found.append((name, advise(own.get(name), 2.0 * u, spread, unit)))
        rows = [_row(place[2], *min(found, key=_shortest), newest["t_utc_ns"])] if found else []
        return rows + [_of_reference(*each) for each in _references(history).items()]

    def _peer(self, place: Place) -> dict[str, Trend]:
        kept_s, found = self._of_peers.get(place, (-PEERS_FOR_S, {}))
        if time.monotonic() - kept_s >= PEERS_FOR_S:
            found = trends(self._database.spread(*place, "calibration", POINTS))
            self._of_peers[place] = time.monotonic(), found
        return found


def trends(history: Sequence[dict[str, Any]]) -> dict[str, Trend]:
    """The trend of each parameter that is determined, by its name."""
    chosen = [history[k] for k in daily([c["t_utc_ns"] for c in history])]
    found = {}
    for i, name in enumerate(PARAMETERS):
        points = []
        for calibration in chosen:
            value, u = _values(calibration)[i], calibration["standard_uncertainty"][i]
            if calibration["determined"][i] and value is not None and u:
                points.append((calibration["t_utc_ns"], value, u))
        if line := _line(points):
            found[name] = line
    return found


def _line(points: Sequence[tuple[int, float, float]]) -> Trend | None:
    if not points:
        return None
    t_utc_ns, values, u = zip(*points, strict=True)
    days = np.array([(t - t_utc_ns[0]) / DAY_NS for t in t_utc_ns])
    return trend(days, np.array(values, dtype=float), np.array(u, dtype=float))


def _values(calibration: dict[str, Any]) -> list[float | None]:
    return [value for row in calibration["sensitivity"] for value in row] + list(calibration["offset"])


def _shortest(found: tuple[str, Advice]) -> float:
    interval = found[1].interval_days
    return float("inf") if interval is None else interval


def _row(subject: str, name: str, advice: Advice, t_utc_ns: int) -> dict[str, Any]:
    days = advice.interval_days
    return {
        "subject": subject,
        "interval_days": days,
        "due_utc_ns": None if days is None else t_utc_ns + round(days * DAY_NS),
        "reason": f"{name}: {advice.reason}",
    }


def _references(history: Sequence[dict[str, Any]]) -> dict[str, list[tuple[int, float, float]]]:
    """Of each reference its certificates in time: (when first used, first sensitivity, its standard uncertainty)."""
    found: dict[str, dict[str, tuple[int, float, float]]] = {}
    for calibration in history:
        for shared in calibration.get("shared_errors", []):
            u = [
                u for kind, u in zip(shared["kinds"], shared["u_stated"], strict=True) if kind == REFERENCE_SENSITIVITY
            ]
            if u and shared["sensitivity"]:
                value = shared["sensitivity"][0]
                point = (calibration["t_utc_ns"], value, abs(value) * u[0])
                found.setdefault(shared["reference"], {}).setdefault(shared["certificate_sha256"], point)
    return {name: list(points.values()) for name, points in found.items()}


def _of_reference(name: str, points: list[tuple[int, float, float]]) -> dict[str, Any]:
    line = _line(points)
    if line is None:
        advice = Advice(None, f"{len(points)} certificates in the history of this sensor; needs 4")
    else:
        advice = advise(line, 2.0 * points[-1][2], None, "of its sensitivity")
    return _row(f"reference {name}", "sensitivity", advice, points[-1][0])
