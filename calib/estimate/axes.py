"""What makes S and Q fit for use: elements that a sensor can have, axes in their places, outputs that are not dead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib.model import PARAMETERS, Array, Calibration

AXES = "xyz"
LEAST_FELT = 0.1  # least sensitivity of a working output in its best direction, relative to the largest sensitivity
# Largest transverse sensitivity, relative to the largest sensitivity of its row. Data sheets of MEMS say 1 to 3 %, and
# 5 % at most; a sensor that is turned by 11 deg against what was stated has 20 %.
MOST_TRANSVERSE = 0.2
LEAST_S = 10.0  # of one window alone; some periods of the slowest motion that a hand or a structure has
COPIED = 1e-9  # relative: rows of S differ by less where two outputs hold the same samples


def sensitivity_reasons(found: Calibration, coverage_factor: float, *, stated: bool) -> list[str]:
    """The reasons why S cannot be a sensor's, each with its numbers; empty if it can.

    `stated`: the sensitivity was known before (nominal or prior). What was stated then decides, not the usual size of
    transverse sensitivities.
    """
    S, U = found.sensitivity, coverage_factor * found.standard_uncertainty[:9].reshape(3, 3)
    return (
        unusable(found, coverage_factor)
        or _dead_reasons(S, found.determined[:9].reshape(3, 3))
        or ([] if stated else _transverse_reasons(S, U))
    )


def unusable(found: Calibration, coverage_factor: float) -> list[str]:
    """The reason why S and Q may not be used, whatever was stated: no number, no main sensitivity, or U above it."""
    return _number_reasons(found) or _main_reasons(found, coverage_factor)


def _number_reasons(found: Calibration) -> list[str]:
    values = np.append(found.sensitivity.ravel(), found.offset)
    wrong = found.determined & ~(np.isfinite(values) & np.isfinite(found.standard_uncertainty))
    if not wrong.any():
        return []
    return [
        f"the estimate gives no number for {_listed([PARAMETERS[k] for k in np.flatnonzero(wrong)])}; "
        "measure longer, with more motion or in more positions"
    ]


def _dead_reasons(S: Array, told: NDArray[np.bool_]) -> list[str]:
    """A reason for each output (row of S) that responds to almost nothing, or for the reference's channel that is dead.

    `S` (3, 3), NaN where it is not known; `told` (3, 3): elements that the data determine. Exchanged axes are not
    refused here.
    """
    size = np.abs(np.where(told, S, np.nan))
    largest = float(np.nanmax(size, initial=0.0))
    felt = np.nanmax(size, axis=1, initial=0.0)
    whole = told.all(axis=1)
    weak = np.flatnonzero(whole & (felt < LEAST_FELT * largest))
    if len(weak) == 2 and _alike(size, weak):
        i, j = (int(k) for k in np.unravel_index(np.nanargmax(size), (3, 3)))
        return [
            f"{PARAMETERS[3 * i + j]} is {S[i, j]:.4g}, but outputs {AXES[weak[0]]} and {AXES[weak[1]]} have "
            f"{felt[weak[0]]:.4g} and {felt[weak[1]]:.4g}: the reference's channel along {AXES[j]} is dead or too "
            "weak (or both these outputs are); mend it, or use a reference that measures there"
        ]
    return [
        f"output {AXES[i]} is dead: its largest sensitivity is {felt[i]:.4g}, that of the others is {largest:.4g} "
        f"(limit {LEAST_FELT:.0%}); check the wiring of this output"
        for i in weak
    ]


def _alike(size: Array, rows: NDArray[np.int64]) -> bool:
    """Whether two outputs respond alike, each along its own axis: then they are sound, and it is too small what the
    third one's sensitivity is divided by. Dead outputs have only crosstalk."""
    third = int(np.nanargmax(np.nanmax(size, axis=0)))
    own = np.delete(size[rows], third, axis=1)
    felt = own.max(axis=1)
    alike = felt.min() > LEAST_FELT * felt.max() and bool(np.all(own.min(axis=1) < 0.5 * felt))
    return alike and own[0].argmax() != own[1].argmax()


def _main_reasons(found: Calibration, coverage_factor: float) -> list[str]:
    """Whether a main sensitivity is known, or the one in its place where axes are exchanged, and nothing is wider."""
    S, U = found.sensitivity, coverage_factor * found.standard_uncertainty[:9].reshape(3, 3)
    told = found.determined[:9].reshape(3, 3)
    size = np.where(np.isfinite(np.diag(S)) & (np.abs(S) > U), np.abs(S), 0.0)  # of columns whose main one is known
    main = float(size.max())
    if main == 0.0:
        return [
            "no main sensitivity (Sxx, Syy, Szz) is determined; measure with more motion along the sensor's axes, or "
            "in more positions"
        ]
    wide = np.where(told, U, 0.0)
    i, j = (int(k) for k in np.unravel_index(np.argmax(wide), (3, 3)))
    if wide[i, j] <= main:
        return []
    return [
        f"U({PARAMETERS[3 * i + j]}) is {wide[i, j]:.3g}, above the largest main sensitivity, {main:.3g}; measure "
        "longer, with more motion or in more positions"
    ]


