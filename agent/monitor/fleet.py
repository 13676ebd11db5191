"""What the page says of each sensor and gateway now: the newest results, a kind, and why a person is needed.

page/fleet.js shows it; the package agent/fleet is the command `fieldcal fleet`.

The kind of a sensor follows from verdicts alone: of its agent on drift and status, and from whether it is heard. The
largest of twelve changes tells nothing: of sound parameters one exceeds its U often enough.
"""

from __future__ import annotations

import math
import re
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

import msgspec

from agent.core.events import RESULTS
from agent.delivery.keys import CHUNK, Address
from agent.site_watch.suspicion import Suspicion
from calib.model import PARAMETERS

NEEDS_A_PERSON = ("INVALID", "HELD", "UNCALIBRATED")
WITNESSES = ("VALID", "HELD", "RECALIBRATING")  # of a sensor whose windows are compared with its calibration
ON_HOLD = "put on hold by "  # as agent.core.gate says it
CALM = ("running", "catching up")  # states of a gateway that need no person
LARGEST = 1e6  # change in units of U; a stranger may send numbers whose quotient is not finite
# A stranger may invent gateways and sensors for ever. So there is a bound: ten times those of docs/fleet-evidence.md.
SENSORS_MAX = 40_000
GATEWAYS_MAX = 10_000
TEXT_MAX = 800  # characters of a reason that are shown; what explains held windows has some 450
EVENTS_MAX = 500  # changes of status, verdicts and commands that the page lists, the newest
LARGEST_TOLD = 16 << 10  # bytes of what a gateway says of itself; with four devices it has 2 kB
SILENT_INTERVALS = 3  # without a result after which a sensor is not heard
# An interval is at least this long: an agent reports its clocks once a minute. It is the longest of the newest ones,
# since windows come by the motion of the structure.
INTERVAL_MIN_S, INTERVALS = 60.0, 8
DAY_NS = 86_400_000_000_000
LOOK_S = 1.0  # s between two looks for sensors that fell silent
MAIN = (0, 4, 8)  # of PARAMETERS
_MAIN_NAMES = frozenset(PARAMETERS[i] for i in MAIN)
# Fields of a verdict that a row has.
VERDICT = ("parameter", "verdict", "change", "u_change", "rate", "u_rate", "onset_utc_ns", "t_utc_ns",
           "false_alarms_a_year")  # fmt: skip
# In the reason of a net change, whose `u_change` and `u_rate` are what is stated of walks in results of engines to 22,
# and no uncertainty of the change; so a row has them as unknown.
ALLOWED = "what is stated allows"
# What a row adds to it: see Fleet.recall.
SINCE_STABLE = ("first_utc_ns", "drifts")
# As calib.state.state.DATED puts the date of the certificate behind the identity of a reference.
_CALIBRATED = re.compile(r"(.*), calibrated ([0-9]{4}-[0-9]{2}-[0-9]{2})", re.DOTALL)
IN_TURNS = (
    "have given results the same numbers: gateways with copies of one memory card are on the bus in turns, and some of "
    "their results are missing here"
)
RUN_SHOWN = 12  # characters of the id of a run
_NUMBERS = re.compile(r"[-+]?[0-9][0-9.e+-]*")

Kind = Literal[
    "drifting", "changed", "held", "doubled", "no data", "silent", "retired", "uncalibrated", "suspected", "sound"
]  # fmt: skip

# A sensor of which none is known, and no drift, has no row. A good window is one that was used: neither a refused one
# nor one that is held.
SHOWN = {"status", "calibration", "good window"}

Place = tuple[str, str, str]  # site, gateway, sensor


class GatewayTold(msgspec.Struct, frozen=True):
    """The part of a gateway's status (agent.supervision.health) that the page shows. It is not signed."""

    state: str
    reasons: list[str]
    t_utc_ns: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
    version: str = ""


