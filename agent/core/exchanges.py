"""Held windows explained by outputs that are exchanged, inverted, or of another scale.

A range that fell back to its default, another unit, a plug that was turned, a board that was mounted anew, a firmware
with other axes: after each of them the outputs of a device are one of few matrices times what they were. Each held
window is computed as it would be without this matrix, and the innovation says how well the state explains it then. This
is linear, and nothing is solved anew. A reference is told from a sensor by gravity, of which the sensor alone shows
another size.

Where users met these causes: a range that fell back to 2 g (bolderflight/invensense-imu, issue 42;
wollewald/ADXL345_WE, issue 1); a range of 16 g that is 1.5 times a power of two (LIS3DH: lis3dh-pid by ST;
sparkfun/SparkFun_LSM9DS1_Arduino_Library, issue 9); g in place of m/s2 (Livox-SDK/livox_ros_driver2, issue 157); axes
that a library or a firmware exchanged or inverted (bolderflight/invensense-imu, issue 121; mesh-iit/ergocub-software,
issue 129).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Literal

import numpy as np

from agent.config import Channel
from agent.core.gate import Limit
from calib.geometry import AXES
from calib.geometry import STANDARD_GRAVITY_MPS2 as G
from calib.model import Array, Calibration, own_channels
from calib.state.state import State
from calib.windows.record import Record

RANGE = "its range is another one, as after a loss of supply"
SCALES: Mapping[float, str] = {
    **{factor: RANGE for size in (2.0, 4.0, 8.0, 16.0, 3.0, 6.0, 12.0) for factor in (size, 1.0 / size)},
    1.0 / G: "it gives g in place of m/s2",
    G: "it gives m/s2 in place of g",
    1000.0: "it gives mg in place of g, or mV in place of V",
    0.001: "it gives g in place of mg, or V in place of mV",
    1000.0 / G: "it gives mg in place of m/s2",
    G / 1000.0: "it gives m/s2 in place of mg",
}
# By so much sensitivity and offset may differ besides, as between two ranges: standard uncertainties. The factors of
# two causes differ by 18 % at least.
BESIDE, BESIDE_MPS2 = 0.03, 1.0
NEAR = 0.05  # of the slopes that a cause may leave more than the best one, to be compared with it by chi-squared
COMPARED = 12  # causes that are compared by all held windows
ALIKE = 10.0  # causes whose chi-squared differ by less are not told apart: a likelihood ratio of 150
MOST_TOLD = 3  # of causes that fit alike


@dataclass(frozen=True, slots=True, eq=False)
class Exchange:
    """One change: `matrix` (m, m) is by what the outputs of a device are multiplied, the sensor or the reference. Of a
    sensor that was turned on its "mount", it turns the acceleration in the sensor's frame."""

    matrix: Array
    of: Literal["sensor", "mount", "reference"] = "sensor"

    @property
    def factor(self) -> float | None:
        """Of another scale of all outputs; None where signs or places changed."""
        factor = float(self.matrix[0, 0])
        return factor if factor in SCALES and np.array_equal(self.matrix, factor * np.eye(len(self.matrix))) else None

    def device(self, channel: Channel) -> str:
        """The name of the device."""
        return (channel.reference or "") if self.of == "reference" else channel.sensor

    def undone(self, record: Record, S: Array, Q: Array) -> Record:
        """The window as it would be without the change; S (3, 3) and Q (3,) were right before it."""
        back = np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)
        if self.of == "reference":
            return _of_another_reference(record, back)
        if self.of == "sensor":
            return _of_other_outputs(record, back, np.zeros(3))
        return _of_other_outputs(record, np.asarray(S @ back @ np.linalg.inv(S)), Q)

    def sentence(self, channel: Channel) -> str:
        """In words, with the cause."""
        device, factor = self.device(channel), self.factor
        if factor is not None:
            return f"all outputs of {device} are {factor:.4g} times what they were ({SCALES[factor]})"
        if self.of == "mount":
            return f"{device} was turned on its mount, so that {_listed(self.matrix)}"
        return f"{_in_words(self.matrix, device)} (by a plug, a setting or a firmware)"


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """The causes that explain the held windows alike, the simplest first: their `chi2`, that of the windows as they
    are, and that of the best other cause."""

    causes: Sequence[Exchange]
    chi2: float
    as_it_is: float
    next_best: float

    @property
    def scale(self) -> float | None:
        """By what the outputs of the sensor are multiplied, where nothing else explains the windows."""
        return self.causes[0].factor if all(cause.of == "sensor" for cause in self.causes) else None


