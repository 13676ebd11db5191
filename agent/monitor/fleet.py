"""What the page says of each sensor and gateway now: the newest results in one row, and why a person is needed."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec

from agent.core.events import RESULTS
from agent.delivery.keys import CHUNK, Address
from calib.model import PARAMETERS

NEEDS_A_PERSON = ("INVALID", "HELD", "UNCALIBRATED")
LARGEST = 1e6  # change in units of U; a stranger may send numbers whose quotient is not finite
# A stranger may invent gateways and sensors for ever, so their numbers are bounded: ten times what docs/fleet.md plans.
SENSORS_MAX = 40_000
GATEWAYS_MAX = 10_000
TEXT_MAX = 500  # characters of a reason that are shown; the program's own have some 100
EVENTS_MAX = 500  # changes of status, verdicts and commands that the page lists, the newest
LARGEST_TOLD = 16 << 10  # bytes of what a gateway says of itself; with four devices it has 2 kB

SHOWN = {"status", "calibration", "good window"}  # a sensor of which none is known, and no drift, has no row

Place = tuple[str, str, str]  # site, gateway, sensor


class GatewayTold(msgspec.Struct, frozen=True):
    """The part of a gateway's status (agent.supervision.health) that the page shows. It is not signed."""

    state: str
    reasons: list[str]
    t_utc_ns: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
    version: str = ""


class Fleet:
    """The newest state of each sensor and gateway. `version` rises with every change. May be used by several threads.

    `left_out` counts results that are not shown: of a name that no gateway can have, or beyond the greatest number of
    sensors and gateways.
    """

    def __init__(self) -> None:
        self.version = time.time_ns() // 1_000_000  # after those before a restart, which pages that are open know
        self.left_out = 0
        self._newest: dict[Place, dict[str, dict[str, Any]]] = {}
        self._alive: set[tuple[str, str]] = set()
        self._told: dict[tuple[str, str], GatewayTold] = {}
        self._doubled: dict[tuple[str, str], int] = {}
        self._gateways: set[tuple[str, str]] = set()
        self._changed: dict[Place, int] = {}  # `version` at the last change of each sensor
        self._made: dict[Place, tuple[str, dict[str, Any]]] = {}  # the row of each sensor, for a state of its gateway
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS_MAX)
        self._alarms: deque[dict[str, Any]] = deque(maxlen=EVENTS_MAX)
        self._mutex = threading.Lock()

    def admits(self, address: Address) -> bool:
        """Whether results of this sensor are shown; if not, this one is counted."""
        with self._mutex:
            place = (address.site, address.gateway, address.sensor)
            admitted = place in self._newest or (
                all(map(CHUNK.fullmatch, place)) and len(self._newest) < SENSORS_MAX and self._knows(place[:2])
            )
            self.left_out += not admitted
            return admitted

    def take(
        self, site: str, gateway: str, sensor: str, what: str, fields: dict[str, Any], *, fresh: bool = True
    ) -> None:
        """Take a result of a sensor that is admitted; it must be newer than those of the same kind before.

        `fresh`: it has just come, so people are told where it needs them.
        """
        part = {
            "drift": f"drift {fields.get('parameter')}",
            "window": "good window" if fields.get("used") else "refused window",
        }.get(what, what)
        if what not in RESULTS or (what == "drift" and fields["parameter"] not in PARAMETERS):
            return
        with self._mutex:
            self._knows((site, gateway))
            self._newest.setdefault((site, gateway, sensor), {})[part] = fields
            self.version += 1
            self._changed[site, gateway, sensor] = self.version
            self._made.pop((site, gateway, sensor), None)
        if told := _told_of(what, fields):
            self.note(
                site, gateway, sensor, what, fields["t_utc_ns"], told, alarm=fresh and _needs_a_person(what, fields)
            )

    def note(
        self, site: str, gateway: str, sensor: str, what: str, t_utc_ns: int, told: str, *, alarm: bool = False
    ) -> None:
        """Add an event to the list of the newest ones; an `alarm` also to those that people are told."""
        event = {"t_utc_ns": t_utc_ns, "site": site, "gateway": gateway, "sensor": sensor, "what": what}
        with self._mutex:
            self._events.append(event | {"text": clipped(told)})
            if alarm:
                self._alarms.append(self._events[-1])
            self.version += 1

    def peers(self, place: Place, most: int) -> list[Place]:
        """At most so many other sensors of the same kind of device (the first word of the identity)."""
        with self._mutex:
            kinds = {
                p: n["calibration"]["identity"].split(" ")[0] for p, n in self._newest.items() if "calibration" in n
            }
        own = kinds.pop(place, "")
        return sorted(p for p, kind in kinds.items() if kind == own and own)[:most]

    def events(self) -> list[dict[str, Any]]:
        """The newest events, the newest first."""
        with self._mutex:
            return list(reversed(self._events))

    def alarms(self) -> list[dict[str, Any]]:
        """The alarms since the last call, the oldest first."""
        with self._mutex:
            found = list(self._alarms)
            self._alarms.clear()
            return found

    def set_alive(self, site: str, gateway: str, alive: bool) -> None:
        """Whether the gateway is on the bus."""
        with self._mutex:
            if alive and self._knows((site, gateway)):
                self._alive.add((site, gateway))
            elif not alive:
                self._alive.discard((site, gateway))
            self.version += 1

    def set_doubled(self, doubled: Mapping[str, int]) -> None:
        """The gateways (`<site>/<gateway>`) of which more than one is on the bus, with their numbers."""
        found = {_place(source): count for source, count in doubled.items()}
        with self._mutex:
            self.version += found != self._doubled
            self._doubled = found

    def set_told(self, site: str, gateway: str, status: bytes) -> None:
        """What a gateway says of itself, as JSON; what is no such status is ignored."""
        if len(status) > LARGEST_TOLD:
            return
        try:
            told = msgspec.json.decode(status, type=GatewayTold)
        except (msgspec.DecodeError, ValueError, RecursionError):
            return
        with self._mutex:
            if self._knows((site, gateway)):
                before, self._told[site, gateway] = self._told.get((site, gateway)), told
                self.version += before is None or (before.state, before.reasons) != (told.state, told.reasons)

    def rows(self) -> list[dict[str, Any]]:
        """One row for each sensor; those that need a person first, then by the worst change."""
        with self._mutex:
            rows = [
                self._row_of(place)
                for place, newest in self._newest.items()
                if any(part in SHOWN or part.startswith("drift ") for part in newest)
            ]
        return sorted(
            rows, key=lambda r: (not r["why"], -(r["change_in_u"] or 0), r["site"], r["gateway"], r["sensor"])
        )

    def gateways(self, refused: Mapping[str, int]) -> list[dict[str, Any]]:
        """One row for each gateway; those that need a person first. `refused`: results not verified, by gateway."""
        with self._mutex:
            counts = Counter(place[:2] for place in self._newest)
            rows = [
                _gateway_row(place, counts[place], place in self._alive, self._told.get(place),
                             refused.get("/".join(place), 0), self._doubled.get(place, 1))
                for place in self._gateways | {_place(source) for source in refused}
            ]  # fmt: skip
        return sorted(rows, key=lambda r: (not r["why"], r["site"], r["gateway"]))

    def _row_of(self, place: Place) -> dict[str, Any]:
        state = self._state_of(place[:2])
        made = self._made.get(place)
        if made is None or made[0] != state:
            if made is not None:
                self._changed[place] = self.version
            row = _row(place, self._newest[place], state) | {"changed": self._changed[place]}
            made = self._made[place] = state, row
        return made[1]

    def _state_of(self, gateway: tuple[str, str]) -> str:
        if gateway not in self._alive:
            return "silent"
        return clipped(self._told[gateway].state) if gateway in self._told else ""

    def _knows(self, gateway: tuple[str, str]) -> bool:
        if gateway not in self._gateways and len(self._gateways) < GATEWAYS_MAX and all(map(CHUNK.fullmatch, gateway)):
            self._gateways.add(gateway)
        return gateway in self._gateways


