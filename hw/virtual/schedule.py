"""Positions of the sensor on the bench, how long each is held, and how the sensor is turned between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STANDARD_GRAVITY_MPS2 = 9.80665


def clamp_frame(theta_rad: float, alpha_rad: float) -> Array:
    """Directions of the bench in the sensor's axes on the clamp, (3, 3); columns: along the slide, lateral, gravity.

    The first column multiplies a_ref and the third g in Eqs. (9)-(11), with the printed signs. The second column
    completes a right-handed frame. The slide of the paper's clamp is horizontal.
    """
    st, ct = np.sin(theta_rad), np.cos(theta_rad)
    sa, ca = np.sin(alpha_rad), np.cos(alpha_rad)
    return np.array([[-sa * ct, -ca, -st * sa], [-ca * ct, sa, -st * ca], [st, 0.0, -ct]])


def rotation(axis: Array, angle_rad: Array | float) -> Array:
    """Rotation matrices (..., 3, 3) about the unit vector `axis` (3,) by angles (...) (Rodrigues)."""
    angle = np.asarray(angle_rad)[..., None, None]
    cross = np.cross(np.eye(3), axis)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross))


@dataclass(frozen=True, slots=True, eq=False)
class Stand:
    """One position of the sensor, held for `hold_s`; the bench moves with `level` times its motion.

    `frame` (3, 3) turns bench axes (horizontal, lateral, gravity) into the sensor's. `slide` (3,) is the unit vector of
    the slide in bench axes; it is horizontal unless the slide is inclined. The angles are kept if a clamp defined the
    frame.
    """

    hold_s: float
    frame: Array
    slide: Array
    level: float = 1.0
    theta_deg: float | None = None
    alpha_deg: float | None = None

    @property
    def carrier(self) -> Array:
        """The three channels of the motion in the sensor's axes, (3, 3), as columns."""
        return np.column_stack([self.frame @ self.slide, self.frame[:, 1:]])


def clamped(theta_deg: float, alpha_deg: float, hold_s: float, level: float = 1.0) -> Stand:
    """A position on the clamp, Eqs. (9)-(11)."""
    frame = clamp_frame(np.deg2rad(theta_deg), np.deg2rad(alpha_deg))
    return Stand(hold_s, frame, np.array([1.0, 0.0, 0.0]), level, theta_deg, alpha_deg)


def directed(direction: Array, gravity: Array, hold_s: float, level: float = 1.0) -> Stand:
    """A position of a field node: motion along the unit vector `direction`, gravity along `gravity` at rest."""
    d, e = (np.asarray(v, dtype=float) / np.linalg.norm(v) for v in (direction, gravity))
    lateral = np.cross(e, d)
    if np.linalg.norm(lateral) < 1e-9:  # the slide is vertical: any horizontal direction will do
        lateral = np.cross(e, np.eye(3)[np.argmin(np.abs(e))])
    lateral /= np.linalg.norm(lateral)
    frame = np.column_stack([np.cross(lateral, e), lateral, e])
    return Stand(hold_s, frame, frame.T @ d, level)


def resting(gravity: Array, hold_s: float) -> Stand:
    """A static position: nothing moves, an ideal sensor indicates along `gravity`."""
    return directed(np.eye(3)[np.argmin(np.abs(gravity))], gravity, hold_s, level=0.0)


class PoseInterval(NamedTuple):
    """The nominal position between two times of the bench's clock, as an operator would write it into poses.csv."""

    start_s: float
    stop_s: float
    theta_deg: float | None
    alpha_deg: float | None
    position: str
    direction: tuple[float, float, float]
    gravity_mps2: tuple[float, float, float]
    level: float


class Span(NamedTuple):
    """Part of a sorted array of times: the hold of window `window`, or the turn into it."""

    part: slice
    window: int
    turning: bool


@dataclass(frozen=True, slots=True, eq=False)
class Schedule:
    """Stands one after the other, repeated without end.

    Between two stands the motion fades out, the sensor is turned, and the motion fades in.

    Window w is stand `w % len(stands)` in repetition `w // len(stands)`. Before `start_s` the sensor is in the first
    position and the slide is at rest.
    """

    stands: tuple[Stand, ...]
    turn_s: float = 3.0
    start_s: float = 1.0

    @property
    def period_s(self) -> float:
        """Duration of one repetition, s."""
        return sum(stand.hold_s + self.turn_s for stand in self.stands)

    def duration_s(self, repetitions: int) -> float:
        """Time from the clock's zero to the end of the last hold of `repetitions`."""
        return self.start_s + repetitions * self.period_s - self.turn_s

    def start_of(self, window: int) -> float:
        """Time at which window `window` starts, s."""
        repetition, index = divmod(window, len(self.stands))
        before = sum(stand.hold_s + self.turn_s for stand in self.stands[:index])
        return self.start_s + repetition * self.period_s + before

    def stand(self, window: int) -> Stand:
        """The stand of window `window`; the first stand for a negative window."""
        return self.stands[max(window, 0) % len(self.stands)]

    def window_at(self, t_s: float) -> int:
        """The window whose hold, or whose turn before the hold, includes `t_s`."""
        repetition = max(0, int((t_s - self.start_s) // self.period_s))
        window = repetition * len(self.stands)
        while t_s >= self.start_of(window) + self.stand(window).hold_s:
            window += 1
        return window

    def spans(self, t_s: Array) -> Iterator[Span]:
        """Divide sorted times `t_s` into holds and turns."""
        first, n = 0, len(t_s)
        window = self.window_at(float(t_s[0]))
        while first < n:
            start = self.start_of(window)
            for turning, stop in ((True, start), (False, start + self.stand(window).hold_s)):
                last = int(np.searchsorted(t_s, stop, side="left"))
                if last > first:
                    yield Span(slice(first, last), window, turning)
                    first = last
            window += 1

    def poses(self, until_s: float) -> list[PoseInterval]:
        """Nominal positions whose hold ends by `until_s` (to 1 us)."""
        found: list[PoseInterval] = []
        window = 0
        while (stop := self.start_of(window) + self.stand(window).hold_s) <= until_s + 1e-6:
            stand = self.stand(window)
            found.append(
                PoseInterval(
                    start_s=self.start_of(window),
                    stop_s=stop,
                    theta_deg=stand.theta_deg,
                    alpha_deg=stand.alpha_deg,
                    position=f"p{window % len(self.stands) + 1}",
                    direction=_triple(stand.carrier[:, 0]),
                    gravity_mps2=_triple(STANDARD_GRAVITY_MPS2 * stand.frame[:, 2]),
                    level=stand.level,
                )
            )
            window += 1
        return found


def _triple(vector: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z