def _transverse_reasons(S: Array, U: Array) -> list[str]:
    """Whether S is, within MOST_TRANSVERSE of the largest of each row, no permutation of the axes with signs."""
    size = np.abs(S)
    scale = _row_scale(S)
    judged = np.isfinite(S) & ~_permutation(S)
    judged[_copies(S)] = False
    beyond = np.where(judged, size - np.nan_to_num(U), 0.0) / scale[:, None]
    i, j = (int(k) for k in np.unravel_index(np.argmax(beyond), (3, 3)))
    if beyond[i, j] <= MOST_TRANSVERSE:
        return []
    return [
        f"{PARAMETERS[3 * i + j]} is {size[i, j] / scale[i]:.0%} of the largest sensitivity of row {AXES[i]}, "
        f"{scale[i]:.4g} (limit {MOST_TRANSVERSE:.0%}): the sensor is turned against what was stated, or an angle is "
        "wrong; correct the poses or the rotation. If the sensor is really so, state `nominal` or `prior`"
    ]


def _row_scale(S: Array) -> Array:
    """(3,) the largest sensitivity of each row; that of all S where the row is not whole, and has only small ones."""
    size = np.abs(S)
    every = float(np.nanmax(size, initial=0.0)) or 1.0
    rows = np.nanmax(size, axis=1, initial=0.0)
    whole = np.isfinite(S).all(axis=1) & (rows > 0.0)
    return np.where(whole | (rows > MOST_TRANSVERSE * every), rows, every)


def _permutation(S: Array) -> NDArray[np.bool_]:
    """(3, 3) one place in each row and column where S is largest: those of the axes, exchanged or not."""
    left = np.nan_to_num(np.abs(S)) / _row_scale(S)[:, None]
    placed = np.zeros((3, 3), dtype=bool)
    for _ in range(3):
        i, j = (int(k) for k in np.unravel_index(np.argmax(left), (3, 3)))
        placed[i, j] = True
        left[i], left[:, j] = -1.0, -1.0
    return placed


def _copies(S: Array) -> list[int]:
    """The outputs that are copied from another one, as people do it who have a sensor of one axis."""
    return [i for i in range(1, 3) if any(np.allclose(S[i], S[k], rtol=COPIED, atol=0.0, equal_nan=True)
                                          and np.isfinite(S[i]).any() for k in range(i))]  # fmt: skip


def axis_warnings(S: Array) -> list[str]:
    """A sentence for each sign that axes are exchanged or inverted. `S` (3, 3) is NaN where it is not known."""
    warnings = []
    if np.isfinite(S).all() and np.linalg.det(S) < 0.0:
        warnings.append(
            f"det S is negative ({np.linalg.det(S):.3g}): an axis is inverted, or two are exchanged; check the order "
            "and the signs of the columns, the sense of alpha, and the polarity of the reference"
        )
    if copies := _copies(S):
        names, holds = _listed([AXES[i] for i in copies]), "hold" if len(copies) > 1 else "holds"
        warnings.append(
            f"output {names} {holds} the samples of another output: only a sensor of one axis may be stated so"
        )
    size, shown = np.abs(S), MOST_TRANSVERSE * _row_scale(S)[:, None]
    off = _permutation(S) & ~np.eye(3, dtype=bool) & (np.nan_to_num(size) > shown)
    off[copies] = False
    if off.any():
        places = np.argwhere(off).tolist()
        told = ", ".join(f"{PARAMETERS[3 * i + j]} = {S[i, j]:.4g}" for i, j in places)
        rows = f"row{'s' * (len(places) > 1)} {_listed([AXES[i] for i, _ in places])}"
        warnings.append(
            f"the largest element of {rows} is off the diagonal ({told}): axes are exchanged, or a rotation by 90 deg "
            "is stated wrongly; check the order of the columns, the poses and the rotation"
        )
    inverted = [i for i in range(3) if S[i, i] < -shown[i, 0]]
    if inverted:
        told = ", ".join(f"{PARAMETERS[4 * i]} = {S[i, i]:.4g}" for i in inverted)
        warnings.append(
            f"{told}: the sensor indicates the opposite of the motion there; check the signs of the axes and the "
            "polarity of the reference"
        )
    return warnings


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def silent_directions(unexcited: Array) -> str:
    """A sentence on the directions (k, 3) in the sensor's frame that nothing excites; "" where there is no motion, or
    motion in all directions."""
    if len(unexcited) == 1:
        return f"the motion is in a plane, and nothing moves along its normal {_in_axes(unexcited[0])}"
    if len(unexcited) == 2:
        return f"all motion that the reference measures is along one direction, {_in_axes(np.cross(*unexcited))}"
    return ""


def _in_axes(direction: Array) -> str:
    return f"({', '.join(f'{round(part, 3):g}' for part in direction)}) in the sensor's axes x, y, z"
