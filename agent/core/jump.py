"""A jump that held windows confirm: the state with these windows, if S, Q, the mount or the reference changed before.

The windows cannot tell whether the sensor or its reference made a step d of the sensitivity, so S is wrong by 0 or by
d. The state follows the step, and u(S) grows by what the reference may have done, until something else tells S:
gravity, a second reference or an operator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from agent.core.gate import Limit
from calib.estimate.recursion import Recursion
from calib.estimate.reference_step import Alike
from calib.estimate.window_rows import Summary
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import Array

# A jump that is being confirmed may be of any size up to what an operator would hardly accept: 10 % of S, and in the
# offset two m/s2, which is a mount that leans by 12 deg.
JUMP_SENSITIVITY = 0.1
JUMP_OFFSET_MPS2 = 2.0
SURELY = 1.6  # U = 2 u covers the errors 0 and d if u is d / 1.6
SIGNIFICANT = 3.0  # standard uncertainties of a changed offset
LARGEST_PHASE_RAD = 0.1  # of a lag that was not taken out: its second order is then 0.5 % of S
WIDER = 3.0  # the possible jump over the one that was found: else the reference would take the larger part of it


def jumped(recursion: Recursion, held: Sequence[Summary], stability: float, limit: Limit) -> Recursion | None:
    """A copy of the state that has taken the held windows after a jump; None if they do not agree with each other.

    `stability` is that of the reference in a year, relative. `limit` is that of the gate.
    """
    first = with_jump(recursion, held, 0.0, lambda _: JUMP_SENSITIVITY / SURELY, limit)
    if first is None:
        return None
    before, after = recursion.result(), first.result()
    moved = np.abs(after.offset - before.offset)
    significant = moved > SIGNIFICANT * after.standard_uncertainty[9:]
    S = after.sensitivity - before.sensitivity

    def u_reference(way: Alike) -> float:
        """Standard uncertainty of the part that the reference has in the step, relative."""
        step = way.step(S, _value(first, way.key) - _value(recursion, way.key))
        return max(stability, abs(step) / SURELY) if step else 0.0

    leaning = tilt_rad(np.where(significant, moved, 0.0), recursion.scale)
    drifted = max((abs(after_drift - _value(recursion, key)) for key, after_drift in first.drifts), default=0.0)
    found = float(np.abs(S).max()) / recursion.scale + drifted
    return with_jump(recursion, held, leaning, u_reference, limit, max(1.0, WIDER * found / JUMP_SENSITIVITY))


def possible_jump(recursion: Recursion, held: Sequence[Summary]) -> Array:
    """(12,) how far S and Q may have jumped: only what these windows tell of, so that no other column moves."""
    told = np.any([recursion.innovation(summary).information > 0.0 for summary in held], axis=0)
    size = np.append(np.full(9, JUMP_SENSITIVITY), np.full(3, JUMP_OFFSET_MPS2)) * recursion.scale
    return np.where(told, size, 0.0)


def tilt_rad(offset: Array, scale: float) -> float:
    """The tilt of the mount that would move the mean output as much as an offset (3,), in output unit: the data cannot
    tell one from the other. `scale` is the output unit per m/s2."""
    return float(np.abs(offset).max(initial=0.0) / (scale * STANDARD_GRAVITY_MPS2))


def with_jump(
    recursion: Recursion,
    held: Sequence[Summary],
    leaning_rad: float,
    u_reference: Callable[[Alike], float],
    limit: Limit,
    wider: float = 1.0,
) -> Recursion | None:
    """See `jumped`. `leaning_rad`: by how much a fixed mount may have leaned; `u_reference` by how much the reference
    may have stepped, relative. None also if the response over frequency or the lag has changed."""
    trial = recursion.copy()
    # A line that was plugged anew may be late by another time; that is no change of S or Q.
    trial.loosen(wider * possible_jump(recursion, held), leaning_rad, line=True, another_filter=True)
    trial.suspect_reference(held, u_reference)
    for k, summary in enumerate(held):
        told = trial.innovation(summary)
        if k and told.statistic > limit(told.degrees_of_freedom):
            return None
        trial.update(summary)
    # With another filter or lag, the windows were made with the wrong ones taken out: they tell no exact S.
    phase_rad = max(abs(trial.lag_s - summary.lag_s) * float(np.sqrt(summary.data.omega2.max())) for summary in held)
    return None if phase_rad > LARGEST_PHASE_RAD or trial.has_another_response(recursion) else trial


def _value(recursion: Recursion, key: str) -> float:
    return recursion.quantity(key)[0] if key in [q.key for q in recursion.quantities] else 0.0
