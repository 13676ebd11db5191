"""Method 3 by adjustment, window by window: S, Q and every persistent nuisance as one state with its joint covariance.

The priors enter once, when the state begins and when a window brings a nuisance of its own (a position never seen);
what belongs to a window alone (its offset, its lag's scatter) is in the weight of its rows. Each window is one
least-squares correction of the state, so that the cost does not depend on how long it has run.

All windows are linearised at one point. At points of their own the same unseen direction (an inclination against the
main sensitivities, say) would be another in each, and a little of it would seem seen: after twelve windows on a clamp u
came out a third too small. So the newest windows are kept in summary, and are taken anew where the estimate has moved
away from the point; a window that leaves them is part of the base for good. With no wandering the result is that of
calib.estimate.adjustment for all windows at once.

At a fixed mount the mean of V is m = Q + S (G + tilt x G) under a gravity that never changes, so that the data tell m
and no part of it. The state then has m in the place of Q; Q = m - S (G + tilt x G) is made of it when it is read, with
the uncertainties of S, G and tilt. Were Q in the state, a mean that drifts would move the column of S along gravity
(by 1.9 % where it drifted by 0.24 m/s2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from calib.distributions import coverage_factor
from calib.estimate.correction import Law
from calib.estimate.determined import determined
from calib.estimate.fixed_mount import Held, held_at, never_turned
from calib.estimate.gauss_newton import Flags
from calib.estimate.innovation import Innovation, innovation
from calib.estimate.joint_state import JointState, gain_of
from calib.estimate.linearised import Linearised
from calib.estimate.nuisances import Priors
from calib.estimate.quantities import LAG, OFFSET_RATE, RATES, S_AND_Q, Quantity
from calib.estimate.wander import TemperatureModel, Wander, wandered
from calib.estimate.window_rows import Noise, Summary, WindowRows
from calib.model import Array, Calibration

MOST_RECENT = 48  # windows: four times round twelve positions
ITERATIONS = 6
MOST_POSITIONS = 48  # whose own nuisances are kept; of the oldest ones nothing but their effect on S and Q remains
METHOD = "3 (recursive adjustment)"


class Recursion:
    """The state of one sensor. `predict`, `update` and `loosen` change it; `innovation` and `result` read.

    `mean` and `standard_uncertainty` (12,) are what was known of S, Q beforehand, in output units; `fixed` mounts do
    not turn. Days count from any origin.
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
    ) -> None:
        self._priors, self._wander, self._temperature, self._fixed = priors, wander, temperature, fixed
        self.scale = float(np.sqrt(np.mean(mean[[0, 4, 8]] ** 2)))
        state = JointState(S_AND_Q, mean, standard_uncertainty)
        for name in RATES:
            state.append(Quantity(name, OFFSET_RATE), 0.0, wander.of(OFFSET_RATE.prior) * self.scale)
        for quantity, u in temperature.terms(self.scale):
            state.append(quantity, 0.0, u)
        self._prior_u = np.array(standard_uncertainty, dtype=np.float64)
        self._joint = Linearised(state)
        self._positions: list[str] = []
        self._noise = Noise()
        self._day: float | None = None
        self._temperature_range = (np.inf, -np.inf)
        self._residual_sd = np.full(3, np.nan)
        self._held: Held | None = None  # at a fixed mount, from the first window on
        self.windows = 0

    # --- reading

    def innovation(self, summary: Summary) -> Innovation:
        """What the window says against the state at its time."""
        return self._against(summary)[0]

    def with_window(self, summary: Summary) -> tuple[Innovation, Recursion]:
        """What the window says against the state at its time, and a copy that has taken it."""
        told, trial, rows, wandered = self._against(summary)
        trial._take(rows, wandered)
        return told, trial

    def _against(self, summary: Summary) -> tuple[Innovation, Recursion, WindowRows, JointState]:
        trial = self.copy()
        rows = trial._know(summary)
        state = trial._wandered(trial._joint.state, trial._day, summary.day)
        return innovation(rows.at(state, state.mean, trial._noise), state), trial, rows, state

    @property
    def lag_s(self) -> float:
        """By how much the sensor's indications come after the reference's; as stated before any window told."""
        told = (m for q, m in zip(self._joint.state.quantities, self._joint.state.mean, strict=True) if q.kind is LAG)
        return float(next(told, self._priors.of(LAG.mean)))

    @property
    def determined(self) -> Flags:
        """(12,) see calib.estimate.determined."""
        mean, covariance = self._parameters()
        return determined(mean, np.sqrt(np.diag(covariance)), self._prior_u, np.ones(12, dtype=bool))

    def result(self) -> Calibration:
        """S and Q as they are; where a parameter is not determined, still what was known beforehand of it."""
        mean, covariance = self._parameters()
        freedom = self._noise.degrees_of_freedom or np.inf
        return Calibration(mean[:9].reshape(3, 3), mean[9:], covariance, self.determined, freedom, METHOD)

    @property
    def coverage_factor(self) -> float:
        """For about 95 % coverage."""
        return coverage_factor(self._noise.degrees_of_freedom or np.inf)

    def _parameters(self) -> tuple[Array, Array]:
        """S and Q (12,) and their covariance."""
        mean, factor = self._parameters_factor()
        return mean, np.asarray(factor @ factor.T)

    def _parameters_factor(self) -> tuple[Array, Array]:
        if self._held is not None:
            return self._held.parameters(self._joint.state)
        return self._joint.state.mean[:12].copy(), self._joint.state.factor[:12].copy()

    def law(self, day: float | None = None) -> Law:
        """S and Q over temperature, with all that their covariance knows of each other; `day`: wandered on until it."""
        if day is not None:
            waited = self.copy()
            waited._joint.state = self._wandered(self._joint.state, self._day, day)
            return waited.law()
        order, rows = self._temperature.offset_order, self._temperature.sensitivity_order > 0
        state = self._joint.state
        more = [state.index(quantity.name) for quantity, _ in self._temperature.terms(self.scale)]
        mean, factor = self._parameters_factor()
        mean, factor = np.append(mean, state.mean[more]), np.vstack([factor, state.factor[more]])
        low, high = self.temperature_range_degc
        u_beyond = self._temperature.u_offset_mps2[1] * self.scale
        return Law(
            mean, factor @ factor.T, order, rows, self.reference_temperature_degc, low, high, u_beyond, self.determined
        )

    def quantity(self, name: str) -> tuple[float, float]:
        """(value, standard uncertainty) of anything in the state. Raises ValueError where it is not in it."""
        k = self._joint.state.index(name)
        return float(self._joint.state.mean[k]), float(np.sqrt(self._joint.state.variance[k]))

    @property
    def residual_sd(self) -> Array:
        """(3,) of single points in the newest window, output unit; NaN before any."""
        return self._residual_sd.copy()

    @property
    def reference_temperature_degc(self) -> float:
        """To which S and Q refer."""
        return self._temperature.reference_degc

    @property
    def names(self) -> list[str]:
        """Of all quantities in the state."""
        return list(self._joint.state.names)

    @property
    def temperature_range_degc(self) -> tuple[float, float]:
        """Lowest and highest temperature of a window taken; NaN before any."""
        low, high = self._temperature_range
        return (low, high) if low <= high else (np.nan, np.nan)

    # --- changing

    def update(self, summary: Summary) -> None:
        """Take a window: one correction of everything."""
        rows = self._know(summary)
        self._take(rows, self._wandered(self._joint.state, self._day, summary.day))

    def _take(self, rows: WindowRows, wandered: JointState) -> None:
        summary = rows.summary
        self._joint.state = self._corrected(wandered, rows)
        self._day = _later(self._day, summary.day)
        self._joint.recent.append(summary)
        self._settle()
        if len(self._joint.recent) > MOST_RECENT:
            self._absorb(1)
        self._noise = self._noise.pooled(rows.noise)
        self._residual_sd = summary.data.type_a.noise[0].copy()
        if np.isfinite(summary.temperature_degc):
            low, high = self._temperature_range
            self._temperature_range = (min(low, summary.temperature_degc), max(high, summary.temperature_degc))
        self._keep_positions(summary.pose.position)
        self.windows += 1

    def loosen(self, standard_uncertainty: Array, tilt_rad: float = 0.0, *, line: bool = False) -> None:
        """Something changed: S and Q (12,) may be off by as much more from now on, and a fixed mount be tilted.

        `line`: a device or its line may have begun anew, which makes the lag another.
        """
        self._absorb(len(self._joint.recent))
        u = np.zeros(len(self._joint.state))
        u[:12] = standard_uncertainty
        for k, quantity in enumerate(self._joint.state.quantities):
            if quantity.kind.loosened_by == "lean" and self._fixed:
                u[k] = tilt_rad
            elif quantity.kind.loosened_by == "line" and line:
                u[k] = self._priors.of(quantity.kind.prior)
        self._joint.state.spread(u**2)
        self._joint.base = self._joint.state.copy()

    def forget_reference(self) -> None:
        """Another reference: what is known of the old one's own sensitivity and lag holds no more."""
        self.put(self.result())
        self._joint.keep([not quantity.kind.of_reference for quantity in self._joint.state.quantities])

    def put(self, calibration: Calibration) -> None:
        """S and Q as an operator wants them, with their covariance; what the nuisances are in them, they stay."""
        self._absorb(len(self._joint.recent))
        self._joint.state.mean[:12], self._joint.state.factor[:12] = self._parameters_factor()
        values = np.append(calibration.sensitivity.ravel(), calibration.offset)
        self._joint.state.restate(slice(0, 12), values, calibration.covariance)
        self._held = None  # Q itself is known again; the next window of a fixed mount makes the mean output of it
        self._joint.base = self._joint.state.copy()
        self._joint.point = self._joint.state.mean.copy()

    def copy(self) -> Recursion:
        """An independent copy, to try windows on."""
        other = object.__new__(Recursion)
        other.__dict__.update(self.__dict__)
        other._joint, other._positions = self._joint.copy(), list(self._positions)
        return other

    # --- inside

    def _rows(self, summary: Summary) -> WindowRows:
        reference_degc = self._temperature.reference_degc
        held = self._held.mps2 if self._held is not None else np.zeros(3) if self._fixed else None
        return WindowRows(summary, self._priors, self.scale, reference_degc, held, self.temperature_range_degc)

    def _wandered(self, state: JointState, since: float | None, day: float) -> JointState:
        """A copy of the state, wandered on to `day`; earlier days are as now."""
        elapsed = 0.0 if since is None else max(day - since, 0.0)
        tilted = 0.0 if self._held is None else float(np.linalg.norm(self._held.mps2))
        a_day = self._wander.variance_a_day(state.quantities, self.scale, tilted)
        return wandered(state, elapsed, a_day, self._joint.bound)

    def _mount(self, summary: Summary) -> None:
        """At the first window of a fixed mount: Q gives its place to the mean output there."""
        if self._fixed and self._held is None and np.isfinite(summary.held_mps2).all():
            self._held, terms = held_at(summary, self._priors)
            self._held.mount(self._joint, terms)

    def _unmount(self, held: Held) -> None:
        """The mount turned after all: from now on means tell Q and S alike."""
        self._absorb(len(self._joint.recent))
        held.unmount(self._joint)
        self._held, self._fixed = None, False

    def _know(self, summary: Summary) -> WindowRows:
        """Nuisances that no window had before come in with their priors; the window's rows."""
        if self._held is not None and not never_turned(np.array([self._held.mps2, summary.held_mps2])):
            self._unmount(self._held)
        self._mount(summary)
        rows = self._rows(summary)
        new = self._joint.append(rows.terms)
        if new and self._held is not None:
            self._held = self._held.moved_by(held_at(summary, self._priors)[0], new)
        return rows

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
            if not self._joint.moved(self.scale):
                return
            self._joint.point = self._joint.state.mean.copy()
            state, since = self._joint.base, self._joint.base_day
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

    # --- state

    def snapshot(self) -> dict[str, Any]:
        """All that changes, exactly."""
        return self._joint.snapshot() | {
            "prior_u": self._prior_u.copy(),
            "positions": list(self._positions),
            "noise": asdict(self._noise),
            "day": self._day,
            "temperature_range": list(self._temperature_range),
            "residual_sd": self._residual_sd.copy(),
            "fixed": self._fixed,
            "held": None if self._held is None else {"mps2": self._held.mps2, "by": dict(self._held.by)},
            "windows": self.windows,
            "scale": self.scale,
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from a snapshot of a recursion that was made with the same settings.

        Unknowns that an older version of the program did not have come in with their priors.
        """
        self._joint = Linearised.load(state)
        self._prior_u = np.array(state["prior_u"])
        self._positions = list(state["positions"])
        self._noise = Noise(**state["noise"])
        self._day = state["day"]
        low, high = state["temperature_range"]
        self._temperature_range = (low, high)
        self._residual_sd = np.array(state["residual_sd"])
        self._fixed = self._fixed and state.get("fixed", True)  # a mount that turned once is fixed no more
        self._held = None if state["held"] is None else Held(**state["held"])
        self.windows, self.scale = state["windows"], state["scale"]
        for summary in self._joint.recent[-1:]:
            self._know(summary)


def _later(day: float | None, other: float) -> float:
    return other if day is None else max(day, other)
