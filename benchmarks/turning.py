"""Slow turning by hand about one, two and three axes, beside a DC-coupled tri-axial reference: right, or refused.

    python -m benchmarks.turning [--seeds 300] [--first 0]

Both instruments see gravity alone. A sensor is turned to and fro by a sine, without a stop, or in steps with rests,
each a third of the seeds. For each number of axes: how many files are valid, refused and end with an error, the largest
error of a determined element in its standard uncertainties, and the share of determined elements within U.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

import calib

Array = NDArray[np.float64]
G_MPS2 = 9.80665
S_TRUE = np.array([[1.02, 0.03, -0.02], [0.015, 0.98, 0.025], [-0.01, 0.02, 1.01]])
Q_TRUE = np.array([0.1, -0.2, 0.3])
TRUTH = np.append(S_TRUE.ravel(), Q_TRUE)
RATE_HZ, LENGTH_S = 100.0, 60.0
NOISE_MPS2, REFERENCE_NOISE_MPS2 = 0.01, 0.001
MOST_U = 4.0  # of a determined element


@dataclass(slots=True)
class Counts:
    """What became of the files of one number of axes. `wrong`: seeds with a determined element beyond MOST_U."""

    valid: int = 0
    refused: int = 0
    crashed: int = 0
    worst_u: float = 0.0
    inside: list[bool] = field(default_factory=list)
    wrong: list[int] = field(default_factory=list)

    @property
    def coverage(self) -> float:
        """Share of determined elements within U."""
        return float(np.mean(self.inside)) if self.inside else float("nan")


def gravity(seed: int, axes: int, time_s: Array) -> Array:
    """Gravity (n, 3) as an ideal sensor reads it at these times (n,), turned about `axes` of its axes."""
    random = np.random.default_rng([seed, axes])
    period_s, size_rad, phase = random.uniform(8.0, 40.0, 3), random.uniform(0.3, 1.5, 3), random.uniform(0.0, 6.3, 3)
    about, up = np.eye(3)[random.permutation(3)], random.normal(size=3)
    felt = np.tile(G_MPS2 * up / np.linalg.norm(up), (len(time_s), 1))
    for k in range(axes):
        angle = _angle(random, seed % 3, time_s, float(period_s[k]), float(size_rad[k]), float(phase[k]))
        cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
        felt = felt * cos + np.cross(about[k], felt) * sin + np.outer(felt @ about[k], about[k]) * (1.0 - cos)
    return felt


def _angle(
    random: np.random.Generator, way: int, time_s: Array, period_s: float, size_rad: float, phase: float
) -> Array:
    """(n,) the angle in rad: to and fro, without a stop, or in steps."""
    if way == 0:
        return np.asarray(size_rad * np.sin(2.0 * np.pi * time_s / period_s + phase))
    if way == 1:
        return np.asarray(2.0 * np.pi * time_s / period_s + phase)
    steps = random.normal(size=200) * size_rad
    at = (time_s + 10.0) / (0.25 * period_s)
    part = np.clip(2.0 * (at % 1.0) - 1.0, 0.0, 1.0)
    k = at.astype(np.int64)
    return np.asarray(np.cumsum(steps)[k] + steps[k + 1] * (0.5 - 0.5 * np.cos(np.pi * part)))


def one(seed: int, axes: int, counts: Counts) -> None:
    """Simulate and calibrate one file, and count what became of it."""
    random = np.random.default_rng([seed, axes, 1])
    time_s = np.arange(0.0, LENGTH_S, 1.0 / RATE_HZ)
    reference_s = np.arange(-2.0, LENGTH_S + 2.0, 1.0 / RATE_HZ)
    V = gravity(seed, axes, time_s) @ S_TRUE.T + Q_TRUE + NOISE_MPS2 * random.normal(size=(len(time_s), 3))
    u = gravity(seed, axes, reference_s) + REFERENCE_NOISE_MPS2 * random.normal(size=(len(reference_s), 3))
    reference = dict(zip(("time_s", "ax", "ay", "az"), (reference_s, *u.T), strict=True))
    try:
        found = calib.calibrate((time_s, V), reference, rotation=np.eye(3))
    except Exception:  # what is counted here is that no file ends with an error, of whatever kind
        counts.crashed += 1
        return
    if found.status == "refused":
        counts.refused += 1
        return
    counts.valid += 1
    error = np.abs(found.values - TRUTH)
    told = found.determined
    counts.inside += (error <= found.expanded_uncertainty)[told].tolist()
    worst = float(np.max((error / found.standard_uncertainty)[told], initial=0.0))
    counts.worst_u = max(counts.worst_u, worst)
    if worst > MOST_U:
        counts.wrong.append(seed)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each number of axes; returns 1 if a file ended with an error or an element is beyond MOST_U."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=300)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args(arguments)
    faults = 0
    for axes in (1, 2, 3):
        counts = Counts()
        for seed in range(options.first, options.first + options.seeds):
            one(seed, axes, counts)
        faults += counts.crashed + len(counts.wrong)
        print(
            f"{axes} axes: {counts.valid} valid, {counts.refused} refused, {counts.crashed} with an error; worst "
            f"{counts.worst_u:.1f} u, beyond {MOST_U:g} u: {len(counts.wrong)} (seeds {counts.wrong}); "
            f"{100.0 * counts.coverage:.1f} % of {len(counts.inside)} determined elements within U",
            flush=True,
        )
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
