"""Two references beside one sensor: which of the three devices has made a step.

If the windows of one reference contradict the state, and those of the other one fit it, either the first reference has
changed, or the windows that fit are too weak to show a step of the sensor. So the step of the sensor that the held
windows show is tried on the windows of the other reference. If it contradicts them, the sensor did not make it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from agent.core.gate import Limit
from agent.core.jump import JUMP_SENSITIVITY, SIGNIFICANT, SURELY, with_jump
from calib.estimate.quantities import REFERENCE, REFERENCE_DRIFT
from calib.estimate.recursion import Recursion
from calib.estimate.window_rows import Summary


class Witnesses:
    """Windows that the state took while others are held. `devices` are the references of the channel, by place."""

    def __init__(self, devices: Sequence[str | None]) -> None:
        self._devices = list(devices)
        self._taken: list[Summary] = []

    def update(self, summary: Summary, *, taken: bool, held: int) -> None:
        """A window was judged; as many windows are `held` now."""
        if not held:
            self._taken = []
        elif taken and len(self._devices) > 1:
            self._taken = [*self._taken, summary][-2 * held :]

    def judge(
        self, recursion: Recursion, held: Sequence[Summary], jump: Recursion | None, limit: Limit, place: int
    ) -> tuple[Recursion | None, str]:
        """The state to adopt after the held windows, and which device has changed, for the operator.

        `jump` is the state if the sensor has changed; None if the held windows do not agree with each other. `place` is
        that of the reference in use. With one reference the answer is `jump`.
        """
        if jump is None or len(self._devices) == 1:
            return jump, ""
        own, other = self._devices[place], self._devices[1 - place]
        if len({summary.reference for summary in held}) > 1:
            return jump, f": windows with {own} and with {other} show the same change, so the sensor has changed"
        others = [w for w in self._taken if w.reference != recursion.reference and w.day > held[0].day]
        if not others or not _contradicted(recursion, held, others, limit):
            return jump, f": no window with {other} tells whether the sensor or the reference {own} has changed"
        after, step = _reference_moved(recursion, held, limit)
        return after, (
            f": the reference {own} has changed by {step}, because windows with {other} still agree with S. S stays as "
            f"it was; have {own} calibrated"
        )

    def snapshot(self) -> list[dict[str, Any]]:
        """State for `load`, bit-exact."""
        return [summary.snapshot() for summary in self._taken]

    def load(self, state: Sequence[Mapping[str, Any]]) -> None:
        """Take the state that `snapshot` gave."""
        self._taken = [Summary.load(summary) for summary in state]


def _contradicted(recursion: Recursion, held: Sequence[Summary], others: Sequence[Summary], limit: Limit) -> bool:
    """Whether the windows `others` contradict that the sensor made the step that the held windows show."""
    trial = with_jump(recursion, held, 0.0, lambda _: 0.0, limit)
    if trial is None:
        return False
    chi2, freedom = 0.0, 0
    for summary in others:
        told, trial = trial.with_window(summary)
        chi2, freedom = chi2 + told.statistic, freedom + told.degrees_of_freedom
    return chi2 > limit(freedom)


def _reference_moved(recursion: Recursion, held: Sequence[Summary], limit: Limit) -> tuple[Recursion | None, str]:
    """The state after another sensitivity of the reference in use, with the sizes of this step as text.

    None if another sensitivity of this reference does not explain the held windows.
    """
    own = [q for q in recursion.quantities if q.owner == recursion.reference and not q.first]
    # A reference that is stated not to drift has no drift in the state.
    kind = REFERENCE_DRIFT if any(q.kind is REFERENCE_DRIFT for q in own) else REFERENCE
    channels = [q for q in own if q.kind is kind]
    u = np.array([JUMP_SENSITIVITY / SURELY if q in channels else 0.0 for q in recursion.quantities])
    trial = recursion.copy()
    trial.loosen(u, line=True)
    for k, summary in enumerate(held):
        told = trial.innovation(summary)
        if k and told.statistic > limit(told.degrees_of_freedom):
            return None, ""
        trial.update(summary)
    sizes = []
    for quantity in channels:
        (value, u_value), before = trial.quantity(quantity.key), recursion.quantity(quantity.key)[0]
        if abs(value - before) > SIGNIFICANT * u_value:
            axis = f"{quantity.name[-1]} " if len(channels) > 1 else ""
            sizes.append(f"{axis}{100.0 * (value - before):+.3g} %")
    return trial, ", ".join(sizes)
