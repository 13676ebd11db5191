"""Ten years of windows at the level of records: old records merged against all of them, at each year's end and before.

    python -m benchmarks.ten_years [--write]

The mount never turns; the reference is another one each year, with a certificate of that day; S, Q and the drift of Q
walk; four steps are stated. Merged are the records once in ten days, as an agent does at the end of a day.
"""

from __future__ import annotations

import os
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.model_records import drawn, smoothed, templates
from benchmarks.page import machine, write_part
from calib.estimate.estimate import Estimate, estimate
from calib.estimate.nuisances import Priors
from calib.estimate.statements import Statements, Step
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Array
from calib.state.thinning import thinned
from calib.windows.record import Record
from tests.clamp_windows import G_MPS2

YEARS, YEAR_DAYS, EVERY_DAYS, MERGED_DAYS = 10, 365.0, 2.0, 10.0
MEAN = np.append(np.eye(3).ravel(), np.zeros(3))
U = np.append(np.where(np.eye(3).ravel() > 0, 0.02, 0.01), np.full(3, 0.5))
STEPS = tuple(Step(day + 0.5, {"Syy": 0.02, "Sxx": 0.02, "Qz": 0.1}) for day in (500.0, 1400.0, 2300.0, 3200.0))
WALKS = {"default": {}, "S 1 % a year": {"sensitivity": 5e-4, "offset_mps2": 0.01}}
SEEDS = (1,)
NAMES = "ABCDEFGHIJ"


def stated(walks: dict[str, Any]) -> Statements:
    """What is stated of the sensor and of ten references."""
    priors = Priors(reference=2e-3, reference_drift=5e-3, offset_mps2=0.02)
    certified = {name: YEAR_DAYS * k for k, name in enumerate(NAMES)}
    model = TemperatureModel(offset_order=1, sensitivity_order=1, reference_degc=0.0)
    held = np.array([0.0, 0.0, G_MPS2])
    return Statements(MEAN, U, {"": priors}, Wander(**walks), model, certified=certified, steps=STEPS, held_mps2=held)


def degc(day: float) -> float:
    """Over a year and over a few days."""
    return float(10.0 * np.sin(2.0 * np.pi * day / YEAR_DAYS) + 3.0 * np.sin(1.7 * day))


@dataclass(frozen=True)
class Compared:
    """All windows against merged records, at a year's end: differences over u, U over U, and seconds of a solution."""

    windows: int
    records: int
    worst: float
    ratio: tuple[float, float]
    past: float
    errors: float
    seconds: tuple[float, float]


def years(walks: dict[str, Any], seed: int) -> Iterator[Compared]:
    """The end of each year."""
    random, statements = np.random.default_rng(seed), stated(walks)
    days = np.arange(0.0, YEARS * YEAR_DAYS, EVERY_DAYS)
    every, truth = drawn(
        random, templates(50), days, statements, temperature=degc, reference=lambda day: NAMES[int(day // YEAR_DAYS)]
    )
    merged: list[Record] = []
    cuts = [step.day for step in STEPS]
    for year in range(1, YEARS + 1):
        end = year * YEAR_DAYS
        for until in np.arange(end - YEAR_DAYS + MERGED_DAYS, end + MERGED_DAYS, MERGED_DAYS):
            until = min(until, end)
            merged += [
                r for r in every if until - MERGED_DAYS <= r.day < until and (not merged or r.day > merged[-1].days[1])
            ]
            merged = thinned(merged, float(until), np.eye(3), cuts)
        so_far = replace(statements, steps=tuple(step for step in STEPS if step.day < end))
        yield compared([r for r in every if r.day < end], merged, so_far, truth)


def compared(every: Sequence[Record], merged: Sequence[Record], statements: Statements, truth: Array) -> Compared:
    """All windows against merged records."""
    begun = time.process_time()
    whole = estimate(every, statements)
    between = time.process_time()
    few = estimate(merged, statements)
    seconds = between - begun, time.process_time() - between
    one, other = whole.now, few.now
    u = np.sqrt(one.variance[:12])
    ratio = np.sqrt(other.variance[:12]) / u
    past, errors = _past(whole, few, truth)
    worst = float(np.abs((other.mean - one.mean)[:12] / u).max())
    return Compared(len(every), len(merged), worst, (float(ratio.min()), float(ratio.max())), past, errors, seconds)


def _past(whole: Estimate, few: Estimate, truth: Array) -> tuple[float, float]:
    """The difference of both pasts and the error of that of the merged records, as rms over u, on the days of those."""
    days, values, _ = smoothed(whole)
    at, found, u = smoothed(few)
    same = np.array([np.interp(at, days, values[:, k]) for k in range(12)]).T
    true = np.array([np.interp(at, days, truth[: len(days), k]) for k in range(12)]).T
    far = ~np.any([np.abs(at - step.day) < 20.0 for step in STEPS], axis=0)  # between windows on both sides of a step
    return tuple(float(np.sqrt(np.mean((moved[far] / u[far]) ** 2))) for moved in (found - same, found - true))  # type: ignore[return-value]


def table() -> str:
    """A row for each year's end."""
    rows = [
        "| walks | year | windows, records | largest difference of S and Q / u | U / U of all "
        "| past: rms of difference / u, of error / u | s of CPU, all and merged |",
        "| --- " * 7 + "|",
    ]
    for name, walks in WALKS.items():
        for seed in SEEDS:
            for k, c in enumerate(years(walks, seed), start=1):
                rows.append(
                    f"| {name} | {k} | {c.windows}, {c.records} | {c.worst:.2f} | {c.ratio[0]:.3f} to {c.ratio[1]:.3f} "
                    f"| {c.past:.2f}, {c.errors:.2f} | {c.seconds[0]:.1f}, {c.seconds[1]:.1f} |"
                )
    return "\n".join(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true")
    text = f"`python -m benchmarks.ten_years`, {machine()}.\n\n{table()}"
    if parser.parse_args().write:
        write_part("ten years", text)
    else:
        print(text)
