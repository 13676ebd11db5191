"""What the best test could find at a site of `benchmarks.site_watch`, and what the watch gives away.

    python -m benchmarks.site_watch_bound [--sites 13] [--write]

For each sensor and direction: the probability that a step is found at its date, Phi(size/u - limit), with u from less
and less knowledge. The first rows know the stated scatter of the simulation, AR(1) over 6 h, and nothing else scatters:
they are a bound. The others have u as the watch has it, without and with its cautions. Half of the cases change one
axis, half all three.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import copy
from collections.abc import Iterator

import numpy as np

from benchmarks.beam_world import BANDS_HZ, World
from benchmarks.page import write_part
from benchmarks.site_watch import GATEWAYS, learned
from calib.distributions import NORMAL
from calib.model import Array
from calib.site_watch import verdicts
from calib.site_watch.day import day_of
from calib.site_watch.together import ALL, jointly
from calib.site_watch.watch import SiteWatch

SENSORS = 8
MARKS = {5: 0.01, 30: 0.005}  # days, size
EFFECTIVE = 12.0  # hours that count as one: (1 + r)/(1 - r) of AR(1) over 6 h
KNOWN = ("stated scatter, norm known", "stated scatter, norm to be learned", "own scatter of each band",
         "and days that depend on each other", "and the walk: the watch")  # fmt: skip


def uncertainties(watch: SiteWatch, days: int) -> Iterator[Array]:
    """u (n, 7) of each direction for a step so many days ago, by KNOWN."""
    steps, world = watch.steps, World()
    k = int(np.argmin([abs(watch.day - begin + 1 - days) for begin in steps.begins]))
    size, information, since = (part.reshape(watch.shape) for part in steps.step([k]))
    weight = (steps.A[0, 0] - steps.before[k][0]).reshape(watch.shape) / np.maximum(since, 1.0)
    of_day = world.scatter**2 * len(BANDS_HZ) * EFFECTIVE / 24.0
    known = np.where(information > 0.0, since, 0.0) / of_day
    learned_days = np.where(weight > 0.0, information / np.where(weight > 0.0, weight, 1.0), 0.0)
    begin = steps.begins[k]
    variance = verdicts._without(watch.variance(), size, information, steps.days.reshape(watch.shape))
    own = information / (variance * watch.band_scatter.without_steps([begin])[0])
    dependent = watch.days_scatter.over(watch.day, [begin])
    before = min(begin - steps.begins[0], verdicts.LONGEST_DAYS)
    walk = verdicts.WALK_PER_ROOT_DAY * np.sqrt(np.array([(watch.day - begin + 1 + before) / 3.0]))
    one, none, norm = np.ones_like(dependent), np.zeros(1), watch.norm_since([k], size[None])
    for info, inflation, walked in (
        (known, one, none), (learned_days / of_day, one, none), (own, one, none), (own, dependent, none),
        (own, dependent, walk),
    ):  # fmt: skip
        yield jointly(np.zeros((1, *watch.shape)), info[None], *norm, inflation, walked).u[0]


def table(sites: int) -> str:
    """Mean probability that a step is found."""
    limit = verdicts.limit_of(SENSORS, GATEWAYS[SENSORS])
    found: dict[tuple[int, int], list[float]] = {(days, k): [] for days in MARKS for k in range(len(KNOWN))}
    for seed in range(sites):
        bridge, watch = learned(1000 + seed, SENSORS, World())
        watch = SiteWatch.loaded(copy.deepcopy(watch.snapshot()))
        for day, hours in enumerate(bridge.days(max(MARKS)), start=1):
            watch.update(day_of(hours, BANDS_HZ))
            if day not in MARKS:
                continue
            for k, u in enumerate(uncertainties(watch, day)):
                one = [NORMAL.cdf(MARKS[day] / x - limit) for x in u[:, :ALL].ravel().tolist()]
                three = [NORMAL.cdf(MARKS[day] / x - limit) for x in u[:, ALL].tolist()]
                found[day, k].append(0.5 * float(np.mean(one)) + 0.5 * float(np.mean(three)))
        print(f"site {seed + 1} of {sites}", flush=True)
    lines = ["| u from | 1 %, 5 days: found | 0.5 %, 30 days: found |", "| --- | --- | --- |"]
    for k, name in enumerate(KNOWN):
        cells = [f"{100.0 * float(np.mean(found[days, k])):.1f} %" for days in MARKS]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sites", type=int, default=13)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    text = f"`python -m benchmarks.site_watch_bound --sites {given.sites}`.\n\n{table(given.sites)}"
    if given.write:
        write_part("site-watch bound", text)
    else:
        print(text)
