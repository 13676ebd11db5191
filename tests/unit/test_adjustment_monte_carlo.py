"""The stated uncertainty against JCGM 101: distributions propagated by trials, with nothing of the estimator in them.

One session is taken; in every trial the recorded points get new noise, every prior estimate (angles, offsets, lag, g)
is drawn anew, and a general-purpose optimiser fits the points themselves to Eqs. (8)-(11). The scatter of what it finds
is the uncertainty, and must be the one that the adjustment states from a single solution.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from calib.adjustment.adjustment import adjust
from calib.estimate.nuisances import Priors
from tests.clamp_windows import ALPHAS_DEG, G_MPS2, Q_TRUE, S_TRUE, Faults, clamp_points, frame

DEGREE = np.deg2rad(1.0)
U_ANGLE, U_THETA, U_OFFSET, U_LAG, U_G, NOISE = 0.2 * DEGREE, 0.2 * DEGREE, 0.05, 0.02, 0.03, 0.01
CYCLES, RATE_HZ, FREQUENCY_HZ, REPETITIONS = 8, 30.0, 3.0, 1
POSITIONS = len(ALPHAS_DEG)
TRIALS = 100
PRIOR_U = np.concatenate([[U_THETA, U_LAG, U_G], np.full(POSITIONS, U_ANGLE), np.full(3 * POSITIONS, U_OFFSET)])


def _points(x: np.ndarray) -> np.ndarray:
    """Indications of all points, from S, Q, theta, lag, g, alphas and offsets in x."""
    S, Q = x[:9].reshape(3, 3), x[9:12]
    theta, lag, g = x[12:15]
    alphas, offsets = x[15 : 15 + POSITIONS], x[15 + POSITIONS :].reshape(POSITIONS, 3)
    t = np.arange(round(CYCLES * RATE_HZ / FREQUENCY_HZ)) / RATE_HZ
    u = 10.0 * np.sin(2.0 * np.pi * FREQUENCY_HZ * (t - lag))
    out = []
    for alpha_deg, alpha, offset in zip(ALPHAS_DEG, alphas, offsets, strict=True):
        d, e = frame(np.deg2rad(35.0) + theta, np.deg2rad(alpha_deg) + alpha)
        out.append((np.outer(u, d) + (G_MPS2 + g) * e) @ S.T + Q + offset)
    return np.concatenate(out)


@pytest.mark.slow
def test_the_stated_covariance_is_that_of_trials():
    random = np.random.default_rng(20)
    session = clamp_points(random, Faults(noise_mps2=NOISE), repetitions=REPETITIONS, rate_hz=RATE_HZ, cycles=CYCLES)
    priors = Priors(
        angle_rad=U_ANGLE, theta_rad=U_THETA, alpha_common_rad=0.0, offset_mps2=U_OFFSET, reference=0.0, transverse=0.0,
        gravity_mps2=U_G, lag_s=U_LAG, lag_axis_s=0.0,
    )  # fmt: skip
    stated = adjust(session.windows, priors)
    start = np.concatenate([S_TRUE.ravel(), Q_TRUE, np.zeros(len(PRIOR_U))])
    trials = []
    for _ in range(TRIALS):
        V = session.V + NOISE * random.normal(size=session.V.shape)
        expected = PRIOR_U * random.normal(size=len(PRIOR_U))

        def residual(x, V=V, expected=expected):
            return np.concatenate([((_points(x) - V) / NOISE).ravel(), (x[12:] - expected) / PRIOR_U])

        scale = np.concatenate([np.full(12, 1e-2), PRIOR_U])
        trials.append(optimize.least_squares(residual, start, x_scale=scale, method="lm").x[:12])
    sd = np.std(trials, axis=0, ddof=1)
    # 99.9 % chi-squared band of an SD over 100 trials, Bonferroni over 12: +-30 %. S_zx and S_zy are all type A, known
    # from 28 degrees of freedom to 13 %; the others hardly have any.
    ratio = sd / stated.calibration.standard_uncertainty
    assert np.all((ratio > 0.70) & (ratio < 1.30)), ratio
    correlation = np.corrcoef(np.array(trials).T)
    u = stated.calibration.standard_uncertainty
    # The SD of a correlation coefficient near zero over 100 trials is 0.1: four of them over 66 pairs.
    np.testing.assert_allclose(correlation, stated.calibration.covariance / np.outer(u, u), rtol=0, atol=0.40)
