"""The nuisances of a set of poses, and the effect of one unit of each nuisance on the inputs (their geometry).

An error of a pose is a small rotation of the sensor relative to its surroundings: the direction of motion and gravity
turn together, as a rigid pair. An error of alpha turns both about the sensor's z axis, an error of theta about the
horizontal normal of the motion (Eqs. 9-11). If the mount leans, with sensor and reference on it, gravity alone turns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from calib.estimate import physics
from calib.estimate import quantities as kinds
from calib.estimate.nuisances import Applied, Priors
from calib.estimate.quantities import Kind, Quantity
from calib.model import Array, Pose, own_channels
from calib.signal.response import ALL_POWERS, by_term
from calib.windows.deviations import ByAxis, LeftOpen

PARALLEL = 1e-3  # rad; if motion and gravity are parallel within this angle, there is no horizontal normal
SETUP_DEG = 1  # one setup is told from another by its angle between motion and gravity to so many degrees
AXES = "xyz"


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """One nuisance: its quantity, its prior standard uncertainty, and the effect of one unit of it.

    Effects: `turn_direction`, `turn_gravity` (P, 3) rotation in rad; `transverse`, `quadrature` (P, 3) transverse
    motion in phase and 90 deg ahead, relative to the motion; `reference` (M,) relative error of the reference;
    `reference_across` (6,) its transverse sensitivities, as in physics.BESIDE, over the main ones;
    `gravity` (1,) in m/s2; `offset` (P, 3) in m/s2; `lag` (3,) in s; `reference_corner`, `sensor_corner` (1,) in rad/s;
    `response` (5,) or (9,) the terms of the response in s^k (calib.signal.response).
    None means no effect. `expected` is the prior's mean. `applied` is the part that the front end has already removed
    from the data; the remaining part is estimated.
    """

    quantity: Quantity
    uncertainty: float
    turn_direction: Array | None = None
    turn_gravity: Array | None = None
    transverse: Array | None = None
    quadrature: Array | None = None
    reference: Array | None = None
    reference_across: Array | None = None
    gravity: Array | None = None
    offset: Array | None = None
    lag: Array | None = None
    reference_corner: Array | None = None
    sensor_corner: Array | None = None
    response: Array | None = None
    expected: float = 0.0
    applied: float = 0.0

    def with_(self, other: Term) -> Term:
        """The same nuisance with the effects of `other` added; the larger standard uncertainty counts."""
        moves: dict[str, Any] = {}
        for f in fields(self):
            own, more = getattr(self, f.name), getattr(other, f.name)
            if isinstance(more, np.ndarray):
                moves[f.name] = more if own is None else own + more
        return replace(self, uncertainty=max(self.uncertainty, other.uncertainty), **moves)

    def with_applied(self, applied: Mapping[Kind, Sequence[float]]) -> Term:
        """The same nuisance; `applied` are the values, by kind, that the front end has already removed from the data:
        one value, for the response one for each of its terms, or for the first of them."""
        if (values := applied.get(self.kind)) is None:
            return self
        if self.response is None:
            return replace(self, applied=float(values[0]))
        k = int(np.flatnonzero(self.response)[0])
        return replace(self, applied=float(values[k] / self.response[k]) if k < len(values) else 0.0)

    def on_inputs(self, poses: int) -> Array:
        """(P, SIZE) the effect of one unit on the inputs of a window (calib.estimate.physics) in each of P poses; an
        offset in m/s2."""
        found = np.zeros((poses, physics.SIZE))
        for where, what in (
            (physics.TURN, self.turn_direction), (physics.TURN_GRAVITY, self.turn_gravity),
            (physics.ACROSS, self.transverse), (physics.AHEAD, self.quadrature), (physics.LAG, self.lag),
            (physics.GRAVITY, self.gravity), (physics.RESPONSE, self.response), (physics.Q, self.offset),
            (physics.REFERENCE, None if self.reference is None else self.reference[:3]),
            (physics.ACROSS_REFERENCE, self.reference_across),
        ):  # fmt: skip
            if what is not None:
                found[:, where.start : where.start + what.shape[-1]] += what
        for sign, corner in ((1.0, self.reference_corner), (-1.0, self.sensor_corner)):
            if corner is not None:
                found[:, physics.CORNER] += sign * corner[0] / (2.0 * np.pi)
        return found

    @property
    def name(self) -> str:
        """The name for people."""
        return self.quantity.name

    @property
    def key(self) -> str:
        """The name for looking up in a joint state."""
        return self.quantity.key

    @property
    def kind(self) -> Kind:
        """The kind of its quantity."""
        return self.quantity.kind

    @property
    def source(self) -> str:
        """The line of the uncertainty budget that it belongs to."""
        return self.kind.source

    @property
    def unit(self) -> str:
        """The unit of its value."""
        return self.kind.unit


def terms(
    poses: Sequence[Pose], channels: int, priors: Priors, applied: Mapping[Kind, Sequence[float]], reference: str = ""
) -> list[Term]:
    """All nuisances of P poses and a reference with this number of channels; also those whose uncertainty is 0.

    `applied` are the values, by kind, that the front end has already removed from the data. Poses of one position share
    the nuisances of that position. `reference` is the identity of the reference, which owns its own nuisances.
    """
    found: dict[str, Term] = {}
    for term in _terms(poses, channels, priors, reference):
        found[term.key] = term if term.key not in found else found[term.key].with_(term)
    return [term.with_applied(applied) for term in found.values()]


def _terms(poses: Sequence[Pose], channels: int, priors: Priors, reference: str) -> Iterator[Term]:
    yield from _clamp_terms(poses, priors)
    yield from _pose_terms(poses, priors, reference)
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
    for (name, own), (drift, _) in zip(
        *(_by_channel(n, channels) for n in ("reference", "reference_drift")), strict=True
    ):
        yield _term(name, kinds.REFERENCE, priors, owner=reference, reference=own)
        yield _term(drift, kinds.REFERENCE_DRIFT, priors, owner=reference, reference=own)
    if own_channels(channels) == 3 and priors.of(kinds.REFERENCE_TRANSVERSE.prior):
        for (own_axis, shown), one in zip(physics.BESIDE, np.eye(6), strict=True):
            name = f"reference_{AXES[own_axis]}{AXES[shown]}"
            yield _term(name, kinds.REFERENCE_TRANSVERSE, priors, reference, reference_across=one)
    yield _term("lag", kinds.LAG, priors, reference, lag=np.ones(3))
    for name, k in zip(_axes("lag"), np.eye(3), strict=True):
        yield _term(name, kinds.LAG_OF_AXIS, priors, owner=reference, lag=k)
    if priors.response > 0.0:
        for name, unit in priors.response_model.unknowns.items():
            yield _term(name, kinds.RESPONSE, priors, reference, response=unit)
    turn = np.full(1, 2.0 * np.pi)
    yield _term("reference_corner", kinds.REFERENCE_CORNER, priors, reference, reference_corner=turn)
    yield _term("sensor_corner", kinds.SENSOR_CORNER, priors, sensor_corner=turn)


def reference_over_temperature(channels: int, priors: Priors, reference: str) -> Iterator[Term]:
    """By how much each channel of a reference indicates more for each kelvin over the temperature of S and Q."""
    for name, own in _by_channel("reference_per_k", channels):
        yield _term(name, kinds.REFERENCE_TEMPERATURE, priors, owner=reference, reference=own)


def _by_channel(name: str, channels: int) -> Iterator[tuple[str, Array]]:
    """Names, and (M,) ones at the channel itself and at its integral."""
    real = own_channels(channels)
    for m in range(real):
        yield f"{name}{'' if real == 1 else f'_{AXES[m]}'}", np.resize(np.eye(real)[m], channels)


def _clamp_terms(poses: Sequence[Pose], priors: Priors) -> Iterator[Term]:
    """Errors of theta and alpha: common to all positions, and by position."""
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


def _pose_terms(poses: Sequence[Pose], priors: Priors, reference: str) -> Iterator[Term]:
    """Errors of stated directions, common and by position, and of the rotation of a tri-axial reference."""
    stated = [p for p, pose in enumerate(poses) if pose.theta_rad is None and own_channels(pose.direction.shape[1]) < 3]
    beside = [p for p, pose in enumerate(poses) if own_channels(pose.direction.shape[1]) == 3]
    for axis, k in zip(AXES, np.eye(3), strict=True):
        if stated:
            turn = _only(poses, stated, k)
            yield _term(f"direction_{axis}", kinds.DIRECTION, priors, turn_direction=turn, turn_gravity=turn)
        if beside:
            turn = _only(poses, beside, k)
            yield _term(f"rotation_{axis}", kinds.ROTATION, priors, owner=reference, turn_direction=turn)
        for p in stated:
            quantity = _at(f"direction_{axis}", kinds.DIRECTION_BY_POSITION, poses[p])
            yield _turned(quantity, priors.of(quantity.kind.prior), _only(poses, p, k))
        for p in beside:
            if np.any(poses[p].gravity_mps2):
                quantity = _at(f"gravity_{axis}", kinds.GRAVITY_DIRECTION, poses[p])
                yield Term(quantity, priors.of(quantity.kind.prior), turn_gravity=_only(poses, p, k))


def _lean_terms(poses: Sequence[Pose], priors: Priors) -> Iterator[Term]:
    """Lean of the mount with sensor and reference on it: gravity turns, the direction of motion does not."""
    for p, pose in enumerate(poses):
        if own_channels(pose.direction.shape[1]) < 3 and np.any(pose.gravity_mps2):
            for axis, k in zip(AXES, np.eye(3), strict=True):
                quantity = _at(f"lean_{axis}", kinds.LEAN, pose)
                yield Term(quantity, priors.of(quantity.kind.prior), turn_gravity=_only(poses, p, k))


def _slide_terms(poses: Sequence[Pose], priors: Priors) -> Iterator[Term]:
    """Motion transverse to a uniaxial reference, and errors of the angle between gravity and the motion.

    What moves the sensor moves it sideways alike in all positions, as long as it stands alike: where stated directions
    are at another angle to gravity, it was set up anew, or each position by hand.
    """
    lateral, vertical, along = (np.zeros((len(poses), 3)) for _ in range(3))
    setups: dict[str, list[int]] = {}
    free = []
    for p, pose in enumerate(poses):
        frame = _slide_frame(pose)
        if frame is not None:
            along[p], vertical[p], lateral[p] = frame
            setups.setdefault(_setup(pose), []).append(p)
        elif own_channels(pose.direction.shape[1]) == 1:
            free.append(p)
    for setup, alike in setups.items():  # named by the pose alone: on-line each window has its own terms
        for name, way in (("lateral", lateral), ("vertical", vertical)):
            yield from _across(f"transverse_{name}{setup}", "", priors, _only(poses, alike, way[alike]))
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
    """Unit vectors along the motion, along the component of gravity normal to it, and normal to both.

    None if they are not defined: motion parallel to gravity, gravity not known, or no uniaxial reference.
    """
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


def _setup(pose: Pose) -> str:
    """The name of how that stands which moves a sensor whose direction of motion is stated: by its angle to gravity, to
    SETUP_DEG. "" where the motion is horizontal, and on a slide, which is one thing at any inclination."""
    if pose.theta_rad is not None:
        return ""
    motion, gravity = pose.direction[:, 0], pose.gravity_mps2
    cosine = float(motion @ gravity) / float(np.linalg.norm(motion) * np.linalg.norm(gravity))
    angle_deg = SETUP_DEG * round(float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))) / SETUP_DEG)
    return "" if angle_deg == 90 else f" at {angle_deg} deg"


def _clamp_frame(pose: Pose) -> tuple[Array, Array]:
    """The vectors d (motion) and e (gravity) of Eqs. (9)-(11), as in calib.geometry.clamp, with static sign +1."""
    theta, alpha = pose.theta_rad or 0.0, pose.alpha_rad or 0.0
    sin_t, cos_t, sin_a, cos_a = np.sin(theta), np.cos(theta), np.sin(alpha), np.cos(alpha)
    return (
        np.array([-sin_a * cos_t, -cos_a * cos_t, sin_t]),
        np.array([-sin_t * sin_a, -sin_t * cos_a, -cos_t]),
    )


def _at(name: str, kind: Kind, pose: Pose) -> Quantity:
    return Quantity(f"{name}[{pose.position}]", kind, pose.position)


def _term(name: str, kind: Kind, priors: Priors, owner: str = "", **moves: Array) -> Term:
    """A nuisance that is common to all positions; `moves` are its effects, as fields of Term."""
    return Term(
        Quantity(name, kind, owner=owner), priors.of(kind.prior), expected=priors.of(kind.mean), applied=0.0, **moves
    )


def _turned(quantity: Quantity, uncertainty: float, axis: Array) -> Term:
    return Term(quantity, uncertainty, turn_direction=axis, turn_gravity=axis)


def _only(poses: Sequence[Pose], where: int | list[int], value: Array) -> Array:
    one = np.zeros((len(poses), 3))
    one[where] = value
    return one


def _axes(name: str) -> list[str]:
    return [f"{name}_{axis}" for axis in AXES]


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """The inputs in P poses at given values of the nuisances: `direction` D (P, 3, M) of the motion; `gravity` G (P, 3)
    and `offset` (P, 3) in m/s2; `lag_s` (3,); `reference_corner` and `sensor_corner` in rad/s."""

    direction: Array
    gravity: Array
    offset: Array
    lag_s: Array
    reference_corner: float
    sensor_corner: float


class Nuisances:
    """The J nuisances of P poses whose uncertainty is not 0: `effect` (P, SIZE, J) of one unit of each on the inputs of
    a window (calib.estimate.physics), an offset in m/s2; `response` (J, K) on the terms of the response."""

    def __init__(
        self, poses: Sequence[Pose], channels: int, priors: Priors, applied: Applied, reference: str = ""
    ) -> None:
        """`reference` is the identity of the reference; see `terms`."""
        self.terms = [t for t in terms(poses, channels, priors, applied.by_kind, reference) if t.uncertainty > 0.0]
        self.direction = np.array([physics.padded(pose.direction, channels) for pose in poses])
        self.gravity = np.nan_to_num([pose.gravity_mps2 for pose in poses])  # 0 in a pose whose gravity is not known
        self.effect = np.zeros((len(poses), physics.SIZE, len(self.terms)))
        for j, term in enumerate(self.terms):
            self.effect[:, :, j] = term.on_inputs(len(poses))
        self.response = self.effect[0, physics.RESPONSE, :].T[:, : priors.response_model.powers]
        self._corners = [
            np.array([0.0 if corner is None else corner[0] for corner in own])
            for own in ([t.reference_corner for t in self.terms], [t.sensor_corner for t in self.terms])
        ]
        # Of ln |h| at the reference frequency by the terms, when the response is 1 at 0 Hz.
        self.reference_frequency_hz, self._known_size = priors.reference_frequency_hz, priors.known_size
        at = np.array([2.0 * np.pi * priors.reference_frequency_hz])
        powers = priors.response_model.powers
        self._at_reference = (1.0 - priors.reference_shares[:powers]) * by_term(at, powers)[0].real
        self.applied_response = np.array([t.applied for t in self.terms]) @ self.response

    def __len__(self) -> int:
        return len(self.terms)

    @property
    def uncertainty(self) -> Array:
        """(J,) prior standard uncertainties."""
        return np.array([t.uncertainty for t in self.terms])

    def steady(self, z: Array) -> Array:
        """(...,) the sensitivity at 0 Hz over that at the reference frequency at the values `z` (..., J)."""
        return np.asarray(
            np.exp(-((self.applied_response + z @ self.response) @ self._at_reference + self._known_size))
        )

    def by_axis(self, z: Array, left_open: LeftOpen) -> ByAxis:
        """The effect of axes that do not respond quite alike, at the values `z` (J,) of the nuisances."""
        terms, powers = self.applied_response + z @ self.response, ALL_POWERS[: len(self._at_reference)]
        return left_open.by_axis(terms, self._at_reference, powers)

    def at(self, z: Array) -> Inputs:
        """The inputs when the nuisances have the values `z` (J,), or (..., J): then all have these dimensions in
        front."""
        p = (self.effect @ z[..., None, :, None])[..., 0]
        reference, sensor = (z @ corner for corner in self._corners)
        return Inputs(
            physics.felt_motion(p, self.direction), physics.felt_gravity(p, self.gravity), p[..., physics.Q],
            p[..., 0, physics.LAG], reference, sensor,
        )  # fmt: skip
