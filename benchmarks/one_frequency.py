"""The paper's bench with motion of one frequency and a filter in the sensor: is S right at that frequency, and Q?

    python -m benchmarks.one_frequency [--runs 100] [--write]

Four positions, 36 s. The clamp's angles are known to 0.2 deg, offsets to 0.05 m/s2; errors are drawn from these. Truth
is S times the filter's gain at the motion's frequency.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import multiprocessing

import numpy as np

from benchmarks.page import machine, write_part
from hw.virtual.spread import Spread, drawn
from tests.one_frequency import ANGLES, at_frequency, bench, calibrated, stated

LINES = ((3.0, 0.0, 1), (3.0, 31.0, 1), (3.0, 62.0, 1), (3.0, 31.0, 2), (6.0, 31.0, 1), (6.0, 62.0, 1), (6.0, 31.0, 2))
MAIN, OFFSET = [0, 4, 8], [9, 10, 11]
Job = tuple[float, float, int, int]


def one(job: Job) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Errors (12,), u (12,) and k of one run; None where it was refused."""
    motion_hz, corner_hz, order, seed = job
    sensor = {"lowpass_hz": corner_hz, "lowpass_order": order} if corner_hz else {}
    random = np.random.default_rng([11, seed])
    made = drawn(bench(motion_hz, **sensor), Spread(angle_deg=0.2, theta_deg=0.2, offset_mps2=0.05), random)
    outcome = calibrated(made, seed, stated(**ANGLES))
    found = outcome.calibration
    if found is None:
        return None
    truth = at_frequency(motion_hz, corner_hz or np.inf, order)
    away = np.append(found.sensitivity.ravel(), found.offset) - truth
    return away, found.standard_uncertainty, outcome.coverage_factor


def line(
    motion_hz: float, corner_hz: float, order: int, found: list[tuple[np.ndarray, np.ndarray, float] | None]
) -> str:
    """A line of the table."""
    told = [f for f in found if f is not None]
    away, u, k = (np.array([f[i] for f in told]) for i in range(3))
    z, told_all = away / u, np.isfinite(u)  # NaN where a parameter is not determined
    inside = (np.abs(away) <= k[:, None] * u)[told_all]
    name = f"order {order} at {corner_hz:g} Hz" if corner_hz else "none"
    rms = [np.sqrt(np.nanmean(z[:, some] ** 2)) for some in (MAIN, OFFSET)]
    return (
        f"| {motion_hz:g} | {name} | {len(found) - len(told)} of {len(found)} | {100.0 * u[:, MAIN].mean():.2f} | "
        f"{rms[0]:.2f} | {rms[1]:.2f} | {told_all.mean(axis=0).min():.0%} | {100.0 * inside.mean():.1f} | "
        f"{np.nanmax(np.abs(z)):.1f} |"
    )


def main() -> None:
    """Print the table, and write it into docs/response.md on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    lines = [
        "| motion, Hz | filter | refused | u of main S, % | RMS of error / u: main S | Q | "
        "least determined | all within U, % | most, u |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    with multiprocessing.Pool() as pool:
        for motion_hz, corner_hz, order in LINES:
            jobs = [(motion_hz, corner_hz, order, seed) for seed in range(options.runs)]
            lines.append(line(motion_hz, corner_hz, order, pool.map(one, jobs, chunksize=1)))
            print(lines[-1], flush=True)
    if options.write:
        write_part("one frequency", "\n".join([*lines, "", f"{options.runs} runs a line; {machine()}."]))


if __name__ == "__main__":
    main()
