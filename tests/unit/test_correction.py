"""The corrected stream: its values, its uncertainty against Monte Carlo, temperature, and its way into a file."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from agent.core.events import Acceleration
from agent.recording.messages import decode, encode, schema_of, topic_of
from calib.estimate.correction import Law, calibration_part, corrected
from calib.model import Calibration

S = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
Q = np.array([0.36, -0.06, 0.165])


def calibration(covariance: np.ndarray) -> Calibration:
    return Calibration(S, Q, covariance, np.ones(12, dtype=bool), np.inf, "test")


def covariance(seed: int, size: int = 12, u: float = 1e-3) -> np.ndarray:
    root = u * np.random.default_rng(seed).normal(size=(size, size))
    return root @ root.T


def test_it_gives_back_what_was_felt() -> None:
    a = np.random.default_rng(1).normal(size=(50, 3))
    found = corrected(a @ S.T + Q, calibration(covariance(1)), np.full(3, 0.02))
    np.testing.assert_allclose(found.acceleration, a, rtol=0, atol=1e-14)
    # Every inverse row of S has a length near one.
    np.testing.assert_allclose(found.noise, 0.02, rtol=0.03)


def test_the_calibrations_part_is_what_trials_scatter_by() -> None:
    random, sigma, a = np.random.default_rng(2), covariance(2), np.array([0.3, -0.2, 9.8])
    V, root, trials = S @ a + Q, np.linalg.cholesky(sigma), 20_000
    drawn = random.normal(size=(trials, 12)) @ root.T
    found = [np.linalg.solve(S + d[:9].reshape(3, 3), V - Q - d[9:]) for d in drawn]
    # An SD over 20,000 trials is known to 0.5 %; second order in u = 4e-3 puts in as little.
    np.testing.assert_allclose(np.cov(np.array(found).T), calibration_part(a, calibration(sigma)), rtol=0, atol=3e-5)
    assert np.diag(calibration_part(a, calibration(sigma))).min() > 5e-4


def test_at_rest_s_and_q_know_of_each_other() -> None:
    # The mean output under gravity is known to 1 mm/s2, S_iz to 1 %: only their covariance says the first.
    u_mean, u_s, g = 1e-3, 0.01, np.array([0.0, 0.0, 9.80665])
    sigma = np.zeros((12, 12))
    for i in range(3):
        column, offset = 3 * i + 2, 9 + i
        sigma[column, column] = u_s**2
        sigma[offset, offset] = (u_s * g[2]) ** 2 + u_mean**2
        sigma[column, offset] = sigma[offset, column] = -(u_s**2) * g[2]
    whole = np.sqrt(np.diag(calibration_part(g, calibration(sigma))))
    alone = np.sqrt(np.diag(calibration_part(g, calibration(np.diag(np.diag(sigma))))))
    np.testing.assert_allclose(whole, 1e-3, rtol=0.05)
    assert alone.min() > 0.1


def test_over_temperature_each_power_and_each_element_has_its_part() -> None:
    c, per_k = np.array([[0.01, -0.02, 0.005], [1e-4, 0.0, -1e-4]]), 1e-4 * np.arange(-4.0, 5.0).reshape(3, 3)
    mean = np.concatenate([S.ravel(), Q, c.ravel(), per_k.ravel()])
    law = Law(mean, covariance(3, 27, 1e-4), 2, True, 20.0, 10.0, 30.0, 1e-3)
    there = law.at(25.0)
    np.testing.assert_allclose(there.sensitivity, S + 5 * per_k, rtol=1e-15)
    np.testing.assert_allclose(there.offset, Q + 5 * c[0] + 25 * c[1], rtol=1e-15)
    # Its covariance by differences: every part moved by itself.
    step, columns = 1e-6, []
    for k in range(27):
        moved = mean.copy()
        moved[k] += step
        other = Law(moved, law.covariance, 2, True, 20.0, 10.0, 30.0, 1e-3).at(25.0)
        columns.append(np.append(other.sensitivity.ravel(), other.offset))
    base = np.append(there.sensitivity.ravel(), there.offset)
    jacobian = (np.array(columns) - base).T / step
    np.testing.assert_allclose(there.covariance, jacobian @ law.covariance @ jacobian.T, rtol=1e-6, atol=1e-12)


def test_beyond_the_range_it_grows_less_sure() -> None:
    law = Law(np.append(S.ravel(), Q), covariance(4), 0, False, 20.0, 10.0, 30.0, 1e-3)
    inside, outside = (law.at(t).standard_uncertainty[9:] for t in (30.0, 40.0))
    np.testing.assert_allclose(outside**2 - inside**2, (1e-3 * 10**2) ** 2, rtol=1e-9)
    unseen = Law(np.append(S.ravel(), Q), covariance(4))
    np.testing.assert_array_equal(unseen.at(90.0).covariance, covariance(4))
    np.testing.assert_array_equal(unseen.at(float("nan")).covariance, covariance(4))


def test_at_no_temperature_told_it_is_as_uncertain_as_the_range() -> None:
    per_k = np.array([0.01, -0.02, 0.0])
    law = Law(np.concatenate([S.ravel(), Q, per_k]), 1e-10 * np.eye(15), 1, False, 20.0, 5.0, 35.0)
    nowhere = law.at(float("nan"))
    np.testing.assert_array_equal(nowhere.offset, Q)
    # At an end, 15 K away, Q is another by so much; of the coefficients' own 1e-5 a K another 15e-5.
    np.testing.assert_allclose(nowhere.standard_uncertainty[9:], [0.15, 0.3, 1.5e-4], rtol=5e-3)


@given(n=st.integers(1, 40), seed=st.integers(0, 2**32 - 1))
def test_a_block_comes_back_from_the_wire_bit_for_bit(n: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    block = Acceleration(
        sensor="s", t_utc_ns=5, first_index=7, rate_hz=999.7, acceleration=random.normal(size=(n, 3)),
        covariance=random.normal(size=(3, 3)), noise=random.random(3), determined=random.random(12) > 0.5,
        calibration_run_id="r", calibration_sequence=9, dynamic_only=True, recorded=True,
        suspect=np.array([False, True, False]),
    )  # fmt: skip
    number, back = decode(schema_of(topic_of(block)), encode(3, block))
    assert number == 3
    assert isinstance(back, Acceleration)
    for name in Acceleration.__slots__:
        np.testing.assert_array_equal(getattr(back, name), getattr(block, name))
