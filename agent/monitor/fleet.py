"""What the page says of each sensor now: its newest results in one row, and the sentence why a person is needed."""

from __future__ import annotations

import threading
from typing import Any

from calib.model import PARAMETERS

NEEDS_A_PERSON = ("INVALID", "HELD", "UNCALIBRATED")
LARGEST = 1e6  # change in units of U; a stranger may send numbers whose quotient is not finite

Place = tuple[str, str, str]  # site, gateway, sensor


class Fleet:
    """The newest state of each sensor. `version` rises with every change. May be used by several threads."""

    def __init__(self) -> None:
        self.version = 0
        self._newest: dict[Place, dict[str, dict[str, Any]]] = {}
        self._alive: set[tuple[str, str]] = set()
        self._mutex = threading.Lock()

    def take(self, site: str, gateway: str, sensor: str, what: str, fields: dict[str, Any]) -> None:
        """Take a result; it must be newer than those of the same kind before."""
        part = {"drift": f"drift {fields.get('parameter')}", "window": "good window"}.get(what, what)
        if what == "window" and not fields["used"]:
            return
        with self._mutex:
            self._newest.setdefault((site, gateway, sensor), {})[part] = fields
            self.version += 1

    def set_alive(self, site: str, gateway: str, alive: bool) -> None:
        """Whether the gateway is on the bus."""
        with self._mutex:
            (self._alive.add if alive else self._alive.discard)((site, gateway))
            self.version += 1

    def rows(self) -> list[dict[str, Any]]:
        """One row for each sensor; those that need a person first, then by the worst change."""
        with self._mutex:
            rows = [
                _row(place, newest, place[:2] in self._alive)
                for place, newest in self._newest.items()
                if newest.keys() & {"status", "calibration", "good window"}
                or any(part.startswith("drift ") for part in newest)
            ]
        return sorted(
            rows, key=lambda r: (not r["why"], -(r["change_in_u"] or 0), r["site"], r["gateway"], r["sensor"])
        )


def _row(place: Place, newest: dict[str, dict[str, Any]], alive: bool) -> dict[str, Any]:
    status = newest.get("status", {})
    drifts = [f for part, f in newest.items() if part.startswith("drift ") and f["verdict"] != "stable"]
    u = newest.get("calibration", {}).get("standard_uncertainty")
    changes = [(_in_u(drift, u), drift) for drift in drifts]
    worst = max(changes, key=lambda change: change[0], default=None)
    why = [f"{drift['parameter']} {drift['verdict']}: {drift['reason']}" for _, drift in changes]
    if status.get("status") in NEEDS_A_PERSON:
        why.insert(0, f"{status['status']}: {status['reason']}")
    if not alive:
        why.append("the gateway is not on the bus")
    good = newest.get("good window", {})
    return {
        "site": place[0],
        "gateway": place[1],
        "sensor": place[2],
        "status": status.get("status", ""),
        "alive": alive,
        "change_in_u": None if worst is None else worst[0],
        "last_good_utc_ns": good.get("t_utc_ns"),
        "why": "; ".join(why),
    }


def _in_u(drift: dict[str, Any], standard_uncertainty: list[float | None] | None) -> float:
    """|change| over U (k = 2) of the parameter in the calibration in force, at most LARGEST; 0 where not known."""
    names = list(PARAMETERS)
    change, name = drift["change"], drift["parameter"]
    u = standard_uncertainty[names.index(name)] if standard_uncertainty and name in names else None
    return min(abs(change) / (2 * u), LARGEST) if u and change is not None else 0.0
