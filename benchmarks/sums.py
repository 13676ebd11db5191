"""Speed of the estimator's parts: window sums compared with recursive estimators, an adjustment, `calibrate` on a file.

The recursive estimators get the same work: 3 outputs, regressors (a_x, a_y, a_z, 1), one sample at a time.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.page import machine, write_part
from calib.adjustment.adjustment import adjust
from calib.estimate.nuisances import Priors
from calib.geometry import clamp
from calib.model import Array, Window
from calib.windows.sums import window_sums

RATE_HZ = 1000.0
SAMPLES = 2_000_000  # for the sums
FEW = 20_000  # for the recursive estimators, which take 30 us per sample
HOUR = 3_600_000
WINDOWS = 100


def signals(n: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """A uniaxial reference (n, 1), its derivative, and the indications (n, 3) of a sensor on the clamp."""
    t = np.arange(n) / RATE_HZ
    omega = 2 * np.pi * 3.0
    u, du = 5.0 * np.sin(omega * t)[:, None], 5.0 * omega * np.cos(omega * t)[:, None]
    pose = clamp(np.deg2rad(35.0), np.deg2rad(30.0))
    V = u @ pose.direction.T + pose.gravity_mps2 + 0.02 * rng.normal(size=(n, 3))
    return u, du, V


def rate(work: Callable[[], object], samples: int) -> float:
    """Samples per second of CPU time, the best of three runs."""
    best = np.inf
    for _ in range(3):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return samples / best


def recursive_rates(rng: np.random.Generator) -> dict[str, float]:
    """Samples per second of filterpy, padasip and river for the same 12 parameters."""
    import padasip
    from filterpy.kalman import KalmanFilter
    from river import linear_model

    a = rng.normal(size=(FEW, 3))
    x, V = np.column_stack([a, np.ones(FEW)]), a + 0.02 * rng.normal(size=(FEW, 3))

    def by_filterpy() -> None:
        filters = [KalmanFilter(dim_x=4, dim_z=1) for _ in range(3)]
        for row, out in zip(x, V, strict=True):
            for axis, one in enumerate(filters):
                one.update(out[axis], H=row[None, :])

    def by_padasip() -> None:
        for axis in range(3):
            padasip.filters.FilterRLS(n=4, mu=1.0).run(V[:, axis], x)

    def by_river() -> None:
        names = ("x", "y", "z", "one")
        models = [linear_model.BayesianLinearRegression(alpha=1.0, beta=1.0) for _ in range(3)]
        for row, out in zip(x.tolist(), V.tolist(), strict=True):
            features = dict(zip(names, row, strict=True))
            for axis, model in enumerate(models):
                model.learn_one(features, out[axis])

    return {"filterpy": rate(by_filterpy, FEW), "padasip": rate(by_padasip, FEW), "river": rate(by_river, FEW)}


def adjustment_ms(rng: np.random.Generator) -> float:
    """CPU time in ms of an adjustment over 100 windows in 12 positions, the best of five runs."""
    windows = []
    for k in range(WINDOWS):
        pose = clamp(np.deg2rad(35.0), np.deg2rad(30.0 * (k % 12)))
        u, du, _ = signals(4000, rng)
        V = u @ pose.direction.T + pose.gravity_mps2 + 0.02 * rng.normal(size=(4000, 3))
        sums = window_sums(u, du, V, np.arange(0, 4001, 500))
        windows.append(Window(10.0 * k, 10.0 * k + 4.0, pose, sums, True, "", 4000, 0))
    best = np.inf
    for _ in range(5):
        start = time.process_time()
        adjust(windows, Priors())
        best = min(best, time.process_time() - start)
    return 1e3 * best


def calibrate_hour(directory: Path, rng: np.random.Generator) -> dict[str, float]:
    """Wall time in s of a calibration of one hour at 1 kHz, and of reading the same two files."""
    t = np.arange(HOUR) / RATE_HZ
    alphas = (0.0, 30.0, 120.0, 210.0)
    quarter = HOUR // len(alphas)
    u, _, _ = signals(HOUR, rng)
    parts = []
    for k, alpha in enumerate(alphas):
        pose = clamp(np.deg2rad(35.0), np.deg2rad(alpha))
        parts.append(u[k * quarter : (k + 1) * quarter] @ pose.direction.T + pose.gravity_mps2)
    V = np.concatenate(parts) + 0.02 * rng.normal(size=(HOUR, 3))
    files = {name: directory / f"{name}.csv" for name in ("sensor", "reference", "poses")}
    np.savetxt(files["sensor"], np.column_stack([t, V]), "%.3f,%.6f,%.6f,%.6f", header="time_s,vx,vy,vz", comments="")
    np.savetxt(files["reference"], np.column_stack([t, u]), "%.3f,%.6f", header="time_s,a", comments="")
    lines = [f"{k * 900 + 1},{k * 900 + 899},35,{alpha:g}" for k, alpha in enumerate(alphas)]
    files["poses"].write_text("\n".join(["start_s,stop_s,theta_deg,alpha_deg", *lines]) + "\n")
    options = [text for name, path in files.items() for text in (f"--{name}", str(path))]
    both = f"{str(files['sensor'])!r}, {str(files['reference'])!r}"
    commands = {
        "calibrate": ["-m", "agent", "calibrate", *options, "--json", "-"],
        "numpy": ["-c", f"import numpy\nfor f in ({both}): numpy.loadtxt(f, delimiter=',', skiprows=1)"],
        "pandas": ["-c", f"import pandas\nfor f in ({both}): pandas.read_csv(f).to_numpy()"],
    }
    return {name: min(wall_s(command) for _ in range(2)) for name, command in commands.items()}


def wall_s(command: list[str]) -> float:
    """Wall time in s of a whole process."""
    start = time.monotonic()
    subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - start


def main() -> None:
    """Measure and write the tables."""
    rng = np.random.default_rng(1)
    u, du, V = signals(SAMPLES, rng)
    rates = {
        f"window sums, segments of {size} samples": rate(
            lambda size=size: window_sums(u, du, V, np.arange(0, SAMPLES + 1, size)),  # type: ignore[misc]
            SAMPLES,
        )
        for size in (500, 1000, 4000)
    }
    rates |= recursive_rates(rng)
    adjusting_ms = adjustment_ms(rng)
    with tempfile.TemporaryDirectory() as directory:
        seconds = calibrate_hour(Path(directory), rng)
    first = next(iter(rates.values()))
    lines = [f"| {name} | {value:.2g} | {first / value:,.0f} |" for name, value in rates.items()]
    write_part(
        "sums",
        f"""
`python -m benchmarks sums` on {machine()}. Samples for each second of CPU on one core, 3 outputs:

| estimator | samples/s | speed of the first row, divided by that of this row |
| --- | --- | --- |
"""
        + "\n".join(lines)
        + f"""

An adjustment over {WINDOWS} windows in 12 positions takes {adjusting_ms:.0f} ms of CPU (goal 50 ms).

`fieldcal calibrate` (by adjustment) on an hour of 1 kHz, sensor and reference, as a whole process:

| process | wall time | time of `fieldcal calibrate`, divided by this time |
| --- | --- | --- |
| fieldcal calibrate | {seconds["calibrate"]:.1f} s | |
| numpy.loadtxt of both files | {seconds["numpy"]:.1f} s | {seconds["calibrate"] / seconds["numpy"]:.1f} |
| pandas.read_csv of both files | {seconds["pandas"]:.1f} s | {seconds["calibrate"] / seconds["pandas"]:.1f} |
""",
    )


if __name__ == "__main__":
    main()
