"""The reference at the sensor's sample times, with its time derivative; and the acceleration behind a velocity or a
displacement.

Interpolation by sixteen taps whose weights are polynomials of the fractional position (Farrow 1988), so that the value
and its derivative come from the same sums. Up to 0.25 of the reference's sampling rate the value is right to 1e-5 and
the derivative to 1e-4 of its amplitude; above 0.3 both fall off.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from calib.model import Array
from calib.signal.order_statistics import distinct
from calib.signal.timing import ClockFit

TAPS, DEGREE = 16, 7
HALF = TAPS // 2
BAND = 0.3  # of the sampling rate: the taps are the best for motion below
RIDGE = 1e-11  # holds the noise amplification at one: more costs accuracy, less costs noise
NODES = 64  # samples between the points at which the clock is inverted: straight in between to 1 ns
FRACTIONS = 256  # classes of the fractional position, over which the noise that interpolation passes is averaged
CHUNK = 2048  # output samples worked on at a time: 16 taps of each fit into the cache
# A signal is differentiated up to here and damped from twice as much: the paper's range and three octaves above it.
DIFFERENTIATED_BAND_HZ = 50.0
DIFFERENTIATED_BAND_LARGEST = 0.15  # of the sampling rate
# A differentiator's ripple counts against the response at the motion's frequency. Of the first derivative that is
# smaller than at the end of the band as the frequency is, of the second by the square.
STOP_BAND_DB = {1: 110.0, 2: 150.0}


@dataclass(frozen=True, slots=True, eq=False)
class Resampled:
    """The reference at given times: u (n, m) and du/dt (n, m); `usable` (n,) where all taps were there.

    `noise_hz` (2,): the bands in which white noise of the reference's samples has the power that it has in u and in
    du/dt. At times between its samples u has less of it than at their times.
    """

    u: Array
    du: Array
    usable: NDArray[np.bool_]
    noise_hz: Array


def resample(x: Array, clock: ClockFit, time_s: Array, first_index: int = 0, margin: int = 0) -> Resampled:
    """Reference `x` (M, m), samples `first_index` on of the device that `clock` times, at `time_s` (n,), rising.

    At most some minutes at a time: one rate turns the derivative into seconds. Not usable are times within half the
    taps (and `margin` samples more) of an end, within those and `NODES` samples of a gap, and beyond.
    """
    nodes = np.linspace(time_s[0], time_s[-1], len(time_s) // NODES + 2)
    if len(clock.knot_time_s) > 2:  # the rate may bend at a knot
        knots = clock.knot_time_s
        between = knots[(knots > time_s[0]) & (knots < time_s[-1])]
        nodes = distinct(np.concatenate([nodes, between]))
    position = np.interp(time_s, nodes, clock.index_of(nodes))
    # A time that is hours away, or not known, has a number that no integer can be.
    near = (position > first_index - TAPS) & (position < first_index + len(x) + TAPS)
    base = np.floor(np.where(near, position, first_index)).astype(np.int64)
    fraction = position - base
    start = base - first_index - (HALF - 1)
    usable = near & (start >= margin) & (start + TAPS + margin <= len(x))
    for gap in clock.gaps:
        usable &= np.abs(base - gap) > HALF + margin + NODES
    # A channel a row: what is done to a channel afterwards finds its samples side by side.
    u, du = np.zeros((x.shape[1], len(position))), np.zeros((x.shape[1], len(position)))
    inside = np.nonzero(usable)[0]
    if not len(inside):
        return Resampled(u.T, du.T, usable, np.zeros(2))
    middle_s = 0.5 * (time_s[(len(time_s) - 1) // 2] + time_s[len(time_s) // 2])
    before_s, after_s = clock.time_of(clock.index_of(middle_s) + np.array([-0.5, 0.5])).tolist()
    rate = 1.0 / (after_s - before_s)
    sixteen = [sliding_window_view(channel, TAPS).T for channel in x.T]
    for k in range(0, len(inside), CHUNK):
        part = as_slice(inside[k : k + CHUNK])
        first = start[part]
        low, high = int(first.min()), int(first.max()) + TAPS
        for channel, views in enumerate(sixteen):
            taps = np.ascontiguousarray(views[:, low : high + 1 - TAPS])
            value, slope = _horner(_taken(_weights() @ taps, first - low), fraction[part])
            u[channel, part], du[channel, part] = value, slope * rate
    return Resampled(u.T, du.T, usable, rate * _noise_bands(fraction[inside]))


def differentiate(x: Array, rate_hz: float, order: int = 1) -> tuple[Array, int]:
    """Derivative (M, m) of `order` 1 or 2 of samples x (M, m), one a sample, in x's unit per s or s2; and how many at
    each end are wrong.

    Eq. (12) holds for amplitudes only. Right to 5e-5 up to `differentiated_band_hz`, damped by 110 dB from twice that
    on, since differentiation raises noise with frequency. Raises ValueError for another order.
    """
    if order not in STOP_BAND_DB:
        raise ValueError(f"a derivative of order {order} is not known, only of order 1 and 2")
    half = differentiator_lost(rate_hz, order)
    n = np.arange(-half, half + 1)
    cut = 1.5 * differentiated_band_hz(rate_hz) / rate_hz
    window = np.kaiser(2 * half + 1, 0.1102 * (STOP_BAND_DB[order] - 8.7))
    taps = _slope(n, cut, window) if order == 1 else _curvature(n, cut, window)
    out = np.column_stack([np.convolve(channel, taps * rate_hz**order, mode="same") for channel in x.T])
    return out, half


def _slope(n: NDArray[np.int64], cut: float, window: Array) -> Array:
    """Taps at `n` of the first derivative a sample up to `cut` of the rate; the slope of a ramp is exact."""
    phase = 2 * np.pi * cut * n
    with np.errstate(invalid="ignore", divide="ignore"):
        taps = np.where(n == 0, 0.0, (phase * np.cos(phase) - np.sin(phase)) / (np.pi * n**2)) * window
    return np.asarray(taps / -(taps @ n))


def _curvature(n: NDArray[np.int64], cut: float, window: Array) -> Array:
    """Taps at `n` of the second derivative; that of a parabola is exact.

    The window smooths the response -omega^2, which adds a constant over the band: a low-pass filter takes it out.
    """
    phase, turn = 2 * np.pi * cut * n, 2 * np.pi * cut
    with np.errstate(invalid="ignore", divide="ignore"):
        taps = ((2.0 - phase**2) * np.sin(phase) - 2.0 * phase * np.cos(phase)) / (np.pi * n.astype(float) ** 3)
    taps = np.where(n == 0, -(turn**3) / (3.0 * np.pi), taps) * window
    constant = np.sinc(2.0 * cut * n) * window
    taps -= taps.sum() * constant / constant.sum()
    return np.asarray(taps * (2.0 / (taps @ n**2)))


def differentiator_lost(rate_hz: float, order: int) -> int:
    """Samples at each end for which `differentiate` has no full support (Kaiser's length for a transition `band`)."""
    if order == 0:
        return 0
    return int(
        np.ceil((STOP_BAND_DB[order] - 8.0) / (2.285 * 2 * np.pi * differentiated_band_hz(rate_hz) / rate_hz) / 2)
    )


def differentiated_band_hz(rate_hz: float) -> float:
    """Up to where a derivative is right."""
    return min(DIFFERENTIATED_BAND_HZ, DIFFERENTIATED_BAND_LARGEST * rate_hz)


def as_slice(numbers: NDArray[np.int64]) -> NDArray[np.int64] | slice:
    """Numbers (n,), n >= 1, of samples, each larger than the one before; as a slice where none is left out between
    them, with which numpy copies nothing."""
    first, stop = int(numbers[0]), int(numbers[-1]) + 1
    return slice(first, stop) if stop - first == len(numbers) else numbers


def _taken(columns: Array, numbers: NDArray[np.int64]) -> Array:
    """The columns (p, n) with these numbers (k,); nothing is copied where these are all, one after the other."""
    if len(numbers) == columns.shape[1] and np.array_equal(numbers, np.arange(len(numbers))):
        return columns
    return columns.take(numbers, axis=1)


def _horner(sums: Array, fraction: Array) -> tuple[Array, Array]:
    """Polynomials `sums` (DEGREE + 1, n), rising powers, at `fraction` (n,): values and derivatives."""
    value, slope = sums[DEGREE].copy(), np.zeros(len(fraction))
    for k in range(DEGREE - 1, -1, -1):
        slope *= fraction
        slope += value
        value *= fraction
        value += sums[k]
    return value, slope


def _noise_bands(fraction: Array) -> Array:
    """(2,) as Resampled.noise_hz, over the sampling rate, at fractional positions (n,)."""
    classes = np.minimum((fraction * FRACTIONS).astype(np.intp), FRACTIONS - 1)
    power, rate_power = np.bincount(classes, minlength=FRACTIONS) @ _noise_passed() / len(fraction)
    return np.array([0.5 * power, np.cbrt(3.0 * rate_power / (8.0 * np.pi**2))])


@lru_cache(maxsize=1)
def _noise_passed() -> Array:
    """(FRACTIONS, 2) by class of the fractional position, the power of a value and of its derivative, of white samples
    of power one."""
    middle, powers = (np.arange(FRACTIONS)[:, None] + 0.5) / FRACTIONS, np.arange(DEGREE + 1)
    value = middle**powers @ _weights()
    slope = powers[1:] * middle ** powers[:-1] @ _weights()[1:]
    return np.column_stack([np.sum(value**2, axis=1), np.sum(slope**2, axis=1)])


@lru_cache(maxsize=1)
def _weights() -> Array:
    """(DEGREE + 1, TAPS) coefficients, rising powers of the fraction, of the weight of each tap.

    For every fraction: least mean square error over frequencies up to BAND, cubic motion exact.
    """
    taps = np.arange(-HALF + 1, HALF + 1)
    nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(4 * DEGREE) + 0.5) / (4 * DEGREE))
    normal = 2 * BAND * np.sinc(2 * BAND * (taps[:, None] - taps)) + RIDGE * np.eye(TAPS)
    powers = np.arange(4)
    moments = (taps / HALF) ** powers[:, None]
    system = np.block([[normal, moments.T], [moments, np.zeros((4, 4))]])
    wanted = np.hstack([2 * BAND * np.sinc(2 * BAND * (taps - nodes[:, None])), (nodes[:, None] / HALF) ** powers])
    weights = np.linalg.solve(system, wanted.T)[:TAPS].T
    chebyshev = np.polynomial.chebyshev.chebfit(2 * nodes - 1, weights, DEGREE)
    to_powers = np.zeros((DEGREE + 1, DEGREE + 1))
    for k in range(DEGREE + 1):
        shifted = np.polynomial.Polynomial([-1.0, 2.0])
        in_powers = np.polynomial.Polynomial(np.polynomial.chebyshev.cheb2poly(np.eye(DEGREE + 1)[k]))(shifted)
        to_powers[: len(in_powers.coef), k] = in_powers.coef
    return np.asarray(to_powers @ chebyshev)