def exchanged(state: State, held: Sequence[Record], limit: Limit) -> Explained | None:
    """The exchange of outputs that explains all held windows; None where there is none, or where they need none.

    `limit`: the largest chi-squared of a consistent window, from its degrees of freedom.
    """
    loose, now = state.copy(), state.result()
    size = np.append(np.full(9, BESIDE), np.full(3, BESIDE_MPS2)) * state.scale
    loose.step(state.changes(size, line=True))
    as_they_are = [loose.innovation(record) for record in held]
    most = [limit(said.degrees_of_freedom) for said in as_they_are]
    k = max(range(len(held)), key=lambda one: as_they_are[one].statistic)  # the window that contradicts most
    if as_they_are[k].statistic <= most[k]:
        return None

    def statistic(cause: Exchange, record: Record) -> float:
        return loose.innovation(cause.undone(record, now.sensitivity, now.offset)).statistic

    one_reference = len({record.reference for record in held}) == 1
    tried = [cause for cause in _causes(held[k]) if one_reference or cause.of != "reference"]
    near = sorted(_near(tried, held[k], now), key=lambda cause: statistic(cause, held[k]))[:COMPARED]
    said = {cause: [statistic(cause, record) for record in held] for cause in tried if cause in near}
    return _alike(said, most, sum(own.statistic for own in as_they_are))


def _near(causes: Sequence[Exchange], record: Record, now: Calibration) -> list[Exchange]:
    """The causes without which S alone explains the slopes of a window nearly as well as without the best one."""
    left = [_left(cause.undone(record, now.sensitivity, now.offset), now.sensitivity) for cause in causes]
    return [cause for cause, own in zip(causes, left, strict=True) if own <= min(left) + NEAR]


def _alike(said: Mapping[Exchange, Sequence[float]], most: Sequence[float], as_it_is: float) -> Explained | None:
    """The causes that explain all held windows alike, None where none does. `said`: chi-squared of each window without
    a cause; `most`: of consistent windows."""
    chi2 = {cause: sum(each) for cause, each in said.items()}
    fitting = [cause for cause, each in said.items() if all(x <= y for x, y in zip(each, most, strict=True))]
    if not fitting:
        return None
    best = min(chi2[cause] for cause in fitting)
    alike = [cause for cause in fitting if chi2[cause] <= best + ALIKE]
    other = [x for cause, x in chi2.items() if cause not in alike]
    return Explained(alike, best, as_it_is, min(other, default=np.inf))


def explanation(found: Explained, channel: Channel, since: str, held: int, number: int | None) -> str:
    """The explanation of so many held windows for an operator. `since`: the time of the change. `number` of the
    estimate that puts the change in force; None if there is none."""
    first, *others = [cause.sentence(channel) for cause in found.causes[:MOST_TOLD]]
    if (more := len(found.causes) - MOST_TOLD) > 0:
        others.append(f"{more} more")
    alike = f" As well fits: {'; '.join(others)}." if others else ""
    other = (
        f"{found.next_best:.3g} with the next other cause" if np.isfinite(found.next_best) else "no other cause is near"
    )
    return (
        f"{held} held windows show one change, since {since} at the latest: {first}. Chi-squared is {found.chi2:.0f} "
        f"with it, {found.as_it_is:.3g} without it; {other}.{alike} {_remedy(found.causes, channel, number)}"
    )


def _remedy(causes: Sequence[Exchange], channel: Channel, number: int | None) -> str:
    devices = " or ".join(dict.fromkeys(cause.device(channel) for cause in causes))
    which = ", whichever has changed," if " or " in devices else ""
    back = f"Set {devices}{which} back to what it was; the next windows are then taken, and S and Q stay"
    if number is not None:
        return f"{back}. Or put the change in force: fieldcal command accept --sequence {number}"
    turns = [cause.matrix for cause in causes if cause.of == "mount"]
    check = channel.check_reference
    if len(turns) != 1 or channel.rotation is None or (check is not None and check.rotation is not None):
        return back
    (turn,) = turns
    stated = {"rotation": turn @ np.reshape(channel.rotation, (3, 3))}
    if channel.rotation_gravity_mps2 is not None and any(channel.rotation_gravity_mps2):
        stated["rotation_gravity_mps2"] = turn @ channel.rotation_gravity_mps2
    keys = " and ".join(f"{key} = [{', '.join(f'{x:.9g}' for x in (v + 0.0).ravel())}]" for key, v in stated.items())
    return f"{back}. If {channel.sensor} is to stay as it stands now, state {keys} and start the agent again"


