"""Dates of changes in the past of `fieldcal show --past`: how often the stated interval contains the true time.

    python -m benchmarks.dates [--draws 34] [--write]

Records of four windows a day for forty days are drawn by equations of their own (tests/drawn_records.py): S walks, the
windows have noise (0.26 % of S each), and at a drawn time one main sensitivity changes at once, or begins to drift. The
change is stated where an agent would have found it: some windows later, and a drift when it has made 1 %. Then the
records older than two weeks are merged to days, also over the true time.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from dataclasses import dataclass

import numpy as np

from benchmarks.page import machine, write_part
from calib.estimate.nuisances import Priors
from calib.estimate.statements import Step
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import PARAMETERS, Array, Pose
from calib.state.dating import Date
from calib.state.state import State
from calib.windows.record import Record
from tests.drawn_records import UP, Truth, template, told

DAYS = np.arange(0.0, 40.0, 0.25)
MEAN = np.append(np.eye(3).ravel(), np.zeros(3))
U = np.append(np.where(np.eye(3).ravel() > 0, 0.02, 0.01), np.full(3, 0.5))
WALK = 1e-4  # of S in a root day
NOISE = 0.1  # SD of a point in output units
WINDOW = template(Pose("beside", np.eye(3), UP), noise=NOISE)
# As agent/core/hypotheses.py states a jump: of all parameters, up to 10 % of S and 2 m/s2.
JUMP = dict(zip(PARAMETERS, [0.1] * 9 + [2.0] * 3, strict=True))
FOUND = 0.01  # relative: the drift test finds a drift when it has made so much


@dataclass(frozen=True)
class Case:
    """A change of S_yy: `size` at once, or `rate` a day; `late` windows later it is found, on an average."""

    name: str
    size: float = 0.0
    rate: float = 0.0
    late: float = 0.0


CASES = (
    Case("step of 0.3 %", size=0.003, late=20.0),
    Case("step of 0.5 %", size=0.005, late=10.0),
    Case("step of 1 %", size=0.01, late=3.0),
    Case("step of 3 %", size=0.03),
    Case("drift of 0.1 % a day", rate=1e-3),
    Case("drift of 0.3 % a day", rate=3e-3),
)


def dated(case: Case, seed: int) -> tuple[float, Date]:
    """The true day of a change, and what the past says of it."""
    random = np.random.default_rng([seed, CASES.index(case)])
    lasts = FOUND / case.rate if case.rate else 0.0
    day = float(random.uniform(DAYS[0], DAYS[-1] - lasts))
    found = min(int(np.searchsorted(DAYS, day + lasts)) + random.poisson(case.late), len(DAYS) - 1)
    state = State(MEAN, U, Priors(reference=1e-3, offset_mps2=0.01), Wander(sensitivity=WALK), TemperatureModel(),
                  fixed=True)  # fmt: skip
    state.meet("A")
    records = [window(random, S, float(t)) for S, t in zip(_course(random, case, day), DAYS, strict=True)]
    u = {"Syy": FOUND, "Syy_rate": case.rate} if case.rate else JUMP
    state.take_also(records, [Step(float(np.nextafter(DAYS[found], -np.inf)), u)])
    state.merge_old(float(DAYS[-1]))
    (change,) = state.past().changes
    return day, change.dated()


def _course(random: np.random.Generator, case: Case, day: float) -> Array:
    """(W, 3, 3) the true S of each window."""
    walk = WALK * np.cumsum(
        np.sqrt(np.diff(DAYS, prepend=0.0))[:, None, None] * random.normal(size=(len(DAYS), 3, 3)), 0
    )
    S = np.eye(3) * (1.0 + 0.01 * random.normal()) + walk
    S[:, 1, 1] += np.where(day <= DAYS, case.size + case.rate * (DAYS - day), 0.0)
    return np.asarray(S)


def window(random: np.random.Generator, S: Array, day: float) -> Record:
    """A window on a day with this S (3, 3)."""
    slopes = NOISE * random.normal(size=(6, 3))
    return told(WINDOW, Truth(S, np.zeros(3)), day, slope_noise=slopes, mean_noise=0.01 * random.normal(size=3))


def table(draws: int) -> str:
    """A row for each case: how many intervals contain the true time, z^2 and u."""
    rows = [
        "| change | draws | within the interval of 95 % | rms error / u | median u, days | largest u, days |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for case in CASES:
        made = [dated(case, seed) for seed in range(draws)]
        within = sum(date.interval[0] <= day <= date.interval[1] for day, date in made)
        z = np.array([(date.day - day) / date.standard_uncertainty for day, date in made])
        u = np.array([date.standard_uncertainty for _, date in made])
        found = f"{np.sqrt((z**2).mean()):.2f} | {np.median(u):.2g} | {u.max():.2g}"
        rows.append(f"| {case.name} | {draws} | {within} | {found} |")
        print(rows[-1], flush=True)
    return "\n".join(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=34)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    text = f"`python -m benchmarks.dates`, {machine()}.\n\n{table(given.draws)}"
    if given.write:
        write_part("dates", text)
    else:
        print(text)
