"""The stated U of each unknown is right: it is drawn from what is stated of it, and the error is compared with u.

An estimate is so nearly linear in what is drawn that one solution for each drawn value tells how far one standard
deviation of it moves the error. The draws are then products with this matrix, as many as one likes: the mean of z^2
over all draws is the sum of the squares of its columns over u^2. Each case names the draw that makes at least 80 % of
the variance, so that a variance 1.5 times too large or too small moves the mean by 0.27 and more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from calib.estimate.estimate import Now, estimate
from calib.estimate.nuisances import Priors
from calib.estimate.statements import Dated, Statements, Step
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import PARAMETERS, Array, Pose
from calib.signal.response import ResponseModel
from calib.state.thinning import merged
from calib.windows.record import Record
from tests.clamp_windows import G_MPS2, frame
from tests.drawn_records import UP, Truth, scatter, template, told

NEAR = 0.03  # of the mean of z^2: squares of what is drawn, and 1e-3 of the variance that the noise makes
SHARE = 0.8
DRAWS, SURELY = 1000, 3.29  # of a sum of squares, and its band of 99.9 % in standard deviations
SCALE = 2.5  # output unit per m/s2
S0, Q0 = SCALE * np.eye(3), np.array([0.2, -0.1, 0.4])
STILL = dict.fromkeys(Wander.none().values, 0.0)
MAIN, ACROSS, OFFSET = ["Sxx", "Syy", "Szz"], ["Sxy", "Syz", "Szx"], ["Qx", "Qy", "Qz"]
BESIDE = template(Pose("p", np.eye(3), UP))
LEVEL = template(Pose("p", np.eye(3), np.zeros(3)))  # of a sensor that does not feel gravity
DIRECTION = np.array([0.6, 0.0, 0.8])
ALONG = template(Pose("p", DIRECTION[:, None], UP))
Weights = Mapping[str, float]


class Drawn:
    """Standard normal values by the name of what is drawn: all 0, or 1 at one place."""

    def __init__(self, at: tuple[str, int] | None = None) -> None:
        self.at, self.sizes = at, dict[str, int]()

    def __call__(self, name: str, size: int = 3) -> Array:
        self.sizes[name] = size
        return np.eye(size)[self.at[1]] if self.at is not None and self.at[0] == name else np.zeros(size)


@dataclass
class World:
    """What is stated, and what was drawn: windows, and the values `now` of unknowns by key.

    `u`: of S, and of Q, before any data. `told_by`: what makes the variance of each of `directions`, which are weights
    by key. `until`: the day at which it is asked for; None is that of the last window.
    """

    told_by: str
    directions: Sequence[Weights]
    records: Sequence[Record]
    now: Mapping[str, float]
    u: tuple[float, float]
    priors: Mapping[str, Any] = field(default_factory=dict)
    walks: dict[str, float] = field(default_factory=dict)
    temperature: TemperatureModel = field(default_factory=TemperatureModel)
    until: float | None = None
    more: Mapping[str, object] = field(default_factory=dict)  # statements

    def solved(self) -> Now:
        mean, u = np.append(S0.ravel(), Q0), np.append(np.full(9, self.u[0]), np.full(3, self.u[1])) * SCALE
        priors = {"": replace(Priors.none(), **self.priors)}
        stated = Statements(mean, u, priors, Wander(STILL | self.walks), self.temperature, **self.more)  # type: ignore[arg-type]
        now = estimate(self.records, stated).now
        return now if self.until is None else now.passed_to(self.until)

    def errors(self) -> tuple[Array, Array]:
        """Of the directions: the errors, and their standard uncertainties."""
        now = self.solved()
        wrong, along = now.mean.copy(), np.zeros((len(self.directions), len(now)))
        for key, value in self.now.items():
            wrong[now.index(key)] -= value
        for row, weights in zip(along, self.directions, strict=True):
            for key, weight in weights.items():
                row[now.index(key)] = weight
        return along @ wrong, np.linalg.norm(along @ now.factor, axis=1)


def each(*keys: str) -> list[Weights]:
    return [{key: 1.0} for key in keys]


def values(S: Array, Q: Array) -> dict[str, float]:
    return dict(zip(PARAMETERS, [*S.ravel().tolist(), *Q.tolist()], strict=True))


def s_and_q(draw: Drawn, u: tuple[float, float]) -> tuple[Array, Array]:
    return S0 + SCALE * u[0] * draw("S", 9).reshape(3, 3), Q0 + SCALE * u[1] * draw("Q")


CASES: dict[str, Callable[[Drawn], World]] = {}


def case(world: Callable[[Drawn], World]) -> Callable[[Drawn], World]:
    CASES[world.__name__] = world
    return world


# --- S and Q: what was known before, walks, rates, steps, dates


@case
def s_of_a_data_sheet(draw: Drawn) -> World:
    u = 0.002, 0.01
    S, Q = s_and_q(draw, u)
    record = told(LEVEL, Truth(S, Q, reference=0.05 * draw("reference")), 0.0)
    return World("S", each(*MAIN), [record], values(S, Q), u, {"reference": 0.05})


@case
def q_of_a_data_sheet(draw: Drawn) -> World:
    u = 0.02, 0.01
    S, Q = s_and_q(draw, u)
    record = told(BESIDE, Truth(S, Q, turn_gravity_rad=0.05 * draw("lean")), 0.0)
    return World("Q", each("Qx", "Qy"), [record], values(S, Q), u, {"gravity_direction_rad": 0.05})


def walked(draw: Drawn, name: str, start: Array, mean: Array | float, u: float, walk: float, days: float) -> Array:
    """After some days of a random walk that is held near its mean, with a variance of u^2 in the long run."""
    kept = np.exp(-0.5 * walk**2 * days / u**2)
    return np.asarray(
        mean + kept * (start - mean) + u * np.sqrt(1.0 - kept**2) * draw(name, start.size).reshape(start.shape)
    )


@case
def s_walks(draw: Drawn) -> World:
    u = 0.05, 0.01
    S, Q = s_and_q(draw, u)
    later = walked(draw, "walk", S, S0, SCALE * 0.05, SCALE * 2e-4, 400.0)
    records = [told(LEVEL, Truth(S, Q), 0.0)]
    return World("walk", each(*PARAMETERS[:9]), records, values(later, Q), u, {}, {"sensitivity": 2e-4}, until=400.0)


@case
def s_has_walked_as_far_as_it_is_held(draw: Drawn) -> World:
    u = 0.01, 0.01
    S, Q = s_and_q(draw, u)
    later = walked(draw, "walk", S, S0, SCALE * 0.01, SCALE * 1e-3, 150.0)
    records = [told(LEVEL, Truth(S, Q), 0.0)]
    return World("walk", each(*PARAMETERS[:9]), records, values(later, Q), u, {}, {"sensitivity": 1e-3}, until=150.0)


@case
def q_walks(draw: Drawn) -> World:
    u = 0.01, 0.5
    S, Q = s_and_q(draw, u)
    later = walked(draw, "walk", Q, Q0, SCALE * 0.5, SCALE * 0.02, 300.0)
    records = [told(BESIDE, Truth(S, Q), 0.0)]
    return World("walk", each(*OFFSET), records, values(S, later), u, {}, {"offset_mps2": 0.02}, until=300.0)


@case
def s_walks_between_windows(draw: Drawn) -> World:
    """In the gap between two windows that tell S, seen from the second: its own walk since the first, told by both."""
    u, noise = (0.05, 0.01), 0.02 * SCALE
    S, Q = s_and_q(draw, u)
    later = walked(draw, "walk", S, S0, SCALE * 0.05, SCALE * 5e-4, 100.0)
    loud = replace(LEVEL, noise=np.full(3, noise * np.abs(LEVEL.root).max()))
    errors = loud.noise[0] * np.sign(np.diag(LEVEL.root))[:, None] * draw("noise", 18).reshape(6, 3)
    records = [told(LEVEL, Truth(S, Q), 0.0), told(loud, Truth(later, Q), 100.0, slope_noise=errors)]
    return World("walk", each(*MAIN), records, values(later, Q), u, {}, {"sensitivity": 5e-4})


@case
def a_tilt_walks_at_a_mount_that_never_turns(draw: Drawn) -> World:
    """The mean output moves by gravity times the tilt: it stands in the place of Q."""
    u = 0.01, 0.5
    S, Q = s_and_q(draw, u)
    moved = SCALE * 1e-4 * G_MPS2 * np.sqrt(100.0) * draw("tilt")
    held = replace(BESIDE, excited=np.eye(3))
    now = values(S, S @ UP + Q + moved)
    more = {"held_mps2": UP}
    records = [told(held, Truth(S, Q), 0.0)]
    return World("tilt", each(*OFFSET), records, now, u, {}, {"tilt_rad": 1e-4}, until=100.0, more=more)


@case
def q_drifts(draw: Drawn) -> World:
    u = 0.01, 0.5
    S, Q = s_and_q(draw, u)
    rate = SCALE * 1e-3 * draw("rate")
    records = [told(BESIDE, Truth(S, Q), 30.0)]
    walks, now = {"offset_rate_mps2": 1e-3}, values(S, Q + 100.0 * rate)
    return World("rate", each(*OFFSET), records, now, u, {}, walks, until=130.0)


@case
def the_drift_of_q_walks(draw: Drawn) -> World:
    """Day by day: the mean rate of each day moves Q on this day. Two windows told the rate of the beginning."""
    u, days, walk, most = (0.01, 0.5), 20, 1e-4, 1e-3
    S, Q = s_and_q(draw, u)
    rate = SCALE * most * draw("rate")
    records = [told(BESIDE, Truth(S, Q), 0.0), told(BESIDE, Truth(S, Q + 1.0 * rate), 1.0)]
    kept = np.exp(-0.5 * walk**2 / most**2)
    moved, later = draw("walk", 3 * days).reshape(days, 3), Q + rate
    for each_day in moved:
        before, rate = rate, kept * rate + SCALE * most * np.sqrt(1.0 - kept**2) * each_day
        later = later + 0.5 * (before + rate)
    walks = {"offset_rate_mps2": most, "offset_rate_walk_mps2": walk}
    return World("walk", each(*OFFSET), records, values(S, later), u, {}, walks, until=1.0 + days)


@case
def a_step(draw: Drawn) -> World:
    u = 0.01, 0.5
    S, Q = s_and_q(draw, u)
    wide = {"Syy": 0.1 * SCALE, "Qz": 2.0 * SCALE}
    before = told(BESIDE, Truth(S, Q), 0.0)
    moved = values(S, Q)
    moved |= {
        key: moved[key] + size * float(step) for (key, size), step in zip(wide.items(), draw("step", 2), strict=True)
    }
    return World("step", each(*wide), [before], moved, u, until=9.0, more={"steps": [Step(5.0, wide)]})


@case
def a_step_before_the_first_window(draw: Drawn) -> World:
    u = 0.002, 0.01
    S, Q = s_and_q(draw, u)
    S = S + np.diag([0.0, 0.01 * SCALE, 0.0]) * draw("step", 1)
    record = told(LEVEL, Truth(S, Q, reference=0.1 * draw("reference")), 5.0)
    more = {"steps": [Step(3.0, {"Syy": 0.01 * SCALE})]}
    return World("step", each("Syy"), [record], values(S, Q), u, {"reference": 0.1}, more=more)


@case
def long_after_a_step(draw: Drawn) -> World:
    """The centre about which S and Q walk has moved with the step: what is far from it is what the walk made."""
    u, days = (0.01, 0.05), 400.0
    S, Q = s_and_q(draw, u)
    step = SCALE * 0.2 * draw("step", 1)
    at_step = walked(draw, "before", S, S0, SCALE * 0.01, SCALE * 1e-3, 1.0) + step * np.diag([0.0, 1.0, 0.0])
    later = walked(draw, "walk", at_step, S0 + step * np.diag([0.0, 1.0, 0.0]), SCALE * 0.01, SCALE * 1e-3, days)
    records = [told(LEVEL, Truth(S, Q), 0.0), told(LEVEL, Truth(at_step, Q), 1.0)]
    more = {"steps": [Step(1.0, {"Syy": 0.2 * SCALE})]}
    return World(
        "walk", each("Sxx", "Szz"), records, values(later, Q), u, {}, {"sensitivity": 1e-3}, until=1.0 + days, more=more
    )


@case
def s_drifts_since_a_step(draw: Drawn) -> World:
    """A drift that was found: from the day of the step on S has an unknown rate. The next window tells nothing of S."""
    u = 0.001, 0.01
    S, Q = s_and_q(draw, u)
    later = S + np.diag([0.0, SCALE * 1e-3 * 100.0, 0.0]) * draw("rate", 1)
    more = {"steps": [Step(float(np.nextafter(0.0, 1.0)), {"Syy_rate": SCALE * 1e-3})]}
    still = replace(LEVEL, root=0.0 * LEVEL.root)
    records = [told(LEVEL, Truth(S, Q), 0.0), told(still, Truth(later, Q), 100.0)]
    return World("rate", each("Syy"), records, values(later, Q), u, more=more)


def correlated(size: int, seed: int) -> Array:
    return np.asarray(np.linalg.cholesky(np.cov(np.random.default_rng(seed).normal(size=(size, 5 * size)))), np.float64)


def dated(draw: Drawn, held: Array | None) -> World:
    """A calibration that an operator put in force, of which all parameters are correlated."""
    u, ways = (0.5, 20.0), 1e-3 * SCALE * correlated(12, 3)
    found = np.append(S0.ravel(), Q0)
    now = found + ways @ draw("calibration", 12)
    S, Q = now[:9].reshape(3, 3), now[9:]
    more: dict[str, object] = {"dated": [Dated(1.0, found, ways @ ways.T)]}
    if held is not None:
        more["held_mps2"], Q = held, S @ held + Q
    return World("calibration", each(*PARAMETERS), [], values(S, Q), u, more=more)


@case
def a_calibration_that_was_put_in_force(draw: Drawn) -> World:
    return dated(draw, None)


@case
def a_calibration_that_was_put_in_force_at_a_mount_that_never_turns(draw: Drawn) -> World:
    return dated(draw, UP)


# --- the reference


@case
def the_reference(draw: Drawn) -> World:
    u = 0.1, 0.01
    S, Q = s_and_q(draw, u)
    record = told(LEVEL, Truth(S, Q, reference=0.01 * draw("reference")), 0.0)
    return World("reference", each(*MAIN), [record], values(S, Q), u, {"reference": 0.01})


@case
def a_reference_has_drifted_since_its_certificate(draw: Drawn) -> World:
    u = 0.1, 0.01
    S, Q = s_and_q(draw, u)
    record = told(LEVEL, Truth(S, Q, reference=0.005 * 2.0 * draw("drift")), 0.0)
    more = {"certified": {"A": -4.0 * 365.25}}
    return World("drift", each(*MAIN), [record], values(S, Q), u, {"reference_drift": 0.005}, more=more)


@case
def a_reference_drifts_between_windows(draw: Drawn) -> World:
    """S may have walked by any amount meanwhile, so that the second window alone tells it."""
    u = 0.5, 0.01
    S, Q = s_and_q(draw, u)
    days = 7.305
    later = walked(draw, "walk", S, S0, SCALE * 0.5, SCALE * 0.01, days)
    drift = 0.005 * np.sqrt(days / 365.25) * draw("drift")
    records = [told(LEVEL, Truth(S, Q), 0.0), told(LEVEL, Truth(later, Q, reference=drift), days)]
    more = {"certified": {"A": 0.0}}
    return World(
        "drift", each(*MAIN), records, values(later, Q), u, {"reference_drift": 0.005}, {"sensitivity": 0.01}, more=more
    )


@case
def the_rotation_of_the_reference(draw: Drawn) -> World:
    u = 0.1, 0.01
    S, Q = s_and_q(draw, u)
    record = told(LEVEL, Truth(S, Q, turn_rad=0.005 * draw("rotation")), 0.0)
    on = [{"Sxy": 1.0, "Syx": -1.0}, {"Syz": 1.0, "Szy": -1.0}, {"Sxz": 1.0, "Szx": -1.0}]
    return World("rotation", on, [record], values(S, Q), u, {"rotation_rad": 0.005})


@case
def the_lag(draw: Drawn) -> World:
    """The lag of a window varies between windows: what is stated of the lag tells more than one of them."""
    u = 0.1, 0.01
    S, Q = s_and_q(draw, u)
    lag = -0.003 + 1e-3 * draw("lag", 1)
    record = told(LEVEL, Truth(S, Q, lag_s=np.repeat(lag + 0.003 + 0.01 * draw("window", 1), 3)), 0.0)
    priors = {"lag_s": 1e-3, "lag_at_s": -0.003, "lag_window_s": 0.01}
    now = values(S, Q) | {"lag of A": float(lag[0])}
    return World("lag", each("lag of A"), [replace(record, lag_s=-0.003)], now, u, priors)


@case
def the_lags_of_the_axes(draw: Drawn) -> World:
    u = 0.1, 0.01
    S, Q = s_and_q(draw, u)
    lag, axes = 2e-3 * draw("lag", 1), 1e-4 * draw("axes")
    record = told(LEVEL, Truth(S, Q, lag_s=lag + axes), 0.0)
    now = values(S, Q) | {"lag of A": float(lag[0])}
    return World("axes", each("lag of A"), [record], now, u, {"lag_s": 2e-3, "lag_axis_s": 1e-4})


@case
def the_mean_of_motion_that_is_late(draw: Drawn) -> World:
    """The slopes tell the lag: so the mean of du/dt, which moves the output by the lag, makes no error."""
    u, own = (1e-4, 5.0), replace(BESIDE, mean_x=np.array([0.1, -0.2, 0.3, 2.0, -1.0, 3.0]))
    S, Q = s_and_q(draw, u)
    late = np.repeat(2e-4 * draw("lag", 1), 3)
    record = told(own, Truth(S, Q, lag_s=late), 0.0, mean_noise=SCALE * 1e-3 * draw("offset"))
    return World("offset", each(*OFFSET), [record], values(S, Q), u, {"lag_s": 2e-4, "offset_mps2": 1e-3})


# --- the pose


@case
def gravity(draw: Drawn) -> World:
    u = 1e-4, 5.0
    S, Q = s_and_q(draw, u)
    record = told(BESIDE, Truth(S, Q, gravity_mps2=0.03 * float(draw("gravity", 1)[0])), 0.0)
    return World("gravity", each("Qz"), [record], values(S, Q), u, {"gravity_mps2": 0.03})


@case
def the_lean_beside_a_reference_of_three_axes(draw: Drawn) -> World:
    u = 1e-4, 5.0
    S, Q = s_and_q(draw, u)
    record = told(BESIDE, Truth(S, Q, turn_gravity_rad=0.005 * draw("lean")), 0.0)
    return World("lean", each("Qx", "Qy"), [record], values(S, Q), u, {"gravity_direction_rad": 0.005})


@case
def the_lean_walks(draw: Drawn) -> World:
    """It may become twice as large as it is stated of the day of mounting. Q has walked as well."""
    u, lean, walk, days = (1e-4, 0.005), 0.005, 1e-3, 200.0
    S, Q = s_and_q(draw, u)
    start = lean * draw("lean")
    later = walked(draw, "walk", start, 0.0, 2.0 * lean, walk, days)
    drift = np.sqrt(days) * 0.5 * SCALE * draw("offset")
    records = [
        told(BESIDE, Truth(S, Q, turn_gravity_rad=start), 0.0),
        told(BESIDE, Truth(S, Q + drift, turn_gravity_rad=later), days),
    ]
    priors, walks = {"gravity_direction_rad": lean}, {"offset_mps2": 0.5, "tilt_rad": walk}
    return World("walk", each("Qx", "Qy"), records, values(S, Q + drift), (u[0], 100.0), priors, walks)


@case
def the_lean_beside_a_reference_of_one_axis(draw: Drawn) -> World:
    u = 1e-4, 5.0
    S, Q = s_and_q(draw, u)
    record = told(ALONG, Truth(S, Q, turn_gravity_rad=0.005 * draw("lean")), 0.0)
    return World("lean", each("Qx", "Qy"), [record], values(S, Q), u, {"lean_rad": 0.005})


@case
def the_tilt_of_a_table(draw: Drawn) -> World:
    u, positions = (1e-4, 5.0), ("a", "b")
    S, Q = s_and_q(draw, u)
    pitch, roll = 0.005 * draw("tilt", 2)
    across = np.cross(UP, DIRECTION) / np.linalg.norm(np.cross(UP, DIRECTION))
    turned = pitch * across + roll * DIRECTION
    records = [
        told(template(replace(ALONG.pose, position=p)), Truth(S, Q, turn_gravity_rad=turned), 0.0) for p in positions
    ]
    return World("tilt", each("Qx", "Qy"), records, values(S, Q), u, {"tilt_rad": 0.005})


@case
def offsets_by_position(draw: Drawn) -> World:
    u, poses = (1e-4, 5.0), [Pose(name, np.eye(3), way) for name, way in (("a", UP), ("b", -UP))]
    S, Q = s_and_q(draw, u)
    moved = SCALE * 0.02 * draw("offsets", 6).reshape(2, 3)
    records = [
        told(template(pose), Truth(S, Q + own), float(k))
        for k, (pose, own) in enumerate(zip(poses, moved, strict=True))
    ]
    return World("offsets", each("Qx", "Qy"), records, values(S, Q), u, {"offset_position_mps2": 0.02})


THETA, ALPHA = np.deg2rad(35.0), np.deg2rad(30.0)
MOTION, FALLS = frame(THETA, ALPHA)
CLAMPED = Pose("a", MOTION[:, None], G_MPS2 * FALLS, THETA, ALPHA)
STATED = Pose("a", DIRECTION[:, None], UP)
TURNS: dict[str, tuple[str, bool, Pose, Array]] = {  # the prior, whether it is common to all positions, the axes
    "theta_of_a_clamp": ("theta_rad", True, CLAMPED, np.cross(FALLS, MOTION)[None]),
    "theta_by_position": ("theta_position_rad", False, CLAMPED, np.cross(FALLS, MOTION)[None]),
    "alpha_of_a_clamp": ("alpha_common_rad", True, CLAMPED, np.array([[0.0, 0.0, -1.0]])),
    "alpha_by_position": ("angle_rad", False, CLAMPED, np.array([[0.0, 0.0, -1.0]])),
    "stated_directions": ("alpha_common_rad", True, STATED, np.eye(3)),
    "stated_directions_by_position": ("angle_rad", False, STATED, np.eye(3)),
}


def turned(draw: Drawn, prior: str, common: bool, pose: Pose, axes: Array) -> World:
    """Motion and gravity turn together, in two positions with the same motion."""
    u, size = (0.1, 5.0), len(axes)
    S, Q = s_and_q(draw, u)
    angles = 0.003 * (np.tile(draw("turn", size), 2) if common else draw("turn", 2 * size)).reshape(2, size)
    records = [
        told(template(replace(pose, position=name)), Truth(S, Q, turn_rad=own @ axes, turn_gravity_rad=own @ axes), 0.0)
        for name, own in zip("ab", angles, strict=True)
    ]
    motion = pose.direction[:, 0]
    ways = [np.cross(axis, motion) for axis in axes]
    on = [output_along(way / np.linalg.norm(way), motion) for way in ways]
    return World("turn", on, records, values(S, Q), u, {prior: 0.003})


def output_along(way: Array, motion: Array) -> Weights:
    """The component of S times the motion, by the elements of S."""
    return dict(zip(PARAMETERS[:9], np.outer(way, motion).ravel().tolist(), strict=True))


CASES |= {name: partial(turned, prior=p, common=c, pose=pose, axes=axes) for name, (p, c, pose, axes) in TURNS.items()}


@case
def motion_that_one_axis_does_not_measure(draw: Drawn) -> World:
    u = 0.1, 0.01
    S, Q = s_and_q(draw, u)
    vertical = np.cross(DIRECTION, [0.0, 1.0, 0.0])
    way = 0.01 * draw("motion", 2) @ np.array([[0.0, 1.0, 0.0], vertical])
    on = [output_along(np.array(way), DIRECTION) for way in ([0.0, 1.0, 0.0], vertical)]
    return World("motion", on, [told(ALONG, Truth(S, Q, across=way), 0.0)], values(S, Q), u, {"transverse": 0.01})


@case
def motion_ahead_that_one_axis_does_not_measure(draw: Drawn) -> World:
    """It looks as if the axes had different lags."""
    u = 0.1, 0.01
    S, Q = s_and_q(draw, u)
    vertical = np.cross(DIRECTION, [0.0, 1.0, 0.0])
    ahead, lag = 1e-3 * draw("motion", 1) * vertical, 2e-3 * draw("lag", 3)
    now = values(S, Q) | {"lag_z of A": float(lag[2]), "lag_x of A": float(lag[0])}
    on = [{"lag_z of A": 1.0, "lag_x of A": -1.0}]
    record = told(ALONG, Truth(S, Q, ahead=ahead, lag_s=lag), 0.0)
    return World("motion", on, [record], now, u, {"transverse": 1e-3, "lag_axis_s": 2e-3})


# --- frequency and temperature


@case
def the_response_between_motion_and_gravity(draw: Drawn) -> World:
    """ln h = sum of c_k (i omega)^k. S holds at 5 Hz; gravity sees S / |h(5 Hz)|, of which a fifth is the reference's,
    and of the sensor's known filters 0.1 of ln |h|."""
    u = 1e-4, 50.0
    S, Q = s_and_q(draw, u)
    stated_by = {"response": 0.02, "reference_frequency_hz": 5.0, "reference_share": 0.2, "known_size": 0.1}
    powers = np.arange(2, 7)
    terms = 0.02 / (powers * (2.0 * np.pi * 8.0) ** powers) * draw("response", 5)
    log_h = float((terms * (2.0j * np.pi * 5.0) ** powers).sum().real)
    at_0hz = S * np.exp(-0.8 * log_h - 0.1)
    own = replace(told(BESIDE, Truth(S, Q), 0.0), means=(at_0hz @ UP + Q)[None])
    still = replace(own, root=0.0 * own.root, slopes=0.0 * own.slopes, passed=0.0 * own.passed)
    model = {"response_model": ResponseModel(8.0)}
    return World("response", each("Qz"), [still], values(S, Q), u, stated_by | model)


