"""The site watched together: are changes found and named, are sound sites left alone, is damage told as damage?

    python -m benchmarks.site_watch --sensors 8 [--cases 160] [--write]
    python -m benchmarks.site_watch --sensors 8 --years 60 [--write]
    python -m benchmarks.site_watch --traffic [--cases 80] [--first-site 10] [--write]
    python -m benchmarks.site_watch --worlds [--write]
    python -m benchmarks.site_watch --cost [--write]
    python -m benchmarks.site_watch --kept [--write]
    python -m benchmarks.site_watch --year [--write]

The bridge is simulated by benchmarks/beam_world.py, whose model is not the estimator's. A site learns for
LEARNED_DAYS, each from another season on. Then each case changes one sensor (each in turn; every second case one axis
alone), two at once, a gateway, or the structure. A case is looked at on the day that its mark names, damage on
several days. `--traffic` draws changes of what moves the structure, of six kinds in turn. Sound sites run for two
years each and are looked at once a week; an alarm that was there four weeks before is the same one. `--kept` puts the
hours of some days into a database of the monitor and repeats the days for a year; the monitor then watches the site
from its days. `--minutes` ends it early: the table then has fewer cases, and says how many.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import copy
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from agent.delivery.keys import Address
from agent.delivery.received import Received
from agent.monitor.database import Database
from agent.monitor.engines import Sqlite
from agent.monitor.watch_store import KEPT_DAYS, close_day, source_of
from agent.site_watch.day_sum import DaySum
from agent.site_watch.view import watch_site
from benchmarks.beam_world import (
    BANDS_HZ,
    EXCITATIONS,
    FREQUENCY_HZ,
    Bridge,
    Damage,
    World,
    changed,
    otherwise,
    turned,
)
from benchmarks.page import machine, write_part
from calib.model import Array
from calib.site_watch.day import Hours, Visits, day_of
from calib.site_watch.verdicts import SiteVerdicts, result
from calib.site_watch.visits import teach
from calib.site_watch.watch import VISIT, SiteWatch

GATEWAYS = {8: 3, 30: 5, 200: 10}
LEARNED_DAYS = 240
CASES_OF_A_SITE = {8: 8, 30: 20, 200: 40}
PAIRS_PART = 3 / 8  # cases of two sensors for each case of one: 60 for 160
DAMAGE_DAYS = 4, 7, 10, 14
TRAFFIC_DAYS = 4, 7, 14, 30
TRAFFIC_OF_A_SITE = 8
TURN_RAD = np.radians(1.0)
SITE_DAYS = 730
FIRST_LOOK = 45  # days after the begin of a site
WORLDS = {
    "0.32 %, 6 h, 0.02 %/K": World(),
    "0.32 %, 24 h, 0.05 %/K": World(scatter_h=24.0, shape_per_k=5e-4),
    "0.88 %, 6 h, 0.02 %/K": World(scatter=0.0088),
}
ALARMS = "sensitivity", "one of two", "turn", "sensor or structure"


def learned(seed: int, sensors: int, world: World) -> tuple[Bridge, SiteWatch]:
    """A site that has learned."""
    bridge = Bridge(seed, sensors, GATEWAYS[sensors], world)
    bridge.hour = 24 * (61 * seed % 365)
    watch = SiteWatch(bridge.gateway, BANDS_HZ)
    for hours in bridge.days(LEARNED_DAYS):
        watch.update(day_of(hours, BANDS_HZ))
    return bridge, watch


def told_after(watch: SiteWatch, days: Iterable[Hours], looks: tuple[int, ...]) -> list[SiteVerdicts]:
    """The results after so many days, from a copy of the watch on."""
    watch, found = SiteWatch.loaded(copy.deepcopy(watch.snapshot())), []
    for number, hours in enumerate(days, start=1):
        watch.update(day_of(hours, BANDS_HZ))
        if number in looks:
            found.append(result(watch))
    return found


def named(found: SiteVerdicts) -> list[int]:
    """Sensors that are said to have changed; -1 for each gateway."""
    return [i for i, told in enumerate(found.sensors) if told.kind in ALARMS] + [-1] * len(found.gateways)


def detection(bridge: Bridge, watch: SiteWatch, cases: int, count: Counter[str]) -> None:
    """One sensor, and two at once, by 1 % for 5 days and by 0.5 % for 30 days."""
    n, random = bridge.sensors, np.random.default_rng(bridge.seed)
    future = list(copy.deepcopy(bridge).days(30))
    order = random.permutation(n)
    singles = [(int(order[k % n]),) for k in range(cases)]
    pairs = [tuple(random.choice(n, 2, replace=False).tolist()) for _ in range(round(PAIRS_PART * cases))]
    for number, who in enumerate([*singles, *pairs]):
        axes = (0, 1, 2) if number % 2 else (number // 2 % 3,)
        kind = "one" if len(who) == 1 else "two"
        for size, days in ((0.01, 5), (0.005, 30)):
            size = size if random.random() < 0.5 else -size
            moved = (changed(hours, np.array(who), 1.0 + size, axes) for hours in future[:days])
            (found,) = told_after(watch, moved, (days,))
            alarms = named(found)
            key = f"{kind} {abs(size):g}"
            count[f"{key} cases"] += len(who)
            count[f"{key} found"] += sum(i in alarms for i in who)
            count[f"{kind} alarms"] += len(alarms)
            count[f"{kind} right"] += sum(i in who for i in alarms)
            for told in (found.sensors[i] for i in who if found.sensors[i].kind == "sensitivity"):
                count["sized"] += 1
                count["covered"] += abs(told.size - np.log1p(size)) <= told.U
                count["dated"] += found.day - days + 1 >= told.earliest and found.day - days + 1 <= told.latest


def others(bridge: Bridge, watch: SiteWatch, cases: int, count: Counter[str]) -> None:
    """A gateway by 1 %, a sensor that turns by 1 deg, a noise floor that doubles."""
    random = np.random.default_rng(bridge.seed + 1)
    future = list(copy.deepcopy(bridge).days(14))
    for _ in range(cases):
        i, g, axis = (
            int(random.integers(bridge.sensors)),
            int(random.integers(bridge.gateways)),
            int(random.integers(3)),
        )
        own = np.flatnonzero(bridge.gateway == g)
        (found,) = told_after(watch, (changed(hours, own, 0.99) for hours in future), (14,))
        count["gateway cases"] += 1
        count["gateway told"] += list(found.gateways) == [g]
        count["gateway others"] += any(x >= 0 and bridge.gateway[x] != g for x in named(found))
        (found,) = told_after(watch, (turned(hours, i, axis, TURN_RAD) for hours in future), (14,))
        count["turn cases"] += 1
        count["turn told"] += found.sensors[i].kind == "turn"
        count["turn as sensitivity"] += found.sensors[i].kind == "sensitivity"
        if found.sensors[i].kind == "turn":
            count["turn covered"] += bool(abs(found.sensors[i].size - TURN_RAD) <= found.sensors[i].U)
        (found,) = told_after(watch, (noisier(hours, i, bridge, random) for hours in future), (14,))
        count["noise cases"] += 1
        count["noise told"] += found.sensors[i].kind == "noise"
        count["noise as sensitivity"] += found.sensors[i].kind == "sensitivity"


def noisier(hours: Hours, i: int, bridge: Bridge, random: np.random.Generator) -> Hours:
    """The same hours, in which the noise floor of a sensor has twice the power."""
    power, noise = hours.power.copy(), hours.noise_psd.copy()
    more = bridge.noise[i] * bridge.width_hz[:, None]
    freedom = bridge.width_hz[:, None] * 3600.0
    scatter = np.sqrt((more**2 + 2.0 * power[:, i] * more) / freedom)
    power[:, i] += more + scatter * random.standard_normal(power[:, i].shape)
    noise[:, i] *= 2.0
    return replace(hours, power=power, noise_psd=noise)


def damage(bridge: Bridge, watch: SiteWatch, cases: int, count: Counter[str]) -> None:
    """A shape that changes by 5 % at three neighbours, otherwise in each mode; a frequency that falls by 2 %."""
    random = np.random.default_rng(bridge.seed + 2)
    begin = bridge.hour // 24
    for number in range(cases):
        first = int(random.integers(bridge.sensors - 2))
        modes = tuple(random.choice(len(FREQUENCY_HZ), 5, replace=False).tolist())
        kinds = {
            "shape": Damage(begin, shape=0.05, modes=modes, sensors=(first, first + 1, first + 2)),
            "frequency": Damage(begin, frequency=0.02, mode=number % len(FREQUENCY_HZ)),
        }
        for name, what in kinds.items():
            hurt = copy.deepcopy(bridge)
            hurt.damage = what
            found = told_after(watch, hurt.days(max(DAMAGE_DAYS)), DAMAGE_DAYS)
            count[f"{name} cases"] += 1
            count[f"{name} told"] += any(
                one.site.kind == "structure" or any(t.kind == "sensor or structure" for t in one.sensors)
                for one in found
            )
            if name == "frequency":
                _of_frequency(found, FREQUENCY_HZ[what.mode], what.frequency, begin, count)
            count[f"{name} as sensitivity"] += any(
                bool(one.gateways) or any(told.kind == "sensitivity" for told in one.sensors) for one in found
            )


def _of_frequency(found: list[SiteVerdicts], hz: float, fallen: float, begin: int, count: Counter[str]) -> None:
    """Is the frequency named, with its size and date, on the last day?"""
    for told in found[-1].frequencies[:1]:
        if abs(told.hz / hz - 1.0) < 0.06:
            count["frequency near"] += 1
            count["frequency covered"] += bool(abs(told.size - np.log1p(-fallen)) <= told.U)
            count["frequency dated"] += told.earliest <= begin <= told.latest


def sound(seed: int, sensors: int, count: Counter[str]) -> None:
    """A sound site for two years: alarms by kind."""
    bridge = Bridge(seed, sensors, GATEWAYS[sensors])
    bridge.hour = 24 * (61 * seed % 365)
    watch, last = SiteWatch(bridge.gateway, BANDS_HZ), dict[tuple[tuple[str, int], str], int]()
    for number, hours in enumerate(bridge.days(SITE_DAYS)):
        watch.update(day_of(hours, BANDS_HZ))
        if number < FIRST_LOOK or number % 7:
            continue
        found = result(watch)
        told = {("sensor", i): one.kind for i, one in enumerate(found.sensors)}
        told |= {("gateway", g): one.kind for g, one in found.gateways.items()}
        told["site", 0] = "frequency" if found.frequencies else "none"
        for who, kind in told.items():
            if kind in ("none", "learning"):
                continue
            group = {
                "noise": "noise",
                "frequency": "frequency",
                "structure": "structure",
                "sensor or structure": "structure",
            }.get(kind, "sensitivity")
            count[f"false {group}"] += number - last.get((who, group), -99) > 28
            last[who, group] = number
    count["days"] += SITE_DAYS - FIRST_LOOK


def traffic(cases: int, end: float, first: int = 0) -> str:
    """What is told of changes of the excitation alone, on any of TRAFFIC_DAYS after them, at 8 sensors, from site
    `first` on."""
    count: Counter[tuple[str, str]] = Counter()
    for seed in range(first, first - (-cases // TRAFFIC_OF_A_SITE)):
        if time.monotonic() > end:
            break
        bridge, watch = learned(1000 + seed, 8, World())
        random = np.random.default_rng(bridge.seed + 3)
        for k in range(TRAFFIC_OF_A_SITE):
            kind = EXCITATIONS[(TRAFFIC_OF_A_SITE * seed + k) % len(EXCITATIONS)]
            other = copy.deepcopy(bridge)
            other.excitation = otherwise(other, kind, bridge.hour // 24, random)
            looks = told_after(watch, other.days(max(TRAFFIC_DAYS)), TRAFFIC_DAYS)
            told = {one.kind for found in looks for one in found.sensors}
            for what in (kind, "all"):
                count[what, "cases"] += 1
                gateways = any(found.gateways for found in looks)
                count[what, "sensitivity"] += gateways or bool(told & {"sensitivity", "one of two"})
                count[what, "turn"] += "turn" in told
                count[what, "bands"] += bool(told & {"sensor or structure", "structure"})
                count[what, "frequency"] += any(found.frequencies for found in looks)
                count[what, "excitation"] += "excitation" in told
        print(f"site {seed + 1}", {name: n for (what, name), n in count.items() if what == "all"}, flush=True)
    names = "sensitivity", "turn", "bands", "frequency", "excitation"
    lines = [
        "| what has changed | told as a sensitivity | as a turn | as bands that change differently | as a frequency "
        "| as the excitation | cases |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for what in (*EXCITATIONS, "all"):
        of = count[what, "cases"]
        cells = [wilson(count[what, name], of) if what == "all" else f"{count[what, name]}" for name in names]
        lines.append(f"| {what} | {' | '.join(cells)} | {of} |")
    return "\n".join(lines)


def wilson(hits: int, of: int) -> str:
    """A share in % with Wilson's interval of 95 %."""
    if not of:
        return "–"
    z, p = 1.96, hits / of
    middle, half = (p + z * z / (2 * of)), z * np.sqrt(p * (1 - p) / of + z * z / (4 * of * of))
    low, high = (100 * (middle + sign * half) / (1 + z * z / of) for sign in (-1, 1))
    return f"{100 * p:.1f} % ({max(low, 0.0):.0f} to {high:.0f})"


