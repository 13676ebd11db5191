"""Why data were refused, as far as samples and poses show it: units of time and angle, dead channels, stuck outputs."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from calib.model import Array, Slices
from calib.recorded.outcome import Outcome
from calib.recorded.poses import CLAMP, Poses
from calib.recorded.table import ReferenceTable, SensorTable, ends_s

# Blocks of consecutive samples that are looked at, spread over the recording, and their length.
BLOCKS, BLOCK = 200, 500
STUCK_SHARE = 0.1  # of the blocks
SILENT = 0.02  # rms of a channel over that of the strongest; a sensor that moves in a plane has outputs as silent
MOVES = 0.2
# What loggers write for a missing value, where it is that many times what nine of ten values are at most.
MISSING_AS = (-999.0, 999.0, -9999.0, 9999.0, -99999.0, 99999.0, -32768.0, 32767.0, -6999.0, 7999.0)
FAR, USUALLY = 10.0, 0.9
MILLI, AROUND = 1000.0, 1.2  # a second in ms; ratio by which recordings of one motion may differ in length
SLOWEST_HZ = 5.0  # a sampling rate below is too low for most motions: then the times may be in ms
FULL_TURN_RAD, UPRIGHT_RAD = 2.0 * math.pi, 0.5 * math.pi


def causes(sensor: SensorTable, reference: ReferenceTable | None, poses: Poses | None, outcome: Outcome) -> list[str]:
    """A sentence, with what to do, for each mistake that would explain why these data were refused."""
    return [
        *_times(sensor, reference, poses, outcome),
        *([] if poses is None else _angles(poses)),
        *_stuck(sensor),
        *_missing(sensor),
    ]


def _times(
    sensor: SensorTable, reference: ReferenceTable | None, poses: Poses | None, outcome: Outcome
) -> Iterator[str]:
    """Times in ms that were taken for s: of one of the tables, or of all."""
    spans = {sensor.name: _span_s(sensor.time_s)}
    if reference is not None:
        spans[reference.name] = _span_s(reference.time_s)
    if poses is not None:
        spans[poses.place] = max(row.stop_s for row in poses.rows) - min(row.start_s for row in poses.rows)
    shortest = min(spans, key=lambda name: spans[name])
    wrong = [name for name, span in spans.items() if 1.0 / AROUND < span / spans[shortest] / MILLI < AROUND]
    for name in wrong:
        yield (
            f"the times of {name} run over {spans[name]:.4g} s, those of {shortest} over {spans[shortest]:.4g} s: the "
            f"times of {name} are in ms; divide them by 1000, or state their unit"
        )
    if not wrong and outcome.rate_hz < SLOWEST_HZ and not any(w.used for w in outcome.windows):
        yield (
            f"by its times the sensor's sampling rate is {outcome.rate_hz:.3g} Hz: if they are in ms, divide all times "
            "by 1000, or state their unit"
        )


def _span_s(time_s: Slices) -> float:
    first_s, last_s = ends_s(time_s)
    return last_s - first_s


def _angles(poses: Poses) -> Iterator[str]:
    """Angles of a clamp in rad that were taken for deg."""
    if CLAMP[0] not in poses.rows[0].values:
        return
    for name, most in zip(CLAMP, (UPRIGHT_RAD, FULL_TURN_RAD), strict=True):
        values = [abs(row.values[name]) for row in poses.rows]
        if 0.0 < max(values) <= most and (name == CLAMP[0] or len(set(values)) > 1):
            yield (
                f"{poses.place}: {name} is {max(values):.4g} at most: it may be in rad; multiply it by 180/pi, to have "
                "deg"
            )


def _stuck(sensor: SensorTable) -> Iterator[str]:
    """Outputs that do not change while another one does."""
    held = [np.ptp(block, axis=0) for block in _blocks(sensor.v)]
    if not held:
        return
    still = np.array(held) == 0.0
    share = np.mean(still & ~still.all(axis=1, keepdims=True), axis=0)
    for k in np.flatnonzero(share > STUCK_SHARE):
        yield (
            f"output {'xyz'[k]} of {sensor.name} is stuck: it does not change at all in {share[k]:.0%} of the "
            "recording, while another output does; check its wiring, or leave this time out of the poses"
        )


def _missing(sensor: SensorTable) -> Iterator[str]:
    """Numbers that stand for a missing value."""
    rows = np.concatenate(list(_blocks(sensor.v)) or [np.empty((0, 3))])
    for k, column in enumerate(rows.T):
        found, counts = np.unique(column[np.isin(column, MISSING_AS)], return_counts=True)
        for value, count in zip(found.tolist(), counts.tolist(), strict=True):
            if count > 1 and abs(value) > FAR * float(np.quantile(np.abs(column), USUALLY)):
                yield (
                    f"output {'xyz'[k]} of {sensor.name} is {value:g} in {100 * count / len(column):.2g} % of the "
                    "recording: if this stands for a missing value, leave the field empty"
                )


def silent_channels(sensor: SensorTable, reference: ReferenceTable, rotation: Array) -> list[str]:
    """A sentence for each channel of a tri-axial reference that hardly changes, though the sensor moves along it.

    `rotation` (3, 3): a = R a_ref.
    """
    rms, moved = _rms(reference.x), _rms(sensor.v)
    if rms.max() == 0.0 or moved.min() < MOVES * moved.max():
        return []
    felt = np.sqrt(rotation**2 @ rms**2)
    along = {int(np.argmax(np.abs(rotation[i]))) for i in np.flatnonzero(felt < SILENT * felt.max())}
    return [
        f"channel {'xyz'[k]} of {reference.name} is dead: it changes by {rms[k]:.3g} m/s2 rms, the strongest one by "
        f"{rms.max():.3g} m/s2, and all outputs of the sensor move; mend this channel, or use another reference"
        for k in sorted(along)
    ]


def _rms(values: Slices) -> Array:
    """(C,) the rms of each column within blocks."""
    return np.asarray(np.sqrt(np.mean([np.var(block, axis=0) for block in _blocks(values)] or [np.zeros(3)], axis=0)))


def _blocks(values: Slices) -> Iterator[Array]:
    """Blocks of consecutive rows without those that are missing, spread over the table."""
    starts = np.unique(np.linspace(0, max(len(values) - BLOCK, 0), BLOCKS).astype(int))
    for first in starts.tolist():
        block = np.asarray(values[first : first + BLOCK])
        block = block[np.isfinite(block).all(axis=1)]
        if len(block) > 1:
            yield block