_GATEWAY_TOLD = msgspec.json.Decoder(GatewayTold)  # made during the import, as agent.delivery.record says


class Fleet:
    """The newest state of each sensor and gateway. `version` rises with every change. May be used by several threads.

    `left_out` counts results that are not shown: of a name that no gateway can have, or beyond the greatest number of
    sensors and gateways.
    """

    def __init__(self, now_ns: Callable[[], int] = time.time_ns, retired: Collection[str] = ()) -> None:
        """`now_ns`: the present, UTC; `retired`: gateways (`<site>/<gateway>`) and sensors that were taken down."""
        self.version = now_ns() // 1_000_000  # after those before a restart, which pages that are open know
        self.left_out = 0
        self._now_ns, self._retired = now_ns, frozenset(retired)
        self._heard: dict[Place, _ArrivalTimes] = {}
        self._silent: set[Place] = set()  # that have not been heard for SILENT_INTERVALS
        self._looked_ns = 0
        self._newest: dict[Place, dict[str, dict[str, Any]]] = {}
        self._since_stable: dict[tuple[Place, str], tuple[int, bool]] = {}  # as SINCE_STABLE, by parameter
        self._alive: set[tuple[str, str]] = set()
        self._told: dict[tuple[str, str], GatewayTold] = {}
        self._doubled: dict[tuple[str, str], tuple[str, ...]] = {}  # the ids of their runs
        self._in_turns: dict[tuple[str, str], tuple[str, ...]] = {}
        self._mixed_utc_ns: dict[tuple[str, str], int] = {}  # since when gateways are in one of the two
        self._gateways: set[tuple[str, str]] = set()
        self._suspected: dict[Place, Suspicion] = {}
        self._changed: dict[Place, int] = {}  # `version` at the last change of each sensor
        self._made: dict[Place, dict[str, Any]] = {}  # the row of each sensor
        self._events: dict[tuple[Place, str, str], dict[str, Any]] = {}  # the newest last
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
        place = site, gateway, sensor
        with self._mutex:
            self._knows((site, gateway))
            if what == "drift":
                fields = fields | self._judged(place, fields)
            self._newest.setdefault(place, {})[part] = fields
            self._heard.setdefault(place, _ArrivalTimes()).take(
                self._now_ns() if fresh else fields["t_utc_ns"], fresh=fresh
            )
            self._silent.discard(place)
            self.version += 1
            self._touch(place)
        if told := _event_text(what, fields):
            self.note(place, what, fields["t_utc_ns"], told, alarm=fresh and _needs_a_person(what, fields))

    def recall(self, place: Place, verdicts: Sequence[dict[str, Any]]) -> None:
        """Take earlier drift verdicts of a sensor, oldest first, after a restart.

        Of each parameter a row says when it was first told since it was last stable (`first_utc_ns`), and whether it
        was told to drift since then (`drifts`): a step that is told of it later does not end its drift.
        """
        with self._mutex:
            for fields in verdicts:
                if fields["parameter"] in PARAMETERS:
                    self._judged(place, fields)

    def _judged(self, place: Place, fields: Mapping[str, Any]) -> dict[str, Any]:
        key = place, fields["parameter"]
        first_utc_ns, drifts = self._since_stable.pop(key, (fields["t_utc_ns"], False))
        if fields["verdict"] == "stable":
            return {}
        self._since_stable[key] = first_utc_ns, drifts or fields["verdict"] == "drifting"
        return dict(zip(SINCE_STABLE, self._since_stable[key], strict=True))

    def note(self, place: Place, what: str, t_utc_ns: int, text: str, *, alarm: bool = False) -> None:
        """Add an event to the list of the newest ones; an `alarm` also to those that people are told."""
        event: dict[str, Any] = {"t_utc_ns": t_utc_ns, **dict(zip(("site", "gateway", "sensor"), place, strict=True))}
        event |= {"what": what, "text": clipped(text)}
        with self._mutex:
            same = place, what, _NUMBERS.sub("", text)
            before = self._events.pop(same, {"first_utc_ns": t_utc_ns, "count": 0})
            self._events[same] = event | {"first_utc_ns": before["first_utc_ns"], "count": before["count"] + 1}
            if len(self._events) > EVENTS_MAX:
                del self._events[next(iter(self._events))]
            if alarm:
                self._alarms.append(event)
            self.version += 1

    def look(self) -> None:
        """See which sensors are not heard any more, at most once in LOOK_S."""
        with self._mutex:
            now_ns = self._now_ns()
            if now_ns - self._looked_ns < LOOK_S * 1e9:
                return
            self._looked_ns = now_ns
            silent = {place for place, heard in self._heard.items() if heard.silent(now_ns)}
            if silent != self._silent:
                self.version += 1
                for place in silent ^ self._silent:
                    self._touch(place)
                self._silent = silent

    def verdicts(self, place: Place) -> list[dict[str, Any]]:
        """The newest verdicts on a sensor's parameters that drift or stepped."""
        with self._mutex:
            return _verdicts(self._newest.get(place, {}))

    def status(self, place: Place) -> str:
        """The newest status of a sensor; "" where none is known."""
        with self._mutex:
            return str(self._newest.get(place, {}).get("status", {}).get("status", ""))

    def beside(self, place: Place, since_utc_ns: int) -> dict[str, int]:
        """Of the other sensors whose newest windows had the same reference: how many can witness (`count`), and how
        many of these have changed (`changed`): windows contradict them, or a main sensitivity drifts or stepped.

        A witness is heard, in the name of one gateway, and has had a window since the time `since_utc_ns`.
        """
        with self._mutex:
            own = _reference(self._newest.get(place, {}))
            others = [
                newest for other, newest in self._newest.items()
                if other != place and own and _reference(newest) == own and self._hears(other)
                and _window_utc_ns(newest) > since_utc_ns and _judges(newest)
            ]  # fmt: skip
        return {"count": len(others), "changed": sum(map(_has_changed, others))}

    def peers(self, place: Place, most: int) -> list[Place]:
        """At most so many other sensors of the same kind of device (the first word of the identity)."""
        with self._mutex:
            kinds = {
                p: n["calibration"]["identity"].split(" ")[0] for p, n in self._newest.items() if "calibration" in n
            }
        own = kinds.pop(place, "")
        return sorted(p for p, kind in kinds.items() if kind == own and own)[:most]

    def events(self) -> list[dict[str, Any]]:
        """The newest events, the newest first. What was said again with other numbers is one event with a `count`."""
        with self._mutex:
            return list(reversed(self._events.values()))

    def alarms(self) -> list[dict[str, Any]]:
        """The alarms since the last call, the oldest first."""
        with self._mutex:
            found = list(self._alarms)
            self._alarms.clear()
            return found

    def set_suspected(
        self, site: str, found: Mapping[tuple[str, str], Suspicion], t_utc_ns: int, *, fresh: bool = True
    ) -> None:
        """What the site tells of its sensors (by gateway and name), in the place of what it told before.

        `fresh`: people are told of a sensor that was not suspected before.
        """
        with self._mutex:
            before = {place for place in self._suspected if place[0] == site}
            now = {(site, *names): one for names, one in found.items()}
            if any(self._suspected.get(place) != now.get(place) for place in before | now.keys()):
                self._suspected = {p: one for p, one in self._suspected.items() if p[0] != site} | now
                self.version += 1
                for place in before | now.keys():
                    if place in self._newest:
                        self._touch(place)
        for place in sorted(now.keys() - before):
            self.note(place, "watch", t_utc_ns, f"suspected: {now[place].text}", alarm=fresh)

    def set_alive(self, site: str, gateway: str, alive: bool) -> None:
        """Whether the gateway is on the bus."""
        with self._mutex:
            if alive and self._knows((site, gateway)):
                self._alive.add((site, gateway))
            elif not alive:
                self._alive.discard((site, gateway))
            self.version += 1
            self._touch_gateway((site, gateway))

    def set_doubled(self, doubled: Mapping[str, Sequence[str]], in_turns: Mapping[str, Sequence[str]]) -> None:
        """The gateways (`<site>/<gateway>`) of which more than one is on the bus, and those in whose name two gateways
        publish in turns; each with the ids of the runs."""
        found, turns = ({_place(source): tuple(runs) for source, runs in of.items()} for of in (doubled, in_turns))
        with self._mutex:
            changed = found.keys() ^ self._doubled.keys() | turns.keys() ^ self._in_turns.keys()
            now_ns, mixed = self._now_ns(), found.keys() | turns.keys()
            self._mixed_utc_ns = {gateway: self._mixed_utc_ns.get(gateway, now_ns) for gateway in mixed}
            self.version += (found, turns) != (self._doubled, self._in_turns)
            self._doubled, self._in_turns = found, turns
            for gateway in changed:
                self._touch_gateway(gateway)

    def set_gateway_status(self, site: str, gateway: str, status: bytes) -> None:
        """What a gateway says of itself, as JSON; what is no such status is ignored."""
        if len(status) > LARGEST_TOLD:
            return
        try:
            told = _GATEWAY_TOLD.decode(status)
        except (msgspec.DecodeError, ValueError, RecursionError):
            return
        with self._mutex:
            if self._knows((site, gateway)):
                before, self._told[site, gateway] = self._told.get((site, gateway)), told
                if before is None or (before.state, before.reasons) != (told.state, told.reasons):
                    self.version += 1
                    self._touch_gateway((site, gateway))

    def rows(self, since: int = 0) -> list[dict[str, Any]]:
        """One row for each sensor that has changed after the version `since`, by site, gateway and name."""
        with self._mutex:
            rows = [
                self._row_of(place)
                for place, newest in self._newest.items()
                if self._changed[place] > since and any(part in SHOWN or part.startswith("drift ") for part in newest)
            ]
        return sorted(rows, key=lambda r: (r["site"], r["gateway"], r["sensor"]))

    def gateways(self, refused: Mapping[str, int]) -> list[dict[str, Any]]:
        """One row for each gateway; those that need a person first. `refused`: results not verified, by gateway."""
        with self._mutex:
            counts = Counter(place[:2] for place in self._newest)
            rows = [
                self._gateway_row(place, counts[place], refused.get("/".join(place), 0))
                for place in self._gateways | {_place(source) for source in refused}
            ]
        return sorted(rows, key=lambda r: (not r["why"], r["site"], r["gateway"]))

    def _gateway_row(self, gateway: tuple[str, str], sensors: int, refused: int) -> dict[str, Any]:
        alive, retired = gateway in self._alive, "/".join(gateway) in self._retired
        told, doubled = self._told.get(gateway), self._doubled.get(gateway, ())
        why = [] if alive or retired else ["the gateway is not on the bus"]
        if doubled:
            why.append(f"{len(doubled)} gateways are on the bus under this name ({_runs(doubled)})")
        elif in_turns := self._in_turns.get(gateway):
            why.append(f"{_runs(in_turns)} {IN_TURNS}")
        if told is not None and told.state not in CALM:
            why.append(clipped(f"{told.state}: {'; '.join(told.reasons[:10])}"))
        if refused:
            why.append(f"{refused} results in its name were refused: no known key of this gateway signed them")
        return {
            "site": gateway[0],
            "gateway": gateway[1],
            "alive": alive,
            "retired": retired,
            "sensors": sensors,
            "state": clipped(told.state) if told else "",
            "version": clipped(told.version) if told else "",
            "told_utc_ns": told.t_utc_ns if told else None,
            "refused": refused,
            "instances": max(len(doubled), 1),
            "why": "; ".join(why),
            "mixed_utc_ns": self._mixed_utc_ns.get(gateway),
        }

    def _row_of(self, place: Place) -> dict[str, Any]:
        if place not in self._made:
            gateway = place[:2]
            # A sensor without data has no results; of its gateway it is known all the same.
            lost = self._newest[place].get("status", {}).get("status") == "INVALID"
            heard = (lost or place not in self._silent) and gateway in self._alive
            doubled = gateway in self._mixed_utc_ns
            of = {"heard_utc_ns": self._heard[place].at_ns, "changed": self._changed[place]}
            retired = not self._retired.isdisjoint(("/".join(gateway), "/".join(place)))
            presence = _Presence(self._state_of(gateway), heard, doubled, retired)
            row = _row(place, self._newest[place], presence, self._suspected.get(place))
            self._made[place] = row | of
        return self._made[place]

    def _hears(self, place: Place) -> bool:
        """Whether results of this sensor come, from one gateway."""
        return place not in self._silent and place[:2] in self._alive and place[:2] not in self._mixed_utc_ns

    def _touch(self, place: Place) -> None:
        self._changed[place] = self.version
        self._made.pop(place, None)

    def _touch_gateway(self, gateway: tuple[str, str]) -> None:
        for place in self._newest:
            if place[:2] == gateway:
                self._touch(place)

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