@case
def q_over_temperature(draw: Drawn) -> World:
    u = 1e-4, 5.0
    S, Q = s_and_q(draw, u)
    by_k = SCALE * np.array([[0.01], [2e-4]]) * draw("law", 6).reshape(2, 3)
    moved = np.array([30.0, 900.0]) @ by_k
    model = TemperatureModel(2, 0, 20.0, (0.01, 2e-4))
    return World(
        "law", each(*OFFSET), [told(BESIDE, Truth(S, Q + moved), 0.0, degc=50.0)], values(S, Q), u, temperature=model
    )


@case
def s_over_temperature(draw: Drawn) -> World:
    u = 0.1, 0.01
    S, Q = s_and_q(draw, u)
    hot = S * (1.0 + 30.0 * 2e-4 * draw("law"))[:, None]
    model = TemperatureModel(0, 1, 20.0, (0.01, 2e-4), 2e-4)
    return World("law", each(*MAIN), [told(LEVEL, Truth(hot, Q), 0.0, degc=50.0)], values(S, Q), u, temperature=model)


@case
def a_temperature_that_nobody_told(draw: Drawn) -> World:
    """It was one end or the other of those before; Q, which has walked, is told by this window alone."""
    u, by_k = (1e-4, 50.0), SCALE * np.array([0.05, -0.02, 0.03])
    S, Q = s_and_q(draw, u)
    later = Q + SCALE * 0.5 * np.sqrt(10.0) * draw("walk")
    seen = [told(BESIDE, Truth(S, Q + by_k * (degc - 20.0)), 0.0, degc=degc) for degc in (10.0, 30.0)]
    last = told(BESIDE, Truth(S, later + by_k * 10.0 * draw("temperature", 1)), 10.0)
    last = replace(last, temperature_degc=np.nan, over_t=np.array([[1.0, 0.0, 0.0]]))
    model = TemperatureModel(1, 0, 20.0, (0.1, 0.0))
    now = values(S, later) | dict(zip(("Qx_T1", "Qy_T1", "Qz_T1"), by_k.tolist(), strict=True))
    return World("temperature", each(*OFFSET), [*seen, last], now, u, {}, {"offset_mps2": 0.5}, model)


