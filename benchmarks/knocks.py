"""Knocks of the sensor that the reference does not feel: what they cost at a bench, and whether U still covers.

    python -m benchmarks.knocks [--runs 20] [--write]

A sensor stays at four positions of a clamp on a shaker, 12.6 s each, beside a laser vibrometer. Its clock is 1.3 % off,
and its samples are stamped in batches of 32, late by 2 ms (standard deviation). Knocks are half-sines of 20 ms and of
2.4 to 8 m/s2, at random times. Angles, offsets and the reference are true, and stated to be so: only noise is left.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse

import numpy as np

from benchmarks.page import machine, write_part
from calib.model import Array
from tests.stays import MAIN, S_TRUE, in_batches, knocked, main_errors_pct, stays

KNOCKS_HZ = (0.0, 0.25, 0.5, 1.0, 2.0)
RATE_HZ, STAY_S, BATCH, LATE_S = 1013.0, 12.6, 32, 2e-3
EXACT = dict.fromkeys(
    (
        "u_angle_deg", "u_theta_deg", "u_alpha_common_deg", "u_offset_mps2", "u_reference_pct",
        "u_transverse_motion_pct",
    ), 0.0,
)  # fmt: skip


def one(knocks_hz: float, seed: int) -> tuple[Array, Array, float] | None:
    """Errors and u (3,) of the main sensitivities in %, and the share of the samples that was left out or is in windows
    that are not used, in %; None where it was refused."""
    made = stays(seed, rate_hz=RATE_HZ, on_s=STAY_S, struck=knocked(knocks_hz))
    batches = -(-len(made.time_s) // BATCH)
    late_s = np.abs(np.random.default_rng([seed, 36]).normal(0.0, LATE_S, batches))
    found = made.calibrated(in_batches(made.time_s, BATCH, late_s), **EXACT)
    if found.status != "valid":
        return None
    u_pct = 100.0 * found.standard_uncertainty[MAIN] / S_TRUE.ravel()[MAIN]
    used, every = sum(w.points for w in found.windows if w.used), sum(w.points + w.left_out for w in found.windows)
    return main_errors_pct(found), u_pct, 100.0 * (1.0 - used / every)


def table(runs: int) -> list[str]:
    """The lines of the table."""
    lines = [
        "| knocks a second | refused | left out, % | RMS of the main errors, % | over that without"
        " | u over that without, median | largest | within 2 u | most |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    clean: tuple[float, float] | None = None
    for knocks_hz in KNOCKS_HZ:
        found = [run for run in (one(knocks_hz, seed) for seed in range(runs)) if run is not None]
        errors, u, left_out = (np.array(part) for part in zip(*found, strict=True))
        rms = float(np.sqrt(np.mean(errors**2)))
        clean = clean or (rms, float(np.median(u)))
        away, times = np.abs(errors / u), u.mean(axis=1) / clean[1]
        cells = [
            f"{knocks_hz:g}", f"{runs - len(found)} of {runs}", f"{left_out.mean():.1f}", f"{rms:.4f}",
            f"{rms / clean[0]:.2f}", f"{np.median(times):.2f}", f"{times.max():.2f}",
            f"{np.count_nonzero(away <= 2.0)} of {away.size}", f"{away.max():.1f}",
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    return lines


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--write", action="store_true", help="write docs/response.md")
    arguments = parser.parse_args()
    lines = table(arguments.runs)
    if arguments.write:
        write_part("knocks", "\n".join([*lines, "", f"{arguments.runs} runs a line; {machine()}."]))


if __name__ == "__main__":
    main()