def _event_text(what: str, fields: dict[str, Any]) -> str:
    """What the list of events says of a result; "" where it is no event."""
    if what == "status":
        return f"{fields['status']}: {fields['reason']}"
    return f"{fields['parameter']} {fields['verdict']}: {fields['reason']}" if what == "drift" else ""


class _ArrivalTimes:
    """When something of a sensor came last, and the intervals between what came."""

    def __init__(self) -> None:
        self.at_ns = 0
        self._intervals: deque[float] = deque(maxlen=INTERVALS)

    def take(self, at_ns: int, *, fresh: bool) -> None:
        # Results of one window come together.
        if fresh and self._intervals and at_ns - self.at_ns < 1e9:
            return
        if fresh:
            self._intervals.append((at_ns - self.at_ns) / 1e9 if self._intervals else 0.0)
        self.at_ns = max(self.at_ns, at_ns)

    def silent(self, now_ns: int) -> bool:
        # Until two results came nobody knows the interval; then the presence of the gateway alone tells.
        known = len(self._intervals) > 1
        return known and now_ns - self.at_ns > SILENT_INTERVALS * max(INTERVAL_MIN_S, *self._intervals) * 1e9


def _reference(newest: Mapping[str, dict[str, Any]]) -> str:
    """The reference of the newest window; "" where there is none."""
    return str((newest.get("calibration", {}).get("references") or [""])[-1])


