"""Motion in a plane or along a line that is not along the axes: is a determined element ever wrong, and is U right?

    python -m benchmarks.planar [MOTION ...] [--seeds 300] [--online]

Planes, S and the errors of all that is stated are drawn (tests/planar_world.py). `--online`: the windows of ten
recordings of one plane go through the estimator of the agent, one after the other.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections.abc import Iterator

import numpy as np

from calib.estimate.nuisances import Priors
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Window
from calib.state.state import State
from calib.windows.record import Record
from tests.planar_world import U_REFERENCE, U_ROTATION, World, calibrated, made, orthonormal

WORLDS = {
    **{f"{kind}, {'starts and stops' if stops else 'steady'}": World(kind, stops)  # type: ignore[arg-type]
       for kind in ("ellipse", "tones", "band") for stops in (False, True)},
    "line, tones": World("tones", directions=1),
    "line, band, starts and stops": World("band", True, directions=1),
    "nominal, ellipse, starts and stops": World("ellipse", True, nominal=True),
    "nominal, tones": World("tones", nominal=True),
    "nominal, band": World("band", nominal=True),
    "nominal, line": World("band", directions=1, nominal=True),
    "two planes": World("band", planes=2),
    "three planes, tones": World("tones", planes=3),
    **{f"third direction at {k} times the noise": World("band", third=float(k)) for k in (3, 10, 30)},
    "third direction at 10 times a stated noise": World("band", third=10.0, told=True, level_mps2=0.1),
    "uniaxial, one line": World("band", directions=1, uniaxial=True),
    "uniaxial, three lines": World("band", directions=1, uniaxial=True, planes=3),
}  # fmt: skip
VISITS, U_PRIOR = 10, np.where(np.eye(3), 0.05, 0.03)


class Tally:
    """Errors over u of the determined elements of S, which of them are within U, and how many draws were valid."""

    def __init__(self) -> None:
        self.z: list[float] = []
        self.inside: list[bool] = []
        self.valid = self.crashes = 0

    def add(self, error: np.ndarray, u: np.ndarray, k: float, told: np.ndarray) -> None:
        """Of one draw: (9,) each, and the coverage factor."""
        found = np.abs(error[told]) / u[told]
        self.z += found.tolist()
        self.inside += (found <= k).tolist()

    def line(self, name: str, draws: int) -> str:
        """A line of the table."""
        z = np.array(self.z)
        told = f"{np.sqrt(np.mean(z**2)):.2f} | {z.max():.1f} | {100.0 * np.mean(self.inside):.1f}" if len(z) else "| |"
        beyond = int(np.count_nonzero(z > 4.0))
        return f"| {name} | {self.valid} of {draws} | {self.crashes} | {len(z) / draws:.1f} | {told} | {beyond} |"


def files(world: World, seed: int, tally: Tally) -> None:
    """One draw as `fieldcal calibrate` sees it."""
    of = made(world, seed)
    try:
        found = calibrated(world, of)
    except Exception as error:  # what is counted here
        print(f"seed {seed}: {error!r}")
        tally.crashes += 1
        return
    tally.valid += found.status == "valid"
    away = found.values[:9] - of.sensitivity.ravel()
    tally.add(away, found.standard_uncertainty[:9], found.coverage_factor, found.determined[:9])


def online(world: World, seed: int, tally: Tally) -> None:
    """One draw as the agent sees it: a fixed mount, visited ten times."""
    random = np.random.default_rng([seed, 1])
    S, plane = np.eye(3) + U_PRIOR * random.normal(size=(3, 3)), orthonormal(random)
    stated = Priors(offset_mps2=1e-3, lag_window_s=0.0, rotation_rad=U_ROTATION, reference=U_REFERENCE)
    u = np.append(U_PRIOR.ravel(), np.full(3, 20.0))
    walk = Wander({**Wander.none().values, "offset_rate_mps2": 1e-9})
    state = State(np.append(np.eye(3), np.zeros(3)), u, stated, walk, TemperatureModel(), fixed=True)
    for day, window in enumerate(_visits(world, S, plane, seed)):
        state.update(Record.of(window, float(day)))
    found = state.result()
    tally.valid += 1
    error = (found.sensitivity - S).ravel()
    tally.add(error, found.standard_uncertainty[:9], state.coverage_factor, found.determined[:9])


def _visits(world: World, S: np.ndarray, plane: np.ndarray, seed: int) -> Iterator[Window]:
    """The windows of all recordings; the mount and the reference are the same in all of them."""
    for visit in range(VISITS):
        of = made(world, seed, S, plane, noise_seed=visit)
        yield from (window for window in of.files.windows(0.0) if window.used)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motions", nargs="*", metavar="MOTION", help=f"{'; '.join(WORLDS)} (all)")
    parser.add_argument("--seeds", type=int, default=300)
    parser.add_argument("--online", action="store_true")
    options = parser.parse_args()
    if unknown := set(options.motions) - set(WORLDS):
        parser.error(f"no motion {sorted(unknown)}; the motions are {'; '.join(WORLDS)}")
    print("| motion | valid | crashes | determined of 9 | RMS of error / u | most | within U, % | beyond 4 u |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in options.motions or WORLDS:
        world = WORLDS[name]
        if options.online and (world.nominal or world.uniaxial or world.planes > 1):
            continue
        tally = Tally()
        for seed in range(options.seeds):
            (online if options.online else files)(world, seed, tally)
        print(tally.line(name, options.seeds), flush=True)


if __name__ == "__main__":
    main()
