"""The position of a sensor from its mean output under gravity: one of several known stops, or the angles of a clamp.

At rest, and in the mean during vibration, V = S G + Q, where G is what an ideal sensor reads at rest in that position.
The covariance of S and Q, and the standard uncertainties of the angles, of gravity and of the offset between windows,
give the uncertainty of S G + Q. Chi-squared compares the measured mean with it; the likelihood ratio compares stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.distributions import chi2_quantile
from calib.excitation.standing import MEAN_S, hann
from calib.geometry import clamp
from calib.model import Array, Calibration, Pose

SHORTEST_S = 4.0  # of data: Hann's window then leaves 2.7 % of a vibration with a period of 2 s in the mean
PERIODS = 2.0  # of the slowest vibration in the shortest data
FALSE_REFUSALS = 1e-4  # part of sound windows that is refused
# Natural logarithm of the likelihood ratio to the next best stop. With normally distributed errors at most one window
# in 10,000 gets a wrong stop, whatever the distance of the stops: sqrt(2 ln 1000) = 3.7 standard uncertainties.
DECISIVE = float(np.log(1000.0))
# The angle is found from the same mean and Q that the window equations use again. So that the information is not
# counted twice, the angle's prior in the adjustment gets its standard uncertainty times this factor: only one part in
# 100 of the information is then counted twice.
WIDER = 10.0
WIDEST_RAD = float(np.deg2rad(10.0))  # standard uncertainty of an angle; above it, sin(x) = x is too inaccurate


@dataclass(frozen=True, slots=True, eq=False)
class MeanOutput:
    """Mean indication `value` (3,) in output unit, and the covariance (3, 3) of its error that vibration causes."""

    value: Array
    covariance: Array


@dataclass(frozen=True, slots=True)
class PlacingUncertainty:
    """Standard uncertainties of a stated angle (rad), of gravity (m/s2), and of the offset between windows (output
    unit)."""

    angle_rad: float
    gravity_mps2: float
    offset: float


@dataclass(frozen=True, slots=True)
class Placed:
    """The pose that was found, or None with the reason; `numbers` are the statistics, each named with its unit."""

    pose: Pose | None
    reason: str
    numbers: dict[str, float]


def mean_output(indications: Array, rate_hz: float, shortest_s: float = SHORTEST_S) -> MeanOutput | None:
    """Mean of indications (n, 3), weighted by Hann's window; rows with NaN are left out.

    None if the other rows cover less than `shortest_s`. Vibration has periods of half of that at most.
    """
    whole = np.isfinite(indications.sum(axis=1))
    duration_s = float(whole.sum()) / rate_hz
    if duration_s < shortest_s:
        return None
    weights = np.where(whole, hann(len(indications)), 0.0)
    weights /= weights.sum()
    clean = np.where(whole[:, None], indications, 0.0)
    value = weights @ clean
    step = max(round(MEAN_S * rate_hz), 1)
    full = len(clean) // step * step
    blocks = np.where(whole[:, None], indications - value, 0.0)[:full].reshape(-1, step, 3).mean(axis=1)
    # Hann's window passes at most 1 / (pi x (x^2 - 1)) of the amplitude of a vibration with x periods in the window;
    # the lower limit of x also covers the first sidelobe.
    x = max(PERIODS * duration_s / shortest_s, 2.4)
    leakage = 1.0 / (np.pi * x * (x**2 - 1.0))
    return MeanOutput(value, leakage**2 * 2.0 * blocks.T @ blocks / len(blocks))


def nearest_stop(
    mean: MeanOutput, stops: Sequence[Pose], calibration: Calibration, knowledge: PlacingUncertainty
) -> Placed:
    """The stop of `stops` at which V = S G + Q agrees with the mean, and decisively better than at any other stop.

    The pose is None if the mean agrees with no stop, or with two stops almost equally well.
    """
    statistic = np.array([_statistic(mean, stop, calibration, knowledge) for stop in stops])
    order = np.argsort(statistic[:, 1], kind="stable")
    best = int(order[0])
    numbers = {"position_chi2": float(statistic[best, 0])}
    limit = chi2_quantile(1.0 - FALSE_REFUSALS, 3.0)
    if statistic[best, 0] > limit:
        reason = f"the sensor stands at none of the stated positions: the nearest is {stops[best].position}, with"
        return Placed(None, f"{reason} chi-squared {statistic[best, 0]:.3g}, the limit is {limit:.3g}", numbers)
    if len(order) > 1:
        second = int(order[1])
        numbers["position_log_odds"] = float(0.5 * (statistic[second, 1] - statistic[best, 1]))
        if numbers["position_log_odds"] < DECISIVE:
            odds = float(np.exp(numbers["position_log_odds"]))
            reason = f"the sensor stands at {stops[best].position} or at {stops[second].position}: the odds are"
            return Placed(None, f"{reason} {odds:.3g} to 1, {np.exp(DECISIVE):.0f} to 1 are needed", numbers)
    return Placed(stops[best], "", numbers)


def clamp_angles(
    mean: MeanOutput,
    calibration: Calibration,
    knowledge: PlacingUncertainty,
    gravity: tuple[float, int],
    theta_rad: float | None,
    position: str,
) -> Placed:
    """Alpha, and theta if `theta_rad` is None, from the direction of gravity (Eqs. 9-11 with a_ref = 0).

    `gravity` is (magnitude in m/s2, static sign as in calib.geometry.clamp). Theta is found between 0 and 90 deg: the
    direction of gravity does not depend on the sense of the motion. The pose gets ten times the standard uncertainties
    that were found (see WIDER). Raises numpy.linalg.LinAlgError if S has no inverse.
    """
    g, sign = gravity
    inverse = np.linalg.inv(calibration.sensitivity)
    a = inverse @ (mean.value - calibration.offset)
    covariance = inverse @ (mean.covariance + _calibration_part(a, calibration)) @ inverse.T
    covariance += knowledge.offset**2 * inverse @ inverse.T
    size = float(np.linalg.norm(a))
    along = a / max(size, np.finfo(float).tiny)
    numbers = {"found_gravity_mps2": size}
    variance = float(along @ covariance @ along) + knowledge.gravity_mps2**2
    limit = chi2_quantile(1.0 - FALSE_REFUSALS, 1.0) * variance
    if (size - g) ** 2 > limit:
        reason = f"the mean acceleration is {size:.4g} m/s2, gravity is {g:.5g} m/s2"
        return Placed(None, f"{reason}: they may differ by {np.sqrt(limit):.2g} m/s2 at most", numbers)
    e = sign * along
    found_theta, alpha = float(np.arctan2(np.hypot(e[0], e[1]), -e[2])), float(np.arctan2(-e[0], -e[1]))
    sin_a, cos_a, sin_t, cos_t = np.sin(alpha), np.cos(alpha), np.sin(found_theta), np.cos(found_theta)
    u_theta = _along(covariance, np.array([-cos_t * sin_a, -cos_t * cos_a, sin_t])) / g
    u_alpha = _along(covariance, np.array([-cos_a, sin_a, 0.0])) / (g * max(sin_t, np.finfo(float).tiny))
    numbers |= {
        "found_theta_deg": float(np.degrees(found_theta)), "u_found_theta_deg": float(np.degrees(u_theta)),
        "found_alpha_deg": float(np.degrees(alpha)), "u_found_alpha_deg": float(np.degrees(u_alpha)),
    }  # fmt: skip
    if cos_t <= 0.0:
        reason = f"gravity shows theta = {np.degrees(found_theta):.4g} deg, more than 90 deg"
        return Placed(None, f"{reason}: change the sign of static_sign", numbers)
    if max(u_alpha, u_theta) > WIDEST_RAD:
        told = f"u(alpha) = {np.degrees(u_alpha):.3g} deg and u(theta) = {np.degrees(u_theta):.3g} deg"
        return Placed(None, f"gravity gives only {told}; {np.degrees(WIDEST_RAD):.0f} deg is the limit", numbers)
    if theta_rad is None:
        return Placed(_clamp_pose(found_theta, alpha, gravity, position, u_alpha, u_theta), "", numbers)
    limit = chi2_quantile(1.0 - FALSE_REFUSALS, 1.0) * (u_theta**2 + knowledge.angle_rad**2)
    if (abs(theta_rad) - found_theta) ** 2 > limit:
        told = f"gravity shows theta = {np.degrees(found_theta):.4g} deg, {np.degrees(theta_rad):.4g} deg is stated"
        most = np.degrees(np.sqrt(limit))
        return Placed(None, f"{told}: they may differ by {most:.2g} deg at most", numbers)
    alpha += np.pi if theta_rad < 0.0 else 0.0
    return Placed(_clamp_pose(theta_rad, alpha, gravity, position, u_alpha, 0.0), "", numbers)


def _clamp_pose(
    theta: float, alpha: float, gravity: tuple[float, int], position: str, u_alpha: float, u_theta: float
) -> Pose:
    pose = clamp(theta, alpha, *gravity, position)
    return Pose(position, pose.direction, pose.gravity_mps2, theta, alpha, WIDER * u_alpha, WIDER * u_theta)


def _statistic(
    mean: MeanOutput, stop: Pose, calibration: Calibration, knowledge: PlacingUncertainty
) -> tuple[float, float]:
    """Chi-squared of the mean at a stop, and -2 ln of its likelihood (without the constant)."""
    S, G = calibration.sensitivity, stop.gravity_mps2
    size2 = float(G @ G)
    turned = knowledge.angle_rad**2 * (size2 * np.eye(3) - np.outer(G, G))
    stretched = knowledge.gravity_mps2**2 * np.outer(G, G) / max(size2, np.finfo(float).tiny)
    covariance = mean.covariance + _calibration_part(G, calibration) + S @ (turned + stretched) @ S.T
    covariance += knowledge.offset**2 * np.eye(3)
    off = mean.value - S @ G - calibration.offset
    chi2 = float(off @ np.linalg.solve(covariance, off))
    return chi2, chi2 + float(np.linalg.slogdet(covariance)[1])


def _calibration_part(acceleration: Array, calibration: Calibration) -> Array:
    """Covariance (3, 3) of S a + Q that is due to the uncertainty of S and Q, for an acceleration a (3,) in m/s2."""
    J = np.hstack([np.kron(np.eye(3), acceleration), np.eye(3)])
    return np.asarray(J @ calibration.covariance @ J.T)


def _along(covariance: Array, direction: Array) -> float:
    return float(np.sqrt(direction @ covariance @ direction))
