"""How far apart the clocks of two loggers are, where that is seconds: far more than the lag of a sensor.

Each piece of the recording tells the time by which the outputs of the sensor come later than the motion of the
reference, by cross-correlation. It is taken only where the pieces agree on one line: motion of one frequency and
devices that do not move together give a time of their own in each piece.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice

import numpy as np

from calib.model import Array, own_channels
from calib.signal.order_statistics import median

FURTHEST_S = 10.0  # a clock that a person sets by a watch is a few seconds off
PIECE_S = 3.0 * FURTHEST_S  # two thirds of a piece remain at the furthest offset
MOST_PIECES = 40  # of a recording, also of a day
FEWEST_PIECES = 2
AGREE = 0.8  # of the pieces; in others a knock may be stronger than the motion


def clock_offset(
    stretches: Iterable[tuple[Array, Array, Array]], span_s: float, most_rate: float, near_s: float
) -> tuple[float, float, float] | None:
    """The time in s by which the sensor's clock shows more than the reference's, by how much this changes in a second,
    and the time in s at which it is so. None where the data do not tell it.

    `stretches` are evenly spaced samples within `span_s`: times (n,) in s, outputs V (n, 3), reference u (n, m). They
    are taken one by one. Clocks differ in rate by `most_rate` at most. Offsets within `near_s` of a line agree.
    """
    every = max(1, int(np.ceil(span_s / (PIECE_S * MOST_PIECES))))
    pieces = islice((piece for stretch in stretches for piece in _pieces(*stretch)), 0, None, every)
    told = np.array([one for piece in pieces if (one := _offset(*piece)) is not None])
    if len(told) < FEWEST_PIECES:
        return None
    time_s, offset_s = told.T
    at_s, rate = float(median(time_s)), _rate(time_s, offset_s, most_rate, near_s)
    left_s = offset_s - rate * (time_s - at_s)
    middle_s = float(median(left_s))
    agree = np.abs(left_s - middle_s) <= near_s
    return (middle_s, rate, at_s) if agree.sum() >= max(AGREE * len(told), FEWEST_PIECES) else None


def _pieces(time_s: Array, V: Array, u: Array) -> Iterator[tuple[Array, Array, Array]]:
    number = max(1, round(float(time_s[-1] - time_s[0]) / PIECE_S))
    return zip(*(np.array_split(x, number) for x in (time_s, V, u)), strict=True)


def _offset(time_s: Array, V: Array, u: Array) -> tuple[float, float] | None:
    """The middle of a piece and the offset at which its squared correlation is largest, in s. None without motion."""
    n, step_s = len(time_s), float(time_s[-1] - time_s[0]) / max(len(time_s) - 1, 1)
    size = min(n // 3, round(FURTHEST_S / step_s)) if step_s > 0.0 else 0
    if not size:
        return None
    length = 1 << (n + size).bit_length()
    own = u[:, : own_channels(u.shape[1])]  # integrals of an AC-coupled reference come a quarter of a period later
    out, moved = ((x - x.mean(axis=0)) / _sd(x) for x in (V, own))
    both = np.fft.irfft(
        np.fft.rfft(out, length, axis=0)[:, :, None] * np.fft.rfft(moved, length, axis=0)[:, None, :].conj(),
        length, axis=0,
    )  # fmt: skip
    power = np.sum(np.concatenate([both[-size:], both[: size + 1]]) ** 2, axis=(1, 2))
    if not power.any():
        return None
    return 0.5 * float(time_s[0] + time_s[-1]), (int(np.argmax(power)) - size) * step_s


def _sd(x: Array) -> Array:
    """The standard deviation of each column, 1 for one that does not change."""
    sd = x.std(axis=0)
    return np.where(sd > 0.0, sd, 1.0)


def _rate(time_s: Array, offset_s: Array, most_rate: float, near_s: float) -> float:
    """The median slope between pairs of pieces, within `most_rate`; 0 where it changes nothing over the recording."""
    first, second = np.triu_indices(len(time_s), 1)
    rate = float(median((offset_s[second] - offset_s[first]) / (time_s[second] - time_s[first])))
    rate = min(max(rate, -most_rate), most_rate)
    return rate if abs(rate) * float(np.ptp(time_s)) > near_s else 0.0
