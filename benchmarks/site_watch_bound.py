"""What the best test could find at a site of `benchmarks.site_watch`, and what the watch gives away.

    python -m benchmarks.site_watch_bound [--sites 13] [--write]

For each sensor and direction: the probability that a step is found at its date, Phi(size/u - limit), with u from less
and less knowledge. The first rows know the stated scatter of the simulation, AR(1) over 6 h, and nothing else scatters:
they are a bound. The others have u as the watch has it, without and with its cautions. The last row has the dependence
of days that was true: the mean square of sound steps of all sites. Half of the cases change one axis, half all three.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections.abc import Iterator

import numpy as np

from benchmarks.beam_world import BANDS_HZ, Bridge, World
from benchmarks.page import write_part
from benchmarks.site_watch import GATEWAYS, LEARNED_DAYS
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
TRUE, OWN = "own scatter of each band, and the dependence of days that was true", 2
FIRST_LOOK, EVERY = 150, 10  # days on which sound steps are looked at


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


def sound_squares(watch: SiteWatch, days: int) -> Array:
    """Mean square (4,) of the steps of all sensors about so many days ago, over u from the own scatter of each band."""
    tests = verdicts.examined(watch)
    assert tests is not None
    k = int(np.argmin([abs(watch.day - begin + 1 - days) for begin in tests.begins]))
    u = list(uncertainties(watch, days))[OWN]
    return np.asarray(np.square(tests.joint.size[k, :, : ALL + 1] / u[:, : ALL + 1]).mean(axis=0))


def share(u: Array, size: float, limit: float) -> float:
    """Mean probability that a step of x, y or z (half of the cases) or of all three is found; `u` (n, 4)."""
    found = np.vectorize(NORMAL.cdf)(size / u[:, : ALL + 1] - limit)
    return float(0.5 * found[:, :ALL].mean() + 0.5 * found[:, ALL].mean())


def table(sites: int) -> str:
    """Mean probability that a step is found."""
    limit = verdicts.limit_of(SENSORS, GATEWAYS[SENSORS])
    found: dict[tuple[int, int], list[float]] = {(days, k): [] for days in MARKS for k in range(len(KNOWN))}
    own: dict[int, list[Array]] = {days: [] for days in MARKS}
    squares: dict[int, list[Array]] = {days: [] for days in MARKS}
    for seed in range(1000, 1000 + sites):
        bridge = Bridge(seed, SENSORS, GATEWAYS[SENSORS], World())
        bridge.hour = 24 * (61 * seed % 365)
        watch = SiteWatch(bridge.gateway, BANDS_HZ)
        for number, hours in enumerate(bridge.days(LEARNED_DAYS + max(MARKS)), start=1):
            watch.update(day_of(hours, BANDS_HZ))
            for days in MARKS if number >= FIRST_LOOK and number % EVERY == 0 else ():
                squares[days].append(sound_squares(watch, days))
            days = number - LEARNED_DAYS
            if days not in MARKS:
                continue
            known = list(uncertainties(watch, days))
            own[days].append(known[OWN])
            for k, u in enumerate(known):
                found[days, k].append(share(u, MARKS[days], limit))
        print(f"site {seed - 999} of {sites}", flush=True)
    lines = ["| u from | 1 %, 5 days: found | 0.5 %, 30 days: found |", "| --- | --- | --- |"]
    for k, name in enumerate(KNOWN):
        cells = [f"{100.0 * float(np.mean(found[days, k])):.1f} %" for days in MARKS]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    true = {days: np.sqrt(np.mean(squares[days], axis=0)) for days in MARKS}
    parts = [np.mean([share(u[:, : ALL + 1] * true[days], MARKS[days], limit) for u in own[days]]) for days in MARKS]
    return "\n".join([*lines, f"| {TRUE} | {' | '.join(f'{100.0 * float(part):.1f} %' for part in parts)} |"])


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