# --- what belongs to a window alone


def noisy(ratio: float = 1.0, freedom: float = 1e4) -> Record:
    """Its white noise makes 2 % of S, and its residuals scatter so many times more than white ones."""
    return replace(LEVEL, noise=np.full(3, 0.02 * SCALE * abs(LEVEL.root[0, 0])), scores=scatter(ratio, freedom))


@case
def noise_of_the_slopes(draw: Drawn) -> World:
    """Residuals that scatter twice as much as white ones, and of which a filter leaves half independent."""
    u, own = (0.5, 0.01), replace(noisy(2.0), independent=0.5)
    S, Q = s_and_q(draw, u)
    record = told(own, Truth(S, Q), 0.0, slope_noise=own.noise * 2.0 * draw("noise", 18).reshape(6, 3))
    return World("noise", each(*PARAMETERS[:9]), [record], values(S, Q), u)


@case
def noise_of_the_slopes_pooled_over_windows(draw: Drawn) -> World:
    """The second window has three times the degrees of freedom of the first: together their ratio is 2.5."""
    u = 0.5, 0.01
    S, Q = s_and_q(draw, u)
    own = [noisy(1.0, 30.0), noisy(3.0, 90.0)]
    noise = draw("noise", 36).reshape(2, 6, 3) * own[0].noise * np.sqrt(2.5)
    records = [told(one, Truth(S, Q), 0.0, slope_noise=each_noise) for one, each_noise in zip(own, noise, strict=True)]
    return World("noise", each(*PARAMETERS[:9]), records, values(S, Q), u)


