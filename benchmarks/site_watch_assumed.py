"""What the site watch assumes of its scatter, measured at simulated sites, and what happens where it is wrong by two.

    python -m benchmarks.site_watch_assumed [--sites 6] [--write]

Of U_BAND: how many changes of 0.5 % would be found after 30 days without it, with half and twice of it, and the mean
square of the steps of sound sensors over their u, as a check of this u. Of PRIOR_TESTS: the mean factor on u, where all
tests of a site have once, twice and four times the variance that is expected. Of PART_SHARED: how often a gateway that
has changed for 14 days is told as this gateway; and how far the scores of sensors correlate, of one gateway and of two,
in blocks of days, over two years of the sound sites of benchmarks.site_watch (sensors without anything in common have
-1/(n - 1), since the level is theirs).
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import copy
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from benchmarks.beam_world import BANDS_HZ, Bridge
from benchmarks.page import write_part
from benchmarks.site_watch import GATEWAYS, LEARNED_DAYS, SITE_DAYS
from calib.distributions import NORMAL
from calib.model import Array
from calib.site_watch import together, verdicts, watch
from calib.site_watch.day import Day, day_of
from calib.site_watch.together import ALL, DIRECTIONS
from calib.site_watch.watch import SiteWatch

SENSORS, LATE_DAYS, FIRST_DAY, DRAWS = 8, 14, 30, 300
PRIORS, SHARED, SIZES = (30.0, 60.0, 120.0), (0.125, 0.25, 0.5), (-0.01, 0.005)
BLOCKS = 1, 7, 28
ALIKE_SITES = {8: 6, 30: 5, 200: 2}  # of so many sensors
BANDED, MONTH_DAYS, SMALL = (0.0, 0.00375, 0.0075, 0.015), 30, 0.005

Site = tuple[Bridge, list[Day]]


class Heard(SiteWatch):
    """A watch that keeps the score of each sensor and day, of all three axes together."""

    def __init__(self, gateway: Array, band_hz: Array) -> None:
        super().__init__(gateway, band_hz)
        self.scores: list[Array] = []
        take = self.days_scatter.update
        self.days_scatter.update = lambda z, there: (self.scores.append(z[:, ALL].copy()), take(z, there))  # type: ignore[func-returns-value,method-assign,assignment,return-value]


def factors() -> list[str]:
    """Mean factor on u by the scatter of all sensors, for each size of site, true variance and prior."""
    random, used = np.random.default_rng(1), together.PRIOR_TESTS
    lines = [
        "| sensors | variance over the expected one | " + " | ".join(f"factor, {p:g} tests" for p in PRIORS) + " |"
    ]
    lines.append("| --- | --- | " + " | ".join("---" for _ in PRIORS) + " |")
    for sensors in GATEWAYS:
        for variance in (1.0, 2.0, 4.0):
            z, cells = np.zeros((DRAWS, sensors, len(DIRECTIONS))), []
            z[..., :3] = random.normal(0.0, np.sqrt(variance), (DRAWS, sensors, 3))
            z[..., 4:] = random.normal(0.0, 1.0, (DRAWS, sensors, 3))
            for together.PRIOR_TESTS in PRIORS:
                cells.append(f"{together._scatter_of_all(z)[:, 0, 0].mean():.2f}")
            lines.append(f"| {sensors} | {variance:g} | {' | '.join(cells)} |")
    together.PRIOR_TESTS = used
    return lines


def learning(seed: int) -> Site:
    """A site, and the days in which it learns."""
    bridge = Bridge(seed, SENSORS, GATEWAYS[SENSORS])
    bridge.hour = 24 * (61 * seed % 365)
    return bridge, [day_of(hours, BANDS_HZ) for hours in bridge.days(LEARNED_DAYS)]


def weighed(sites: list[Site]) -> list[str]:
    """What is found of small changes, for each scatter of a band in a day."""
    limit, used = verdicts.limit_of(SENSORS, GATEWAYS[SENSORS]), watch.U_BAND
    lines = [
        "| scatter of a band in a day | 0.5 %, 30 days: found | mean square of sound steps over u |",
        "| --- | --- | --- |",
    ]
    for watch.U_BAND in BANDED:
        found, squares = [], []
        for site in sites:
            size, u = _stepped(*site)
            chance = np.array([[NORMAL.cdf(SMALL / one - limit) for one in own] for own in u.tolist()])
            found.append(0.5 * float(chance[:, :ALL].mean() + chance[:, ALL].mean()))
            squares.append(float(np.mean(np.square(size / u))))
        spread = 2.0 * np.std(squares) / np.sqrt(len(sites))
        cells = f"{100.0 * np.mean(found):.1f} % | {np.mean(squares):.2f} ± {spread:.2f}"
        lines.append(f"| {100.0 * watch.U_BAND:.3g} % | {cells} |")
    watch.U_BAND = used
    return lines


def _stepped(bridge: Bridge, days: list[Day]) -> tuple[Array, Array]:
    """Size and u (n, 4) of the steps of sensitivities MONTH_DAYS before the last of the days."""
    site = SiteWatch(bridge.gateway, BANDS_HZ)
    for day in days:
        site.update(day)
    tests = verdicts.examined(site)
    assert tests is not None
    k = int(np.argmin([abs(site.day - begin + 1 - MONTH_DAYS) for begin in tests.begins]))
    return tests.joint.size[k, :, together.SENSITIVITIES], tests.joint.u[k, :, together.SENSITIVITIES]


def shared(sites: list[Site]) -> list[str]:
    """Gateways that are told, for each part that is taken as common."""
    told: Counter[tuple[float, float]] = Counter()
    for bridge, days in sites:
        site = SiteWatch(bridge.gateway, BANDS_HZ)
        for day in days[:-LATE_DAYS]:
            site.update(day)
        for gateway in range(bridge.gateways):
            for size in SIZES:
                changed = SiteWatch.loaded(copy.deepcopy(site.snapshot()))
                for day in days[-LATE_DAYS:]:
                    value = day.value.copy()
                    value[bridge.gateway == gateway, :, :3] += np.log1p(size)
                    changed.update(replace(day, value=value))
                _told(changed, gateway, size, told)
    cases = len(sites) * GATEWAYS[SENSORS]
    lines = ["| part that is common | " + " | ".join(f"{100 * s:+g} %: told as this gateway" for s in SIZES) + " |"]
    lines.append("| --- | " + " | ".join("---" for _ in SIZES) + " |")
    lines += [f"| {part:g} | {' | '.join(f'{told[part, size]} of {cases}' for size in SIZES)} |" for part in SHARED]
    return lines


def sound_days(seed: int, sensors: int) -> tuple[Array, Iterable[Day]]:
    """The gateways and the days of a sound site."""
    bridge = Bridge(seed, sensors, GATEWAYS[sensors])
    bridge.hour = 24 * (61 * seed % 365)
    return bridge.gateway, (day_of(hours, BANDS_HZ) for hours in bridge.days(SITE_DAYS))


def alike() -> list[str]:
    """How much more the scores of sensors of one gateway correlate than those of two."""
    lines = [
        "| sensors | sites | blocks of | correlation within a gateway | between gateways | difference |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for sensors, sites in ALIKE_SITES.items():
        correlation: dict[int, list[tuple[float, float]]] = {days: [] for days in BLOCKS}
        for seed in range(2000, 2000 + sites):
            gateway, days = sound_days(seed, sensors)
            site = Heard(gateway, BANDS_HZ)
            for day in days:
                site.update(day)
            _correlated(np.array(site.scores)[FIRST_DAY:], gateway, correlation)
        for number, pairs in correlation.items():
            more = np.subtract(*np.transpose(pairs))
            cells = " | ".join(f"{mean:.2f}" for mean in np.mean(pairs, axis=0))
            u = np.std(more, ddof=1) / np.sqrt(sites)
            lines.append(f"| {sensors} | {sites} | {number} d | {cells} | {more.mean():.2f} ± {2.0 * u:.2f} |")
    return lines


def _correlated(scores: Array, gateway: Array, correlation: dict[int, list[tuple[float, float]]]) -> None:
    same = (gateway[:, None] == gateway) & ~np.eye(len(gateway), dtype=bool)
    for days, pairs in correlation.items():
        whole = len(scores) // days * days
        c = np.corrcoef(scores[:whole].reshape(-1, days, len(gateway)).sum(axis=1).T)
        pairs.append((float(c[same].mean()), float(c[gateway[:, None] != gateway].mean())))


def _told(site: SiteWatch, gateway: int, size: float, told: Counter[tuple[float, float]]) -> None:
    used = verdicts.PART_SHARED
    for verdicts.PART_SHARED in SHARED:
        told[verdicts.PART_SHARED, size] += list(verdicts.result(site).gateways) == [gateway]
    verdicts.PART_SHARED = used


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sites", type=int, default=6)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    sites = [learning(1000 + k) for k in range(given.sites)]
    lines = [
        f"`python -m benchmarks.site_watch_assumed --sites {given.sites}`.",
        "",
        *weighed(sites),
        "",
        *factors(),
        "",
        *shared(sites),
        "",
        *alike(),
    ]
    if given.write:
        write_part("site-watch assumed", "\n".join(lines))
    else:
        print("\n".join(lines))
