"""The site watched together: are changes found and named, are sound sites left alone, is damage told as damage?

    python -m benchmarks.site_watch --sensors 8 [--cases 160] [--write]
    python -m benchmarks.site_watch --sensors 8 --years 60 [--write]
    python -m benchmarks.site_watch --worlds [--write]
    python -m benchmarks.site_watch --cost [--write]

The bridge is simulated by benchmarks/beam_world.py, whose model is not the estimator's. A site learns for
LEARNED_DAYS, each from another season on. Then each case changes one sensor (each in turn; every second case one
axis alone), two at once, a gateway, or the structure. A case is looked at on the day that its mark names, damage on
several days. Sound sites run for two years each and are looked at once a week; an alarm that was there four weeks
before is the same one. `--minutes` ends it early: the table then has fewer cases, and says how many.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import copy
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import TypeVar

import numpy as np

from benchmarks.beam_world import BANDS_HZ, FREQUENCY_HZ, Bridge, Damage, World, changed, turned
from benchmarks.page import machine, write_part
from calib.model import Array
from calib.site_watch.day import Hours, day_of
from calib.site_watch.verdicts import SiteVerdicts, result
from calib.site_watch.watch import SiteWatch

T = TypeVar("T")
GATEWAYS = {8: 3, 30: 5, 200: 10}
LEARNED_DAYS = 240
CASES_OF_A_SITE = {8: 8, 30: 20, 200: 40}
PAIRS_PART = 3 / 8  # cases of two sensors for each case of one: 60 for 160
DAMAGE_DAYS = 4, 7, 10, 14
SITE_DAYS = 730
FIRST_LOOK = 45  # days after the begin of a site
WORLDS = {
    "0.32 %, 6 h, 0.02 %/K": World(),
    "0.32 %, 24 h, 0.05 %/K": World(scatter_h=24.0, shape_per_k=5e-4),
    "0.88 %, 6 h, 0.02 %/K": World(scatter=0.0088),
}
ALARMS = "sensitivity", "turn", "sensor or structure"


def learned(seed: int, sensors: int, world: World) -> tuple[Bridge, SiteWatch]:
    """A site that has learned."""
    bridge = Bridge(seed, sensors, GATEWAYS[sensors], world)
    bridge.hour = 24 * (61 * seed % 365)
    watch = SiteWatch(bridge.gateway, BANDS_HZ)  # type: ignore[arg-type] # whole numbers
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
        later = (changed(hours, own, 0.99) for hours in future)  # type: ignore[arg-type] # whole numbers
        (found,) = told_after(watch, later, (14,))
        count["gateway cases"] += 1
        count["gateway told"] += list(found.gateways) == [g]
        count["gateway others"] += any(x >= 0 and bridge.gateway[x] != g for x in named(found))
        (found,) = told_after(watch, (turned(hours, i, axis, np.radians(1.0)) for hours in future), (14,))
        count["turn cases"] += 1
        count["turn told"] += found.sensors[i].kind == "turn"
        count["turn as sensitivity"] += found.sensors[i].kind == "sensitivity"
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
    return Hours(hours.hour, power, hours.cross, noise, hours.temperature_degc)


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
            count[f"{name} as sensitivity"] += any(
                bool(one.gateways) or any(told.kind == "sensitivity" for told in one.sensors) for one in found
            )


def sound(seed: int, sensors: int, count: Counter[str]) -> None:
    """A sound site for two years: alarms by kind."""
    bridge = Bridge(seed, sensors, GATEWAYS[sensors])
    bridge.hour = 24 * (61 * seed % 365)
    watch = SiteWatch(bridge.gateway, BANDS_HZ)  # type: ignore[arg-type] # whole numbers
    last = dict[tuple[tuple[str, int], str], int]()
    for number, hours in enumerate(bridge.days(SITE_DAYS)):
        watch.update(day_of(hours, BANDS_HZ))
        if number < FIRST_LOOK or number % 7:
            continue
        found = result(watch)
        told = {("sensor", i): one.kind for i, one in enumerate(found.sensors)}
        told |= {("gateway", g): one.kind for g, one in found.gateways.items()}
        for who, kind in told.items():
            if kind in ("none", "learning"):
                continue
            group = {"noise": "noise", "structure": "structure", "sensor or structure": "structure"}.get(
                kind, "sensitivity"
            )
            count[f"false {group}"] += number - last.get((who, group), -99) > 28
            last[who, group] = number
    count["days"] += SITE_DAYS - FIRST_LOOK


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
    ):
        of = count[f"{told.split()[0]} cases"]
        lines.append(f"| {name} | {wilson(count[told], of)} | {of} |")
        if wrong:
            lines.append(f"| the same: told as a sensitivity | {wilson(count[wrong], of)} | {of} |")
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
    for kind, name in (("sensitivity", "sensitivity, turn or gateway"), ("structure", "structure"), ("noise", "noise")):
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
        lines.append(_cost_row(sensors))
        print(lines[-1], flush=True)
    return "\n".join(lines)


def _cost_row(sensors: int) -> str:
    bridge = Bridge(1, sensors, GATEWAYS[sensors])
    hours = list(bridge.days(10))
    merge, few = used(lambda: [day_of(one, BANDS_HZ) for one in hours])
    watch = SiteWatch(bridge.gateway, BANDS_HZ)  # type: ignore[arg-type] # whole numbers

    def year() -> None:
        for k in range(365):
            watch.update(_later(few[k % 10], k))

    whole, _ = used(year)
    read, _ = used(lambda: result(watch))
    size = sum(part.nbytes for part in arrays(watch.snapshot())) / 1e3 / sensors
    return f"| {sensors} | {whole:.2f} | {read:.2f} | {size:.0f} | {100.0 * merge:.1f} |"


def _later(day, number: int):  # type: ignore[no-untyped-def]
    day = copy.copy(day)
    object.__setattr__(day, "number", number)
    return day


def used(what: Callable[[], T]) -> tuple[float, T]:
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
    parser.add_argument("--worlds", action="store_true")
    parser.add_argument("--cost", action="store_true")
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    if given.cost:
        name, text = "site-watch cost", f"`python -m benchmarks.site_watch --cost`, {machine()}.\n\n{cost()}"
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
