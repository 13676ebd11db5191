"""A joint state with its recent windows, all linearised at the same point (see calib.estimate.window_state)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib.estimate.joint_state import JointState
from calib.estimate.quantities import ALL_RATES, SENSITIVITY_RATE, YEAR_DAYS, Kind, Quantity
from calib.estimate.terms import Term
from calib.estimate.window_rows import Summary
from calib.model import Array


class Linearised:
    """A state that contains all windows, a base that contains all but the recent ones, and the point of linearisation.

    All three have the same N quantities. `base_day` is the day of the base, None before the first window; `recent` are
    the recent windows; `point` (N,) are the values at which they are linearised. `certified_day` is the date of the
    certificate of the present reference, None if it is not stated.
    """

    def __init__(self, state: JointState) -> None:
        self.state, self.base = state, state.copy()
        self.base_day: float | None = None
        self.recent: list[Summary] = []
        self.point = state.mean.copy()
        self.certified_day: float | None = None

    @property
    def bound(self) -> Array:
        """(N,) the largest variance that random walks may reach: that of the prior, for a nuisance four times that.

        Later the mount may lean by more than its prior says of the day of mounting. A reference drifts without a limit.
        """
        kinds = [quantity.kind for quantity in self.state.quantities]
        most = np.where([kind.of_nuisance for kind in kinds], 4.0, 1.0) * self.state.stated_u**2
        return np.where([kind.since_certificate for kind in kinds], np.inf, most)

    def begun(self, term: Term, day: float) -> float:
        """Standard uncertainty with which a nuisance begins on `day`; see `Kind.since_certificate`."""
        if not term.kind.since_certificate:
            return term.uncertainty
        years = 0.0 if self.certified_day is None else (day - self.certified_day) / YEAR_DAYS
        return float(term.uncertainty * np.sqrt(max(years, 0.0)))

    def append(self, terms: Sequence[Term], day: float) -> list[str]:
        """Add each nuisance that the state does not have yet, with its prior on `day`. Returns their keys."""
        new = [term for term in terms if term.key not in self.state]
        for term in new:
            self._add(term.quantity, term.expected, self.begun(term, day))
            if term.kind.walk is not None:
                self.append_first([len(self.state) - 1])
        return [term.key for term in new]

    def add_rates(self, parameters: Iterable[int]) -> None:
        """Add the rates of these parameters that the state does not have yet, with the value and uncertainty 0."""
        for p in parameters:
            if ALL_RATES[p] not in self.state:
                self._add(Quantity(ALL_RATES[p], SENSITIVITY_RATE), 0.0, 0.0)

    def append_first(self, concerned: Iterable[int]) -> None:
        """Add the first value of these nuisances, unless the state has it, before they change.

        The base must have their present values: they are new, or no window is recent.
        """
        for k in concerned:
            quantity = self.state.quantities[k]
            if quantity.kind.of_nuisance and not quantity.first and replace(quantity, first=True).key not in self.state:
                for state in (self.state, self.base):
                    state.append_first(k)
                self.point = np.append(self.point, self.point[k])

    def _add(self, quantity: Quantity, mean: float, u: float) -> None:
        for state in (self.state, self.base):
            state.append(quantity, mean, u)
        self.point = np.append(self.point, mean)

    def keep(self, kept: Sequence[bool]) -> None:
        """Remove all other quantities. Before the call, the recent windows must have been moved to the base."""
        self.point = self.point[np.array(kept)]
        self.state.keep(kept)
        self.base = self.state.copy()

    def keep_in_base(self, kept: Sequence[bool]) -> None:
        """Remove all other quantities from the base. The recent windows must be taken again."""
        self.base.keep(kept)
        self.begin_with(self.base, self.base_day)

    def begin_with(self, base: JointState, day: float | None = None) -> None:
        """Replace the base. The recent windows must be taken again."""
        points = dict(zip(self.state.keys, self.point, strict=True))
        self.base, self.base_day, self.state = base, day, base.copy()
        self.point = np.array([points.get(key, mean) for key, mean in zip(base.keys, base.mean, strict=True)])

    def shift(self, kind: Kind, owner: str, factor: float, amount: float) -> None:
        """State all unknowns of a kind and an owner against another zero (see JointState.shift)."""
        for state in (self.state, self.base):
            for k, quantity in enumerate(state.quantities):
                if (quantity.kind, quantity.owner) == (kind, owner):
                    state.shift(k, factor, amount)
        self.point = self.state.mean.copy()

    def hand_over(self, owner: str, new_owner: str, *, of_place: bool = False) -> dict[str, str]:
        """Give the quantities and the recent windows of a reference another name of the same reference.

        With `of_place`: what belongs to the place of a reference goes to the next one there; no window may be recent.
        Returns the new key of each quantity by its old one.
        """
        before = list(self.state.keys)
        for state in (self.state, self.base):
            state.hand_over(owner, new_owner, of_place=of_place)
        self.recent = [replace(w, reference=new_owner) if w.reference == owner else w for w in self.recent]
        return dict(zip(before, self.state.keys, strict=True))

    def moved(self, scale: float) -> bool:
        """Whether an unknown is so far from the point that the windows must be linearised again (see `Kind.straight`).

        `scale` is the sensor's output unit per m/s2.
        """
        kinds = [quantity.kind for quantity in self.state.quantities]
        limit = [kind.straight * (scale if kind.in_output_unit else 1.0) for kind in kinds]
        return bool(np.any(np.abs(self.state.mean - self.point) > limit))

    def copy(self) -> Linearised:
        """An independent copy."""
        other = Linearised(self.state.copy())
        other.base, other.base_day, other.recent = self.base.copy(), self.base_day, list(self.recent)
        other.point, other.certified_day = self.point.copy(), self.certified_day
        return other

    def snapshot(self) -> dict[str, Any]:
        """The complete state, for `load`; bit for bit."""
        return {
            "state": self.state.snapshot(),
            "base": self.base.snapshot(),
            "base_day": self.base_day,
            "recent": [summary.snapshot() for summary in self.recent],
            "point": self.point.copy(),
            "certified_day": self.certified_day,
        }

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> Linearised:
        """The object whose snapshot this is."""
        loaded = cls(JointState.load(state["state"]))
        loaded.base, loaded.base_day = JointState.load(state["base"]), state["base_day"]
        loaded.recent = [Summary.load(summary) for summary in state["recent"]]
        loaded.point, loaded.certified_day = np.array(state["point"]), state["certified_day"]
        return loaded
