"""What is not S or Q but moves the data: angles, offsets, the reference, gravity, time. Each with a stated prior.

An error of a pose is a small rotation of the sensor's whole surroundings: direction of motion and gravity stay a rigid
pair. Alpha turns it about the sensor's z axis, theta about the horizontal normal of the motion (Eqs. 9-11). The input
acceleration in the sensor's frame is then, P poses and M reference channels,

    a(t) = D u(t - lag) + D' u'(t) / omega + G
    D = R(turn) (D0 + t L) / (1 + r)        D' = R(turn) q L        G = R(turn') G0 (1 + dg / |G0|)

t and q being motion along L that a uniaxial reference does not see, in phase with the motion and 90 deg ahead of it (a
table that rocks does both), and r the reference's relative error.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from calib.estimate import quantities as kinds
from calib.estimate.quantities import PRIORS, Kind, Quantity, Stated, Statement
from calib.model import Array, Pose, own_channels

PARALLEL = 1e-3  # rad; motion and gravity closer to one line than this leave the horizontal normal open
AXES = "xyz"


@dataclass(frozen=True, init=False)
class Priors(Stated):
    """What is known before the data: a standard uncertainty (GUM type B) of each nuisance, and some means.

    The numbers are attributes, their names and defaults are in calib.estimate.quantities; an uncertainty of 0 fixes the
    nuisance at its mean. With `Priors.none()` all are fixed, and the adjustment is plain Method 3.
    `parameters` (12,) and `covariance` (12, 12): what was known of S, Q in the order of
    calib.model.PARAMETERS, inf on the diagonal where nothing was.
    """

    table: ClassVar[Mapping[str, Statement]] = PRIORS
    parameters: Array | None = field(default=None, compare=False)
    covariance: Array | None = field(default=None, compare=False)

    def __init__(
        self,
        values: Mapping[str, float] | None = None,
        parameters: Array | None = None,
        covariance: Array | None = None,
        **stated: float,
    ) -> None:
        """`stated` counts before `values`, and these before the defaults. Raises TypeError for an unknown name."""
        super().__init__(values, **stated)
        object.__setattr__(self, "parameters", parameters)
        object.__setattr__(self, "covariance", covariance)


@dataclass(frozen=True, slots=True)
class Applied:
    """What the front end has already taken out of the data; nuisances are reported in total, with it."""

    lag_s: float = 0.0
    reference_corner_hz: float = 0.0
    sensor_corner_hz: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """One nuisance: which quantity it is, its standard uncertainty beforehand, and per unit of it what it moves.

    Turns (P, 3) in rad, `transverse` and `quadrature` (P, 3), `reference` (M,), `gravity` in m/s2, `offset` (P, 3) in
    m/s2, `lag` (3,) in s, corners in rad/s. None moves nothing. `expected` is the prior's mean, `applied` what the
    front end took out: the unknown is what is left.
    """

    quantity: Quantity
    uncertainty: float
    turn_direction: Array | None = None
    turn_gravity: Array | None = None
    transverse: Array | None = None
    quadrature: Array | None = None
    reference: Array | None = None
    gravity: Array | None = None
    offset: Array | None = None
    lag: Array | None = None
    reference_corner: Array | None = None
    sensor_corner: Array | None = None
    expected: float = 0.0
    applied: float = 0.0

    @property
    def name(self) -> str:
        """For people."""
        return self.quantity.name

    @property
    def kind(self) -> Kind:
        """Its nature."""
        return self.quantity.kind

    @property
    def source(self) -> str:
        """The line of a budget that it belongs to."""
        return self.kind.source

    @property
    def unit(self) -> str:
        """Of its value."""
        return self.kind.unit


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """Input accelerations at one value of the J nuisances and their derivatives with respect to each.

    `direction` (P, 3, M), `quadrature` (P, 3), `gravity` (P, 3), `lag_s` (3,), `reference_corner` and `sensor_corner`
    in rad/s; `d_...` the same with J in front.
    """

    direction: Array
    quadrature: Array
    gravity: Array
    lag_s: Array
    reference_corner: float
    sensor_corner: float
    d_direction: Array
    d_quadrature: Array
    d_gravity: Array


class Nuisances:
    """All nuisances that P poses have, as linear maps onto what they move, stacked: (J, ...)."""

    def __init__(self, poses: Sequence[Pose], channels: int, priors: Priors, applied: Applied) -> None:
        self.terms = [t for t in _terms(poses, channels, priors, applied) if t.uncertainty > 0.0]
        n = len(poses)
        self._stated = np.zeros((n, 3, channels))
        self._along = np.tile(np.eye(channels), (n, 1, 1))
        for p, pose in enumerate(poses):
            m = pose.direction.shape[1]
            self._stated[p, :, :m] = pose.direction
            if pose.along is not None:
                self._along[p, :m, :m] = pose.along
        self.direction = self._stated @ self._along
        self.gravity = np.array([pose.gravity_mps2 for pose in poses])
        self._real = own_channels(channels)
        self._magnitude = np.maximum(np.linalg.norm(self.gravity, axis=1), np.finfo(float).tiny)
        self._turn_direction = self._stacked("turn_direction", (n, 3))
        self._turn_gravity = self._stacked("turn_gravity", (n, 3))
        self._transverse = self._stacked("transverse", (n, 3))
        self._quadrature = self._stacked("quadrature", (n, 3))
        self._reference = self._stacked("reference", (channels,))
        self._gravity = self._stacked("gravity", (1,))
        self.offset = self._stacked("offset", (n, 3))
        self.lag = self._stacked("lag", (3,))
        self.reference_corner = self._stacked("reference_corner", (1,))[:, 0]
        self.sensor_corner = self._stacked("sensor_corner", (1,))[:, 0]
        self._corner_hz = (self.reference_corner - self.sensor_corner) / (2.0 * np.pi)

    def __len__(self) -> int:
        return len(self.terms)

    @property
    def uncertainty(self) -> Array:
        """(J,) prior standard uncertainties."""
        return np.array([t.uncertainty for t in self.terms])

    def _stacked(self, name: str, shape: tuple[int, ...]) -> Array:
        maps = [getattr(t, name) for t in self.terms]
        return np.array([np.zeros(shape) if m is None else m for m in maps]).reshape(len(self.terms), *shape)

    def at(self, z: Array) -> Inputs:
        """Inputs where the nuisances have the values `z` (J,)."""
        turn = rotations(np.einsum("j,jpk->pk", z, self._turn_direction))
        scale = 1.0 + np.einsum("j,jm->m", z, self._reference)
        sideways = self._stated.copy()
        if sideways.shape[2]:
            sideways[:, :, 0] += np.einsum("j,jpk->pk", z, self._transverse)
        real = self._real
        felt = turn @ sideways[:, :, :real]
        # A corner of c Hz took c times the integral, which has channels of its own (calib.signal.corner).
        direction = np.concatenate([felt, float(z @ self._corner_hz) * felt], axis=2)[:, :, : sideways.shape[2]] / scale
        d_direction = np.cross(self._turn_direction[..., None], direction, axisa=2, axisb=1, axisc=2)
        d_direction -= direction * (self._reference / scale)[:, None, None, :]
        if real:
            d_direction[..., 0] += np.einsum("pik,jpk->jpi", turn, self._transverse) / scale[0]
            d_direction[..., real:] += (
                self._corner_hz[:, None, None, None] * (felt / scale[:real])[..., : sideways.shape[2] - real]
            )
        # Second order in the turn and the quadrature is left out: 1 % of 0.2 deg.
        d_quadrature = np.einsum("pik,jpk->jpi", turn, self._quadrature)
        stretch = 1.0 + np.einsum("j,jo->o", z, self._gravity) / self._magnitude
        unstretched = np.einsum("pik,pk->pi", rotations(np.einsum("j,jpk->pk", z, self._turn_gravity)), self.gravity)
        gravity = unstretched * stretch[:, None]
        d_gravity = np.cross(self._turn_gravity, gravity) + self._gravity[:, :, None] * (
            unstretched / self._magnitude[:, None]
        )
        return Inputs(
            direction @ self._along,
            np.einsum("jpk,j->pk", d_quadrature, z),
            gravity,
            z @ self.lag,
            float(z @ self.reference_corner),
            float(z @ self.sensor_corner),
            d_direction @ self._along,
            d_quadrature,
            d_gravity,
        )


def rotations(vectors: Array) -> Array:
    """Rotation matrices (P, 3, 3) of rotation vectors (P, 3) in rad (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    cross = np.zeros((len(vectors), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = vectors
    cross[:, [1, 2, 0], [2, 0, 1]] = -vectors
    linear, square = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.asarray(np.eye(3) + linear * cross + square * (cross @ cross))


def _terms(poses: Sequence[Pose], channels: int, priors: Priors, applied: Applied) -> Iterator[Term]:
    yield from _clamp_terms(poses, priors)
    yield from _pose_terms(poses, priors)
    yield from _lean_terms(poses, priors)
    yield from _slide_terms(poses, priors)
    for name, k in zip(_axes("offset"), np.eye(3), strict=True):
        for p, pose in enumerate(poses):
            quantity = _at(name, kinds.OFFSET_BY_POSITION, pose)
            yield Term(quantity, priors.of(quantity.kind.prior), offset=_only(poses, p, k))
    if any(np.any(pose.gravity_mps2) for pose in poses):
        yield _term("gravity", kinds.GRAVITY, priors, gravity=np.ones(1))
    if channels == 0:
        return
    real = own_channels(channels)
    for m in range(real):
        name = "reference" if real == 1 else f"reference_{AXES[m]}"
        yield _term(name, kinds.REFERENCE, priors, reference=np.resize(np.eye(real)[m], channels))
    yield _term("lag", kinds.LAG, priors, applied.lag_s, lag=np.ones(3))
    for name, k in zip(_axes("lag"), np.eye(3), strict=True):
        yield _term(name, kinds.LAG_OF_AXIS, priors, lag=k)
    turn = np.full(1, 2.0 * np.pi)
    taken = applied.reference_corner_hz
    yield _term("reference_corner", kinds.REFERENCE_CORNER, priors, taken, reference_corner=turn)
    yield _term("sensor_corner", kinds.SENSOR_CORNER, priors, applied.sensor_corner_hz, sensor_corner=turn)


def _clamp_terms(poses: Sequence[Pose], priors: Priors) -> Iterator[Term]:
    """Theta and alpha, common and by position."""
    clamped = [p for p, pose in enumerate(poses) if pose.theta_rad is not None]
    if not clamped:
        return
    theta, alpha = np.zeros((len(poses), 3)), np.zeros((len(poses), 3))
    for p in clamped:
        motion, gravity = _clamp_frame(poses[p])
        theta[p] = np.cross(gravity, motion)
        alpha[p] = 0.0, 0.0, -1.0
    for name, axis, common, single, found in (
        ("theta", theta, kinds.THETA, kinds.THETA_BY_POSITION, [poses[p].u_theta_rad for p in clamped]),
        ("alpha", alpha, kinds.ALPHA, kinds.ALPHA_BY_POSITION, [poses[p].u_alpha_rad for p in clamped]),
    ):
        yield _term(name, common, priors, turn_direction=axis, turn_gravity=axis)
        for p, u in zip(clamped, found, strict=True):
            yield _turned(_at(name, single, poses[p]), max(priors.of(single.prior), u), _only(poses, p, axis[p]))


def _pose_terms(poses: Sequence[Pose], priors: Priors) -> Iterator[Term]:
    """Stated directions, common and by position, and the mounting of a tri-axial reference."""
    stated = [p for p, pose in enumerate(poses) if pose.theta_rad is None and own_channels(pose.direction.shape[1]) < 3]
    beside = [p for p, pose in enumerate(poses) if own_channels(pose.direction.shape[1]) == 3]
    for axis, k in zip(AXES, np.eye(3), strict=True):
        if stated:
            turn = _only(poses, stated, k)
            yield _term(f"direction_{axis}", kinds.DIRECTION, priors, turn_direction=turn, turn_gravity=turn)
        if beside:
            turn = _only(poses, beside, k)
            yield _term(f"rotation_{axis}", kinds.ROTATION, priors, turn_direction=turn)
        for p in stated:
            quantity = _at(f"direction_{axis}", kinds.DIRECTION_BY_POSITION, poses[p])
            yield _turned(quantity, priors.of(quantity.kind.prior), _only(poses, p, k))
        for p in beside:
            if np.any(poses[p].gravity_mps2):
                quantity = _at(f"gravity_{axis}", kinds.GRAVITY_DIRECTION, poses[p])
                yield Term(quantity, priors.of(quantity.kind.prior), turn_gravity=_only(poses, p, k))


def _lean_terms(poses: Sequence[Pose], priors: Priors) -> Iterator[Term]:
    """Gravity in other directions than stated, the direction of motion as stated: a mount with all on it leans."""
    for p, pose in enumerate(poses):
        if own_channels(pose.direction.shape[1]) < 3 and np.any(pose.gravity_mps2):
            for axis, k in zip(AXES, np.eye(3), strict=True):
                quantity = _at(f"lean_{axis}", kinds.LEAN, pose)
                yield Term(quantity, priors.of(quantity.kind.prior), turn_gravity=_only(poses, p, k))


def _slide_terms(poses: Sequence[Pose], priors: Priors) -> Iterator[Term]:
    """Motion across a uniaxial reference, and gravity not square to the motion as stated."""
    lateral, vertical, along = (np.zeros((len(poses), 3)) for _ in range(3))
    free = []
    for p, pose in enumerate(poses):
        frame = _slide_frame(pose)
        if frame is not None:
            along[p], vertical[p], lateral[p] = frame
        elif own_channels(pose.direction.shape[1]) == 1:
            free.append(p)
    for name, way in (("lateral", lateral), ("vertical", vertical)):
        if way.any():
            yield from _across(f"transverse_{name}", "", priors, way)
    for p in free:
        position = poses[p].position
        for name, k in zip("ab", np.linalg.svd(poses[p].direction[:, :1])[0].T[1:], strict=True):
            yield from _across(f"transverse_{name}[{position}]", position, priors, _only(poses, p, k))
    for name, axis in (("pitch", lateral), ("roll", along)):
        if axis.any():
            yield _term(f"tilt_{name}", kinds.TILT, priors, turn_gravity=axis)


def _across(name: str, position: str, priors: Priors, way: Array) -> Iterator[Term]:
    u = priors.of(kinds.TRANSVERSE.prior)
    yield Term(Quantity(name, kinds.TRANSVERSE, position), u, transverse=way)
    yield Term(Quantity(f"{name}_quadrature", kinds.TRANSVERSE, position), u, quadrature=way)


def _slide_frame(pose: Pose) -> tuple[Array, Array, Array] | None:
    """Unit vectors along the motion, along gravity's part square to it, and across both; None where they are open."""
    if pose.theta_rad is not None:
        motion, gravity = _clamp_frame(pose)
        return motion, gravity, np.cross(gravity, motion)
    if own_channels(pose.direction.shape[1]) != 1:
        return None
    motion = pose.direction[:, 0]
    gravity = np.nan_to_num(pose.gravity_mps2)
    across = np.cross(gravity, motion)
    length = float(np.linalg.norm(across))
    if length <= PARALLEL * max(float(np.linalg.norm(gravity)), np.finfo(float).tiny):
        return None
    return motion, np.cross(motion, across / length), across / length


def _clamp_frame(pose: Pose) -> tuple[Array, Array]:
    """d and e of Eqs. (9)-(11), whichever of them the pose's sensor feels."""
    theta, alpha = pose.theta_rad or 0.0, pose.alpha_rad or 0.0
    sin_t, cos_t, sin_a, cos_a = np.sin(theta), np.cos(theta), np.sin(alpha), np.cos(alpha)
    return (
        np.array([-sin_a * cos_t, -cos_a * cos_t, sin_t]),
        np.array([-sin_t * sin_a, -sin_t * cos_a, -cos_t]),
    )


def _at(name: str, kind: Kind, pose: Pose) -> Quantity:
    return Quantity(f"{name}[{pose.position}]", kind, pose.position)


def _term(name: str, kind: Kind, priors: Priors, applied: float = 0.0, **moves: Array) -> Term:
    """A nuisance that all positions have in common; `moves` are fields of Term."""
    u, expected = priors.of(kind.prior), priors.of(kind.mean)
    return Term(Quantity(name, kind), u, expected=expected, applied=applied, **moves)


def _turned(quantity: Quantity, uncertainty: float, axis: Array) -> Term:
    return Term(quantity, uncertainty, turn_direction=axis, turn_gravity=axis)


def _only(poses: Sequence[Pose], where: int | list[int], value: Array) -> Array:
    one = np.zeros((len(poses), 3))
    one[where] = value
    return one


def _axes(name: str) -> list[str]:
    return [f"{name}_{axis}" for axis in AXES]
