"""The rows of windows: their derivatives by every unknown against central differences of what they predict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.estimate.nuisances import Priors
from calib.estimate.quantities import REFERENCE_DRIFT, TEMPERATURE, WALK
from calib.estimate.rows import BESIDE, CORRECTION, LAGS, OFFSETS, TYPE_A, UNSEEN, NoiseScores, Rows, TemperatureSpread
from calib.estimate.statements import Statements, Step
from calib.estimate.unknowns import Unknowns
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Pose
from calib.windows.record import Record
from tests.clamp_windows import G_MPS2, frame
from tests.drawn_records import template

MOTION, FALLS = frame(np.deg2rad(35.0), np.deg2rad(30.0))
ASKEW = np.array([[0.98, 0.1, 0.02], [-0.1, 0.99, 0.05], [0.01, -0.06, 1.0]])
OBLIQUE = np.array([0.5, -1.0, 9.7])
POSES = {
    "a clamp": Pose("p", MOTION[:, None], G_MPS2 * FALLS, np.deg2rad(35.0), np.deg2rad(30.0)),
    "a stated direction": Pose("p", np.array([[0.6], [0.0], [0.8]]), OBLIQUE),
    "motion along gravity": Pose("p", OBLIQUE[:, None] / np.linalg.norm(OBLIQUE), OBLIQUE),
    "three axes": Pose("p", ASKEW, OBLIQUE),
    "three axes that are AC-coupled": Pose("p", np.hstack([ASKEW, ASKEW]), OBLIQUE),
    "at rest": Pose("p", np.zeros((3, 0)), OBLIQUE),
}
TURNS = ("rotation", "gravity_", "direction", "theta", "alpha", "lean", "tilt")
ALL = {name: 1e-3 for name, value in Priors().values.items() if not name.startswith(("response", "known", "corner"))}
DRIFT = Step(0.5, {"Sxy_rate": 1e-4, "Szz_rate": 1e-4})


def everything() -> Priors:
    stated = Priors.none().with_values(ALL | {"reference_share": 0.2, "lag_window_s": 0.0})
    return stated.with_response((1.0, 8.0)).with_values({"response": 0.5, "known_size": 0.1})


def records(pose: Pose) -> list[Record]:
    """Two of them on one day, of unlike temperature; what the response adds to their slopes is drawn."""
    random, own = np.random.default_rng(2), template(pose, (1.0, 2.0, 3.0, 0.1, 0.2, 0.3), noise=0.01)
    powers = np.arange(2, 2 + len(own.passed))
    units = 1.0 / (powers * (2.0 * np.pi * 8.0) ** powers)  # as of a low-pass filter at 8 Hz
    moved = random.normal(size=own.passed.shape) / units[:, None, None]
    told = random.normal(size=(3, len(powers) + 1)) / np.append(units, 1.0)
    own = replace(own, passed=moved, mean_x=0.1 * random.normal(size=own.mean_x.shape), told=told, response=(1e-5,))
    return [
        replace(
            own, day=1.0, days=(1.0, 1.0), temperature_degc=degc, over_t=np.array([[1.0, degc, degc**2]]), behind_k=1.5
        )
        for degc in (5.0, 40.0)
    ]


def test_each_share_is_in_the_covariance_and_the_covariance_is_in_the_shares() -> None:
    """A merged record of a fixed mount beside one axis, without a temperature, has all that makes slopes and means
    scatter. The shares of quantities that move with its rows add up to all of their squares."""
    direction, told = np.array([[0.6], [0.0], [0.8]]), np.array([[0.62], [0.0], [np.sqrt(1.0 - 0.62**2)]])
    own = replace(
        template(Pose("p", direction, OBLIQUE), (1.0,), noise=0.01), windows=10, days=(0.0, 6.0), day=3.0,
        attenuation=0.02, u_lag_s=1e-3, temperature_degc=np.nan, excited=told @ told.T,
    )  # fmt: skip
    priors = Priors.none().with_values(
        {"lag_s": 0.01, "lag_window_s": 1e-3, "offset_mps2": 0.05, "transverse": 0.1, "reference_drift": 0.01}
    )
    stated = Statements(
        np.append(2.0 * np.eye(3).ravel(), np.zeros(3)), np.full(12, 0.1), {"": priors},
        Wander(sensitivity=1e-3, offset_mps2=0.01), TemperatureModel(1, 1), held_mps2=OBLIQUE,
    )  # fmt: skip
    spread = TemperatureSpread((-20.0, 20.0), np.full((2, 3), 1e-3), np.full((3, 3), 1e-3))
    unknowns = Unknowns(stated, [own])
    rows = Rows(unknowns, [own], np.array([3.0]), [NoiseScores()], spread)
    (made,) = rows.at(unknowns.prior[0][None], unknowns.prior[0][None])
    gains = np.random.default_rng(4).normal(size=(len(made), 5))
    shares = rows.shares([gains])
    assert set(shares) == {
        TYPE_A, LAGS, CORRECTION, UNSEEN, BESIDE, OFFSETS, WALK, TEMPERATURE, REFERENCE_DRIFT.source,
    }  # fmt: skip
    total = (gains**2).sum(axis=0)
    assert all((share > 1e-9 * total).all() for share in shares.values()), shares
    np.testing.assert_allclose(sum(shares.values()), total, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", POSES)
def test_derivatives_are_those_of_what_is_predicted(name: str) -> None:
    own, random = records(POSES[name]), np.random.default_rng(3)
    stated = Statements(
        np.append(2.0 * np.eye(3).ravel(), np.zeros(3)), np.full(12, 0.1), {"": everything()}, Wander(),
        TemperatureModel(2, 1), steps=[DRIFT],
    )  # fmt: skip
    unknowns = Unknowns(stated, own)
    mean, u = unknowns.prior
    turns = np.array([key.startswith(TURNS) for key in unknowns.at])
    # A turn is added to the left of the one before: where that is none, both are the same sum.
    x = mean + np.where(turns, 0.0, np.minimum(u, 0.1)) * random.normal(size=len(mean))
    x[:9] += 0.1 * random.normal(size=9)
    spread = TemperatureSpread((0.0, 0.0), np.zeros((2, 3)))
    rows = Rows(unknowns, own, np.array([0.25, 0.25]), [NoiseScores(), NoiseScores()], spread)

    def at(values: np.ndarray) -> list[np.ndarray]:
        return rows.at(np.tile(values, (2, 1)), np.tile(values, (2, 1)))

    linear = np.array([key.startswith("response") for key in unknowns.at])
    step = np.where(linear, 0.1, np.clip(1e-4 * u, 1e-6, 1e-5))
    found, told = at(x), np.zeros(len(x), dtype=bool)
    for k, size in enumerate(step):
        ahead, behind = at(x + size * np.eye(len(x))[k]), at(x - size * np.eye(len(x))[k])
        for window in range(2):
            expected = (behind[window][:, -1] - ahead[window][:, -1]) / (2.0 * size)
            largest = np.abs(expected).max()
            np.testing.assert_allclose(
                found[window][:, k], expected, rtol=0, atol=2e-6 * largest + 1e-9, err_msg=list(unknowns.at)[k]
            )
            told[k] |= largest > 0.0
    silent = {key for key, tells in zip(unknowns.at, told, strict=True) if not tells}
    nothing = ("centre",) if own[0].channels == 6 else ("centre", "corner")  # the integrals of the motion tell a corner
    assert all(key.endswith(nothing) for key in silent), silent
