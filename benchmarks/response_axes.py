"""Axes whose filters differ: is S covered by U, and what does U cost?

    python -m benchmarks.response_axes [--runs 12] [--write]

As `python -m benchmarks.response`, with a motion of 0.5 to 20 Hz and low-pass filters whose corners differ from axis to
axis by a normally distributed error. The estimator has one response for all axes, so that the bands of an axis deviate
from it.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import itertools

import numpy as np

from benchmarks.page import machine, write_part
from benchmarks.response import U_REFERENCE
from calib.estimate.nuisances import Priors
from calib.estimate.quantities import REFERENCE
from calib.model import Array
from calib.recorded.adjusting import adjusted
from tests.pair import Filter, flat, lowpass, pair

BAND_HZ = (0.5, 20.0)
RATIOS = (1.5, 3.0)  # of the corner over the upper end of the motion
ORDERS = (1, 2, 4)
SPREAD_PCT = (0.0, 0.5, 1.0, 2.0, 5.0)


def one(order: int, ratio: float, spread_pct: float, in_reference: bool, seed: int) -> tuple[Array, Array] | None:
    """Relative errors of the main sensitivities (3,), and u (3,), both besides the reference's; None where refused."""
    random = np.random.default_rng([29, seed, order, round(10.0 * ratio), int(in_reference)])
    corners_hz = ratio * BAND_HZ[1] * (1.0 + spread_pct / 100.0 * random.normal(size=3))
    own = [lowpass(order, corner_hz) for corner_hz in corners_hz.tolist()]
    by_axis: Filter = lambda f: np.stack([h(f) for h in own])  # noqa: E731
    undone: Filter = lambda f: 1.0 / by_axis(f)  # noqa: E731
    error = float(U_REFERENCE * random.normal())
    made = pair(
        seed, undone if in_reference else flat, of_outputs=flat if in_reference else by_axis, band_hz=BAND_HZ,
        rate_hz=200.0, seconds=300.0, reference_error=error,
    )  # fmt: skip
    stated = Priors(reference=U_REFERENCE, reference_frequency_hz=made.reference_frequency_hz)
    outcome = adjusted(made.files, stated)
    if outcome.calibration is None:
        return None
    main = np.diag(made.sensitivity)
    others = [u for source, u in outcome.more["budget"].items() if source != REFERENCE.source]
    u = np.array([np.hypot.reduce([of[name] for of in others]) for name in ("Sxx", "Syy", "Szz")]) / main
    return np.diag(outcome.calibration.sensitivity) / main - 1.0 + error, u


def table(runs: int) -> list[str]:
    """The lines of the table."""
    lines = [
        "| filter | corner over motion | differs by axis by, % | in | refused | u, % | RMS error, %"
        " | within 2 u | most, u |",
        "| --- |" + " --- |" * 8,
    ]
    for order, ratio, in_reference, spread in itertools.product(ORDERS, RATIOS, (False, True), SPREAD_PCT):
        told = [found for k in range(runs) if (found := one(order, ratio, spread, in_reference, k)) is not None]
        away, u = (np.array([both[k] for both in told]) for k in (0, 1))
        z = np.abs(away / u)
        lines.append(
            f"| low-pass, order {order} | {ratio:g} | {spread:g} | {'reference' if in_reference else 'sensor'} "
            f"| {runs - len(told)} of {runs} | {100.0 * u.mean():.3f} "
            f"| {100.0 * np.sqrt(np.mean(away**2)):.3f} | {np.count_nonzero(z <= 2.0)} of {z.size} | {z.max():.1f} |"
        )
        print(lines[-1], flush=True)
    return lines


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--write", action="store_true", help="write docs/response.md")
    arguments = parser.parse_args()
    lines = table(arguments.runs)
    if arguments.write:
        write_part("axes", "\n".join([*lines, "", f"{arguments.runs} runs a line; {machine()}."]))


if __name__ == "__main__":
    main()
