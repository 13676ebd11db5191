"""What is told of a site: a verdict for each sensor with its witnesses, what is to be done, and what visits have
shown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent import __version__
from agent.site_watch.day_sum import days_of
from agent.site_watch.source import SiteSource
from agent.site_watch.suspicion import (
    AXES_OF,
    Suspicion,
    date,
    frequency_sentence,
    relative,
    sentence,
    since,
    sized,
    witness_of,
)
from calib.model import Array
from calib.site_watch.verdicts import COVERAGE, SUSPECTED, WALK_PER_ROOT_DAY, SensorVerdict, SiteVerdicts, result
from calib.site_watch.visits import teach
from calib.site_watch.watch import VISIT, SiteWatch

U_VISIT = 0.003  # relative standard uncertainty of what a visit finds
MUTE_DAYS = 3  # without a value, after which it is told
U_UNKNOWN = 0.01  # of a calibration that states none
DO = {
    "none": "nothing",
    "learning": "wait",
    "sensitivity": "visit the sensor: its sensitivity has changed, or the structure at it, in all bands alike",
    "one of two": "visit one of the two: its sensitivity has changed, or that of the other one",
    "turn": "visit the sensor: look whether its mount has turned",
    "clock": "set the clock of its gateway: until then nothing else is told of the sensor",
    "noise": "look at its cable, supply and noise",
    "sensor or structure": "look at the sensor, its mount and the structure there",
    "structure": "look at the structure there",
    "excitation": "nothing: works, pumps or traffic there have changed",
    "gateway": "visit the gateway: its supply, its clock, its converter; then one of its sensors",
}


@dataclass(frozen=True, slots=True, eq=False)
class SiteView:
    """A site with its verdicts. `order`: sensors by what a visit would tell, most first, with the information in
    nat. `visits`: rows of calib.site_watch.watch.VISIT. `last`: the last day on which each sensor told something; 0 for
    none."""

    source: SiteSource
    found: SiteVerdicts
    order: Sequence[tuple[int, float]]
    visits: Array
    last: Array

    @property
    def changed(self) -> bool:
        """Whether a sensor, a gateway or the structure is told to have changed."""
        told = [*self.found.sensors, *self.found.gateways.values(), self.found.site]
        return any(one.kind not in ("none", "learning", "excitation") for one in told)

    def suspected(self, i: int) -> Suspicion | None:
        """What is suspected of the sensitivity or direction of a sensor: by itself, or with its gateway."""
        (gateway, sensor), told = self.source.sensors[i], self.found.sensors[i]
        if told.kind not in SUSPECTED:
            with_gateway = self.found.gateways.get(self.source.gateways.index(gateway))
            if with_gateway is None:
                return None
            told = with_gateway
        size, U = relative(told)
        return Suspicion(
            gateway=gateway, sensor=sensor, axes=AXES_OF[told.direction], turn=told.kind == "turn", size=size,
            expanded_uncertainty=U, since=date(told.since), earliest=date(told.earliest), latest=date(told.latest),
            witnesses=[witness_of(one) for one in told.witnesses], text=sentence(told),
            visit_information_nat=dict(self.order).get(i), one_of_two=told.kind == "one of two",
        )  # fmt: skip

    @property
    def sentences(self) -> list[str]:
        """The frequency that has changed; what is suspected of sensors, with witnesses, in the order of visits."""
        told = [one for i, _ in self.order if (one := self.suspected(i)) is not None and one.witnesses]
        frequencies = [frequency_sentence(one) for one in self.found.frequencies[:1]]
        return frequencies + [f"{one.gateway}/{one.sensor}: {one.text}" for one in told]


def watch_site(source: SiteSource, beside_reference: Sequence[int] = ()) -> SiteView:
    """Watch the site over all its days. `beside_reference`: positions of the sensors that have one."""
    gateways, n = source.gateways, len(source.sensors)
    watch = SiteWatch(np.array([gateways.index(gateway) for gateway, _ in source.sensors]),
                      10.0 ** (np.array(source.bands) / 10.0))  # fmt: skip
    known, u_main = np.full(n, np.inf), np.full(n, np.nan)
    beside, last = list(beside_reference), np.zeros(n)
    for day in days_of(source.sums(), source.numbers, source.bands):
        u_main = day.u_main
        known[beside] = np.where(np.isfinite(u_main[beside]), u_main[beside], U_UNKNOWN)
        if day.visits.there.any():
            teach(watch, day.visits, known)
        watch.update(day.day, day.visits)
        last[np.isfinite(day.day.value).any(axis=(1, 2))] = day.day.number
    found = result(watch, known)
    return SiteView(source, found, _order(source, found, u_main, beside), watch.visits, last)


def _order(
    source: SiteSource, found: SiteVerdicts, u_main: Array, beside_reference: Sequence[int]
) -> list[tuple[int, float]]:
    """What a visit would tell of each sensor: 0.5 ln(1 + u²/u_visit²), with u from its calibration, the walk of its
    sensitivity and what is suspected of it or its gateway."""
    information = []
    for i, (told, (gateway, _)) in enumerate(zip(found.sensors, source.sensors, strict=True)):
        u2 = float(np.nan_to_num(u_main[i], nan=U_UNKNOWN)) ** 2 + WALK_PER_ROOT_DAY**2 * float(found.days[i])
        with_gateway = found.gateways.get(source.gateways.index(gateway))
        if told.kind in SUSPECTED:
            u2 += told.size**2
        elif with_gateway is not None:
            u2 += with_gateway.size**2
        elif told.kind in ("sensor or structure", "structure"):
            least = float(np.min(found.least_detectable[i]))
            u2 += least**2 if np.isfinite(least) else U_UNKNOWN**2
        if i not in beside_reference:
            information.append((i, 0.5 * math.log1p(u2 / U_VISIT**2)))
    return sorted(information, key=lambda one: -one[1])


def rows(what: SiteView) -> list[tuple[str, str, str, str, str]]:
    """The table: sensor, verdict, size with U, since, what to do. First what has changed, in the order of visits."""
    found, places = what.found, {i: k for k, (i, _) in enumerate(what.order)}
    table = [("site", *_cells(found.site))] if found.site.kind != "none" else []
    table += [(f"gateway {what.source.gateways[g]}", *_cells(told)) for g, told in found.gateways.items()]
    quiet = ("none", "learning")
    by_visit = sorted(
        range(len(found.sensors)), key=lambda i: (found.sensors[i].kind in quiet, places.get(i, len(places)))
    )
    table += [("/".join(what.source.sensors[i]), *_cells(found.sensors[i])) for i in by_visit]
    return table


def _cells(told: SensorVerdict) -> tuple[str, str, str, str]:
    verdict = f"{told.kind}: {told.what}" if told.what else told.kind
    return verdict, sized(told), since(told), DO.get(told.kind, "")


def blind_spots(what: SiteView) -> list[str]:
    """What this site cannot show, one sentence each."""
    found, names = what.found, what.source.sensors
    lines = []
    if found.common is None:
        lines.append("A change that all sensors share, of any size, is not seen: no sensor stands beside a reference.")
    else:
        lines.append(f"A change that all sensors share is not seen below {100.0 * found.hidden:.2g} %; found: "
                     f"{sized(found.common)} ({found.common.what}).")  # fmt: skip
    gateways = what.source.gateways
    if len(gateways) == 1:
        lines.append("A change of the whole gateway is not seen: the site has no other one.")
    elif len(gateways) == 2:
        lines.append("Of two gateways that differ it is not seen which one changed.")
    if len(names) == 2:
        lines.append("Of two sensors that differ it is not seen which one changed, unless a witness says so.")
    least = found.least_detectable.min(axis=1)
    blind = [i for i in range(len(names)) if not np.isfinite(least[i])]
    if blind:
        lines.append(f"Of {len(blind)} sensors nothing is told yet: fewer than 21 days, or all bands in the noise: "
                     f"{_some(names, blind)}.")  # fmt: skip
    if len(blind) < len(names):
        known = 100.0 * least[np.isfinite(least)]
        lines.append(f"Least change found 30 days after it: {np.median(known):.2g} % in the middle, "
                     f"{known.max():.2g} % at the worst sensor.")  # fmt: skip
    mute = np.flatnonzero(found.day - what.last >= MUTE_DAYS).tolist()
    if mute:
        who = _some(names, mute)
        lines.append(f"Nothing is told for {MUTE_DAYS} days or more by {who}: silent, dead, or all bands in the noise.")
    outside = [i for i in np.flatnonzero(found.outside).tolist() if i not in mute]
    if outside:
        lines.append(f"The last day is warmer or colder than all days of the norm of {_some(names, outside)}.")
    return lines


def _some(names: Sequence[tuple[str, str]], which: Sequence[int]) -> str:
    told = ", ".join("/".join(names[i]) for i in which[:5])
    return told if len(which) <= 5 else f"{told} and {len(which) - 5} more"


def as_object(what: SiteView) -> dict[str, Any]:
    """The members of the JSON object of docs/site-watch.md."""
    found, source = what.found, what.source
    information = dict(what.order)
    return {
        "until": date(found.day),
        "changed": what.changed,
        "limit": found.limit,
        "site": _verdict_object(found.site),
        "frequencies": [{"frequency_hz": one.hz, **_verdict_object(one)} for one in found.frequencies],
        "gateways": {source.gateways[g]: _verdict_object(told) for g, told in found.gateways.items()},
        "sensors": [
            {
                "gateway": gateway,
                "sensor": sensor,
                **_verdict_object(found.sensors[i]),
                "suspected": what.suspected(i),
                "days": int(found.days[i]),
                "last_day": date(int(what.last[i])) if what.last[i] else None,
                "least_detectable_pct": 100.0 * found.least_detectable[i],
                "temperature_range_degc": found.seen_degc[i],
                "outside_temperature_range": bool(found.outside[i]),
                "visit_information_nat": information.get(i),
            }
            for i, (gateway, sensor) in enumerate(source.sensors)
        ],
        "visit_order": ["/".join(source.sensors[i]) for i, _ in what.order],
        "visits": [_visit(what, row) for row in what.visits.tolist()],
        "common": None if found.common is None else _verdict_object(found.common),
        "not_seen": blind_spots(what),
        "lines": source.lines,
        "left_out": dict(source.left_out),
        "version": __version__,
    }


def _verdict_object(told: SensorVerdict) -> dict[str, Any]:
    unit, factor = ("rad", 1.0) if told.kind == "turn" else ("%", 100.0)
    dated, (size, U) = told.since >= 0, relative(told)
    return {
        "verdict": told.kind,
        "what": told.what,
        "size": factor * size if math.isfinite(U) else None,
        "expanded_uncertainty": factor * U if math.isfinite(U) else None,
        "unit": unit,
        "since": date(told.since) if dated else None,
        "earliest": date(told.earliest) if dated else None,
        "latest": date(told.latest) if dated else None,
        "statistic": told.statistic,
    }


def _visit(what: SiteView, row: Sequence[float]) -> dict[str, Any]:
    """A visit, and whether it confirmed what was suspected."""
    told = dict(zip(VISIT, row, strict=True))
    apart = abs(told["size"] - told["found"]) / math.hypot(told["u"], told["u_found"])
    verdict = "confirmed" if apart <= COVERAGE else "refuted"
    return {
        "sensor": "/".join(what.source.sensors[int(told["sensor"])]), "date": date(int(told["day"])),
        "suspicion": verdict if told["suspected"] else "none",
        "suspected_pct": 100.0 * math.expm1(told["size"]) if told["suspected"] else None,
        "found_pct": 100.0 * math.expm1(told["found"]), "expanded_uncertainty_pct": 100.0 * COVERAGE * told["u_found"],
    }  # fmt: skip
