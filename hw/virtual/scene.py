"""Mechanics of the bench: the acceleration in the sensor's axes at any time, without any instrument."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hw.virtual.hand import ByHand
from hw.virtual.motion import ComplexArray
from hw.virtual.noise import NoiseStream, generator
from hw.virtual.parameters import BenchParameters
from hw.virtual.schedule import Schedule, Span, Stand, clamp_frame, rotation

Array = NDArray[np.float64]
RAMP_S = 0.4  # the motion fades in and out within this time, inside the turning
KNOCK_CELL_S = 1.0  # shocks are drawn separately for each cell of this length, s


class Scene:
    """Motion, clamp, gravity, handling and shocks of one bench. Times are sorted arrays in s of the bench's clock."""

    def __init__(self, parameters: BenchParameters, seed: int) -> None:
        self._p = parameters
        self._seed = seed
        self._true = true_schedule(parameters)

    def position_of(self, window: int) -> int:
        """Index of the position of `window` in the schedule."""
        return max(window, 0) % len(self._true.stands)

    def spans(self, t_s: Array) -> list[Span]:
        """Holds and turns at `t_s`."""
        return list(self._true.spans(t_s))

    def slide(self, t_s: Array, response: ComplexArray | None = None) -> tuple[Array, Array]:
        """Velocity (m/s) and acceleration (m/s2) of the bench, each (n, 3) in the motion's channels."""
        x, v, a = self._p.motion.evaluate(t_s, response)
        level, rate, curvature = (part[:, None] for part in self._level(t_s))
        return level * v + rate * x, level * a + 2 * rate * v + curvature * x

    def felt(
        self, t_s: Array, response: ComplexArray | None = None, *, gravity: bool = True, knocks: bool = True
    ) -> Array:
        """Acceleration (n, 3) in the sensor's true axes, Eqs. (9)-(11).

        The motion passes through `response`; gravity, the vibration by handling and the shocks do not.
        """
        _, motion = self.slide(t_s, response)
        g = self._p.static_sign * self._p.gravity_mps2 if gravity else 0.0
        felt = np.empty_like(motion)
        for span in self._true.spans(t_s):
            stand = self._true.stand(span.window)
            if span.turning:
                felt[span.part] = self._turning(t_s[span.part], span.window, motion[span.part], g)
                continue
            for part, held in self._held(t_s, span, stand):
                felt[part] = motion[part] @ held.carrier.T + g * held.frame[:, 2]
        if knocks and self._p.knocks.rate_hz:
            self._add_knocks(t_s, felt)
        return felt

    def _held(self, t_s: Array, span: Span, stand: Stand) -> list[tuple[slice, Stand]]:
        """A hold as one part, or as two if the clamp slips in it."""
        slip = self._p.slip
        if slip is None or self._true.window_at(slip.at_s) != span.window:
            return [(span.part, stand)]
        at = span.part.start + int(np.searchsorted(t_s[span.part], slip.at_s))
        slipped = _displaced(stand, slip.theta_deg, slip.alpha_deg)
        return [(slice(span.part.start, at), stand), (slice(at, span.part.stop), slipped)]

    def _level(self, t_s: Array) -> Array:
        """Level of the motion with its first and second derivative, (3, n)."""
        level = np.zeros((3, len(t_s)))
        for span in self._true.spans(t_s):
            after = self._true.stand(span.window).level
            if not span.turning:
                level[0, span.part] = after
                continue
            start, stop, before = self._turn(span.window)
            ramp = min(RAMP_S, (stop - start) / 2)
            t = t_s[span.part]
            level[:, span.part] = before * (np.array([[1.0], [0.0], [0.0]]) - _fade((t - start) / ramp, ramp))
            level[:, span.part] += after * _fade((t - stop) / ramp + 1, ramp)
        return level

    def _turn(self, window: int) -> tuple[float, float, float]:
        """Start and stop of the turn into `window`, and the level before it; before the first window all is at rest."""
        stop = self._true.start_of(window)
        if window == 0:
            return stop - max(self._p.schedule.turn_s, RAMP_S), stop, 0.0
        return stop - self._true.turn_s, stop, self._true.stand(window - 1).level

    def _turning(self, t_s: Array, window: int, motion: Array, g: float) -> Array:
        """Acceleration while a person turns the clamp from the position before `window` into that of `window`."""
        start, stop, _ = self._turn(window)
        progress = (t_s - start) / (stop - start)
        before, after = self._true.stand(window - 1), self._true.stand(window)
        frame = _turned(before, after, _fade(progress, 1.0)[0])
        slide = np.where(progress[:, None] < 0.5, before.slide, after.slide)
        along = slide * motion[:, :1] + np.pad(motion[:, 1:], ((0, 0), (1, 0)))
        along[:, 2] += g
        hands = np.sin(np.multiply.outer(t_s, 2 * np.pi * np.array([3.1, 4.3, 5.9])) + np.arange(3.0))
        busy = self._p.handling_mps2 if window else 0.0
        bump = busy * np.sin(np.pi * np.clip(progress, 0, 1)) ** 2
        return np.asarray(np.einsum("nij,nj->ni", frame, along) + bump[:, None] * hands)

    def _add_knocks(self, t_s: Array, felt: Array) -> None:
        knocks = self._p.knocks
        first = int((t_s[0] - knocks.duration_s) // KNOCK_CELL_S)
        for cell in range(max(first, 0), int(t_s[-1] // KNOCK_CELL_S) + 1):
            random = generator(self._seed, NoiseStream.KNOCK, cell)
            for _ in range(random.poisson(knocks.rate_hz * KNOCK_CELL_S)):
                start = (cell + random.random()) * KNOCK_CELL_S
                blow = random.normal(size=3)
                blow *= knocks.peak_mps2 * random.uniform(0.3, 1.0) / np.linalg.norm(blow)
                part = slice(*np.searchsorted(t_s, (start, start + knocks.duration_s)))
                felt[part] += np.sin(np.pi * (t_s[part, None] - start) / knocks.duration_s) * blow


def true_schedule(parameters: BenchParameters) -> Schedule:
    """The schedule with the true positions: the nominal one plus the errors of the clamp's angles.

    Raises ValueError if an angle error is given for a position without a clamp, or if the number of errors is wrong.
    """
    nominal = parameters.schedule
    if isinstance(nominal, ByHand):
        return nominal  # its stands have their errors
    theta_deg, alpha_deg = parameters.clamp.of_positions(len(nominal.stands))
    stands = tuple(map(_displaced, nominal.stands, theta_deg, alpha_deg))
    return Schedule(stands, nominal.turn_s, nominal.start_s)


def _displaced(stand: Stand, theta_error_deg: float, alpha_error_deg: float) -> Stand:
    if theta_error_deg == 0 and alpha_error_deg == 0:
        return stand
    if stand.theta_deg is None or stand.alpha_deg is None:
        raise ValueError("angle errors are only possible for positions on the clamp")
    theta_deg, alpha_deg = stand.theta_deg + theta_error_deg, stand.alpha_deg + alpha_error_deg
    frame = clamp_frame(np.deg2rad(theta_deg), np.deg2rad(alpha_deg))
    return replace(stand, frame=frame, theta_deg=theta_deg, alpha_deg=alpha_deg)


def _fade(progress: Array, duration: float) -> Array:
    """Smooth step from 0 to 1 for `progress` 0..1 within `duration`, with its first two time derivatives, (3, n)."""
    p = np.clip(progress, 0.0, 1.0)
    step = p**3 * (10 - 15 * p + 6 * p**2)
    rate = 30 * p**2 * (1 - p) ** 2 / duration
    curvature = 60 * p * (1 - p) * (1 - 2 * p) / duration**2
    return np.stack([step, rate, curvature])


def _turned(before: Stand, after: Stand, progress: Array) -> Array:
    """Frames (n, 3, 3) on the shortest rotation from the frame of `before` to that of `after`."""
    way = after.frame @ before.frame.T
    angle = np.arccos(np.clip((np.trace(way) - 1) / 2, -1.0, 1.0))
    if angle < 1e-12:
        return np.broadcast_to(before.frame, (len(progress), 3, 3))
    # (way + way') / 2 = cos I + (1 - cos) k k': its largest column gives the axis k, also at 180 deg.
    outer = (way + way.T) / 2 - np.cos(angle) * np.eye(3)
    axis = outer[:, np.argmax(np.diag(outer))]
    axis = axis / np.linalg.norm(axis)
    if np.sum(np.cross(np.eye(3), axis) * (way - way.T)) < 0:  # the column gives k without its sign
        axis = -axis
    return np.asarray(rotation(axis, progress * angle) @ before.frame)
