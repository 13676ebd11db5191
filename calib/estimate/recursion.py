"""Method 3 by adjustment, window by window: S, Q and every persistent nuisance as one state with its joint covariance.

Each window is one least-squares correction of the state (calib.estimate.window_state), so that the cost does not depend
on how long it has run. With no wandering the result is that of calib.estimate.adjustment for all windows at once.

What is known of a reference or a mount belongs to it: its unknowns stay in the state, with their covariance with S and
Q, through swaps, restarts and changes of the configuration.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from calib.distributions import coverage_factor
from calib.estimate.correction import Law
from calib.estimate.determined import determined
from calib.estimate.gauss_newton import Flags
from calib.estimate.innovation import Innovation, innovation
from calib.estimate.joint_state import JointState
from calib.estimate.quantities import ALL_RATES, GRAVITY, LAG, REFERENCE, REFERENCE_DRIFT, Quantity
from calib.estimate.reference_step import Alike, alike
from calib.estimate.response_told import ResponseTold
from calib.estimate.window_rows import Summary, WindowRows
from calib.estimate.window_state import WindowState
from calib.model import Array, Calibration
from calib.signal.response import Response

DATED = ", calibrated "  # in the identity of a reference whose certificate states its date
STEADY = np.zeros(12)  # rates of S and Q
METHOD = "3 (recursive adjustment)"


class Recursion(WindowState):
    """The state of one sensor. The methods under "reading" do not change it, those under "changing" do."""

    # --- reading

    def innovation(self, summary: Summary, *, at_its_lag: bool = False) -> Innovation:
        """What the window says against the state at its time.

        `at_its_lag`: linearised at the lag that was taken out of the window, not at the state's, which may be too far.
        """
        return self._against(summary, at_its_lag)[0]

    def with_window(self, summary: Summary, *, at_its_lag: bool = False) -> tuple[Innovation, Recursion]:
        """What the window says against the state at its time (see `innovation`), and a copy that has taken it."""
        told, trial, rows, wandered = self._against(summary, at_its_lag)
        trial._take(rows, wandered)
        return told, trial

    def _against(self, summary: Summary, at_its_lag: bool) -> tuple[Innovation, Recursion, WindowRows, JointState]:
        trial = self.copy()
        rows = trial._know(summary)
        state = trial._wandered(trial._joint.state, trial._day, summary.day)
        at = state.mean
        if at_its_lag:
            at, trial._joint.point = (rows.with_its_lag(state, values) for values in (at, trial._joint.point))
        return innovation(rows.at(state, at, trial._noise), state, at), trial, rows, state

    @property
    def lag_s(self) -> float:
        """By how much the sensor is later than the reference; as stated before any window told."""
        state, key = self._joint.state, Quantity("lag", LAG, owner=self.reference).key
        return float(state.mean[state.index(key)]) if key in state else self._beside[self._place].priors.of(LAG.mean)

    @property
    def response(self) -> Response:
        """The response of the sensor over that of the reference in use, to take out of the next window."""
        before = (kept.response for kept in reversed(self._joint.recent) if kept.reference == self.reference)
        return self._over.response(self._joint.state, self.reference, next(before, ()))

    @property
    def response_is_known(self) -> bool:
        """Whether windows have told it: one more cannot change it much."""
        return self._over.is_known(self._joint.state, self.reference)

    def response_is(self, taken: Response) -> bool:
        """Whether it is the one that was taken out of a window, but for a part of its uncertainty."""
        return self._over.is_taken_out(taken, self._joint.state, self.reference)

    def response_change(self, since: Recursion) -> tuple[float, float]:
        """The upper end of the motion in Hz, and by how much S is larger there than it was, relative."""
        to_hz = self._over.motion_hz[1] if self._over.motion_hz else self._over.first_hz
        now, before = (one._over.log_h(one._joint.state, self.reference, to_hz) for one in (self, since))
        return to_hz, float(np.expm1(now - before))

    def has_another_response(self, than: Recursion) -> bool:
        """Whether the response beside the reference in use is surely another than in an earlier state."""
        return self._over.differs(self._joint.state, than._joint.state, self.reference)

    @property
    def response_told(self) -> ResponseTold | None:
        """What is known of it, by frequency; None where it is no unknown."""
        return self._over.told(self._joint.state, self.reference, self._stated.priors, self.coverage_factor)

    @property
    def reference_frequency_hz(self) -> float:
        """The frequency at which S holds; 0 if nothing moved yet."""
        return self._over.reference_hz(self._stated.priors)

    @property
    def motion_to_hz(self) -> float:
        """Upper end of the motion that is used; inf before a window told a band that is wide enough for a response."""
        return self._over.to_hz

    @property
    def determined(self) -> Flags:
        """(12,) see calib.estimate.determined."""
        return self._determined(*self._parameters())

    def _determined(self, mean: Array, covariance: Array) -> Flags:
        u = np.sqrt(covariance.diagonal())
        return determined(mean, u, self._stated.standard_uncertainty, np.ones(12, dtype=bool))

    def result(self) -> Calibration:
        """S and Q as they are; where a parameter is not determined, still what was known beforehand of it."""
        mean, covariance = self._parameters()
        freedom = self._noise.degrees_of_freedom or np.inf
        told = self._determined(mean, covariance)
        return Calibration(mean[:9].reshape(3, 3), mean[9:], covariance, told, freedom, METHOD)

    @property
    def covariance(self) -> Array:
        """(12, 12) that of `result`."""
        return self._parameters()[1]

    @property
    def coverage_factor(self) -> float:
        """For about 95 % coverage."""
        return coverage_factor(self._noise.degrees_of_freedom or np.inf)

    def _parameters(self) -> tuple[Array, Array]:
        """S and Q (12,) and their covariance."""
        mean, factor = self._parameters_factor()
        return mean, np.asarray(factor @ factor.T)

    def law(self, day: float | None = None) -> Law:
        """S and Q over temperature, with all that their covariance knows of each other; `day`: wandered on until it."""
        if day is not None:
            waited = self.copy()
            waited._joint.state = self._wandered(self._joint.state, self._day, day)
            return waited.law()
        temperature = self._stated.temperature
        order, rows = temperature.offset_order, temperature.sensitivity_order > 0
        state = self._joint.state
        more = [state.index(quantity.name) for quantity, _ in temperature.terms(self.scale)]
        mean, factor = self._parameters_factor()
        mean, factor = np.append(mean, state.mean[more]), np.vstack([factor, self._factor()[more]])
        covariance, (low, high) = factor @ factor.T, self.temperature_range_degc
        told, u_beyond = self._determined(mean[:12], covariance[:12, :12]), temperature.u_offset_mps2[1] * self.scale
        return Law(mean, covariance, order, rows, self.reference_temperature_degc, low, high, u_beyond, told)

    def quantity(self, name: str) -> tuple[float, float]:
        """(value, u) of an unknown of the sensor, its mount or its present reference. Raises KeyError for another."""
        state = self._joint.state
        k = state.index(name if name in state else f"{name} of {self.reference}")
        return float(state.mean[k]), float(np.sqrt(state.variance[k]))

    @property
    def residual_sd(self) -> Array:
        """(3,) of single points in the newest window, output unit; NaN before any."""
        return self._residual_sd.copy()

    @property
    def reference_temperature_degc(self) -> float:
        """To which S and Q refer."""
        return self._stated.temperature.reference_degc

    @property
    def quantities(self) -> list[Quantity]:
        """All quantities in the state, also those of references that are away."""
        return list(self._joint.state.quantities)

    @property
    def names(self) -> list[str]:
        """Of all quantities of the sensor, its mount and its present reference."""
        return [q.name for q in self._joint.state.quantities if q.owner in ("", self.reference) and not q.first]

    @property
    def drifts(self) -> list[tuple[str, float]]:
        """(key, value) of the drift of each channel of the present reference, relative."""
        state = self._joint.state
        return [
            (q.key, float(state.mean[k]))
            for k, q in enumerate(state.quantities)
            if q.kind is REFERENCE_DRIFT and q.owner == self.reference and not q.first
        ]

    @property
    def references(self) -> list[str]:
        """References to whose errors S and Q owe their values; the newest window's is the last."""
        return list(self._references)

    @property
    def temperature_range_degc(self) -> tuple[float, float]:
        """Lowest and highest temperature of a window taken; NaN before any."""
        return self._seen_degc

    # --- changing

    def update(self, summary: Summary) -> None:
        """Take a window: one correction of everything."""
        rows = self._know(summary)
        self._take(rows, self._wandered(self._joint.state, self._day, summary.day))

    def loosen(
        self,
        standard_uncertainty: Array,
        tilt_rad: float = 0.0,
        *,
        u_rate: Array = STEADY,
        line: bool = False,
        another_filter: bool = False,
    ) -> None:
        """Something changed: S and Q (12,), or all `quantities` (N,), may be off by as much more from now on, and a
        fixed mount be tilted.

        `u_rate` (12,): S and Q may drift by as much more a day. `line`: a device or its line may have begun anew, which
        makes the lag another. `another_filter`: the response over frequency may be another.
        """
        self._absorb(len(self._joint.recent))
        drifting = np.flatnonzero(u_rate)
        self._joint.add_rates(drifting)
        u = np.zeros(len(self._joint.state))
        u[: len(standard_uncertainty)] = standard_uncertainty
        u[[self._joint.state.index(ALL_RATES[p]) for p in drifting]] = u_rate[drifting]
        for k, quantity in enumerate(self._joint.state.quantities):
            if quantity.first:
                continue
            if "lean" in quantity.kind.loosened_by and self._fixed:
                u[k] = tilt_rad
            elif quantity.owner == self.reference and (
                (line and "line" in quantity.kind.loosened_by)
                or (another_filter and "filter" in quantity.kind.loosened_by)
            ):
                u[k] = self._beside[self._place].priors.of(quantity.kind.prior)
        self._spread(u)

    def _spread(self, u: Array) -> None:
        """The quantities (N,) may be off by `u` more from now on; no window is recent."""
        self._joint.base = self._joint.state.copy()
        self._joint.append_first(np.flatnonzero(u).tolist())
        state = self._joint.state
        state.spread(np.append(u, np.zeros(len(state) - len(u))) ** 2)
        self._joint.base = state.copy()

    def remount(self, *, of_reference: bool) -> None:
        """The sensor was mounted again, or the reference in use was: what a mount decides may be another from now on.

        The new value is the old one and a difference: as large as that of two independent values, since it may be.
        """
        self._absorb(len(self._joint.recent))
        if self._held is not None and not of_reference:
            self._held.unmount(self._joint)
            self._held = None
        state, u = self._joint.state, np.zeros(len(self._joint.state))
        owners = [self.reference] if of_reference else ["", *self._mounted]
        for k, quantity in enumerate(state.quantities):
            there = quantity.owner in owners and (quantity.kind.of_reference or not of_reference)
            if there and not quantity.first and "remount" in quantity.kind.loosened_by:
                u[k] = np.sqrt(2.0) * state.stated_u[k]
        self._spread(u)

    def suspect_reference(self, windows: Sequence[Summary], u: Callable[[Alike], float]) -> None:
        """The reference may have stepped before these windows, each channel by `u` (relative). After `loosen` only."""
        rows, state = [self._know(summary) for summary in windows], self._joint.state
        for step in alike([own.at(state, state.mean, self._noise) for own in rows], state):
            state.suspect(u(step) * step.change)
        self._joint.base = state.copy()

    def date_certificate(self, day: float | None) -> None:
        """The date of the certificate of the reference in use; its drift counts from there. None: no date is stated."""
        self._joint.certified_day = day

    def use(self, place: int) -> None:
        """The next windows are of the reference at this place. Both are mounted all the time: nothing is loosened."""
        self._place = place

    def meet(self, reference: str, calibrated: str = "", sensitivity: float = 1.0) -> bool:
        """Another reference takes the place of the one in use. What is known of that one stays, and comes back with it.

        `calibrated` is the date of its certificate, "" where none is stated: a reference that was calibrated again is
        another one. `sensitivity` is that of its certificate. What the certificate states is exchanged for what was
        stated of this reference before. Returns whether that changed S or Q.
        """
        owner = self._owner(reference, calibrated)
        another = self._mounted[self._place] not in ("", owner)
        before, stated = self._references.get(owner) or sensitivity, self._beside[self._place]
        if another or before != sensitivity or self._before[self._place].of_references_differ(stated):
            self._absorb(len(self._joint.recent))  # these windows were made with other statements
        if another:
            self._rename(self._joint.hand_over(self._mounted[self._place], owner, of_place=True))
        if before != sensitivity:
            self._joint.shift(REFERENCE, owner, before / sensitivity, before / sensitivity - 1.0)
            self._references[owner] = sensitivity
        self._mounted[self._place], self._sensitivity[self._place] = owner, sensitivity
        changed = self._restate(owner)
        if another:
            self.remount(of_reference=True)
        return changed

    def _rename(self, keys: Mapping[str, str]) -> None:
        self._held = None if self._held is None else self._held.renamed(keys)

    def _owner(self, reference: str, calibrated: str) -> str:
        """The reference with the date of its certificate, as an owner of unknowns."""
        dated = f"{reference}{DATED}{calibrated}"
        if calibrated and dated not in self._references and reference in self._references:
            self._rename(self._joint.hand_over(reference, dated))  # the date of the same certificate was stated later
            self._references = {(dated if of == reference else of): s for of, s in self._references.items()}
            self._mounted = [dated if of == reference else of for of in self._mounted]
        if calibrated:
            return dated
        return next((known for known in reversed(self._references) if known.startswith(reference + DATED)), reference)

    def restate(self, gravity_mps2: tuple[float, float] | None = None) -> bool:
        """After `load`: put what is stated now of sensor and mount in the place of what was stated before.

        `gravity_mps2`: the local gravity as stated before and now, if that changed. What is stated of the reference
        follows when it is known which one is connected (`meet`). Returns whether S or Q changed.
        """
        if gravity_mps2 is not None:
            before, now = gravity_mps2
            self._joint.recent = [summary.with_gravity(now / before) for summary in self._joint.recent]
            self._joint.shift(GRAVITY, "", 1.0, before - now)
            self._held = None if self._held is None else self._held.with_gravity(now / before)
        return self._restate("")

    def _restate(self, reference: str) -> bool:
        changed = self._beside[self._place].restate(self._joint, self._before[self._place], self._held, reference)
        if changed:
            self._take_again()
            self._settle()
        for k, stated in enumerate(self._beside):
            self._before[k] = self._before[k].now(stated, of_reference=bool(reference) and k == self._place)
        return changed

    def put(self, calibration: Calibration) -> None:
        """S and Q as an operator wants them. Their covariance with the nuisances is not known: see `intersect`."""
        self._absorb(len(self._joint.recent))
        if self._held is not None:
            self._held.unmount(self._joint)
            self._held = None  # Q itself is known again; the next window of a fixed mount makes the mean output of it
        state = self._joint.state
        values = np.append(calibration.sensitivity.ravel(), calibration.offset)
        state.intersect(slice(0, 12), values, calibration.covariance)
        self._joint.base = state.copy()
        self._joint.point = state.mean.copy()
