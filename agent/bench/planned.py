"""What the stated positions of a channel will tell, before they are taken: which of the 12 parameters, and to what U.

Computed as `fieldcal bench` plans its stops (calib.visit.next_stop), for the motion that it begins with. Whether a
first calibration comes of it is decided as the agent's gate decides it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.bench.session import START
from agent.bench.stops import CORNER, GRAVITY, BenchStop, on_clamp, on_faces, ways
from agent.config import Channel
from agent.config.pose import Stop as Stated
from agent.core.anchor import Anchor
from calib.estimate.determined import determined
from calib.estimate.nuisances import Priors
from calib.geometry import along, beside
from calib.model import PARAMETERS, Array, Calibration
from calib.visit.next_stop import COVERAGE_FACTOR, Flags, JointCovariance, Plan, WantedUncertainty

MOST_STOPS = 100  # of more, so many that are spread over them tell nearly the same
MOST_MORE = 4  # stops that are proposed
OFTEN = 1e4  # visits of each position, whose offsets then average out
THETAS_DEG, ALPHAS_DEG = (35.0, 55.0), tuple(range(0, 360, 15))  # that `fieldcal bench` proposes
UNSEEN = 1e-3  # of the largest mean square: so little is felt along a direction that is not excited
UNKNOWN_MPS2 = 1e6  # u of the mean of a sensor that feels gravity, where gravity is not stated


@dataclass(frozen=True, slots=True, eq=False)
class Planned:
    """What positions tell.

    `determined` (12,): the parameters that are, once each position was taken often, or that the prior states well
    enough. `needed`: how many of them the first calibration needs. `expanded` (12,): U (k = 2) once each position was
    taken, of S relative to the main sensitivity and of Q in m/s2, apart from the reference's own error. `unseen` (3,):
    the direction in the sensor's frame along which nothing is felt to change; None where there is none.
    """

    determined: Flags
    needed: int
    expanded: Array
    unseen: Array | None

    @property
    def count(self) -> int:
        """How many parameters are determined."""
        return int(np.count_nonzero(self.determined))

    @property
    def enough(self) -> bool:
        """Whether a first calibration comes of it."""
        return self.count >= self.needed

    @property
    def missing(self) -> list[str]:
        """The parameters that are not determined."""
        return [name for name, told in zip(PARAMETERS, self.determined, strict=True) if not told]


def states_positions(channel: Channel) -> bool:
    """Whether the configuration states the positions, or that the sensor stands beside a tri-axial reference."""
    return channel.rotation is not None or bool(_stated_positions(channel))


def plan_of(channel: Channel, nominal: float | None) -> Planned:
    """What the stated positions tell. `nominal` is the sensitivity by the data sheet of the device.

    Raises ValueError where S by the prior cannot be a start.
    """
    return _plan_by(channel, nominal, _stops(channel))


def missing_stops(channel: Channel, nominal: float | None) -> list[BenchStop]:
    """The positions that are missing, the one that gains most first; empty where no position helps."""
    stops, candidates = _stops(channel), _candidates(channel)
    found: list[BenchStop] = []
    while candidates and not _plan_by(channel, nominal, [*stops, *found]).enough:
        if len(found) == MOST_MORE:
            return []
        priors = _priors(channel, nominal)
        plan, joint = _plan(candidates, priors), _after([*stops, *found], priors)
        found.append(candidates[plan.suggestions(joint, START, WantedUncertainty())[0].stop])
    return found


def if_in_radians(channel: Channel) -> Channel | None:
    """The channel with its angles in degrees, if those that are stated may be radians; else None."""
    angles = [angle for pair in angles_deg(channel) for angle in pair]
    if not angles or max(map(abs, angles)) > 2.0 * np.pi or all(float(angle).is_integer() for angle in angles):
        return None

    def turned(one: Stated) -> Stated:
        in_rad = {name: getattr(one, name) or 0.0 for name in ("theta_deg", "alpha_deg")}
        return one.model_copy(update={name: float(np.degrees(value)) for name, value in in_rad.items()})

    name = "poses" if channel.poses else "positions"
    return channel.model_copy(update={name: tuple(turned(one) for one in _stated_positions(channel))})


def angles_deg(channel: Channel) -> list[tuple[float, float]]:
    """theta and alpha of each position on a clamp."""
    pairs = ((one.theta_deg, one.alpha_deg) for one in _stated_positions(channel))
    return [(theta, alpha) for theta, alpha in pairs if theta is not None and alpha is not None]


def _stated_positions(channel: Channel) -> Sequence[Stated]:
    return channel.poses or (() if channel.positions == "free" else channel.positions)


def _stops(channel: Channel) -> list[BenchStop]:
    """The positions that the configuration states, none twice."""
    if channel.rotation is not None:
        stated = channel.rotation_gravity_mps2
        pose = beside(np.reshape(channel.rotation, (3, 3)), stated if channel.coupling == "dc" else np.zeros(3))
        of_gravity = channel.coupling == "dc" and stated is not None and not any(stated)
        up = channel.gravity_mps2 * np.array([0.0, 0.0, 1.0]) if of_gravity else np.zeros(3)
        return [BenchStop("", "", pose, {}, np.reshape(channel.rotation, (3, 3)).T @ up)]
    forms = {(one.theta_deg, one.alpha_deg, one.direction, one.gravity_mps2): one for one in _stated_positions(channel)}
    some = np.unique(np.linspace(0, len(forms) - 1, min(len(forms), MOST_STOPS)).astype(int))
    chosen = [list(forms.values())[k] for k in some]
    felt = channel.coupling == "dc"
    poses = [one.pose(channel.gravity_mps2, channel.static_sign, feels_gravity=felt) for one in chosen]
    return [BenchStop("", "", pose, {}, np.zeros(pose.direction.shape[1])) for pose in poses]


def _candidates(channel: Channel) -> list[BenchStop]:
    """The positions that may be taken besides: of the clamp, along axes, edges and corners, or on the six faces."""
    if channel.rotation is not None:
        return []
    if channel.reference is None:
        return on_faces(channel.gravity_mps2)
    felt = channel.gravity_mps2 if channel.coupling == "dc" else 0.0
    stated = _stated_positions(channel)
    if not stated or stated[0].theta_deg is not None:
        thetas = sorted({*THETAS_DEG, *(one.theta_deg for one in stated if one.theta_deg)})
        return on_clamp(thetas, ALPHAS_DEG, felt, channel.static_sign)
    found = []
    for told, name, up in ways(CORNER):
        columns = dict(zip(("dx", "dy", "dz", *GRAVITY), [*up, *(felt * up)], strict=True))
        found.append(BenchStop(told, name, along(up, felt * up), columns, np.zeros(1)))
    return found


def _plan_by(channel: Channel, nominal: float | None, stops: Sequence[BenchStop]) -> Planned:
    priors = _priors(channel, nominal)
    before, once = JointCovariance.before(priors, _scale(priors)), _after(stops, priors)
    often = _after(stops, priors.with_values({"offset_mps2": priors.offset_mps2 / np.sqrt(OFTEN)}))
    gate = channel.gate.filled(before.scale, fixed_mount=channel.fixed_mount)
    told = determined(before.mean, _u(often), _u(before), np.ones(12, dtype=bool))
    assert priors.parameters is not None
    assert priors.covariance is not None
    S, Q = priors.parameters[:9].reshape(3, 3), priors.parameters[9:]
    known = Anchor(gate, Calibration(S, Q, priors.covariance, np.ones(12, dtype=bool), np.inf, "prior")).known
    expanded = np.append(once.expanded, COVERAGE_FACTOR * _u(once)[9:] / before.scale)
    return Planned(told | known, gate.least_determined or 1, expanded, _unseen(stops))


def _priors(channel: Channel, nominal: float | None) -> Priors:
    """The priors of the nuisances, and of S and Q. Where nothing tells a sensitivity yet, it is counted as 1."""
    mean = channel.prior.mean(1.0 if nominal is None else nominal)
    stated = channel.priors(fixed_mount=channel.fixed_mount)
    covariance = np.diag(channel.prior.standard_uncertainty(mean) ** 2)
    return replace(stated, parameters=mean, covariance=covariance)


def _scale(priors: Priors) -> float:
    return priors.output_per_mps2 or 1.0


def _after(stops: Sequence[BenchStop], priors: Priors) -> JointCovariance:
    """What is known once each position was taken."""
    joint = JointCovariance.before(priors, _scale(priors))
    blind = [bool(np.isnan(stop.pose.gravity_mps2).any()) for stop in stops]
    for unknown in (False, True):
        some = [stop for stop, is_blind in zip(stops, blind, strict=True) if is_blind == unknown]
        if some:
            plan = _plan(some, priors.with_values({"offset_mps2": UNKNOWN_MPS2}) if unknown else priors)
            expected = START if some[0].pose.direction.shape[1] else replace(START, rms_mps2=0.0)
            for k in range(len(some)):
                joint = plan.after(joint, k, expected)
    return joint


def _plan(stops: Sequence[BenchStop], priors: Priors) -> Plan:
    poses = [replace(stop.pose, gravity_mps2=np.nan_to_num(stop.pose.gravity_mps2)) for stop in stops]
    return Plan(poses, priors, np.array([stop.reference_mps2 for stop in stops]))


def _unseen(stops: Sequence[BenchStop]) -> Array | None:
    """The direction along which neither motion nor gravity is felt to change."""
    gravity = np.nan_to_num(np.array([stop.pose.gravity_mps2 for stop in stops]))
    felt = [*(gravity - gravity.mean(axis=0)), *(START.rms_mps2 * d for s in stops for d in s.pose.direction.T)]
    power, axes = np.linalg.eigh(np.transpose(felt) @ felt)
    if power[0] > UNSEEN * power[-1]:
        return None
    return np.asarray(axes[:, 0] * np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0]))


def _u(joint: JointCovariance) -> Array:
    return np.asarray(np.sqrt(np.diag(joint.covariance)[:12]))