def _needs_a_person(what: str, fields: dict[str, Any]) -> bool:
    if what == "drift":
        return bool(fields["verdict"] != "stable")
    return what == "status" and fields["status"] in NEEDS_A_PERSON


def _told_of(what: str, fields: dict[str, Any]) -> str:
    """What the list of events says of a result; "" where it is no event."""
    if what == "status":
        return f"{fields['status']}: {fields['reason']}"
    return f"{fields['parameter']} {fields['verdict']}: {fields['reason']}" if what == "drift" else ""


def _row(place: Place, newest: dict[str, dict[str, Any]], gateway_state: str) -> dict[str, Any]:
    status = newest.get("status", {})
    drifts = [f for part, f in newest.items() if part.startswith("drift ") and f["verdict"] != "stable"]
    calibration = newest.get("calibration", {})
    changes = [(_in_u(drift, calibration.get("standard_uncertainty")), drift) for drift in drifts]
    worst = max(changes, key=lambda change: change[0], default=None)
    why = [f"{drift['parameter']} {drift['verdict']}: {drift['reason']}" for _, drift in changes]
    if status.get("status") in NEEDS_A_PERSON:
        why.insert(0, f"{status['status']}: {status['reason']}")
    if gateway_state == "silent":
        why.append("the gateway is not on the bus")
    good = newest.get("good window", {})
    return {
        "site": place[0],
        "gateway": place[1],
        "sensor": place[2],
        "status": status.get("status", ""),
        "gateway_state": gateway_state,
        "change_in_u": None if worst is None else worst[0],
        "last_good_utc_ns": good.get("t_utc_ns"),
        "verified": bool(newest) and all(fields.get("signed_by") for fields in newest.values()),
        "why": "; ".join(clipped(reason) for reason in why),
    }


def _gateway_row(
    place: tuple[str, str], sensors: int, alive: bool, told: GatewayTold | None, refused: int, instances: int
) -> dict[str, Any]:
    why = [] if alive else ["the gateway is not on the bus"]
    if instances > 1:
        why.append(f"{instances} gateways are on the bus under this name: stop one of them, or give it another name")
    if told is not None and told.state != "running":
        why.append(clipped(f"{told.state}: {'; '.join(told.reasons[:10])}"))
    if refused:
        why.append(f"{refused} results in its name were refused: no known key of this gateway signed them")
    return {
        "site": place[0],
        "gateway": place[1],
        "alive": alive,
        "sensors": sensors,
        "state": clipped(told.state) if told else "",
        "version": clipped(told.version) if told else "",
        "told_utc_ns": told.t_utc_ns if told else None,
        "refused": refused,
        "instances": instances,
        "why": "; ".join(why),
    }


def clipped(text: str) -> str:
    """A text of the bus, at most TEXT_MAX characters of it."""
    return text if len(text) <= TEXT_MAX else f"{text[: TEXT_MAX - 1]}…"


def _place(source: str) -> tuple[str, str]:
    site, _, gateway = source.partition("/")
    return site, gateway


def _in_u(drift: dict[str, Any], standard_uncertainty: list[float | None] | None) -> float:
    """|change| over U (k = 2) of the parameter in the calibration in force, at most LARGEST; 0 where not known."""
    names = list(PARAMETERS)
    change, name = drift["change"], drift["parameter"]
    u = standard_uncertainty[names.index(name)] if standard_uncertainty and name in names else None
    return min(abs(change) / (2 * u), LARGEST) if u and change is not None else 0.0
