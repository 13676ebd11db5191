"""Hum, rattle and noise that is strong at some frequencies only: what they cost, and whether U still covers.

    python -m benchmarks.disturbed [--runs 20] [--write]

A sensor and a tri-axial reference move together for 300 s, with the same response. The error of the reference is drawn
from its stated uncertainty of 0.1 %. "u over that without" is the mean u of the main sensitivities of a run, over the
median of that of the runs without a disturbance.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import multiprocessing
from collections.abc import Callable

import numpy as np

from benchmarks.page import machine, write_part
from benchmarks.response import BANDS_HZ, U_REFERENCE
from calib.estimate.nuisances import Priors
from calib.model import Array
from calib.recorded.adjusting import adjusted
from tests.pair import Disturbance, flat, hum, noise, pair, rattle, undisturbed

Made = Callable[[float, float], Disturbance]  # of the ends of the motion in Hz


def _density(low_hz: float, high_hz: float) -> float:
    """Of a motion of 1 m/s2, in m/s2 per root Hz."""
    return float(1.0 / np.sqrt(high_hz - low_hz))


def _upper_half(low_hz: float, high_hz: float) -> Callable[[Array], Array]:
    return lambda f: np.where(f > 0.5 * high_hz, _density(low_hz, high_hz), 0.0)


KINDS: dict[str, Made] = {
    "none": lambda *_: undisturbed,
    "hum of 0.3 m/s² within the motion": lambda _, high: hum(0.6 * high, 0.3),
    "hum of 0.5 m/s² above it": lambda _, high: hum(2.3 * high, 0.5),
    "rattle of 0.5 m/s² above it": lambda _, high: rattle(1.5 * high, 0.5),
    "rattle of 0.3 m/s² within it": lambda _, high: rattle(0.7 * high, 0.3),
    "1/f noise of the sensor, 1 % of the motion": lambda low, high: noise(
        lambda f: 0.01 * _density(low, high) * np.sqrt(np.sqrt(low * high) / f)
    ),
    "noise of the sensor as strong as the motion, above half of its band": lambda *ends: noise(_upper_half(*ends)),
    "the same in the reference": lambda *ends: noise(_upper_half(*ends), of_reference=True),
    "white noise of the reference, 10 % of the motion": lambda low, high: noise(
        lambda f: np.full(len(f), 0.1 * _density(low, high)), of_reference=True
    ),
    "noise of the reference that grows with frequency, 3 % of the motion in the middle": lambda low, high: noise(
        lambda f: 0.03 * _density(low, high) * f / np.sqrt(low * high), of_reference=True
    ),
    "noise of the reference, 10 % of the motion at its frequencies, none elsewhere": lambda low, high: noise(
        lambda f: 0.1 * _density(low, high) * ((f >= low) & (f <= high)), of_reference=True
    ),
}  # fmt: skip


def one(job: tuple[str, tuple[float, float], int]) -> tuple[Array, Array] | None:
    """Errors of S over u (3, 3), and u (3, 3) in % of 1; None where it was refused."""
    name, band_hz, seed = job
    random = np.random.default_rng([seed, [*KINDS].index(name), round(band_hz[1])])
    error = float(U_REFERENCE * random.normal())
    made = pair(
        seed, flat, band_hz=band_hz, rate_hz=10.0 * band_hz[1], seconds=300.0, reference_error=error,
        disturbed=KINDS[name](*band_hz),
    )  # fmt: skip
    stated = Priors(reference=U_REFERENCE, reference_frequency_hz=made.reference_frequency_hz)
    found = adjusted(made.files, stated).calibration
    if found is None:
        return None
    u = found.standard_uncertainty[:9].reshape(3, 3)
    return (found.sensitivity - made.sensitivity) / u, 100.0 * u


def table(runs: int) -> list[str]:
    """The lines of the table."""
    lines = [
        "| disturbance | motion, Hz | refused | u over that without, median | largest | within 2 u | most |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    clean: dict[tuple[float, float], float] = {}
    with multiprocessing.get_context("forkserver").Pool() as pool:
        for name in KINDS:
            for band_hz in BANDS_HZ:
                found = pool.map(one, [(name, band_hz, seed) for seed in range(runs)], chunksize=1)
                told = [run for run in found if run is not None]
                cells = ["-", "-", "-", "-"]
                if told:
                    z, u = (np.array(part) for part in zip(*told, strict=True))
                    main = np.mean(u[:, range(3), range(3)], axis=1)
                    times = main / clean.setdefault(band_hz, float(np.median(main)))
                    within = np.count_nonzero(np.abs(z) <= 2.0)
                    cells = [
                        f"{np.median(times):.2f}",
                        f"{times.max():.1f}",
                        f"{within} of {z.size}",
                        f"{np.abs(z).max():.1f}",
                    ]
                refused = f"{len(found) - len(told)} of {runs}"
                lines.append("| " + " | ".join([name, f"{band_hz[0]:g}-{band_hz[1]:g}", refused, *cells]) + " |")
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
        write_part("disturbed", "\n".join([*lines, "", f"{arguments.runs} runs a line; {machine()}."]))


if __name__ == "__main__":
    main()