@case
def noise_of_the_mean(draw: Drawn) -> World:
    u, own = (1e-4, 50.0), replace(BESIDE, noise=np.array([1.0, 2.0, 3.0]), scores=scatter(3.0, 1e4), independent=0.5)
    S, Q = s_and_q(draw, u)
    errors = own.noise * np.sqrt(6.0 / own.count) * draw("noise")
    return World("noise", each(*OFFSET), [told(own, Truth(S, Q), 0.0, mean_noise=errors)], values(S, Q), u)


@case
def offsets_of_windows(draw: Drawn) -> World:
    u = 1e-4, 50.0
    S, Q = s_and_q(draw, u)
    errors = SCALE * 0.05 * draw("offsets", 6).reshape(2, 3)
    records = [told(BESIDE, Truth(S, Q), float(k), mean_noise=errors[k]) for k in range(2)]
    return World("offsets", each(*OFFSET), records, values(S, Q), u, {"offset_mps2": 0.05})


@case
def offsets_of_windows_that_were_merged(draw: Drawn) -> World:
    u, count = (1e-4, 50.0), 4
    S, Q = s_and_q(draw, u)
    errors = SCALE * 0.05 * draw("offsets", 3 * count).reshape(count, 3)
    records = [told(BESIDE, Truth(S, Q), 0.0, mean_noise=own) for own in errors]
    return World("offsets", each(*OFFSET), [merged(records, S0 / SCALE)], values(S, Q), u, {"offset_mps2": 0.05})


