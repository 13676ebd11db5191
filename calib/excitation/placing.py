"""How a sensor stands, from its mean output under gravity: which of several known stops, or a clamp's angles.

At rest, and in the mean while it shakes, V = S G + Q, G being what an ideal sensor reads there. What is known of S and
Q (12 values with their covariance), of the angles, of gravity and of the offset's scatter says how near the mean must
be to S G + Q, and how well stops can be told apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.distributions import chi2_quantile
from calib.excitation.standing import MEAN_S, hann
from calib.geometry import clamp
from calib.model import Array, Calibration, Pose

SHORTEST_S = 4.0  # of data: what Hann's window leaves of a vibration of 2 s period is then 2.7 %
SLOWEST_HZ = 0.5
FALSE_REFUSALS = 1e-4  # sound windows refused
# Natural logarithm of the likelihood ratio to the next best stop. Of normal errors at most one in 10,000 leads to a
# wrong stop, whatever their distance: sqrt(2 ln 1000) = 3.7 standard uncertainties.
DECISIVE = float(np.log(1000.0))
# An angle found from the mean and Q must not count as told a second time beside the same mean and Q in the equations.
# The angle's prior in the adjustment is wider than what was found by this: one part in 100 is counted twice.
WIDER = 10.0
WIDEST_RAD = float(np.deg2rad(10.0))  # standard uncertainty of an angle; beyond, sines are no angles


@dataclass(frozen=True, slots=True, eq=False)
class MeanOutput:
    """Mean indication (3,) and the covariance (3, 3) of what vibration leaves in it, output unit."""

    value: Array
    covariance: Array


@dataclass(frozen=True, slots=True)
class Knowledge:
    """Standard uncertainties beside S and Q: of a stated angle (rad), of gravity (m/s2), of the offset (output unit)
    between windows."""

    angle_rad: float
    gravity_mps2: float
    offset: float


@dataclass(frozen=True, slots=True)
class Placed:
    """The pose found, or None with the reason; `numbers` are the statistics behind it, unit in the name."""

    pose: Pose | None
    reason: str
    numbers: dict[str, float]


def mean_output(indications: Array, rate_hz: float) -> MeanOutput | None:
    """Mean of indications (n, 3), Hann's weights; rows with NaN are left out. None for less than SHORTEST_S of them."""
    whole = np.isfinite(indications.sum(axis=1))
    duration_s = float(whole.sum()) / rate_hz
    if duration_s < SHORTEST_S:
        return None
    weights = np.where(whole, hann(len(indications)), 0.0)
    weights /= weights.sum()
    clean = np.where(whole[:, None], indications, 0.0)
    value = weights @ clean
    step = max(round(MEAN_S * rate_hz), 1)
    full = len(clean) // step * step
    blocks = np.where(whole[:, None], indications - value, 0.0)[:full].reshape(-1, step, 3).mean(axis=1)
    # Hann's window passes at most 1 / (pi x (x^2 - 1)) of an amplitude with x periods in it, at x = 2 a sidelobe more.
    x = max(SLOWEST_HZ * duration_s, 2.4)
    leakage = 1.0 / (np.pi * x * (x**2 - 1.0))
    return MeanOutput(value, leakage**2 * 2.0 * blocks.T @ blocks / len(blocks))


def nearest_stop(mean: MeanOutput, stops: Sequence[Pose], calibration: Calibration, knowledge: Knowledge) -> Placed:
    """The stop whose gravity the mean agrees with, decisively better than with any other one."""
    statistic = np.array([_statistic(mean, stop, calibration, knowledge) for stop in stops])
    order = np.argsort(statistic[:, 1], kind="stable")
    best = int(order[0])
    numbers = {"position_chi2": float(statistic[best, 0])}
    limit = chi2_quantile(1.0 - FALSE_REFUSALS, 3.0)
    if statistic[best, 0] > limit:
        reason = f"stands at none of the stated positions: nearest is {stops[best].position},"
        return Placed(None, f"{reason} chi-squared {statistic[best, 0]:.3g} where {limit:.3g} is the limit", numbers)
    if len(order) > 1:
        second = int(order[1])
        numbers["position_log_odds"] = float(0.5 * (statistic[second, 1] - statistic[best, 1]))
        if numbers["position_log_odds"] < DECISIVE:
            odds = float(np.exp(numbers["position_log_odds"]))
            reason = f"stands at {stops[best].position} or at {stops[second].position}, odds {odds:.3g} to 1"
            return Placed(None, f"{reason} where {np.exp(DECISIVE):.0f} to 1 are needed", numbers)
    return Placed(stops[best], "", numbers)


def clamp_angles(
    mean: MeanOutput,
    calibration: Calibration,
    knowledge: Knowledge,
    gravity: tuple[float, int],
    theta_rad: float | None,
    position: str,
) -> Placed:
    """Alpha, and theta where `theta_rad` does not state it, by the direction of gravity (Eqs. 9-11 at rest).

    `gravity` is (m/s2, static sign). Theta comes out from 0 to 90 deg: gravity does not tell which way the motion goes.
    The pose carries ten times the standard uncertainties found, see WIDER. Raises numpy.linalg.LinAlgError where S has
    no inverse.
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
    if (size - g) ** 2 > chi2_quantile(1.0 - FALSE_REFUSALS, 1.0) * variance:
        return Placed(None, f"reads {size:.4g} m/s2 in the mean where gravity is {g:.5g}", numbers)
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
        return Placed(None, f"the clamp leans by {np.degrees(found_theta):.4g} deg: static_sign is the other", numbers)
    if max(u_alpha, u_theta) > WIDEST_RAD:
        told = f"alpha to {np.degrees(u_alpha):.3g} deg, theta to {np.degrees(u_theta):.3g} deg"
        return Placed(None, f"gravity tells {told}; {np.degrees(WIDEST_RAD):.0f} deg are needed", numbers)
    if theta_rad is None:
        return Placed(_found(found_theta, alpha, gravity, position, u_alpha, u_theta), "", numbers)
    limit = chi2_quantile(1.0 - FALSE_REFUSALS, 1.0) * (u_theta**2 + knowledge.angle_rad**2)
    if (abs(theta_rad) - found_theta) ** 2 > limit:
        told = f"gravity leans by {np.degrees(found_theta):.4g} deg"
        return Placed(None, f"{told} where theta is {np.degrees(theta_rad):.4g} deg", numbers)
    alpha += np.pi if theta_rad < 0.0 else 0.0
    return Placed(_found(theta_rad, alpha, gravity, position, u_alpha, 0.0), "", numbers)


def _found(
    theta: float, alpha: float, gravity: tuple[float, int], position: str, u_alpha: float, u_theta: float
) -> Pose:
    pose = clamp(theta, alpha, *gravity, position)
    return Pose(position, pose.direction, pose.gravity_mps2, theta, alpha, WIDER * u_alpha, WIDER * u_theta)


def _statistic(mean: MeanOutput, stop: Pose, calibration: Calibration, knowledge: Knowledge) -> tuple[float, float]:
    """Chi-squared of the mean at a stop, and -2 ln likelihood."""
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
    """Covariance (3, 3) that S and Q put into the output under an acceleration (3,)."""
    J = np.hstack([np.kron(np.eye(3), acceleration), np.eye(3)])
    return np.asarray(J @ calibration.covariance @ J.T)


def _along(covariance: Array, direction: Array) -> float:
    return float(np.sqrt(direction @ covariance @ direction))