def _window_utc_ns(newest: Mapping[str, dict[str, Any]]) -> int:
    """The time of the newest window; 0 where there is none."""
    return max(int(newest.get(part, {}).get("t_utc_ns", 0)) for part in ("good window", "refused window"))


def _judges(newest: Mapping[str, dict[str, Any]]) -> bool:
    """Whether a calibration is in force that windows are compared with, and which no operator has put on hold."""
    status = newest.get("status", {})
    return status.get("status") in WITNESSES and not str(status.get("reason")).startswith(ON_HOLD)


def _has_changed(newest: Mapping[str, dict[str, Any]]) -> bool:
    moved = any(verdict["parameter"] in _MAIN_NAMES for verdict in _verdicts(newest))
    return moved or newest.get("status", {}).get("status") == "HELD"


def _verdicts(newest: Mapping[str, dict[str, Any]]) -> list[dict[str, Any]]:
    return [f for part, f in newest.items() if part.startswith("drift ") and f["verdict"] != "stable"]


def kind_of(
    verdicts: Collection[str], status: str, *, heard: bool, doubled: bool = False, retired: bool = False,
    suspected: bool = False,
) -> Kind:  # fmt: skip
    """The kind of a sensor: what it counts as on the page. `verdicts`: "drifting" or "stepped"; `doubled`: two gateways
    have the name of its own, so nobody knows whose results these are; `retired`: it was taken down; `suspected`: by the
    other sensors of its site.

    Held windows are what shows a step, so a sensor that is held and has stepped is held. One whose step was adopted has
    changed: of a drift, too, a part may be told as a step (trends.change_in).
    """
    if not heard:
        return "retired" if retired else "silent"
    if doubled:
        return "doubled"
    if "drifting" in verdicts:
        return "drifting"
    if verdicts and status != "HELD":
        return "changed"
    kind = _OF_STATUS.get(status, "uncalibrated")
    return "suspected" if suspected and kind == "sound" else kind


