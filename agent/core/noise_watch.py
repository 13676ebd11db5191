"""Whether the noise of a sensor has grown: the residuals of each window beside those of the first windows.

Residuals grow with the motion, by what is not known of the response, the lever arm or the clocks; in proportion to it
at most. So each of the first windows bounds the noise of another one: its own noise, multiplied by the ratio of the
motions where the other one moves more. The third lowest of these bounds is what is expected. How much more noise the
first windows have than is expected by the others tells how much is usual; a sensor whose noise has grown has more of it
in three windows in a row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib.geometry import AXES
from calib.model import Array
from calib.state.state import MOST_REFERENCES
from calib.windows.record import Record

FIRST = 24  # windows that are learnt: of fewer, the third largest number is no bound of what is usual
LOW = 2  # so many of the bounds may be too low, and so many of the first windows too noisy
IN_A_ROW = 3
GROWN, SCATTERS = np.log(1.5), 4.0  # beyond what is usual: at least so much, and so many SDs of the first windows
AGAIN = np.log(2.0)  # growth since the last message, for the next one
KEPT = ("first", "usual", "newest", "grown")


@dataclass(slots=True)
class NoiseHistory:
    """Of the windows beside one reference, all as logarithms: `first` (n, 4) motion and noise of the first ones,
    `usual` (3,) by how much a sound one may exceed what is expected, `newest` (k, 3) by how much the newest ones do,
    and `grown` (3,) what was told of that."""

    first: Array = field(default_factory=lambda: np.zeros((0, 4)))
    usual: Array = field(default_factory=lambda: np.full(3, np.inf))
    newest: Array = field(default_factory=lambda: np.zeros((0, 3)))
    grown: Array = field(default_factory=lambda: np.zeros(3))

    def update(self, motion: float, noise: Array) -> list[tuple[int, float]]:
        """A window with the logarithms of its motion and of its noise (3,). Which outputs have other noise now, and how
        much more than is expected, as a logarithm; 0 where it is as it was."""
        if len(self.first) < FIRST:
            self.first = np.vstack([self.first, [motion, *noise]])
            self.usual = _usual(self.first) if len(self.first) == FIRST else self.usual
            return []
        self.newest = np.vstack([self.newest, noise - expected(self.first, motion)])[-IN_A_ROW:]
        if len(self.newest) < IN_A_ROW:
            return []
        least = np.where(self.grown > 0.0, self.grown + AGAIN, self.usual)
        more = np.flatnonzero(self.newest.min(axis=0) > least)
        back = np.flatnonzero((self.grown > 0.0) & (self.newest.max(axis=0) <= self.usual))
        self.grown[more], self.grown[back] = np.median(self.newest, axis=0)[more], 0.0
        return [(int(k), float(self.grown[k])) for k in sorted([*more, *back])]


def expected(first: Array, motion: float) -> Array:
    """(3,) the logarithm of the noise that windows `first` (n, 4) let expect of one with this motion."""
    return np.asarray(np.sort(first[:, 1:] + np.maximum(0.0, motion - first[:, :1]), axis=0)[LOW])


def _usual(first: Array) -> Array:
    """(3,) by how much more a window may exceed what is expected than the first windows (n, 4) do by the others."""
    others = ~np.eye(len(first), dtype=bool)
    beyond = np.array([own[1:] - expected(first[of], own[0]) for own, of in zip(first, others, strict=True)])
    spread = 1.4826 * np.median(np.abs(beyond - np.median(beyond, axis=0)), axis=0)
    return np.asarray(np.sort(beyond, axis=0)[-1 - LOW] + np.maximum(GROWN, SCATTERS * spread))


class NoiseWatch:
    """Watches the noise of the windows of a sensor."""

    def __init__(self) -> None:
        self._of: dict[str, NoiseHistory] = {}

    def update(self, record: Record, scale: float) -> str:
        """The news of a window for the operator; "" if there is none. `scale`: output unit per m/s2."""
        motion = float(np.sqrt(np.sum(record.slopes**2) / record.count))
        density = record.noise / np.sqrt(record.independent)  # without filter: a narrower one passes less of it
        if not 0.0 < motion < np.inf or not (np.isfinite(density) & (density > 0.0)).all():
            return ""
        known = self._of.pop(record.reference, None) or NoiseHistory()
        self._of = dict([*self._of.items(), (record.reference, known)][-MOST_REFERENCES:])
        changed = known.update(float(np.log(motion)), np.log(density))
        return "; ".join(_sentence(AXES[k], density[k] / scale, float(np.exp(more))) for k, more in changed)

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {reference: {name: getattr(own, name).copy() for name in KEPT} for reference, own in self._of.items()}

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._of = {
            reference: NoiseHistory(*(np.array(own[name]) for name in KEPT)) for reference, own in state.items()
        }


def _sentence(axis: str, noise_mps2: float, times: float) -> str:
    if times == 1.0:
        return f"the noise of output {axis} is as it was before: {noise_mps2:.3g} m/s2"
    return (
        f"the noise of output {axis} has grown: {noise_mps2:.3g} m/s2, in the last {IN_A_ROW} windows {times:.3g} "
        f"times what their motion lets expect by the first {FIRST} windows. Look at supply, cable and mount of the "
        "sensor, and at its reference"
    )
