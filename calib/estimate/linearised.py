"""A joint state with its recent windows, which are all linearised at the same point (see calib.estimate.recursion)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.estimate.joint_state import JointState
from calib.estimate.terms import Term
from calib.estimate.window_rows import Summary


class Linearised:
    """A state that contains all windows, a base that contains all but the recent ones, and the point of linearisation.

    All three have the same N quantities. `base_day` is the day of the base, None before the first window; `recent` are
    the recent windows; `point` (N,) are the values at which they are linearised; `bound` (N,) is the largest variance
    that random walks may reach.
    """

    def __init__(self, state: JointState) -> None:
        self.state, self.base = state, state.copy()
        self.base_day: float | None = None
        self.recent: list[Summary] = []
        self.point = state.mean.copy()
        self.bound = state.variance.copy()

    def append(self, terms: Sequence[Term]) -> list[str]:
        """Add each nuisance that the state does not have yet, with its prior. Returns the names of those added."""
        new = [term for term in terms if term.name not in self.state.names]
        for term in new:
            for state in (self.state, self.base):
                state.append(term.quantity, term.expected, term.uncertainty)
            self.point = np.append(self.point, term.expected)
            # Twice the stated u: later the mount may lean by more than its prior says of the day of mounting.
            self.bound = np.append(self.bound, (2.0 * term.uncertainty) ** 2)
        return [term.name for term in new]

    def keep(self, kept: Sequence[bool]) -> None:
        """Remove all other quantities. Before the call, the recent windows must have been moved to the base."""
        self.bound, self.point = self.bound[np.array(kept)], self.point[np.array(kept)]
        self.state.keep(kept)
        self.base = self.state.copy()

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
        other.point, other.bound = self.point.copy(), self.bound.copy()
        return other

    def snapshot(self) -> dict[str, Any]:
        """The complete state, for `load`; bit for bit."""
        return {
            "state": self.state.snapshot(),
            "base": self.base.snapshot(),
            "base_day": self.base_day,
            "recent": [summary.snapshot() for summary in self.recent],
            "point": self.point.copy(),
            "bound": self.bound.copy(),
        }

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> Linearised:
        """The object whose snapshot this is."""
        loaded = cls(JointState.load(state["state"]))
        loaded.base, loaded.base_day = JointState.load(state["base"]), state["base_day"]
        loaded.recent = [Summary.load(summary) for summary in state["recent"]]
        loaded.point, loaded.bound = np.array(state["point"]), np.array(state["bound"])
        return loaded