_OF_STATUS: dict[str, Kind] = {"VALID": "sound", "RECALIBRATING": "sound", "HELD": "held", "INVALID": "no data"}


@dataclass(frozen=True, slots=True)
class _Presence:
    """What is known of a sensor apart from its results. `gateway`: the state of its gateway; `heard`: results of the
    sensor come; `doubled`: two gateways have the name of its own; `retired`: it was taken down."""

    gateway: str
    heard: bool
    doubled: bool
    retired: bool


def _reasons(
    status: Mapping[str, Any], verdicts: Sequence[Mapping[str, Any]], presence: _Presence, suspicion: Suspicion | None
) -> list[str]:
    """Why the sensor is not sound, or is not heard."""
    why = [f"{drift['parameter']} {drift['verdict']}: {drift['reason']}" for drift in verdicts]
    if status.get("status") in NEEDS_A_PERSON:
        why.insert(0, f"{status['status']}: {status['reason']}")
    if presence.retired and not presence.heard:
        why = ["it was taken down"]
    elif presence.gateway == "silent":
        why.append("the gateway is not on the bus")
    elif not presence.heard:
        why.append(f"no result for {SILENT_INTERVALS} intervals")
    if presence.doubled:
        why.append("two gateways have one name")
    if suspicion is not None:
        why.append(f"suspected: {suspicion.text}")
    return why


