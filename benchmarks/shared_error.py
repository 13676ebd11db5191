"""The difference of two sensors that were calibrated with one reference: does its U cover, with and without the shared
part of the covariance?

    python -m benchmarks.shared_error [REFERENCES]

Each reference has an error of its own, drawn from its prior (0.3 % for each channel). Two sensors with different S are
calibrated with it by three windows each, with mount offsets drawn from their prior.
"""

from __future__ import annotations

import sys

import numpy as np

from calib.estimate.nuisances import Priors
from calib.estimate.reference_share import shared_covariance
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Array
from calib.state.state import State
from calib.windows.record import Record
from tests.building_windows import building_window
from tests.clamp_windows import Q_TRUE, S_TRUE

SEED, REFERENCES, WINDOWS = 15, 1000, 3
STATED = {"reference": 3e-3, "rotation_rad": 3e-3, "gravity_mps2": 0.03, "lag_s": 0.005, "offset_mps2": 0.02}
PRIOR = np.append(np.eye(3).ravel(), np.zeros(3))
U_PRIOR = np.append(np.where(np.eye(3).ravel() > 0, 0.05, 0.03), np.full(3, 1.0))
CHILDREN = (S_TRUE, S_TRUE @ np.diag([0.99, 1.01, 1.02]))
MAIN = [0, 4, 8]


def child(random: np.random.Generator, error: Array, S: Array) -> State:
    """A sensor after its windows beside a reference whose channels indicate (1 + `error`) (3,) of the motion."""
    steady = Wander(dict.fromkeys(Wander.none().values, 0.0))
    priors = Priors(dict(Priors.none().values) | STATED)
    found = State(PRIOR, U_PRIOR, priors, steady, TemperatureModel(), fixed=False)
    found.meet("A")
    for k in range(WINDOWS):
        Q = Q_TRUE + S @ random.normal(0.0, STATED["offset_mps2"], 3)
        window = building_window(random, level_mps2=(0.3, 0.3, 0.3), reference_error=error, S=S, Q=Q, noise_mps2=0.02)
        found.update(Record.of(window, k / 24.0, 0.0, np.nan, "A"))
    return found


def covered(references: int) -> tuple[Array, Array]:
    """(3,), (3,): for how many references U of the difference of the main sensitivities covers, with and without the
    shared part."""
    random = np.random.default_rng(SEED)
    shared, alone = np.zeros(3), np.zeros(3)
    for _ in range(references):
        error = random.normal(0.0, STATED["reference"], 3)
        one, other = (child(random, error, S) for S in CHILDREN)
        found = [c.result() for c in (one, other)]
        off = np.diag(found[0].sensitivity - found[1].sensitivity - CHILDREN[0] + CHILDREN[1])
        both, cross = found[0].covariance + found[1].covariance, shared_covariance(one.shares(), other.shares())
        shared += np.abs(off) < 1.96 * np.sqrt(np.diag(both - cross - cross.T)[MAIN])
        alone += np.abs(off) < 1.96 * np.sqrt(np.diag(both)[MAIN])
    return shared, alone


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else REFERENCES
    for name, found in zip(("with the shared part", "without it"), covered(count), strict=True):
        print(f"{name}: {', '.join(f'{n:.0f}' for n in found)} of {count} (Sxx, Syy, Szz), seed {SEED}", flush=True)
