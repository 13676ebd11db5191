"""Derivatives of windows must not follow a random walk: S_k / (1 + r) would tell r by what S has walked.

A smaller r makes all steps of S smaller, and so the largest posterior density prefers it, however little the windows
tell of r. Ten years of windows moved the main sensitivities by 4 to 7 u. Here S walks by 1 % between two windows and
the reference is known to 2 %, so that 40 windows show as much.
"""

from __future__ import annotations

import numpy as np
import pytest

from calib.estimate.estimate import estimate
from calib.estimate.nuisances import Priors
from calib.estimate.statements import Statements
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Pose
from calib.windows.record import Record
from tests.drawn_records import UP, Truth, template, told

WINDOWS, STEP, U_REFERENCE = 40, 0.01, 0.02
MEAN = np.append(np.eye(3).ravel(), np.zeros(3))
U = np.append(np.full(9, 0.1), np.full(3, 1.0))
WALK = Wander(dict.fromkeys(Wander.none().values, 0.0) | {"sensitivity": STEP})
PRIORS = Priors.none().with_values({"reference": U_REFERENCE, "offset_mps2": 0.01})
MAIN = [0, 4, 8]


def walked(seed: int) -> tuple[list[Record], np.ndarray]:
    """Windows a day apart of an S that walks beside a reference that is wrong, and S at the end."""
    random = np.random.default_rng(seed)
    own = template(Pose("p", np.eye(3), UP))
    S, wrong, records = np.eye(3), U_REFERENCE * random.normal(size=3), []
    for day in range(WINDOWS):
        S = S + STEP * random.normal(size=(3, 3))
        mean_noise = 0.01 * random.normal(size=3)
        records.append(told(own, Truth(S, np.zeros(3), reference=wrong), float(day), mean_noise=mean_noise))
    return records, S


@pytest.mark.slow
def test_s_is_not_moved_by_what_it_has_walked() -> None:
    z = []
    for seed in range(8):
        records, S = walked(seed)
        now = estimate(records, Statements(MEAN, U, {"": PRIORS}, WALK, TemperatureModel())).now
        u = np.sqrt(now.variance[:9])
        z.append(((now.mean[:9] - S.ravel()) / u)[MAIN])
        assert u[0] > 0.7 * U_REFERENCE
    # 24 values of variance 1: their mean has an SD of 0.2. Derivatives at each S_k move it to -1.7.
    assert abs(np.mean(z)) < 3.5 / np.sqrt(np.size(z))