def _row(
    place: Place, newest: dict[str, dict[str, Any]], presence: _Presence, suspicion: Suspicion | None
) -> dict[str, Any]:
    status, calibration = newest.get("status", {}), newest.get("calibration", {})
    verdicts = sorted(_verdicts(newest), key=lambda drift: -_in_u(drift, calibration))
    u_pct, u_axis = _largest_u(calibration)
    reference, calibrated_utc_ns = dated(_reference(newest))
    return {
        "site": place[0],
        "gateway": place[1],
        "sensor": place[2],
        "kind": kind_of(
            ["drifting" if drift["drifts"] else "stepped" for drift in verdicts],
            status.get("status", ""),
            heard=presence.heard,
            doubled=presence.doubled,
            retired=presence.retired,
            suspected=suspicion is not None,
        ),
        "status": status.get("status", ""),
        "status_utc_ns": status.get("t_utc_ns"),
        "reason": clipped(status.get("reason", "")),
        "gateway_state": presence.gateway,
        "verdicts": [_verdict(drift) for drift in verdicts],
        "size_in_u": _in_u(verdicts[0], calibration) if verdicts else None,
        "u_pct": u_pct,
        "u_axis": u_axis,
        "suspected": None if suspicion is None else _suspected(suspicion, calibration),
        "band_hz": calibration.get("valid_band_hz", []),
        "calibration_utc_ns": calibration.get("t_utc_ns"),
        "reference": clipped(reference),
        "calibrated_utc_ns": calibrated_utc_ns,
        "estimate": newest.get("estimate", {}).get("sequence"),
        "estimate_utc_ns": newest.get("estimate", {}).get("t_utc_ns"),
        "last_good_utc_ns": newest.get("good window", {}).get("t_utc_ns"),
        "result_utc_ns": max(fields["t_utc_ns"] for fields in newest.values()),
        "verified": bool(newest) and all(fields.get("signed_by") for fields in newest.values()),
        "why": "; ".join(clipped(reason) for reason in _reasons(status, verdicts, presence, suspicion)),
    }