def rows_of_one(count: Counter[str]) -> list[str]:
    """What is found of one sensor and of two."""
    lines = []
    for kind, who in (("one", "one sensor"), ("two", "two sensors at once")):
        for size, days in (("0.01", 5), ("0.005", 30)):
            of = count[f"{kind} {size} cases"]
            found = wilson(count[f"{kind} {size} found"], of)
            lines.append(f"| {who}, {100 * float(size):g} %, {days} days: found | {found} | {of} |")
        alarms = count[f"{kind} alarms"]
        lines.append(f"| {who}: alarms that name it | {wilson(count[f'{kind} right'], alarms)} | {alarms} |")
    return lines


def table(sensors: int, cases: int, end: float) -> str:
    """What is found at one size of site."""
    count: Counter[str] = Counter()
    own = CASES_OF_A_SITE[sensors]
    sites = -(-cases // own)
    for seed in range(sites):
        if time.monotonic() > end:
            break
        site = learned(1000 + seed, sensors, World())
        detection(*site, min(own, cases - seed * own), count)
        others(*site, own // 4 or 1, count)
        damage(*site, own // 4 or 1, count)
        print(f"site {seed + 1} of {sites}", dict(count), flush=True)
    lines = ["| case | share or rate, with 95 % | cases |", "| --- | --- | --- |", *rows_of_one(count)]
    lines.append(f"| size within U | {wilson(count['covered'], count['sized'])} | {count['sized']} |")
    lines.append(f"| date within what is told | {wilson(count['dated'], count['sized'])} | {count['sized']} |")
    for name, told, wrong in (
        ("a gateway by 1 %, 14 days: told as this gateway", "gateway told", ""),
        ("a sensor turns by 1°, 14 days: told as a turn", "turn told", "turn as sensitivity"),
        ("a noise floor doubles, 14 days: told as noise", "noise told", "noise as sensitivity"),
        ("a shape changes by 5 % at three sensors, 14 days: told as structure", "shape told", "shape as sensitivity"),
        ("a frequency falls by 2 %, 14 days: told as structure", "frequency told", "frequency as sensitivity"),
        ("the same: the frequency named, within 6 %", "frequency near", ""),
    ):
        of = count[f"{told.split()[0]} cases"]
        lines.append(f"| {name} | {wilson(count[told], of)} | {of} |")
        if wrong:
            lines.append(f"| the same: told as a sensitivity | {wilson(count[wrong], of)} | {of} |")
        if told == "turn told":
            held = wilson(count["turn covered"], count[told])
            lines.append(f"| the turns that are told: size within U | {held} | {count[told]} |")
    of = count["frequency near"]
    lines.append(f"| of these: size within U | {wilson(count['frequency covered'], of)} | {of} |")
    lines.append(f"| of these: date within what is told | {wilson(count['frequency dated'], of)} | {of} |")
    return "\n".join(lines)


def sound_table(sensors: int, years: float, end: float) -> str:
    """False alarms of sound sites."""
    count: Counter[str] = Counter()
    sites = round(years * 365.25 / (SITE_DAYS - FIRST_LOOK) + 0.499)
    for seed in range(sites):
        if time.monotonic() > end:
            break
        sound(2000 + seed, sensors, count)
        print(f"sound site {seed + 1} of {sites}", dict(count), flush=True)
    passed = count["days"] / 365.25
    lines = ["| false alarms of sound sites | for each site and year | years |", "| --- | --- | --- |"]
    for kind, name in (("sensitivity", "sensitivity, turn or gateway"), ("structure", "structure, by shapes"),
                       ("frequency", "structure, by a frequency"), ("noise", "noise")):  # fmt: skip
        lines.append(f"| {name} | {poisson(count[f'false {kind}'], passed)} | {passed:.1f} |")
    return "\n".join(lines)


def poisson(events: int, years: float) -> str:
    """A rate with its interval of 99 % (chi-squared)."""
    from scipy.stats import chi2

    low = chi2.ppf(0.005, 2 * events) / 2 / years if events else 0.0
    return f"{events / years:.2f} ({low:.2f} to {chi2.ppf(0.995, 2 * events + 2) / 2 / years:.2f}, 99 %)"


def worlds(cases: int) -> str:
    """Detection at 8 sensors in each world."""
    lines = [
        "| scatter of an hour, its correlation, shapes | 1 %, 5 days: found | 0.5 %, 30 days: found "
        "| alarms that name it | cases |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, world in WORLDS.items():
        count: Counter[str] = Counter()
        for seed in range(cases // 8):
            detection(*learned(3000 + seed, 8, world), 8, count)
        cells = [wilson(count[f"one {size} found"], count[f"one {size} cases"]) for size in ("0.01", "0.005")]
        right = wilson(count["one right"], count["one alarms"])
        lines.append(f"| {name} | {' | '.join(cells)} | {right} | {count['one 0.01 cases']} |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


def cost() -> str:
    """Processor time from day sums, and the size of the state."""
    lines = [
        "| sensors | year of day sums, s | result, s | state a sensor, kB | hours to a day, ms |",
        "| --- | --- | --- | --- | --- |",
    ]
    for sensors in GATEWAYS:
        bridge = Bridge(1, sensors, GATEWAYS[sensors])
        hours = list(bridge.days(10))
        merge, few = used(lambda hours=hours: [day_of(one, BANDS_HZ) for one in hours])  # type: ignore[misc]
        watch = SiteWatch(bridge.gateway, BANDS_HZ)
        whole, _ = used(lambda few=few, watch=watch: [watch.update(_later(few[k % 10], k)) for k in range(365)])  # type: ignore[misc]
        read, _ = used(lambda watch=watch: result(watch))  # type: ignore[misc]
        size = sum(part.nbytes for part in arrays(watch.snapshot())) / 1e3 / sensors
        lines.append(f"| {sensors} | {whole:.2f} | {read:.2f} | {size:.0f} | {100.0 * merge:.1f} |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


# What becomes true in a year of a site of 8 sensors, from the day YEAR_BEGINS on: day, sensors, factor, axes.
YEAR_BEGINS, YEAR_DAYS, VISIT_AFTER, U_VISIT = 240, 365, 3, 0.002
EVENTS = (
    (20, (2,), 0.99, (0, 1, 2)),
    (80, (5,), 1.007, (2,)),
    (140, (3, 4, 5), 0.99, (0, 1, 2)),
    (200, (0,), 0.99, (1,)),
)
HURT = 270  # day of a damage at sensors 5 to 7


def year(seed: int = 7) -> str:
    """A year of a site: what a person is asked to do and does, against what is true.

    A person visits the sensor that is told most clearly, VISIT_AFTER days after something new is told, of a gateway all
    its sensors, and looks at the structure where that is told. A visit finds the truth with U_VISIT, and the sensor is
    calibrated anew.
    """
    bridge = Bridge(seed, 8, GATEWAYS[8])
    watch, random = SiteWatch(bridge.gateway, BANDS_HZ), np.random.default_rng(seed)
    true, told_since, structure_seen = np.ones((8, 3)), -1, False
    lines = ["| day | what is true | what the site says | what a person does and finds |", "| --- | --- | --- | --- |"]
    for day in range(-YEAR_BEGINS, YEAR_DAYS):
        for at, sensors, factor, axes in EVENTS:
            if day == at:
                true[np.ix_(sensors, axes)] *= factor
                lines.append(f"| {day} | {_named(sensors, axes)} by {100 * (factor - 1):+.1f} % | | |")
        if day == HURT:
            bridge.damage = Damage(bridge.hour // 24, shape=0.05, modes=(0, 1, 3, 5, 7), sensors=(5, 6, 7))
            lines.append(f"| {day} | the structure at sensors 5, 6, 7: shapes by 5 % | | |")
        visits = Visits.unknown(np.zeros(8, dtype=bool))
        found = result(watch) if day >= 0 else None
        asked = [] if found is None else [*found.gateways] + [i for i in named(found) if i >= 0]
        told_since = -1 if not asked else day if told_since < 0 else told_since
        if found is not None and asked and day - told_since >= VISIT_AFTER:
            who = _visited(found, bridge)
            visits.there[who], visits.u[who] = True, U_VISIT
            visits.found[who] = true[who] - 1.0 + U_VISIT * random.standard_normal((len(who), 3))
            teach(watch, visits)
            lines.append(f"| {day} | | {_said(found)} | visits {', '.join(map(str, who))}: {_outcome(watch, who)} |")
            true[who], told_since = 1.0, -1
        if found is not None and found.site.kind == "structure" and not structure_seen:
            lines.append(f"| {day} | | {found.site.what} | looks at the structure |")
            structure_seen = True
        (hours,) = bridge.days(1)
        for i in range(8):
            for axis in range(3):
                hours = hours if true[i, axis] == 1.0 else changed(hours, np.array([i]), true[i, axis], (axis,))
        watch.update(day_of(hours, BANDS_HZ), visits)
    return "\n".join(lines)


def _named(sensors: tuple[int, ...], axes: tuple[int, ...]) -> str:
    which = f"sensor {sensors[0]}" if len(sensors) == 1 else f"gateway of sensors {', '.join(map(str, sensors))}"
    return f"{which}: {' '.join('xyz'[axis] for axis in axes)}"


def _visited(found: SiteVerdicts, bridge: Bridge) -> list[int]:
    """Whom a person visits: all sensors of a gateway that is told, or the sensors that are."""
    if found.gateways:
        return [int(i) for i in np.flatnonzero(np.isin(bridge.gateway, list(found.gateways)))]
    strength = [one.statistic if one.kind in ALARMS else 0.0 for one in found.sensors]
    return [int(np.argmax(strength))]


def _said(found: SiteVerdicts) -> str:
    told = [f"gateway {g}: {100 * one.size:+.1f} ± {100 * one.U:.1f} %" for g, one in found.gateways.items()]
    for i, one in enumerate(found.sensors):
        if one.kind in ALARMS:
            size = f" {100 * one.size:+.1f} ± {100 * one.U:.1f} %" if np.isfinite(one.U) else ""
            told.append(f"sensor {i}: {one.what}{size}")
    return "; ".join(told)


def _outcome(watch: SiteWatch, who: list[int]) -> str:
    """What the visits found, and whether a suspicion was right."""
    rows = [dict(zip(VISIT, row, strict=True)) for row in watch.visits.tolist()[-len(who) :]]
    rows = [row for row in rows if int(row["sensor"]) in who and row["day"] == watch.day + 1]
    told = []
    for row in rows:
        right = abs(row["size"] - row["found"]) <= 2.0 * np.hypot(row["u"], row["u_found"])
        verdict = ("confirmed, " if right else "refuted, ") if row["suspected"] else ""
        told.append(f"{verdict}{100 * row['found']:+.1f} %")
    return "; ".join(told) or "nothing was said of their sensitivity"


def kept() -> str:
    """What the monitor keeps of a sensor and a year, and how long a year of a site takes it."""
    lines = [
        "| sensors | hour, bytes | day, bytes a sensor | a sensor and year, MB | a year of the site from days, s "
        "| a batch of 100 hours, ms |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for sensors in GATEWAYS:
        with TemporaryDirectory() as directory, closing(Sqlite(Path(directory) / "monitor.sqlite")) as engine:
            row = _kept(sensors, engine)
        lines.append(f"| {sensors} | {row} |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


def _kept(sensors: int, engine: Sqlite) -> str:
    """The row of a site in `kept`: two days of hours are kept, then days are copied until there are 365."""
    bridge, first, database = Bridge(1, sensors, GATEWAYS[sensors]), 20_000, Database(engine)
    bridge.hour = 24 * first
    results = [one for hours in bridge.days(3) for one in _received(hours, bridge)]
    batches = [results[k : k + 100] for k in range(0, len(results), 100)]
    taken, _ = used(lambda: [database.add(batch) for batch in batches])  # type: ignore[func-returns-value]
    while close_day(database.query) is not None:
        pass
    ((hour,),) = database.query("SELECT avg(length(payload)) FROM watch_hour")
    ((day,),) = database.query("SELECT avg(length(payload)) FROM watch_day WHERE stale = 0")
    pages = database.query("SELECT sum(pgsize) FROM dbstat WHERE name LIKE '%watch_hour%'")
    an_hour = pages[0][0] / len(results)  # with what the table takes beside the hours
    rows = database.query("SELECT day, payload FROM watch_day WHERE stale = 0 ORDER BY day")
    decoder = msgspec.msgpack.Decoder(DaySum)
    for k in range(365):
        one = decoder.decode(rows[k % len(rows)][1])
        one.number = first + 10 + k
        database.query(
            "INSERT INTO watch_day VALUES ('bridge', :day, :last, 0, 0, :payload)",
            day=one.number, last=24 * one.number + 23, payload=msgspec.msgpack.encode(one),
        )  # fmt: skip
    year, _ = used(lambda: watch_site(source_of(database.query, "bridge", closed=True)))
    a_year = (365 * day / sensors + KEPT_DAYS * 24 * an_hour) / 1e6
    return f"{hour:.0f} | {day / sensors:.0f} | {a_year:.1f} | {year:.1f} | {1e3 * taken / len(batches):.0f}"


def _received(hours: Hours, bridge: Bridge) -> Iterable[Received]:
    """The results of a day as the bus brings them."""
    assert hours.frequency is not None
    hz = BANDS_HZ[:, None] * np.exp(hours.frequency)
    for h, hour in enumerate(hours.hour.tolist()):
        for i in range(bridge.sensors):
            fields = {
                "sensor": f"s{i}", "sequence": int(hour) * bridge.sensors + i, "hour_utc_ns": int(hour) * 3600 * 10**9,
                "t_utc_ns": int(hour + 1) * 3600 * 10**9, "duration_s": 3600.0, "samples": 360_000,
                "temperature_degc": float(hours.temperature_degc[h, i]), "band_hz": BANDS_HZ.tolist(),
                "noise_psd": hours.noise_psd[h, i].tolist(), "mean_mps2": [0.1, 0.2, 9.8], "u_main_pct": [0.2] * 3,
                "band_power": hours.power[h, i].T.ravel().tolist(), "calibration_run_id": "0" * 32,
                "cross_power": hours.cross[h, i].T.ravel().tolist(), "calibration_sequence": 1,
                "peak_frequency_hz": [f if f > 0.0 else None for f in hz[h, i].T.ravel().tolist()],
            }  # fmt: skip
            address = Address("bridge", f"g{bridge.gateway[i]}", f"s{i}", "watch")
            yield Received("", address, fields["sequence"], fields, None)


def _later(day, number: int):  # type: ignore[no-untyped-def]
    day = copy.copy(day)
    object.__setattr__(day, "number", number)
    return day


def used(what: Callable[[], object]) -> tuple[float, object]:
    """Processor time of a call, in s, and what it gives."""
    begin = time.process_time()
    given = what()
    return time.process_time() - begin, given


def arrays(told: object) -> list[Array]:
    """All arrays of a snapshot."""
    if isinstance(told, dict):
        return [part for value in told.values() for part in arrays(value)]
    return [np.asarray(told)]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensors", type=int, choices=list(GATEWAYS))
    parser.add_argument("--cases", type=int, default=160)
    parser.add_argument("--years", type=float, default=0.0)
    parser.add_argument("--minutes", type=float, default=1e6)
    parser.add_argument("--traffic", action="store_true")
    parser.add_argument("--first-site", type=int, default=0)
    parser.add_argument("--worlds", action="store_true")
    parser.add_argument("--cost", action="store_true")
    parser.add_argument("--kept", action="store_true")
    parser.add_argument("--year", action="store_true")
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    if given.cost:
        name, text = "site-watch cost", f"`python -m benchmarks.site_watch --cost`, {machine()}.\n\n{cost()}"
    elif given.kept:
        name, text = "site-watch kept", f"`python -m benchmarks.site_watch --kept`, {machine()}.\n\n{kept()}"
    elif given.year:
        name, text = "site-watch year", f"`python -m benchmarks.site_watch --year`; {GATEWAYS[8]} gateways.\n\n{year()}"
    elif given.traffic:
        text = traffic(given.cases, time.monotonic() + 60.0 * given.minutes, given.first_site)
        name = "site-watch traffic"
        asked = f"--cases {given.cases}" + (f" --first-site {given.first_site}" if given.first_site else "")
        text = f"`python -m benchmarks.site_watch --traffic {asked}`; {GATEWAYS[8]} gateways.\n\n{text}"
    elif given.worlds:
        text = f"`python -m benchmarks.site_watch --worlds --cases {given.cases}`.\n\n{worlds(given.cases)}"
        name = "site-watch worlds"
    else:
        n, end = given.sensors or 8, time.monotonic() + 60.0 * given.minutes
        if given.years:
            name, asked, text = f"site-watch {n} sound", f"--years {given.years:g}", sound_table(n, given.years, end)
        else:
            name, asked, text = f"site-watch {n}", f"--cases {given.cases}", table(n, given.cases, end)
        text = f"`python -m benchmarks.site_watch --sensors {n} {asked}`; {GATEWAYS[n]} gateways.\n\n{text}"
    if given.write:
        write_part(name, text)
    else:
        print(text)
