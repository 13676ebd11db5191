"""Coverage of the on-line U: constant faults are drawn per run, parameters in force are compared with the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from agent.core.events import CalibrationUpdate
from benchmarks.online.node import Stated, Timing, node
from benchmarks.online.runner import EPOCH_NS, Run, visits
from calib.model import PARAMETERS

SEED = 50_000
RUNS = 300
TIMING = Timing(30.0, 120.0, 16)
CHIP_HZ = 125.0  # output data rate of the sensor, an ADXL355
# As in a data sheet rather than a certificate, so that the data halve the u of every parameter.
STATED = Stated(main_pct=3.0, transverse_pct=1.5, offset_mps2=0.5)
LEVEL = 0.999  # of the band over all parameters together (Bonferroni)


def one(seed: int) -> NDArray[np.float64]:
    """Error over U (12,) of the calibration in force after the last window; NaN where a parameter is not determined."""
    drawn = node(seed, all_axes=True, timing=TIMING, stated=STATED, chip_hz=CHIP_HZ)
    run = Run(drawn.config)
    results = [r for event in visits(drawn.building, range(TIMING.windows)) for r in run.feed(event)]
    update = [r for r in results if isinstance(r, CalibrationUpdate)][-1]
    truth = drawn.building.truth((update.t_utc_ns - EPOCH_NS) * 1e-9)
    value = np.append(np.ravel(update.sensitivity), update.offset)
    sensitivity = drawn.building.size(update.reference_frequency_hz) * truth.sensitivity
    error = value - np.append(sensitivity.ravel(), truth.offset_at_mean)
    expanded = update.coverage_factor * np.array(update.standard_uncertainty)
    return np.where(update.determined, error / expanded, np.nan)


def band(runs: int, parameters: int, share: float = 0.95, level: float = LEVEL) -> tuple[int, int]:
    """Lowest and highest number of covered runs for a correct U, for all `parameters` together, at this level."""
    tail = (1 - level) / parameters / 2
    logs = [
        math.lgamma(runs + 1) - math.lgamma(k + 1) - math.lgamma(runs - k + 1)
        + k * math.log(share) + (runs - k) * math.log1p(-share)
        for k in range(runs + 1)
    ]  # fmt: skip
    below = np.cumsum(np.exp(logs))
    return int(np.searchsorted(below, tail)), int(np.searchsorted(below, 1 - tail))


def table(ratios: Sequence[NDArray[np.float64]]) -> str:
    """One row per parameter: number of runs in which it is determined, number with the truth within U, band."""
    values = np.array(ratios)
    lines = ["| parameter | determined | within U | % | band |", "| --- | --- | --- | --- | --- |"]
    for p, name in enumerate(PARAMETERS):
        known = values[np.isfinite(values[:, p]), p]
        if len(known):
            low, high = band(len(known), len(PARAMETERS))
            covered = int(np.sum(np.abs(known) <= 1))
            lines.append(f"| {name} | {len(known)} | {covered} | {100 * covered / len(known):.1f} | {low}..{high} |")
    known = values[np.isfinite(values)]
    lines.append(f"| all | {len(known)} | {np.sum(np.abs(known) <= 1)} | {100 * np.mean(np.abs(known) <= 1):.2f} | |")
    return "\n".join(lines)