def _causes(record: Record) -> Iterator[Exchange]:
    """Those that are tried; what changes fewer outputs comes first."""
    own = own_channels(record.channels)
    yield from (Exchange(factor * np.eye(3)) for factor in SCALES)
    yield from (Exchange(matrix) for matrix in _places(3))
    yield from (Exchange(matrix, "mount") for matrix in _places(3) if np.linalg.det(matrix) > 0.0)
    if own:
        yield from (Exchange(factor * np.eye(own), "reference") for factor in SCALES)
        yield from (Exchange(matrix, "reference") for matrix in _places(own))


def _places(outputs: int) -> list[Array]:
    """All other orders and signs of so many outputs."""
    one = np.eye(outputs)
    found = [
        one[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(outputs))
        for signs in product((1.0, -1.0), repeat=outputs)
    ]
    changed = [m for m in found if not np.array_equal(m, one)]
    return sorted(changed, key=lambda m: (np.count_nonzero(np.diag(m) != 1.0), np.count_nonzero(m < 0.0)))


def _left(record: Record, S: Array) -> float:
    """The part of a window's slopes that S (3, 3) alone does not explain, without lag and response; 0 at rest."""
    moved = record.root[:, : record.pose.direction.shape[1]] @ (S @ record.pose.direction).T
    size = float(np.linalg.norm(record.slopes))
    return float(np.linalg.norm(record.slopes - moved)) / size if size else 0.0


def _of_other_outputs(record: Record, back: Array, about: Array) -> Record:
    """The window with outputs that differ from `about` (3,) by `back` (3, 3) times as much."""
    slopes, means = record.slopes @ back.T, (record.means - about) @ back.T + about
    return replace(record, slopes=slopes, means=means, noise=np.sqrt(back**2 @ record.noise**2), bands=None)


def _of_another_reference(record: Record, back: Array) -> Record:
    """The window with channels of the reference that are `back` (m, m) times what they are. Their integrals and
    derivatives change as they do."""
    every, pose = np.kron(np.eye(record.channels // len(back)), back), record.pose
    whole, forth = np.kron(np.eye(2), every), np.linalg.inv(every)
    ways, root = np.linalg.qr(record.root @ whole.T)
    turn = pose.direction @ every @ np.linalg.pinv(pose.direction)  # of the motion in the sensor's frame
    only = turn / np.abs(np.linalg.det(back)) ** (1.0 / len(back))
    return replace(
        record, root=root, slopes=ways.T @ record.slopes, passed=ways.T @ record.passed @ every.T,
        along=every @ record.along @ forth, along_rate_s=every @ record.along_rate_s @ forth,
        excited=only @ record.excited @ only.T, mean_x=whole @ record.mean_x, bands=None, motion=None,
        held_mps2=pose.gravity_mps2 + turn @ (record.held_mps2 - pose.gravity_mps2),
    )  # fmt: skip


def _in_words(matrix: Array, device: str) -> str:
    """Which outputs show what others did."""
    changed = np.flatnonzero(np.diag(matrix) != 1.0).tolist()
    if len(matrix) < len(AXES):
        return f"the output of {device} is inverted"
    if len(changed) == 1:
        return f"output {AXES[changed[0]]} of {device} is inverted"
    if len(changed) == 2 and matrix.min() == 0.0:
        return f"the outputs {AXES[changed[0]]} and {AXES[changed[1]]} of {device} are exchanged"
    return f"of the outputs of {device}, {_listed(matrix)}"


def _listed(matrix: Array) -> str:
    """What each output that changed shows."""
    parts = []
    for axis, row in zip(AXES, matrix, strict=True):
        of, minus = AXES[int(np.argmax(np.abs(row)))], row.sum() < 0.0
        if of == axis and minus:
            parts.append(f"{axis} is inverted")
        elif of != axis:
            parts.append(f"{axis} shows {'minus ' if minus else ''}what {of} showed")
    return ", ".join(parts)
