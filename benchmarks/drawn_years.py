"""The smoothed past of drawn years: coverage, and the change of S and Q across a gap of 60 days against the filter's.

    python -m benchmarks.drawn_years [--years 100] [--write]

A window every three days beside a mount that never turns, with a gap of 60 days and a stated step; everything is drawn
from what is stated. Each year counts as one draw: the mean of z^2 is over its epochs, and the band of 99.9 % is that of
the scatter between years.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse

import numpy as np

from benchmarks.model_records import drawn, smoothed, templates
from benchmarks.page import machine, write_part
from benchmarks.ten_years import MEAN, U, degc
from calib.estimate.estimate import estimate
from calib.estimate.nuisances import Priors
from calib.estimate.statements import Statements, Step
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Array
from tests.clamp_windows import G_MPS2

GAP = 150.0, 210.0
STEP_DAY = 250.0
DAYS = np.array([*np.arange(0.0, GAP[0] + 1.0, 3.0), *np.arange(GAP[1], 366.0, 3.0)])
MAIN, OFFSET = [0, 4, 8], [9, 10, 11]


def stated() -> Statements:
    """A reference that is known well, so that walks are what is seen."""
    priors = Priors(reference=2e-4, reference_drift=2e-4, offset_mps2=0.02)
    walks = Wander(sensitivity=1e-4)
    held = np.array([0.0, 0.0, G_MPS2])
    model = TemperatureModel(offset_order=1, reference_degc=0.0)
    return Statements(MEAN, U, {"": priors}, walks, model, steps=[Step(STEP_DAY, {"Syy": 0.01})], held_mps2=held)


def year(seed: int) -> tuple[Array, Array, Array, Array]:
    """z^2 of the smoothed past (12,) as a mean over epochs, the share within 1.96 u (12,), and the errors of the change
    across the gap (12,) by the past and by the filter."""
    random, statements = np.random.default_rng(seed), stated()
    records, truth = drawn(random, templates(40), DAYS, statements, temperature=degc)
    days, values, u = smoothed(estimate(records, statements))
    z = (values - truth) / u
    before, after = int(np.searchsorted(days, GAP[0])), int(np.searchsorted(days, GAP[1]))
    moved = truth[after] - truth[before]
    early = estimate(records[: before + 1], statements).now.mean[:12]
    late = estimate(records[: after + 1], statements).now.mean[:12]
    change = values[after] - values[before]
    return (z**2).mean(axis=0), (np.abs(z) < 1.96).mean(axis=0), change - moved, late - early - moved


def table(years: int) -> str:
    """Main and transverse sensitivities, and offsets."""
    squares, within, past, filtered = (
        np.array(part) for part in zip(*(year(seed) for seed in range(years)), strict=True)
    )
    ratio = np.sqrt((past**2).mean(axis=0) / (filtered**2).mean(axis=0))
    rows = [
        "| | mean of z^2 | band of 99.9 % | within 1.96 u | rms error of the change across the gap, past / filter |",
        "| --- | --- | --- | --- | --- |",
    ]
    transverse = [k for k in range(9) if k not in MAIN]
    for name, own in (("main sensitivities", MAIN), ("transverse", transverse), ("offsets", OFFSET)):
        each = squares[:, own].mean(axis=1)
        half = 3.29 * each.std(ddof=1) / np.sqrt(years)
        rows.append(
            f"| {name} | {each.mean():.2f} | {1 - half:.2f} to {1 + half:.2f} | {100 * within[:, own].mean():.1f} % "
            f"| {ratio[own].min():.2f} to {ratio[own].max():.2f} |"
        )
    return "\n".join(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--years", type=int, default=100)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    text = f"`python -m benchmarks.drawn_years`, {machine()}; {given.years} years.\n\n{table(given.years)}"
    if given.write:
        write_part("drawn years", text)
    else:
        print(text)