@case
def noise_of_windows_that_were_merged(draw: Drawn) -> World:
    """Of unlike noise, so that each counts by its own."""
    u = 0.5, 0.01
    S, Q = s_and_q(draw, u)
    own = [replace(noisy(), noise=times * noisy().noise) for times in (0.5, 1.0, 2.0)]
    noise = draw("noise", 54).reshape(3, 6, 3)
    records = [told(one, Truth(S, Q), 0.0, slope_noise=one.noise * more) for one, more in zip(own, noise, strict=True)]
    return World("noise", each(*PARAMETERS[:9]), [merged(records, S0)], values(S, Q), u)


@case
def noise_of_means_that_were_merged(draw: Drawn) -> World:
    u = 1e-4, 50.0
    S, Q = s_and_q(draw, u)
    own = [replace(BESIDE, noise=np.full(3, noise)) for noise in (0.5, 1.0, 2.0)]
    noise = draw("noise", 9).reshape(3, 3) / np.sqrt(BESIDE.count)
    records = [told(one, Truth(S, Q), 0.0, mean_noise=one.noise * more) for one, more in zip(own, noise, strict=True)]
    return World("noise", each(*OFFSET), [merged(records, S0)], values(S, Q), u)


@case
def a_walk_within_windows_that_were_merged(draw: Drawn) -> World:
    """Their mean differs from S and Q in the middle of their time, to which they are ascribed.

    The steps between `count` windows are so large that their mean walks as that of many windows.
    """
    u, count = (0.5, 50.0), 20
    S, Q = s_and_q(draw, u)
    steps = draw("walk", 2 * count).reshape(2, count) * np.array([[1e-4], [0.1]]) * SCALE * np.sqrt(10.0 / count)
    steps[:, [0, -1]] *= np.sqrt(0.5)  # from the middle to the windows on both sides
    half = count // 2
    path = np.hstack([np.cumsum(steps[:, :half], axis=1)[:, ::-1], np.cumsum(steps[:, half:][:, ::-1], axis=1)])
    records = []
    for k, (of_S, of_Q) in enumerate(path.T):
        truth = Truth(S + np.diag([0.0, of_S, 0.0]), Q + np.array([0.0, 0.0, of_Q]))
        records.append(told(BESIDE, truth, 10.0 * k / (count - 1)))
    walks = {"sensitivity": 1e-4, "offset_mps2": 0.1}
    return World("walk", each("Syy", "Qz"), [merged(records, S0)], values(S, Q), u, {}, walks)


