"""Carries out `fieldcal fleet watch`: all sensors of a site day by day, and what is to be done."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from agent import __version__
from agent.fleet.watched import Watched
from calib.site_watch.verdicts import WALK_PER_ROOT_DAY, SensorVerdict, SiteVerdicts, result
from calib.site_watch.watch import SiteWatch

U_VISIT = 0.003  # relative standard uncertainty of what a visit finds
U_UNKNOWN = 0.01  # of a calibration that states none
DO = {
    "none": "nothing",
    "learning": "wait",
    "sensitivity": "visit the sensor: its sensitivity has changed, or the structure at it, in all bands alike",
    "turn": "visit the sensor: look whether its mount has turned",
    "noise": "look at its cable, supply and noise",
    "sensor or structure": "look at the sensor, its mount and the structure there",
    "structure": "look at the structure there",
    "gateway": "visit the gateway: its supply, its clock, its converter; then one of its sensors",
}
TOLD_UNITS = {"turn": ("°", math.degrees(1.0)), "": (" %", 100.0)}


@dataclass(frozen=True, slots=True, eq=False)
class SiteView:
    """A site with its verdicts. `order`: sensors by what a visit would tell, most first, with the information in
    nat."""

    watched: Watched
    found: SiteVerdicts
    order: Sequence[tuple[int, float]]

    @property
    def changed(self) -> bool:
        """Whether anything is told to have changed."""
        told = [*self.found.sensors, *self.found.gateways.values(), self.found.site]
        return any(one.kind not in ("none", "learning") for one in told)


def seen(files: Watched, beside_reference: Sequence[int] = ()) -> SiteView:
    """Watch the site over all its days. `beside_reference`: numbers of the sensors that have one."""
    gateways = files.gateways
    watch = SiteWatch(np.array([gateways.index(gateway) for gateway, _ in files.sensors]), files.band_hz)
    for day, visited in files.days():
        watch.update(day, visited)
    known = np.full(len(files.sensors), np.inf)
    for i in beside_reference:
        known[i] = files.u_main.get(i, U_UNKNOWN)
    found = result(watch, known)
    return SiteView(files, found, _order(files, found, beside_reference))


def _order(files: Watched, found: SiteVerdicts, beside_reference: Sequence[int]) -> list[tuple[int, float]]:
    """What a visit would tell of each sensor: 0.5 ln(1 + u²/u_visit²), with u from its calibration, the walk of its
    sensitivity and what is suspected of it."""
    gain = []
    for i, told in enumerate(found.sensors):
        u2 = files.u_main.get(i, U_UNKNOWN) ** 2 + WALK_PER_ROOT_DAY**2 * float(found.days[i])
        if told.kind in ("sensitivity", "turn"):
            u2 += told.size**2
        elif told.kind in ("sensor or structure", "structure"):
            least = float(np.min(found.least_detectable[i]))
            u2 += least**2 if np.isfinite(least) else U_UNKNOWN**2
        if i not in beside_reference:
            gain.append((i, 0.5 * math.log1p(u2 / U_VISIT**2)))
    return sorted(gain, key=lambda one: -one[1])


def rows(what: SiteView) -> list[tuple[str, str, str, str, str]]:
    """The table: sensor, verdict, size with U, since, what to do. First what has changed, in the order of visits."""
    found, places = what.found, {i: k for k, (i, _) in enumerate(what.order)}
    table = [("site", *_cells(found.site))] if found.site.kind != "none" else []
    table += [(f"gateway {what.watched.gateways[g]}", *_cells(told)) for g, told in found.gateways.items()]
    quiet = ("none", "learning")
    by_visit = sorted(
        range(len(found.sensors)), key=lambda i: (found.sensors[i].kind in quiet, places.get(i, len(places)))
    )
    table += [("/".join(what.watched.sensors[i]), *_cells(found.sensors[i])) for i in by_visit]
    return table


def _cells(told: SensorVerdict) -> tuple[str, str, str, str]:
    verdict = f"{told.kind}: {told.what}" if told.what else told.kind
    return verdict, _size(told), _since(told), DO.get(told.kind, "")


def _size(told: SensorVerdict) -> str:
    if not math.isfinite(told.U):
        return ""
    unit, factor = TOLD_UNITS.get(told.kind, TOLD_UNITS[""])
    return f"{factor * told.size:+.2f} ± {factor * told.U:.2f}{unit}"


def _since(told: SensorVerdict) -> str:
    if told.since < 0:
        return ""
    reach = max(told.latest - told.since, told.since - told.earliest, 1)
    return f"{date(told.since)} ± {reach} d"


def date(day: int) -> str:
    """The date of a day since 1970."""
    return (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(days=day)).date().isoformat()


def not_seen(what: SiteView) -> list[str]:
    """What this site cannot show, one sentence each."""
    found, names = what.found, what.watched.sensors
    lines = []
    if found.common is None:
        lines.append("A change that all sensors share, of any size, is not seen: no sensor stands beside a reference.")
    else:
        lines.append(f"A change that all sensors share is not seen below {100.0 * found.hidden:.2g} %; found: "
                     f"{_size(found.common)}.")  # fmt: skip
    gateways = what.watched.gateways
    if len(gateways) == 1:
        lines.append("A change of the whole gateway is not seen: the site has no other one.")
    elif len(gateways) == 2:
        lines.append("Of two gateways that differ it is not seen which one changed.")
    least = found.least_detectable.min(axis=1)
    blind = [i for i in range(len(names)) if not np.isfinite(least[i])]
    if blind:
        lines.append(f"Of {len(blind)} sensors nothing is told yet: fewer than 21 days, or all bands in the noise: "
                     f"{_some(names, blind)}.")  # fmt: skip
    if len(blind) < len(names):
        known = 100.0 * least[np.isfinite(least)]
        lines.append(f"Least change found 30 days after it: {np.median(known):.2g} % in the middle, "
                     f"{known.max():.2g} % at the worst sensor.")  # fmt: skip
    outside = np.flatnonzero(found.outside).tolist()
    if outside:
        lines.append(f"The last day is warmer or colder than all days of the norm of {_some(names, outside)}.")
    return lines


def _some(names: Sequence[tuple[str, str]], which: Sequence[int]) -> str:
    told = ", ".join("/".join(names[i]) for i in which[:5])
    return told if len(which) <= 5 else f"{told} and {len(which) - 5} more"


def as_object(what: SiteView) -> dict[str, Any]:
    """The members of the JSON object of docs/site-watch.md."""
    found, files = what.found, what.watched
    gain = dict(what.order)
    return {
        "until": date(found.day),
        "changed": what.changed,
        "limit": found.limit,
        "site": _told(found.site),
        "gateways": {files.gateways[g]: _told(told) for g, told in found.gateways.items()},
        "sensors": [
            {
                "gateway": gateway,
                "sensor": sensor,
                **_told(found.sensors[i]),
                "days": int(found.days[i]),
                "least_detectable_pct": 100.0 * found.least_detectable[i],
                "temperature_range_degc": found.seen_degc[i],
                "outside_temperature_range": bool(found.outside[i]),
                "visit_information_nat": gain.get(i),
            }
            for i, (gateway, sensor) in enumerate(files.sensors)
        ],
        "visit_order": ["/".join(files.sensors[i]) for i, _ in what.order],
        "common": None if found.common is None else _told(found.common),
        "not_seen": not_seen(what),
        "lines": files.lines,
        "left_out": dict(files.left_out),
        "version": __version__,
    }


def _told(told: SensorVerdict) -> dict[str, Any]:
    unit, factor = ("rad", 1.0) if told.kind == "turn" else ("%", 100.0)
    dated = told.since >= 0
    return {
        "verdict": told.kind,
        "what": told.what,
        "size": factor * told.size if math.isfinite(told.U) else None,
        "expanded_uncertainty": factor * told.U if math.isfinite(told.U) else None,
        "unit": unit,
        "since": date(told.since) if dated else None,
        "earliest": date(told.earliest) if dated else None,
        "latest": date(told.latest) if dated else None,
        "statistic": told.statistic,
    }
