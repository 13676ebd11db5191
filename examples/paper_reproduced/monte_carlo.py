"""Monte Carlo (JCGM 101) on the virtual bench: benches and sensors are drawn as the budgets state."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.adjustment.adjustment import adjust
from calib.estimate.nuisances import Priors
from calib.model import Array
from paper_reproduced.bench import Device, drawn, record
from paper_reproduced.comparison import MAIN, METHODS, compare

ADJUSTED = "3, adjusted"


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Result for one device and one method.

    U (k = 2) of the main sensitivities (3,) in %: by the GUM budget, and as twice the rms of the errors. `within` of
    the `errors` lie within U.
    """

    device: Device
    method: str
    gum_pct: Array
    monte_carlo_pct: Array
    within: int
    errors: int


def monte_carlo(device: Device, priors: Priors, benches: int, seed: int) -> list[Drawn]:
    """Apply the three methods to `benches` recordings (3 Hz, 10 m/s2, 200 samples/s, one repetition)."""
    random = np.random.default_rng(seed)
    off = {m: np.empty((benches, 3)) for m in (*map(str, METHODS), ADJUSTED)}
    U = {m: np.empty((benches, 3)) for m in off}
    for k in range(benches):
        one = _sensor(device, random)
        runs = record(one, drawn(priors, random), 3.0, 10.0, seed + k, repetitions=1, rate_hz=200.0)
        found = compare(one, runs, priors)
        adjusted = adjust(found.windows, priors).calibration
        main = np.diag(one.sensitivity)
        for m in METHODS:
            off[str(m)][k] = (found.main[m] - main) / main * 100
            U[str(m)][k] = found.expanded_pct[m]
        off[ADJUSTED][k] = (np.diag(adjusted.sensitivity) - main) / main * 100
        U[ADJUSTED][k] = 2 * adjusted.standard_uncertainty[MAIN] / main * 100
    return [
        Drawn(
            device,
            m,
            U[m].mean(axis=0),
            2 * np.sqrt(np.mean(off[m] ** 2, axis=0)),
            int(np.sum(np.abs(off[m]) <= U[m])),
            off[m].size,
        )
        for m in off
    ]


def _sensor(device: Device, random: np.random.Generator) -> Device:
    """The device with transverse sensitivities drawn evenly within the limit that Method 2 assumes."""
    limit = device.transverse_limit_pct / 100
    main = np.diag(device.sensitivity)
    S = main[:, None] * random.uniform(-limit, limit, (3, 3))
    np.fill_diagonal(S, main)
    return replace(device, sensitivity=S)