@case
def a_reference_that_drifts_within_windows_that_were_merged(draw: Drawn) -> World:
    """S is known, so that they tell the drift in the middle of their time, but for what it walked before and after."""
    u, count, days = (1e-6, 0.01), 20, 100.0
    S, Q = s_and_q(draw, u)
    steps = draw("walk", 2 * count).reshape(2, count) * 0.005 * np.sqrt(days / 365.25 / count)
    steps[:, [0, -1]] *= np.sqrt(0.5)
    half = count // 2
    path = np.hstack([np.cumsum(steps[:, :half], axis=1)[:, ::-1], np.cumsum(steps[:, half:][:, ::-1], axis=1)])
    own = [told(LEVEL, Truth(S, Q, reference=np.append(w, 0.0)), days * k / (count - 1)) for k, w in enumerate(path.T)]
    first = told(replace(LEVEL, root=0.0 * LEVEL.root), Truth(S, Q), -10000.0)
    now = {"reference_drift_x of A": 0.0, "reference_drift_y of A": 0.0}
    return World("walk", each(*now), [first, merged(own, S0)], values(S, Q) | now, u, {"reference_drift": 0.005})


@case
def a_reference_that_drifts_from_the_first_of_windows_that_were_merged(draw: Drawn) -> World:
    """S is not known: it owes to the drift until the middle of their time, and nothing of it is known beforehand."""
    u, days = (0.5, 0.01), 100.0
    S, Q = s_and_q(draw, u)
    drifted = 0.005 * np.sqrt(0.5 * days / 365.25) * draw("drift")
    walk = 0.005 * np.sqrt(days / 12.0 / 365.25) * draw("within")
    record = told(LEVEL, Truth(S, Q, reference=drifted + walk), 0.5 * days)
    record = replace(record, days=(0.0, days), windows=40)
    return World("drift", each(*MAIN), [record], values(S, Q), u, {"reference_drift": 0.005})


