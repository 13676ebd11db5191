"""What held windows show that agree with each other: which of the devices has changed, and the state after that.

Each hypothesis is a step of its own unknowns before the first held window. The whole is solved anew with it and with
the held windows. The sum of squares of all rows tells how well it explains them, and those of two references together
tell the sensor from its references. With one reference they cannot: S is then wrong by 0 or by the step d, and the
state follows the step, with u(S) larger by what the reference may have done, until something else tells S.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from agent.core.gate import Limit
from calib.estimate.physics import WITHIN_U
from calib.estimate.quantities import REFERENCE, REFERENCE_DRIFT, Quantity
from calib.geometry import AXES, STANDARD_GRAVITY_MPS2
from calib.model import Array, Calibration, own_channels
from calib.state.state import FIRST, State
from calib.windows.record import Record

# A jump that is being confirmed may be of any size up to what an operator would hardly accept: 10 % of S, and in the
# offset two m/s2, which is a mount that leans by 12 deg.
JUMP_SENSITIVITY = 0.1
JUMP_OFFSET_MPS2 = 2.0
SURELY = 1.6  # U = 2 u covers the errors 0 and d if u is d / 1.6
SIGNIFICANT = 3.0  # standard uncertainties of a change
LARGEST_PHASE_RAD = 0.1  # of a lag that was not taken out: its second order is then 0.5 % of S
WIDER = 10.0  # the possible jump over the one that was found: else the reference would take the larger part of it
AN_UNKNOWN = 2.0  # chi-squared that an unknown more must gain (Akaike 1974)
DECISIVE = 10.0  # hypotheses whose chi-squared differ by less are not told apart: a likelihood ratio of 150
NOTHING = np.zeros(12)  # of S and Q


@dataclass(frozen=True, slots=True, eq=False)
class TriedStep:
    """A hypothesis: the state after its step and the held windows, by how much chi-squared grows, and how many unknowns
    the step has. `fits`: the held windows agree with it within what chance allows."""

    state: State
    chi2: float
    unknowns: int
    fits: bool


@dataclass(frozen=True, slots=True)
class Devices:
    """The names of the reference of the newest window and of the other one ("" if there is none), the stability of the
    former in a year, relative, and its place."""

    own: str
    other: str
    stability: float
    place: int = FIRST


def confirmed(state: State, held: Sequence[Record], devices: Devices, limit: Limit) -> tuple[State | None, str]:
    """The state to adopt after the held windows, and which device has changed, for the operator.

    None if the held windows do not agree with each other. `limit` is that of the gate.
    """
    before, place = state.chi2_beside(held), devices.place
    sensor = _tried(state, held, place, _of_sensor(state, held, place), limit, before)
    own, other = devices.own, devices.other
    if len({record.reference for record in held}) > 1:
        told = f": windows with {own} and with {other} show the same change, so the sensor has changed"
        return (sensor.state if sensor.fits else None), told
    channels = _channels(state, place)
    stepped = dict.fromkeys((q.key for q in channels), JUMP_SENSITIVITY / SURELY)
    reference = _tried(state, held, place, state.changes(NOTHING, place=place, line=True) | stepped, limit, before)
    # The step of the sensor has more unknowns, and so fits the better, if nothing else contradicts it.
    if reference.fits and reference.chi2 < sensor.chi2 - DECISIVE:
        why = f"windows with {other} still agree" if other else "gravity still agrees"
        return reference.state, (
            f": the reference {own} has changed by {_sizes(state, reference.state, channels)}, because {why} with S. S "
            f"stays as it was; have {own} calibrated"
        )
    told = ""
    if other:
        more = AN_UNKNOWN * (sensor.unknowns - reference.unknowns)
        if sensor.fits and sensor.chi2 < reference.chi2 - more - DECISIVE:
            return sensor.state, f": windows with {other} show the same change, so the sensor has changed"
        told = f": no window with {other} tells whether the sensor or the reference {own} has changed"
    return _of_either(state, held, sensor, devices, limit, before), told


def rescaled(state: State, held: Sequence[Record], factor: float, limit: Limit, place: int) -> State | None:
    """The state after held windows that show all outputs of the sensor at another scale; None if they do not agree. The
    newest one is beside the reference at a place."""
    wider = max(1.0, WIDER * abs(factor - 1.0) / JUMP_SENSITIVITY)
    u = _of_sensor(state, held, place, wider=wider)
    tried = _tried(state, held, place, u, limit, state.chi2_beside(held))
    return tried.state if tried.fits else None


@dataclass(frozen=True, slots=True)
class Shape:
    """What a change of S may look like: chi-squared of what is left of the change, its unknowns, and the words."""

    chi2: float
    unknowns: int
    words: str

    @property
    def score(self) -> float:
        """For comparison: the lowest is the best."""
        return self.chi2 + AN_UNKNOWN * self.unknowns


def shape_of_change(state: State, day: float, directions: Array, limit: Limit, place: int = FIRST) -> str:
    """What the change of S since the windows of a day looks like, for the operator: a turn, another scale of an output,
    of all, or of a channel of the reference at a place, with `directions` (3, C) in the sensor's frame. "" where it is
    none of these, or where nothing has changed.

    The change follows from all windows, as if S and Q had stepped before this day.
    """
    size = np.append(np.full(9, JUMP_SENSITIVITY), np.full(3, JUMP_OFFSET_MPS2)) * state.scale
    moved, covariance = state.change_on(day, state.changes(size, place=place))
    white = np.linalg.inv(np.linalg.cholesky(covariance[:9, :9]))
    found = sorted(_shapes(moved[:9], white, state.result().sensitivity, directions), key=lambda shape: shape.score)
    best, none = found[0], Shape(float(np.sum((white @ moved[:9]) ** 2)), 0, "")
    if best.score > none.score - DECISIVE or best.chi2 > limit(9.0 - best.unknowns):
        return ""
    alike = [shape.words for shape in found if shape.score <= best.score + DECISIVE]
    chi2 = f"chi-squared {best.chi2:.0f}, {none.chi2:.0f} without a change"
    return f"the change of S looks like {' or '.join(alike)} ({chi2})"


def _shapes(moved: Array, white: Array, S: Array, directions: Array) -> Iterator[Shape]:
    """Each shape with its sizes by least squares; `white` (9, 9) makes the covariance of `moved` (9,) one."""

    def fitted(*changes: Array) -> tuple[float, Array]:
        by = white @ np.array([change.ravel() for change in changes]).T
        sizes = np.linalg.lstsq(by, white @ moved, rcond=None)[0]
        return float(np.sum((white @ moved - by @ sizes) ** 2)), sizes

    # A sensor that is turned feels all turned the other way.
    chi2, turn = fitted(*(S @ np.cross(way, np.eye(3)) for way in np.eye(3)))
    angle = max(float(np.linalg.norm(turn)), np.finfo(float).tiny)
    axis = ", ".join(f"{x:.2f}" for x in turn / angle)
    yield Shape(chi2, 3, f"a turn of the sensor against its reference by {np.rad2deg(angle):.2g} deg about ({axis})")
    for axis, row in zip(AXES, np.eye(3), strict=True):
        chi2, (size,) = fitted(row[:, None] * S)
        yield Shape(chi2, 1, f"{100.0 * size:+.2g} % in output {axis} of the sensor")
    chi2, (size,) = fitted(S)
    yield Shape(chi2, 1, f"{100.0 * size:+.2g} % in all outputs")
    for axis, way in zip(AXES, directions.T, strict=False):
        chi2, (size,) = fitted(np.outer(S @ way, way))
        yield Shape(chi2, 1, f"{-100.0 * size:+.2g} % in channel {axis} of the reference")


def _of_sensor(
    state: State, held: Sequence[Record], place: int, leaning_rad: float = 0.0, wider: float = 1.0
) -> dict[str, float]:
    """A line that was plugged anew may be late by another time; that is no change of S or Q."""
    jump = wider * possible_jump(state, held)
    return state.changes(jump, leaning_rad, place=place, line=True, another_filter=np.inf)


def _tried(
    state: State, held: Sequence[Record], place: int, u: Mapping[str, float], limit: Limit, before: float
) -> TriedStep:
    after = state.after(held, u)
    grown = after.chi2 - before
    fits = grown <= limit(sum(record.rows for record in held)) and not _differs_in_making(state, after, held, place)
    return TriedStep(after, grown, len(u), fits)


def _differs_in_making(before: State, after: State, held: Sequence[Record], place: int) -> bool:
    """Whether the held windows were made with another filter or lag taken out than is right: they tell no exact S."""
    lag_s = after.lag_s(place)
    phases_rad = [_beyond_own_s(lag_s, record) * float(np.sqrt(record.omega2)) for record in held]
    return max(phases_rad) > LARGEST_PHASE_RAD or after.has_another_response(before, place)


def _beyond_own_s(lag_s: float, record: Record) -> float:
    """By how much the lag that was taken out of a record differs from `lag_s` beyond what the clocks leave open."""
    return max(abs(lag_s - record.lag_s) - WITHIN_U * record.u_lag_s, 0.0)


def _of_either(
    state: State, held: Sequence[Record], sensor: TriedStep, devices: Devices, limit: Limit, chi2: float
) -> State | None:
    """The sensor made the step, or the reference did: S follows, and its u covers both."""
    if not sensor.fits:
        return None
    place = devices.place
    before, after = state.result(place), sensor.state.result(place)
    moved = np.abs(after.offset - before.offset)
    significant = moved > SIGNIFICANT * np.sqrt(_covariance_of_change(before, after).diagonal()[9:].clip(0.0))
    leaning = tilt_rad(np.where(significant, moved, 0.0), state.scale)
    found = float(np.abs(after.sensitivity - before.sensitivity).max()) / state.scale
    u = _of_sensor(state, held, place, leaning, max(1.0, WIDER * found / JUMP_SENSITIVITY))
    tried = _tried(state, held, place, u | _of_reference(state, held, before, after, devices), limit, chi2)
    return tried.state if tried.fits else None


def _of_reference(
    state: State, held: Sequence[Record], before: Calibration, after: Calibration, devices: Devices
) -> dict[str, float]:
    """By how much the reference may have stepped, relative, by the key of its drift: it indicates more by the part by
    which S times the direction of a channel is larger."""
    found, change = {}, after.sensitivity - before.sensitivity
    covariance = _covariance_of_change(before, after)[:9, :9]
    drifts = [quantity for quantity in state.present(devices.place) if quantity.kind is REFERENCE_DRIFT]
    direction = held[0].pose.direction[:, : own_channels(held[0].channels)]
    for quantity, way in zip(drifts, direction.T, strict=False):
        output = before.sensitivity @ way
        by = np.kron(output, way) / (output @ output)  # of the relative step, by the elements of S
        step, u = float(by @ change.ravel()), float(np.sqrt(max(by @ covariance @ by, 0.0)))
        if abs(step) > SIGNIFICANT * u:
            found[quantity.key] = max(devices.stability, abs(step) / SURELY)
    return found


def _covariance_of_change(before: Calibration, after: Calibration) -> Array:
    """(12, 12) that of a free step: what S and Q owe to constant errors, as that of the certificate, is no part of
    it."""
    return np.asarray(after.covariance - before.covariance)


def _channels(state: State, place: int) -> list[Quantity]:
    """What a step of the reference at a place changes: its drift, or its sensitivity if it is stated not to drift."""
    present = state.present(place)
    drifts = [quantity for quantity in present if quantity.kind is REFERENCE_DRIFT]
    return drifts or [quantity for quantity in present if quantity.kind is REFERENCE]


def _sizes(before: State, after: State, channels: Sequence[Quantity]) -> str:
    sizes = []
    for quantity in channels:
        (value, u), was = after.quantity(quantity.key), before.quantity(quantity.key)[0]
        if abs(value - was) > SIGNIFICANT * u:
            axis = f"{quantity.name[-1]} " if len(channels) > 1 else ""
            sizes.append(f"{axis}{100.0 * (value - was):+.3g} %")
    return ", ".join(sizes)


def possible_jump(state: State, held: Sequence[Record]) -> Array:
    """(12,) how far S and Q may have jumped: only what these windows tell of, so that no other column moves."""
    told = np.any([state.innovation(record).information > 0.0 for record in held], axis=0)
    size = np.append(np.full(9, JUMP_SENSITIVITY), np.full(3, JUMP_OFFSET_MPS2)) * state.scale
    return np.where(told, size, 0.0)


def tilt_rad(offset: Array, scale: float) -> float:
    """The tilt of the mount that would move the mean output as much as an offset (3,), in output unit: the data cannot
    tell one from the other. `scale` is the output unit per m/s2."""
    return float(np.abs(offset).max(initial=0.0) / (scale * STANDARD_GRAVITY_MPS2))
