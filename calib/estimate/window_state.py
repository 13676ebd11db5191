"""The joint state of all windows of a sensor, and how a window changes it.

The priors enter once, when the state begins and when a window brings a nuisance of its own (a new position, another
reference). What belongs to a window alone (its offset, the scatter of its lag) is in the weight of its rows.

All windows are linearised at one point. If each window had a point of its own, the same direction that the data do not
determine would be another direction in each window, and a little of it would seem to be determined: after twelve
windows on a clamp u was a third too small. So the newest windows are kept as summaries. They are taken again where the
estimate has moved away from the point. A window that is too old becomes part of the base, and is not linearised again.

At a fixed mount the mean of V is m = Q + S (G + tilt x G) under a gravity that never changes, so that the data
determine m and no part of it. The state then has m in the place of Q; Q = m - S (G + tilt x G) is computed when it is
read, with the uncertainties of S, G and tilt. If Q were in the state, a mean that drifts would change the column of S
along gravity (by 1.9 % for a drift of 0.24 m/s2).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, Self

import numpy as np

from calib.estimate.beforehand import Before, Beforehand
from calib.estimate.fixed_mount import Held, held_at, never_turned
from calib.estimate.joint_state import JointState, gain_of
from calib.estimate.linearised import Linearised
from calib.estimate.nuisances import Priors
from calib.estimate.over_frequency import OverFrequency, changed
from calib.estimate.reference_share import ReferenceShare, share_in
from calib.estimate.wander import TemperatureModel, Wander, wandered
from calib.estimate.window_rows import Noise, Summary, WindowRows
from calib.model import Array

MOST_RECENT = 48  # windows: four times round twelve positions
ITERATIONS = 6
MOST_POSITIONS = 48  # whose own nuisances are kept; of the oldest ones nothing but their effect on S and Q remains
MOST_REFERENCES = 8  # the same, of references


class WindowState:
    """S, Q and all nuisances as one state, from the windows taken so far.

    `mean` and `standard_uncertainty` (12,) are what was known of S, Q beforehand, in output units; `fixed` mounts do
    not turn. Days count from any origin. `check` are the priors beside further references, which are mounted all the
    time as the first one is. The first has place 0, the next one has place 1.
    """

    def __init__(
        self,
        mean: Array,
        standard_uncertainty: Array,
        priors: Priors,
        wander: Wander,
        temperature: TemperatureModel,
        *,
        fixed: bool,
        check: Sequence[Priors] = (),
    ) -> None:
        mean, standard_uncertainty = np.array(mean, dtype=float), np.array(standard_uncertainty, dtype=float)
        self._stated = Beforehand(mean, standard_uncertainty, priors, wander, temperature)
        self._beside = [self._stated, *(replace(self._stated, priors=other) for other in check)]  # by place
        # With what the state was made, by place; differs only between `load` and `restate`.
        self._before = [Before.of(stated) for stated in self._beside]
        self._fixed = fixed
        self.scale = self._stated.scale
        self._place = 0  # of the reference in use
        self._mounted = [""] * len(self._beside)  # the references by place
        self._sensitivity = [1.0] * len(self._beside)  # of these references, by their certificates
        self._references: dict[str, float] = {}  # the same of every reference whose unknowns are kept, last use last
        self._joint = Linearised(self._stated.state())
        self._positions: list[str] = []
        self._noise = Noise()
        self._day: float | None = None
        self._temperature_range = (np.inf, -np.inf)
        self._residual_sd = np.full(3, np.nan)
        self._held: Held | None = None  # at a fixed mount, from the first window on
        self._over = OverFrequency()
        self._made: dict[int, WindowRows] = {}  # rows of the recent windows, by id(summary): made once, used twice
        self.windows = 0

    @property
    def reference(self) -> str:
        """The reference in use: that of the next windows."""
        return self._mounted[self._place]

    def _parameters_factor(self) -> tuple[Array, Array]:
        """S and Q (12,) and a factor of their covariance."""
        state, factor = self._joint.state, self._factor()
        if self._held is not None:
            return self._held.parameters(state, factor)
        return state.mean[:12].copy(), factor[:12].copy()

    def _factor(self) -> Array:
        """A factor of the covariance of the state, with what the response over frequency adds to it."""
        return self._over.factor(self._joint.state, self.reference, self._stated.priors)

    @property
    def shares(self) -> list[ReferenceShare]:
        """What S and Q owe to the errors of each reference; that of the newest window is the last."""
        state, (_, factor) = self._joint.state, self._parameters_factor()
        return [share_in(state, factor, *reference) for reference in self._references.items()]

    def settled(self) -> Self:
        """A copy in which all windows are in the base: it holds no summary of a window."""
        other = self.copy()
        other._joint.begin_with(self._joint.state.copy(), self._day)
        other._joint.recent = []
        return other

    def copy(self) -> Self:
        """An independent copy, to try windows on."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        other._joint, other._positions = self._joint.copy(), list(self._positions)
        other._references, other._before = dict(self._references), list(self._before)
        other._mounted, other._sensitivity = list(self._mounted), list(self._sensitivity)
        other._made = dict(self._made)
        return other

    def _take(self, rows: WindowRows, wandered: JointState) -> None:
        summary = rows.summary
        self._joint.state = self._corrected(wandered, rows)
        self._day = _later(self._day, summary.day)
        self._joint.recent.append(summary)
        self._settle()
        if len(self._joint.recent) > MOST_RECENT:
            self._absorb(1)
        self._made[id(summary)] = rows
        recent = {id(kept) for kept in self._joint.recent}
        self._made = {key: made for key, made in self._made.items() if key in recent}
        self._noise, self._over = self._noise.pooled(rows.noise), self._over.taken(summary.data)
        self._residual_sd = summary.data.type_a.noise[0].copy()
        if np.isfinite(summary.temperature_degc):
            low, high = self._temperature_range
            self._temperature_range = (min(low, summary.temperature_degc), max(high, summary.temperature_degc))
        self._keep_positions(summary.pose.position)
        self._keep_references(summary.reference)
        self.windows += 1

    def _rows(self, summary: Summary) -> WindowRows:
        reference_degc = self._stated.temperature.reference_degc
        held = self._held.mps2 if self._held is not None else np.zeros(3) if self._fixed else None
        priors, seen_degc = self._priors(summary), self._seen_degc
        made = self._made.get(id(summary))
        if made is not None and made.made_of(summary, priors, held, seen_degc):
            return made
        like = next((rows.nuisances for rows in self._made.values() if rows.summary.moved is summary.moved), None)
        return WindowRows(summary, priors, self.scale, reference_degc, held, seen_degc, like)

    def _priors(self, summary: Summary) -> Priors:
        """What is stated now beside the reference of a window."""
        return self._beside[self._place_of(summary.reference)].priors

    def _place_of(self, reference: str) -> int:
        """The place of a reference; that of the first one if the reference is not mounted."""
        return self._mounted.index(reference) if reference in self._mounted else 0

    @property
    def _seen_degc(self) -> tuple[float, float]:
        low, high = self._temperature_range
        return (low, high) if low <= high else (np.nan, np.nan)

    def _wandered(self, state: JointState, since: float | None, day: float) -> JointState:
        """A copy of the state, wandered on to `day`; earlier days are as now."""
        elapsed = 0.0 if since is None else max(day - since, 0.0)
        tilted = 0.0 if self._held is None else float(np.linalg.norm(self._held.mps2))
        a_day = self._stated.wander.variance_a_day(state.quantities, self.scale, tilted)
        return wandered(state, elapsed, a_day, self._joint.bound)

    def _mount(self, summary: Summary, day: float) -> None:
        """At the first window of a fixed mount: Q gives its place to the mean output there."""
        if self._fixed and self._held is None and np.isfinite(summary.held_mps2).all():
            self._held, terms = held_at(summary, self._priors(summary))
            self._held.mount(self._joint, terms, day)

    def _unmount(self, held: Held) -> None:
        """The mount turned after all: from now on means tell Q and S alike."""
        self._absorb(len(self._joint.recent))
        held.unmount(self._joint)
        self._held, self._fixed = None, False

    def _know(self, summary: Summary) -> WindowRows:
        """Nuisances that no window had before come in with their priors; the window's rows."""
        if self._held is not None and not never_turned(np.array([self._held.mps2, summary.held_mps2])):
            self._unmount(self._held)
        day = summary.day if self._day is None else self._day  # from which the state will wander on
        over = self._over.begun(summary.motion_hz, summary.data, summary.lag_s)
        first = over is not self._over
        if first:
            self._over = over
            self._state_response()
        self._mount(summary, day)
        rows = self._rows(summary)
        new = self._joint.append(rows.terms, day)
        if new and self._held is not None:
            self._held = self._held.moved_by(held_at(summary, self._priors(summary))[0], new)
        if self._held is not None and (first or not self._held.steady):
            steady = self._over.steady(self._joint.state, summary.reference, self._priors(summary))
            self._held = replace(self._held, steady=steady, known_size=self._priors(summary).known_size)
        if first and self._joint.recent:
            self._take_again()  # the windows before this one depend on the response as well
        return rows

    def _state_response(self) -> None:
        """The response over frequency is an unknown from now on, with its prior."""
        self._beside = [replace(stated, priors=self._over.stated(stated.priors)) for stated in self._beside]
        self._before = [replace(before, priors=self._over.stated(before.priors)) for before in self._before]
        self._stated = self._beside[0]

    def _taken(self, before: JointState, since: float | None, rows: WindowRows) -> JointState:
        return self._corrected(self._wandered(before, since, rows.summary.day), rows)

    def _corrected(self, state: JointState, rows: WindowRows) -> JointState:
        """The state, at its day already, after one window, linearised at the point."""
        own = rows.at(state, self._joint.point, self._noise)
        gain = gain_of(own.jacobian, state.factor)
        step = gain @ (own.residual + own.jacobian @ (self._joint.point - state.mean))
        state.correct(step, gain, own.jacobian)
        return state

    def _settle(self) -> None:
        """Take the recent windows anew, from the base on, until the point is where the estimate is."""
        for _ in range(ITERATIONS):
            if not (self._joint.moved(self.scale) or changed(self._joint.state, self._joint.point)):
                return
            self._joint.point = self._joint.state.mean.copy()
            self._take_again()

    def _take_again(self) -> None:
        """Make the state of the base and the recent windows."""
        for summary in self._joint.recent:
            self._joint.append(self._rows(summary).terms, summary.day)
        state, since = self._joint.base.copy(), self._joint.base_day
        for summary in self._joint.recent:
            state = self._taken(state, since, self._rows(summary))
            since = _later(since, summary.day)
        self._joint.state = state

    def _absorb(self, count: int) -> None:
        """The oldest recent windows become part of the base, linearised as they are now."""
        for summary in self._joint.recent[:count]:
            self._joint.base = self._taken(self._joint.base, self._joint.base_day, self._rows(summary))
            self._joint.base_day = _later(self._joint.base_day, summary.day)
        del self._joint.recent[:count]

    def _keep_positions(self, position: str) -> None:
        if position in self._positions:
            self._positions.remove(position)
        self._positions.append(position)
        while len(self._positions) > MOST_POSITIONS:
            oldest = self._positions.pop(0)
            self._absorb(len(self._joint.recent))
            self._joint.keep([quantity.position != oldest for quantity in self._joint.state.quantities])

    def _keep_references(self, reference: str) -> None:
        self._references.pop(reference, None)
        self._references[reference] = self._sensitivity[self._place_of(reference)]
        while len(self._references) > MOST_REFERENCES:
            oldest = next(iter(self._references))
            del self._references[oldest]
            self._absorb(len(self._joint.recent))
            self._joint.keep([quantity.owner != oldest for quantity in self._joint.state.quantities])

    # --- state

    def snapshot(self) -> dict[str, Any]:
        """All that changes, exactly."""
        return self._joint.snapshot() | {
            "stated": [before.snapshot() for before in self._before],
            "mounted": list(self._mounted),
            "references": dict(self._references),
            "sensitivity": list(self._sensitivity),
            "positions": list(self._positions),
            "noise": asdict(self._noise),
            "day": self._day,
            "temperature_range": list(self._temperature_range),
            "residual_sd": self._residual_sd.copy(),
            "fixed": self._fixed,
            "held": None if self._held is None else asdict(self._held),
            "over": self._over.snapshot(),
            "windows": self.windows,
            "scale": self.scale,
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from a snapshot. Where it was made with other statements, `restate` and `meet` must follow.

        Unknowns that an older version of the program did not have come in with their priors.
        """
        self._joint = Linearised.load(state)
        self._place, self._references = 0, dict(state["references"])
        for place, stated in enumerate(self._beside[: len(state["mounted"])]):
            self._before[place] = Before.load(state["stated"][place], stated)
            self._mounted[place], self._sensitivity[place] = state["mounted"][place], state["sensitivity"][place]
        self._positions = list(state["positions"])
        self._noise = Noise(**state["noise"])
        self._day = state["day"]
        low, high = state["temperature_range"]
        self._temperature_range = (low, high)
        self._residual_sd = np.array(state["residual_sd"])
        self._fixed = self._fixed and state["fixed"]  # a mount that turned once is fixed no more
        self._held = None if state["held"] is None else Held(**state["held"])
        self._over = OverFrequency.load(state["over"])
        self._state_response()
        self.windows, self.scale = state["windows"], state["scale"]
        for summary in self._joint.recent[-1:]:
            self._know(summary)


def _later(day: float | None, other: float) -> float:
    return other if day is None else max(day, other)