@case
def the_lag_of_each_window(draw: Drawn) -> World:
    """The two clocks tell it to 0.1 ms, as stated, in the first window, and to 0.3 ms in the second."""
    u = 0.1, 0.01
    S, Q = s_and_q(draw, u)
    lag, late = 2e-4 * draw("lag", 1), np.array([1e-4, 3e-4]) * draw("windows", 2)
    own = replace(LEVEL, noise=np.full(3, 1e-2))  # a lag of 0.3 ms makes S smaller by 4e-6 as well
    records = [
        replace(told(own, Truth(S, Q, lag_s=np.repeat(lag + more, 3)), float(k)), u_lag_s=u_lag_s)
        for k, (more, u_lag_s) in enumerate(zip(late, (0.0, 3e-4), strict=True))
    ]
    now = values(S, Q) | {"lag of A": float(lag[0])}
    return World("windows", each("lag of A"), records, now, u, {"lag_s": 1.0, "lag_window_s": 1e-4})


@case
def the_noise_of_the_reference_that_was_subtracted(draw: Drawn) -> World:
    u = 0.5, 0.01
    S, Q = s_and_q(draw, u)
    record = told(LEVEL, Truth(S * (1.0 + 0.02 * float(draw("size", 1)[0])), Q), 0.0)
    return World("size", each(*MAIN), [replace(record, attenuation=0.02)], values(S, Q), u)


