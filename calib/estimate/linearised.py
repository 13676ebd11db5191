"""A joint state of which all recent windows are linearised at one point (see calib.estimate.recursion)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.estimate.joint_state import JointState
from calib.estimate.terms import Term
from calib.estimate.window_rows import Summary


class Linearised:
    """The state with all windows, the base without the recent ones, and the point: always of the same quantities.

    `base_day` is the day of the base, None before any window; `point` (N,) the values at which the recent windows are
    linearised; `bound` (N,) the variance that wandering may not exceed.
    """

    def __init__(self, state: JointState) -> None:
        self.state, self.base = state, state.copy()
        self.base_day: float | None = None
        self.recent: list[Summary] = []
        self.point = state.mean.copy()
        self.bound = state.variance.copy()

    def append(self, terms: Sequence[Term]) -> list[str]:
        """Nuisances that are not in the state yet come in with their priors; their names."""
        new = [term for term in terms if term.name not in self.state.names]
        for term in new:
            for state in (self.state, self.base):
                state.append(term.quantity, term.expected, term.uncertainty)
            self.point = np.append(self.point, term.expected)
            # A mount may come to lean by more than anybody stated of the day it was made.
            self.bound = np.append(self.bound, (2.0 * term.uncertainty) ** 2)
        return [term.name for term in new]

    def keep(self, kept: Sequence[bool]) -> None:
        """Forget the other quantities; the recent windows must be in the base."""
        self.bound, self.point = self.bound[np.array(kept)], self.point[np.array(kept)]
        self.state.keep(kept)
        self.base = self.state.copy()

    def moved(self, scale: float) -> bool:
        """Whether an unknown has left the point by more than its product with S counts as straight.

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
        """All of it, exactly."""
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
        """Of a snapshot."""
        loaded = cls(JointState.load(state["state"]))
        loaded.base, loaded.base_day = JointState.load(state["base"]), state["base_day"]
        loaded.recent = [Summary.load(summary) for summary in state["recent"]]
        loaded.point, loaded.bound = np.array(state["point"]), np.array(state["bound"])
        return loaded