def _verdict(drift: Mapping[str, Any]) -> dict[str, Any]:
    """What a row has of a verdict; `u_change`, `u_rate` are None where it tells no uncertainty of the change."""
    told = {name: drift[name] for name in (*VERDICT, *SINCE_STABLE)}
    return told | ({"u_change": None, "u_rate": None} if ALLOWED in drift["reason"] else {})


def _suspected(suspicion: Suspicion, calibration: Mapping[str, Any]) -> dict[str, Any]:
    """What is suspected, with `u_pct`: the largest U of a main sensitivity enlarged by it, in %; None where no
    calibration is known."""
    enlarged = [
        suspicion.enlarged_u_pct(pct, PARAMETERS[i][1]) for i, pct in _main_u(calibration).items()
    ] if calibration else []  # fmt: skip
    told: dict[str, Any] = msgspec.to_builtins(suspicion)
    return told | {"u_pct": max(enlarged, default=None)}


def dated(reference: str) -> tuple[str, int | None]:
    """The reference without the date of its certificate, and this date (UTC, ns); None where it has none."""
    if (found := _CALIBRATED.fullmatch(reference)) is None:
        return reference, None
    try:
        date = datetime.fromisoformat(found[2]).replace(tzinfo=UTC)
    except ValueError:  # no date of a calendar
        return reference, None
    return found[1], int(date.timestamp()) * 10**9


def _largest_u(calibration: Mapping[str, Any]) -> tuple[float | None, str]:
    """The largest U of a main sensitivity, in % of it, and which one it is; None and "" where none is known."""
    if not calibration:
        return None, ""
    return max(((pct, PARAMETERS[i]) for i, pct in _main_u(calibration).items()), default=(None, ""))


def _main_u(calibration: Mapping[str, Any]) -> dict[int, float]:
    """U of each main sensitivity in % of it, by its index in PARAMETERS, where it is known."""
    values, u, k = calibration["sensitivity"], calibration["standard_uncertainty"], _coverage_factor(calibration)
    found = {i: 100.0 * k * u[i] / abs(s) for i in MAIN if (s := values[i // 3][i % 3]) and u[i] is not None}
    return {i: pct for i, pct in found.items() if math.isfinite(pct)}


def _runs(ids: Sequence[str]) -> str:
    """The runs of gateways with one name; the log of each says its own when it begins."""
    return f"runs {', '.join(run[:RUN_SHOWN] for run in ids)}"


def clipped(text: str) -> str:
    """A text of the bus, at most TEXT_MAX characters of it."""
    return text if len(text) <= TEXT_MAX else f"{text[: TEXT_MAX - 1]}…"


def _place(source: str) -> tuple[str, str]:
    site, _, gateway = source.partition("/")
    return site, gateway


def _in_u(drift: dict[str, Any], calibration: Mapping[str, Any]) -> float:
    """The size of a change over U of the parameter in force, at most LARGEST; 0 where not known. A drift has gone on
    since its verdict."""
    change, rate = abs(drift["change"] or 0.0), abs(drift["rate"] or 0.0)
    if drift["verdict"] == "drifting" and calibration:
        change = max(change, rate * (calibration["t_utc_ns"] - drift["onset_utc_ns"]) / DAY_NS)
    u = calibration["standard_uncertainty"][PARAMETERS.index(drift["parameter"])] if calibration else None
    expanded = _coverage_factor(calibration) * u if u else math.nan
    return min(change / expanded, LARGEST) if expanded > 0.0 else 0.0


def _coverage_factor(calibration: Mapping[str, Any]) -> float:
    """k of a result; NaN where it tells none, as a result of a stranger may."""
    k = calibration["coverage_factor"]
    return k if k is not None and k > 0.0 else math.nan