@case
def motion_along_an_axis_that_tells_nothing(draw: Drawn) -> World:
    """At a mount that never turns. Along x little moves, with the motion along y, and S there is known to 5 % only."""
    u = 0.05, 0.01
    S, Q = s_and_q(draw, u)
    askew = np.array([[0.0, 0.05, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    own = told(replace(LEVEL, root=np.diag([0.0, 1.0, 0.0, 0.0, 1.0, 0.0])), Truth(S, Q), 0.0)
    slopes = own.root @ np.vstack([(S @ askew).T, np.zeros((3, 3))])
    record = replace(own, slopes=slopes, along=askew, excited=np.diag([0.0, 1.0, 0.0]))
    return World("S", each("Sxy", "Syy", "Szy"), [record], values(S, Q), u, more={"held_mps2": np.zeros(3)})


SOME_AT_ONCE = [pytest.param(name, marks=pytest.mark.slow if k % 12 else ()) for k, name in enumerate(CASES)]


@pytest.mark.slow
@pytest.mark.parametrize("name", SOME_AT_ONCE)
def test_what_is_stated_is_what_the_error_is(name: str) -> None:
    world, draws = CASES[name], Drawn()
    own = world(draws)
    wrong, u = own.errors()
    np.testing.assert_allclose(wrong / u, 0.0, atol=0.02, err_msg="nothing was drawn, and there is an error")
    by = {
        drawn: np.array([(world(Drawn((drawn, k))).errors()[0] - wrong) / u for k in range(size)])
        for drawn, size in draws.sizes.items()
    }
    shares = {drawn: (moved**2).sum(axis=0) for drawn, moved in by.items()}
    total = np.sum(list(shares.values()), axis=0)
    np.testing.assert_allclose(total, 1.0, rtol=0, atol=NEAR, err_msg=str(shares))
    assert (shares[own.told_by] > SHARE).all(), shares
    z = np.random.default_rng(1).normal(size=(DRAWS, sum(draws.sizes.values()))) @ np.vstack(list(by.values()))
    assert np.abs((z**2).mean(axis=0) - 1.0).max() < SURELY * np.sqrt(2.0 / DRAWS)
