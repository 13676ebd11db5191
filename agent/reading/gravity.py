"""Samples that are in g although their file states m/s2.

A frequent fault of drivers: sensor_msgs/msg/Imu (ros2/common_interfaces) asks for m/s2 "not in g's".
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agent.reading.source import ROWS_AT_ONCE
from calib.model import Slices
from calib.recorded.choice import ChosenColumn
from calib.recorded.units import unit_of

MEANT = 64  # samples whose mean shows gravity without the motion
MIDDLE = (0.25, 0.75)
NEAR_ONE = 0.2  # relative; Livox-SDK/livox_ros_driver pull request 98 shows 0.88 g at rest


def unit_warning(path: Path, option: str, chosen: Sequence[ChosenColumn], values: Slices) -> tuple[str, ...]:
    """A line where time, x, y and z (`chosen`) state m/s2, but `values` (n, 3) have the magnitude 1 at rest.

    The magnitude is that of the mean of MEANT samples, so that neither motion nor turning matters. It must be near 1 in
    the middle half of all of these: motion without gravity has magnitudes of all kinds.
    """
    units = [unit_of(each.unit) for each in chosen[1:]]
    if len(units) != 3 or any(unit is None or (unit.quantity, unit.si) != ("acceleration", 1.0) for unit in units):
        return ()
    magnitudes = []
    for first in range(0, len(values), ROWS_AT_ONCE):
        rows = values[first : first + ROWS_AT_ONCE]
        rows = rows[np.isfinite(rows).all(axis=1)]
        whole = rows[: len(rows) // MEANT * MEANT].reshape(-1, MEANT, 3)
        magnitudes.append(np.linalg.norm(whole.mean(axis=1), axis=1))
    every = np.concatenate(magnitudes)
    if not len(every) or (np.abs(np.quantile(every, MIDDLE) - 1.0) > NEAR_ONE).any():
        return ()
    group = chosen[0].column.group
    names = ",".join(f"{word}={each.column.name}:g" for word, each in zip("xyz", chosen[1:], strict=True))
    stated = f"{option} {f'group={group},' if group else ''}time={chosen[0].column.name},{names}"
    return (
        f"{path}{f', {group}' if group else ''}: the magnitude at rest is {np.median(every):.3g}, but the unit is "
        f"m/s2: the samples are probably in g; if they are, state it: {stated}",
    )
