"""What a state says of U, against closed formulas: remounts, calibrations put in force, a fixed mount, chi-squared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from calib.estimate.estimate import estimate
from calib.estimate.nuisances import Priors
from calib.estimate.rows import NoiseScores, Rows, TemperatureSpread
from calib.estimate.statements import Dated, Statements, Step, Widening
from calib.estimate.unknowns import Unknowns
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import PARAMETERS, Calibration, Pose
from calib.signal.known_response import known_response_of
from calib.signal.response import FLAT
from calib.state.over_frequency import OverFrequency
from calib.state.state import State
from calib.windows.record import Record
from tests.clamp_windows import G_MPS2
from tests.drawn_records import UP, Truth, template, told

SCALE, U_S, U_Q = 2.5, 0.01, 5.0
S, Q = SCALE * np.eye(3), np.array([0.2, -0.1, 0.4])
MEAN = np.append(S.ravel(), Q)
U = SCALE * np.append(np.full(9, U_S), np.full(3, U_Q))
STILL = dict.fromkeys(Wander.none().values, 0.0)
BESIDE = template(Pose("p", np.eye(3), UP))
AT_REST = replace(BESIDE, root=0.0 * BESIDE.root, passed=0.0 * BESIDE.passed, mean_hz=0.0)


def state(
    priors: Mapping[str, float], *, fixed: bool = False, walks: Mapping[str, float] | None = None, unit: float = 1.0
) -> State:
    stated = Priors.none().with_values(priors)
    made = State(unit * MEAN, unit * U, stated, Wander({**STILL, **(walks or {})}), TemperatureModel(), fixed=fixed)
    made.meet("A")
    return made


def record(own: Record = BESIDE, day: float = 0.0, reference: str = "A") -> Record:
    return told(own, Truth(S, Q), day, reference=reference)


def test_what_was_mounted_again_differs_as_two_independent_values_do() -> None:
    found = state({"rotation_rad": 0.003, "gravity_direction_rad": 0.002, "gravity_mps2": 0.03})
    found.update(record())
    names = ("rotation_x", "gravity_x[p]", "gravity")
    before = [found.quantity(name)[1] for name in names]
    found.remount()
    after = [found.quantity(name)[1] for name in names]
    grown = np.sqrt(np.square(after) - np.square(before))
    np.testing.assert_allclose(grown, np.sqrt(2.0) * np.array([0.003, 0.002, 0.0]), rtol=1e-6, atol=1e-9)


def test_nuisances_that_come_after_a_calibration_was_put_in_force_are_as_doubtful_as_those_before() -> None:
    """Its errors may be theirs: the variances of both are doubled."""
    found = state({"gravity_direction_rad": 0.002, "offset_position_mps2": 0.02, "gravity_mps2": 0.03})
    found.update(record())
    covariance = np.diag((1e-3 * SCALE) ** 2 * np.ones(12))
    told_by = np.ones(12, dtype=bool)
    found.put(Calibration(S, Q, covariance, told_by, np.inf, "3"))
    np.testing.assert_allclose(found.result().covariance, 2.0 * covariance, rtol=1e-5, atol=1e-12)
    again = record(template(Pose("new", np.eye(3), -UP)), 1.0)
    new = {unknown.key: unknown.u for unknown in found._know(again)[1].unknowns.all}
    assert new["gravity_x[new]"] == pytest.approx(np.sqrt(2.0) * 0.002, rel=1e-12)
    assert new["offset_x[new]"] == pytest.approx(np.sqrt(2.0) * 0.02, rel=1e-12)
    assert new["gravity_x[p]"] == 0.002


def test_q_of_a_fixed_mount_is_the_mean_output_less_s_g_and_so_is_its_uncertainty() -> None:
    """The mount leans by 2 deg in the newest window, as stated: Q is the same."""
    found = state({}, fixed=True)
    leaning = G_MPS2 * np.array([0.035, 0.02, np.sqrt(1.0 - 0.035**2 - 0.02**2)])
    found.update(record(AT_REST))
    found.update(record(replace(AT_REST, pose=replace(AT_REST.pose, gravity_mps2=leaning), held_mps2=leaning), 0.5))
    now = found.result()
    np.testing.assert_allclose(now.offset, Q, rtol=0, atol=1e-6)
    np.testing.assert_allclose(now.sensitivity, S, rtol=0, atol=1e-9)
    np.testing.assert_allclose(now.standard_uncertainty[9:], SCALE * U_S * G_MPS2, rtol=1e-3)
    with_S = now.covariance[9 + 2, 8] / (now.standard_uncertainty[11] * now.standard_uncertainty[8])
    assert with_S == pytest.approx(-1.0, abs=1e-3)


def test_chi_squared_is_that_of_what_was_stated_and_seen() -> None:
    """Q of a prior, a walk over ten days, a step, and two windows whose offsets scatter: a covariance of two values."""
    walk, step, scatter, u = 0.1, 0.5, 0.05, 0.2
    own = replace(AT_REST, pose=Pose("p", np.eye(3), np.zeros(3)))
    records = [told(own, Truth(S, Q + by), day) for by, day in ((0.7, 0.0), (-0.4, 10.0))]
    priors = {"": Priors.none().with_values({"offset_mps2": scatter})}
    own_u, walks = np.append(U[:9], np.full(3, SCALE * u)), Wander(STILL | {"offset_mps2": walk})
    steps = [Step(5.0, {"Qy": SCALE * step})]
    stated = Statements(MEAN, own_u, priors, walks, TemperatureModel(), steps=steps)
    kept = np.exp(-0.5 * walk**2 * 10.0 / u**2)
    expected = 0.0
    for stepped in (0.0, step, 0.0):
        later = kept**2 * u**2 + u**2 * (1.0 - kept**2) + stepped**2 + scatter**2
        covariance = SCALE**2 * np.array([[u**2 + scatter**2, kept * u**2], [kept * u**2, later]])
        seen = np.array([0.7, -0.4])
        expected += float(seen @ np.linalg.solve(covariance, seen))
    found = estimate(records, stated)
    assert found.chi2 == pytest.approx(expected, rel=1e-4)


def test_a_window_that_is_taken_adds_to_chi_squared_what_it_is_off_its_prediction() -> None:
    """Three axes, each with an offset of the same prior whose windows scatter: a covariance of two values."""
    own, scatter = replace(AT_REST, pose=Pose("p", np.eye(3), np.zeros(3))), 0.05
    found, seen = state({"offset_mps2": scatter}), np.array([0.7, -0.4])
    for day, by in enumerate(seen):
        found.update(told(own, Truth(S, Q + by), float(day)))
    covariance = SCALE**2 * (scatter**2 * np.eye(2) + U_Q**2)
    assert found.chi2 == pytest.approx(3.0 * seen @ np.linalg.solve(covariance, seen), rel=1e-4)


@pytest.mark.parametrize("unit", [1e-9, 1e6])
def test_the_output_unit_does_not_matter(unit: float) -> None:
    """A sensor whose output is in nV, or in counts: all that is stated of S and Q is in proportion."""
    priors = {"reference": 0.01, "gravity_direction_rad": 0.003, "offset_mps2": 0.05, "lag_s": 0.01}
    walks = {"sensitivity": 1e-3, "offset_mps2": 0.01, "offset_rate_mps2": 1e-3, "offset_rate_walk_mps2": 1e-4}
    means, us = [], []
    for one in (1.0, unit):
        own = [record(replace(BESIDE, noise=np.full(3, 0.01)), float(day)) for day in (0, 3)]
        own = [replace(r, slopes=one * r.slopes, means=one * r.means, noise=one * r.noise) for r in own]
        flat = np.append(np.full(9, 0.02), np.full(3, np.inf)) * one * SCALE
        stated = {"": Priors.none().with_values(priors)}
        now = estimate(own, Statements(one * MEAN, flat, stated, Wander(STILL | walks), TemperatureModel())).now
        means.append(now.mean[:12] / one)
        us.append(np.sqrt(now.variance[:12]) / one)
    np.testing.assert_allclose(us[1], us[0], rtol=1e-6)
    np.testing.assert_allclose((means[1] - means[0]) / us[0], 0.0, atol=1e-5)


def test_a_window_at_another_time_than_its_epoch_has_what_drifted_meanwhile() -> None:
    statements = Statements(
        MEAN, U, {"": Priors.none()}, Wander(STILL | {"offset_rate_mps2": 1e-3}), TemperatureModel()
    )
    own = record(day=3.0)
    unknowns = Unknowns(statements, [own])
    x = unknowns.prior[0].copy()
    x[unknowns.at["Qz_rate"]] = 0.5

    def seen(epoch: float, values: np.ndarray) -> np.ndarray:
        spread = TemperatureSpread((0.0, 0.0), np.zeros((2, 3)))
        rows = Rows(unknowns, [own], np.array([epoch]), [NoiseScores()], spread)
        return np.asarray(rows.at(values[None], values[None])[0][:, -1])

    moved = x.copy()
    moved[PARAMETERS.index("Qz")] += 2.0 * 0.5
    np.testing.assert_allclose(seen(1.0, x), seen(3.0, moved), rtol=1e-9)
    assert not np.allclose(seen(3.0, x), seen(3.0, moved))


def test_a_dated_calibration_counts_once() -> None:
    """Beside a prior of the same weight the mean is in the middle, and the variance is half."""
    covariance = np.diag(U**2)
    dated = Dated(0.0, MEAN + 2.0 * U, covariance)
    stated = Statements(MEAN, U, {"": Priors.none()}, Wander(STILL), TemperatureModel(), dated=[dated])
    now = estimate([], stated).now
    np.testing.assert_allclose(now.mean[:12], MEAN + U, rtol=1e-9)
    np.testing.assert_allclose(now.variance[:12], 0.5 * U**2, rtol=1e-9)


def test_half_of_the_time_of_a_widened_walk_adds_half_of_its_variance() -> None:
    """The first window tells S, the second one, at rest, nothing of it."""
    variances = []
    for widened in ((), (Widening(0.0, 10.0, {"Sxx": 0.02}),)):
        stated = Statements(
            MEAN, U, {"": Priors.none()}, Wander(STILL), TemperatureModel(), widened=widened, held_mps2=UP
        )
        variances.append(estimate([record(), record(AT_REST, 5.0)], stated).now.variance[:9])
    np.testing.assert_allclose(variances[1] - variances[0], np.append(0.5 * 0.02**2, np.zeros(8)), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("left", "is_taken_out"), [(0.0029, True), (0.0031, False)])
def test_a_response_is_taken_out_if_less_than_0_3_per_cent_is_left_at_the_end_of_the_motion(
    left: float, is_taken_out: bool
) -> None:
    """Its terms are in units of those of a low-pass filter a tenth above the end of the motion: (i f / f0)^k / k."""
    size = abs(sum((1.0j / 1.1) ** k / k for k in range(2, 7)))
    over = OverFrequency(motion_hz=(1.0, 8.0), settled_hz=3.0)
    priors = over.stated(Priors.none()).with_values({"response": 1e-9, "response_at": left / size})
    now = estimate([record()], Statements(MEAN, U, {"": priors}, Wander(STILL), TemperatureModel())).now
    assert over.is_taken_out(FLAT, now, "A") == is_taken_out


@pytest.mark.parametrize(
    ("octaves", "is_another"), [((0.9, 0.3), False), ((-0.9, -0.3), False), ((1.1, 0.0), True), ((0.0, 0.37), True)]
)
def test_the_band_is_another_one_octave_below_or_a_third_above(octaves: tuple[float, float], is_another: bool) -> None:
    low_hz, high_hz = (float(hz * 2.0**by) for hz, by in zip((1.0, 8.0), octaves, strict=True))
    moving = replace(BESIDE, motion_hz=(low_hz, high_hz), mean_hz=2.0)
    found = OverFrequency(motion_hz=(1.0, 8.0), first_hz=2.0).begun(moving, [])
    assert found.motion_hz == ((low_hz, high_hz) if is_another else (1.0, 8.0))


def test_what_known_filters_leave_open_is_in_the_uncertainty_of_s() -> None:
    """At half the corner, |h| of a first order is (1 + 1/4)^-0.5, and changes by 0.2 % for each % of the corner. The
    data tell how much both filters attenuate together; what one of two alike has of it stays open by 1 / sqrt(2)."""
    filters = ["lowpass order=1 corner_hz=16 u_corner_pct=0.5"]
    priors = Priors.none().beside_known(known_response_of(filters, filters))
    now = estimate([record()], Statements(MEAN, U, {"": priors}, Wander(STILL), TemperatureModel())).now
    over = OverFrequency(first_hz=8.0, late_s=0.0)
    more = over.factor(now, "A", priors)[:12]
    grown = more @ more.T - now.factor[:12] @ now.factor[:12].T
    open_ = np.append(0.005 * 0.2 / np.sqrt(2.0) * S.ravel(), np.zeros(3))
    told = over.budget(now, "A", priors, np.eye(12, len(now)))["known filters"]
    np.testing.assert_allclose(told, open_**2, rtol=2e-2)
    np.testing.assert_allclose(grown, np.outer(open_, open_), rtol=2e-2, atol=1e-9)
