"""A bench whose sensor is turned by a person while it runs, in place of a schedule that is known beforehand."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hw.virtual.noise import NoiseStream
from hw.virtual.schedule import STANDARD_GRAVITY_MPS2, Schedule, Stand, clamped, resting, rotation


@dataclass(frozen=True, slots=True, eq=False)
class ByHand(Schedule):
    """Stands that are added one after the other; the newest is held until the sensor is turned again.

    `stands` has the first one. Every stand that is added differs from what was asked for: on the clamp by the error
    `theta_deg`, which is the same for all, and by one of alpha with the SD `alpha_deg`; at rest by a tilt of the SD
    `tilt_deg`. A stand that is taken again has the same error again. All errors follow from `seed`.
    """

    seed: int = 0
    theta_deg: float = 0.0
    alpha_deg: float = 0.0
    tilt_deg: float = 0.0
    _starts: list[float] = field(default_factory=list)
    _true: list[Stand] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._starts.append(self.start_s)
        self._true.append(replace(self.stands[0], hold_s=np.inf))

    def turn(self, stand: Stand, at_s: float) -> float:
        """Begin to turn the sensor at `at_s`; the time at which it stands in the new position."""
        last = len(self._true) - 1
        at_s = max(at_s, self._starts[last])
        self._true.append(replace(self._misplaced(stand), hold_s=np.inf))
        self._starts.append(at_s + self.turn_s)
        # Last, because readers in other threads look from now on for the new stand.
        self._true[last] = replace(self._true[last], hold_s=at_s - self._starts[last])
        return self._starts[-1]

    def _misplaced(self, stand: Stand) -> Stand:
        place = np.rint(1000.0 * (stand.frame + 1.0)).astype(int).ravel().tolist()
        random = np.random.default_rng([self.seed, NoiseStream.PRESET, *place])
        if stand.theta_deg is not None and stand.alpha_deg is not None:
            alpha_deg = stand.alpha_deg + self.alpha_deg * random.normal()
            return clamped(stand.theta_deg + self.theta_deg, alpha_deg, np.inf, stand.level)
        axis = random.normal(size=3)
        tilt_rad = np.deg2rad(self.tilt_deg) * random.normal()
        up = rotation(axis / np.linalg.norm(axis), tilt_rad) @ stand.frame[:, 2]
        return resting(STANDARD_GRAVITY_MPS2 * up, np.inf)

    @property
    def period_s(self) -> float:
        """It does not repeat."""
        return float(np.inf)

    def start_of(self, window: int) -> float:
        """Time at which window `window` starts, s."""
        return self._starts[window]

    def stand(self, window: int) -> Stand:
        """The stand of window `window`; the first stand for a negative window."""
        return self._true[max(window, 0)]

    def window_at(self, t_s: float) -> int:
        """The window whose hold, or whose turn before the hold, includes `t_s`."""
        ends = (start + stand.hold_s for start, stand in zip(self._starts, self._true, strict=False))
        return next(window for window, end in enumerate(ends) if t_s < end)
