"""The plan of the next stop: what it promises is what the adjustment then tells, and it finds short ways."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from agent.bench.session import BenchSession
from agent.bench.stops import on_clamp, on_faces, turned_by_hand
from benchmarks.guided import AMPLITUDE_MPS2, NOISE_MPS2, OFFSET_MPS2, RATE_HZ, STAY_S, User, priors
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.visit.next_stop import MAIN, Expected, JointCovariance, Plan, WantedUncertainty
from calib.visit.stop_order import ALL_SETS, StopSets

ANGLE = float(np.deg2rad(0.2))
ALPHAS_DEG = tuple(range(0, 360, 15))
STATED = priors(OFFSET_MPS2, theta_rad=ANGLE, angle_rad=ANGLE, lag_s=0.02)
TWO = on_clamp((35.0, 55.0), ALPHAS_DEG, STANDARD_GRAVITY_MPS2, 1)
TRIAD = turned_by_hand(np.eye(3), STANDARD_GRAVITY_MPS2)


def _session(stops, stated, wanted=None):
    """A session whose motion is known beforehand, as the live reference shows it."""
    rms_mps2 = AMPLITUDE_MPS2 / np.sqrt(2.0) if stops[0].pose.direction.shape[1] == 1 else 0.0
    return BenchSession(
        stops, stated, wanted or WantedUncertainty(), expected=Expected(rms_mps2, NOISE_MPS2, STAY_S * RATE_HZ)
    )


@pytest.mark.slow
def test_the_promise_is_what_the_adjustment_tells():
    """The covariance after six stops, foretold at the S that was found; offsets scatter less than stated."""
    user, session, stops = User.drawn(3, 0.5 * OFFSET_MPS2), _session(TWO, STATED), []
    for _ in range(6):
        stops.append(session.suggestion().stop)
        session.take([*session.windows, user.on_clamp(TWO[stops[-1]])])
    foretold = JointCovariance.before(STATED)
    foretold.mean[:12] = session.joint.mean[:12]
    for stop in stops:
        foretold = session.plan.after(foretold, stop, session.expected)
    for group in (MAIN, ~MAIN):
        worst = session.joint.expanded[group].max()
        np.testing.assert_allclose(foretold.expanded[group], session.joint.expanded[group], atol=0.05 * worst)


def test_the_first_promise_of_a_stop_is_its_information():
    """With S known exactly but for one element, one stop tells it as a scalar regression does."""
    plan, session = Plan([s.pose for s in TWO], priors(0.0)), BenchSession(TWO, priors(0.0), WantedUncertainty())
    after = plan.after(session.joint, 0, session.expected)
    white = session.expected.noise_mps2 / np.sqrt(session.expected.points)
    d, g = TWO[0].pose.direction[:, 0] * session.expected.rms_mps2, TWO[0].pose.gravity_mps2
    rows = np.vstack([np.append(d, 0.0), np.append(g, 1.0)]) / white  # S_xx, S_xy, S_xz, Q_x
    before = np.diag(1.0 / np.array([0.1, 0.03, 0.03, 20.0]) ** 2)
    expected = np.sqrt(np.diag(np.linalg.inv(before + rows.T @ rows)))[:3]
    np.testing.assert_allclose(after.expanded[:3], 2.0 * expected, rtol=1e-6)


@pytest.mark.slow
def test_two_inclinations_need_few_stops_and_one_does_not_get_there():
    two = _session(TWO, STATED)
    assert two.outlook().stops == 8
    assert _session(TWO, STATED, WantedUncertainty(5e-4, 1.0)).outlook().stops <= 5
    one = BenchSession(on_clamp((35.0,), ALPHAS_DEG, STANDARD_GRAVITY_MPS2, 1), STATED, WantedUncertainty()).outlook()
    assert one.stops is None
    assert one.best[0] == pytest.approx(1.2e-3, rel=0.05)


def test_a_common_alpha_is_a_floor_and_is_named():
    stated = priors(OFFSET_MPS2, theta_rad=ANGLE, angle_rad=ANGLE, alpha_common_rad=0.5 * ANGLE)
    told = BenchSession(TWO, stated, WantedUncertainty()).outlook()
    assert told.stops is None
    assert told.because == "alpha"
    assert told.floor[1] == pytest.approx(2.0 * 0.5 * ANGLE, rel=0.02)  # a rotation by u turns S by u


@pytest.mark.slow
@pytest.mark.parametrize(("offset_mps2", "most"), [(0.0025, 5), (0.005, 16)])
def test_rests_beside_a_triad(offset_mps2, most):
    told = BenchSession(TRIAD, priors(offset_mps2), WantedUncertainty(5e-4, 1.0)).outlook()
    assert told.stops is not None
    assert told.stops <= most
    # N rests spread evenly: u(S_ij) = u(offset) / g sqrt(3 / N); no set of N is better for the worst of the three
    assert told.best[0] >= 2.0 * offset_mps2 / STANDARD_GRAVITY_MPS2 * np.sqrt(3.0 / told.stops)


def test_four_rests_are_a_tetrahedron_and_what_is_said_of_more_rests_follows_from_few_degrees_of_freedom():
    """N rests spread evenly: u = s / g sqrt(3 / N). From five rests on, the scatter that is seen may be larger."""
    told = _session(TRIAD, priors(0.0025), WantedUncertainty(5e-4, 1.0)).outlook()
    s_mps2 = np.hypot(0.0025, NOISE_MPS2 / np.sqrt(STAY_S * RATE_HZ))
    even = [2.0 * s_mps2 / STANDARD_GRAVITY_MPS2 * np.sqrt(3.0 / n) for n in range(1, 20)]
    assert told.stops == 4
    assert told.best[0] == pytest.approx(even[3], rel=1e-3)
    seen = [np.sqrt(chi2.ppf(0.95, 3 * n - 12) / (3 * n - 12)) for n in range(5, 20)]
    assert told.mostly == 5 + next(k for k, factor in enumerate(seen) if factor * even[4 + k] <= 5e-4) == 7


@pytest.mark.slow
def test_the_set_of_stops_is_the_best_of_all():
    """Of all sets of three stops on the clamp, and of the sets of four to which exchanges lead: tried one by one."""
    session = _session(TWO[::4], STATED, WantedUncertainty(5e-4, 1.0))
    together = StopSets(session.plan, session.joint, session.expected, session.wanted)
    for count, all_sets in ((3, ALL_SETS), (4, 0)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("calib.visit.stop_order.ALL_SETS", all_sets)
            _, found = together.best(range(count))
        costs = []
        for some in itertools.combinations(range(len(TWO[::4])), count):
            joint = session.joint
            for stop in some:
                joint = session.plan.after(joint, stop, session.expected)
            costs.append(float(session.wanted.cost(joint.expanded)))
        assert float(session.wanted.cost(found)) == pytest.approx(min(costs), rel=1e-3)


def test_six_faces_are_repeated_where_offsets_scatter():
    """U of a main sensitivity is at best 2 u / (g sqrt(2)) by the two faces of an axis, whatever the angles."""
    stated = priors(0.0025, angle_rad=ANGLE)
    told = BenchSession(on_faces(STANDARD_GRAVITY_MPS2), stated, WantedUncertainty(3e-4, 1.0)).outlook()
    assert told.stops is not None
    assert 6 < told.stops <= 12


@pytest.mark.slow
def test_wrong_turns_are_noticed_and_named_and_right_ones_are_not_called_wrong():
    for seed in range(1):
        user, session = User.drawn(seed, OFFSET_MPS2), BenchSession(TWO, STATED, WantedUncertainty())
        for known, off_deg in enumerate((45.0, -45.0, 180.0, 15.0)):
            stop = session.suggestion().stop
            wrong = session.fit(stop, user.on_clamp(TWO[stop], off_deg))
            assert not wrong.fits
            assert wrong.instead is not None
            away = TWO[wrong.instead].columns["alpha_deg"] - TWO[stop].columns["alpha_deg"] - off_deg
            assert abs((away + 180.0) % 360.0 - 180.0) <= (1.0 if known else 15.0)  # before any S, the one beside it
            right = user.on_clamp(TWO[stop])
            assert session.fit(stop, right).fits
            session.take([*session.windows, right])


@pytest.mark.slow
def test_a_sensor_that_came_loose_from_its_triad_is_noticed():
    user, session = User.drawn(5, 0.0025), BenchSession(TRIAD, priors(0.0025), WantedUncertainty(5e-4, 1.0))
    for _ in range(4):
        session.take([*session.windows, user.beside_triad(TRIAD[session.suggestion().stop])])
    stop = session.suggestion().stop
    assert session.fit(stop, user.beside_triad(TRIAD[stop])).fits
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    loose = User(user.random, user.S @ turned, user.Q, 0.0, {}, user.offset_mps2)
    found = session.fit(stop, loose.beside_triad(TRIAD[stop]))
    assert not found.fits
    assert found.instead is None


def test_what_is_wanted_is_the_only_measure():
    """With S wanted no better than it is, nothing is needed."""
    assert BenchSession(TWO, STATED, WantedUncertainty(1.0, 1.0)).outlook().stops == 0
    assert not WantedUncertainty(5e-4, 1.0).reached(np.where(MAIN, 6e-4, 0.0))


@pytest.mark.thorough
def test_a_first_stop_that_was_wrong_is_found_by_the_later_ones():
    """A turn of 15 deg at the first stop, where S is not known yet, looks possible; a later stop finds it by name."""
    user, session = User.drawn(0, OFFSET_MPS2), _session(TWO, STATED)
    first = session.suggestion().stop
    window = replace(user.on_clamp(TWO[first], 15.0), start_s=-1.0)
    for _ in range(5):
        session.take([*session.windows, window])
        stop = session.suggestion().stop
        window = user.on_clamp(TWO[stop])
        if (found := session.fit(stop, window).earlier) is not None:
            break
    assert found is not None
    start_s, instead = found
    away = TWO[instead].columns["alpha_deg"] - TWO[first].columns["alpha_deg"]
    assert (start_s, away % 360.0) == (-1.0, 15.0)
