"""Power of three outputs in third octaves, their noise floor, and where in frequency the power lies, from segments of
about a minute.

A segment gives sums of squared lines, which later segments do not change. The numbers of an hour are medians over its
segments: a knock or a lorry in less than half of them hardly moves these.

The peak frequency of a window is the first moment of its squared PSD over log frequency: the square lets the strongest
mode count, and hardly its skirts, other modes and noise. A window reaches from the centre of the third octave below to
that of the one above, with a weight that falls linearly in log frequency from 1 at its own centre. So a mode that
moves across the edge of a band moves smoothly through two windows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from calib.distributions import NORMAL
from calib.model import Array
from calib.signal.band import hanning
from calib.signal.order_statistics import median, quantile

SEGMENT_S = 60.0
MOST_SAMPLES = 1 << 16  # of a segment: a minute up to 1092 Hz, and less above, so that memory has a bound
LEAST_HZ, TOP = 1.0 / 16.0, 0.8  # between which a band lies as a whole: Hz, and share of the Nyquist frequency
FLOOR = (0.02, 0.4)  # shares of the Nyquist frequency between which noise is looked for: below most devices' corners
GROUPS, FEWEST_LINES = 64, 16  # of neighbouring lines for the floor: at most so many, each with so many lines or more
DECILE = 0.1
U_FLOOR = 0.05  # relative standard uncertainty of the noise floor, in that of a peak frequency
LEAST_RATIO = 3.0  # of the squared PSD over what the noise adds to it, for a window to have a peak frequency
THIRD_OCTAVE = 0.1 * math.log(10.0)  # in log frequency
HANN = (1.0, -2.0 / 3.0, 1.0 / 6.0)  # correlation of lines that are 0, 1 and 2 apart, of white noise
MANY_LINES = 100  # from which on the shape of their sum follows in proportion
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # xx, yy, zz, xy, xz, yz: the order of six numbers


@dataclass(frozen=True, slots=True)
class NoiseScatter:
    """How a sum of lines of white noise scatters from segment to segment: its relative standard deviation `u`, and the
    `shape` of the gamma distribution that has the same skewness."""

    u: float
    shape: float

    def median_share(self, count: int) -> float:
        """The expected median of `count` values over their mean, within 3 %.

        The median of the distribution, and half its curvature times the variance of a sample median: with density f,
        -f' / (8 n f^3). Of two values the median is the mean.
        """
        if count < 3:
            return 1.0 if count else math.nan
        k = self.shape
        at = k - 1.0 / 3.0 + 8.0 / (405.0 * k) + 184.0 / (25515.0 * k**2)
        f = math.exp((k - 1.0) * math.log(at) - at - math.lgamma(k))
        at -= ((k - 1.0) / at - 1.0) / (8.0 * count * f**2)
        return 1.0 + self.u * (at - k) / math.sqrt(k)


@dataclass(frozen=True, slots=True, eq=False)
class Bands:
    """How segments of `samples` at `rate_hz` are divided.

    `centre_hz` (B,) and `edges_hz` (B, 2): third octaves (IEC 61260-1, base ten: centres 10^(n/10) Hz, edges a factor
    10^(1/20) away), and how the power of each scatters. `groups` (G + 1,): first lines of the groups for the floor,
    and the end; how the mean of each scatters. `nodes` (B + 3,): first line of each interval between centres, from the
    one below the lowest centre on, and the end; `place`: where each of these lines lies in its interval, 0 to 1.
    """

    rate_hz: float
    samples: int
    centre_hz: Array
    edges_hz: Array
    scatter: tuple[NoiseScatter, ...]
    groups: tuple[int, ...]
    group_scatter: NoiseScatter
    nodes: NDArray[np.int64]
    place: Array

    @property
    def line_hz(self) -> float:
        """From line to line."""
        return self.rate_hz / self.samples


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """What is kept of one segment, in the squares of the output unit: `mean` (3,), `power` (6, B) as PAIRS, `floor`
    (3, G) mean PSD of each group of lines, per Hz. `peaks` (4, 3, B): sums over the lines of each window along other
    axes: of the power of each, of it times its place (in third octaves from the centre), and the same of half its
    square, which is the square of what is expected."""

    mean: Array
    power: Array
    floor: Array
    peaks: Array


@cache
def bands_of(rate_hz: float) -> Bands:
    """How segments at this sampling rate are divided. A band that is narrower than a line is left out."""
    samples = int(min(max(round(SEGMENT_S * rate_hz), 2), MOST_SAMPLES))
    line_hz, half = rate_hz / samples, 10.0**0.05
    top_hz = TOP * rate_hz / 2.0
    numbers = range(math.floor(10.0 * math.log10(LEAST_HZ)), math.ceil(10.0 * math.log10(max(top_hz, LEAST_HZ))) + 1)
    centres = [10.0 ** (n / 10.0) for n in numbers]
    kept = [c for c in centres if c / half >= LEAST_HZ and c * half <= top_hz and c * (half - 1.0 / half) >= line_hz]
    centre = np.array(kept)
    edges = np.column_stack([centre / half, centre * half])
    scatter = tuple(_scatter(_weights(low / line_hz, high / line_hz)) for low, high in edges)
    first, stop = (int(share * samples / 2.0) for share in FLOOR)
    count = max(1, min(GROUPS, (stop - first) // FEWEST_LINES))
    groups = tuple(np.linspace(max(first, 1), max(stop, 2), count + 1).astype(int).tolist())
    group_scatter = _scatter(np.ones(max(groups[1] - groups[0], 1)))
    nodes, place = _intervals(centre, line_hz)
    return Bands(rate_hz, samples, centre, edges, scatter, groups, group_scatter, nodes, place)


def segment_of(x: Array | NDArray[np.float32], bands: Bands, by: Array) -> Segment:
    """The sums of one segment x (3, samples), by the PSDs of all its lines under Hann's window, one-sided.

    `peaks` are along axes that are `by` (3, 3) of those of x.

    The power of a band is the integral of the PSD between its edges; a line at k has the width of a line around k.
    """
    window = hanning(bands.samples)
    mean, lines = np.zeros(3), []
    for i, own in enumerate(x):
        held = own.astype(np.float64)
        mean[i] = held.mean()
        held -= mean[i]
        held *= window
        lines.append(np.fft.rfft(held))
    scale = 2.0 / (bands.rate_hz * float(np.sum(window**2)))
    ends = np.array(bands.groups)
    power, floor = np.zeros((6, len(bands.centre_hz))), np.zeros((3, len(ends) - 1))
    places = bands.edges_hz / bands.line_hz + 0.5  # line k lies between k and k + 1
    whole = np.floor(places).astype(int)
    for number, (i, k) in enumerate(PAIRS):
        psd = scale * (lines[i].real * lines[k].real + lines[i].imag * lines[k].imag)
        sums = np.concatenate([[0.0], np.cumsum(psd), [0.0]])
        below = sums[whole] + (places - whole) * psd[np.minimum(whole, len(psd) - 1)]
        power[number] = bands.line_hz * (below[:, 1] - below[:, 0])
        if i == k:
            floor[i] = np.diff(sums[ends]) / np.diff(ends)
    return Segment(mean, power, floor, _peaks(np.array(lines), scale * bands.line_hz, bands, by))


def turned(power: Array, by: Array) -> Array:
    """The power (6, B) of other axes, which are `by` (3, 3) of those of `power`: the real part of A G A'."""
    square = np.empty((power.shape[1], 3, 3))
    for number, (i, k) in enumerate(PAIRS):
        square[:, i, k] = square[:, k, i] = power[number]
    found = by @ square @ by.T
    return np.array([found[:, i, k] for i, k in PAIRS])


def robust_power(power: Array, bands: Bands) -> Array:
    """(6, B) from the power (n, 6, B) of n segments: medians over the segments over their `median_share`.

    A cross power is no positive number with a known median; it is a quarter of the power of the sum of two outputs,
    less that of their difference (Gnanadesikan and Kettenring 1972), each a median.
    """
    share = np.array([scatter.median_share(len(power)) for scatter in bands.scatter])
    by_band = np.moveaxis(power, 0, -1)  # (6, B, n)
    found = np.empty(power.shape[1:])
    for number, (i, k) in enumerate(PAIRS):
        if i == k:
            found[number] = median(by_band[number])
        else:
            together = by_band[i] + by_band[k]
            twice = 2.0 * by_band[number]
            found[number] = 0.25 * (median(together + twice) - median(together - twice))
    return np.asarray(found / share)


def peak_frequency(peaks: Array, noise_psd: Array, bands: Bands) -> tuple[Array, Array]:
    """Peak frequency (3, B) of x, y, z in each window, and its standard uncertainty, in Hz; NaN where the noise is too
    strong. `peaks` (n, 4, 3, B) of n segments; `noise_psd` (3,), which is subtracted.

    Each segment weighs by 1 / (its squares + their median): loud ones count little more than others, and as the weight
    multiplies a difference whose mean is zero, neither noise nor weight moves the result. The uncertainty is from the
    scatter of the segments, and from that of the floor.
    """
    n, noise = len(peaks), (noise_psd * bands.line_hz)[:, None]
    white = _windowed(np.ones(bands.nodes[-1]), bands)[:, None]
    power, square = peaks[:, :2], peaks[:, 2:]
    weight = 1.0 / np.maximum(square[:, 0] + median(np.moveaxis(square[:, 0], 0, -1)), 1e-300)
    # (S + N)² is S² + 2 (S + N) N - N², of which the first is sought; the floor moves it by twice S N.
    signal = square - 2.0 * noise * power + noise**2 * white
    moved = 2.0 * noise * (power - noise * white)
    total, by_noise = (np.sum(weight[:, None] * part, axis=0) for part in (signal, moved))
    whole = np.where(total[0] > LEAST_RATIO * np.abs(by_noise[0]), total[0], np.nan)
    place = total[1] / whole
    left = np.sum(np.square(weight * (signal[:, 1] - place * signal[:, 0])), axis=0) * n / max(n - 1.0, 0.1)
    floor = U_FLOOR * (by_noise[1] - place * by_noise[0])
    frequency = bands.centre_hz * np.exp(THIRD_OCTAVE * place)
    return frequency, THIRD_OCTAVE * frequency * np.sqrt(left + floor**2) / whole if n > 1 else np.nan * frequency


def noise_floor(floor: Array, bands: Bands) -> Array:
    """(3,) PSD of the noise from the groups (n, 3, G) of n segments.

    Of each group the median over the segments over its `median_share`; of the groups the lower decile, over the decile
    that white noise has by chance. Motion in most of the lines is no noise as long as one group in ten is free of it;
    where none is, the number is too large.
    """
    n, groups = len(floor), floor.shape[2]
    levels = median(np.moveaxis(floor, 0, -1)) / bands.group_scatter.median_share(n)
    scatter = bands.group_scatter.u * math.sqrt(0.5 * math.pi / n)  # of a median
    by_chance = 1.0 + NORMAL.inv_cdf(DECILE) * scatter if groups > 1 else 1.0
    return np.array([quantile(own, DECILE) for own in levels]) / max(by_chance, 0.1)


def _intervals(centre_hz: Array, line_hz: float) -> tuple[NDArray[np.int64], Array]:
    """`nodes` and `place` of Bands."""
    if not len(centre_hz):
        return np.zeros(1, dtype=np.int64), np.zeros(0)
    step = math.exp(THIRD_OCTAVE)
    at = np.concatenate([[centre_hz[0] / step], centre_hz, [centre_hz[-1] * step]])
    nodes = np.ceil(at / line_hz).astype(np.int64)
    lines = np.arange(nodes[0], nodes[-1])
    return nodes, np.log(lines * line_hz / np.repeat(at[:-1], np.diff(nodes))) / THIRD_OCTAVE


def _peaks(lines: NDArray[np.complex128], scale: float, bands: Bands, by: Array) -> Array:
    """`peaks` of Segment from the lines (3, L) of a segment."""
    found = np.zeros((4, 3, len(bands.centre_hz)))
    for i, row in enumerate(by):
        turned_lines = row @ lines[:, : bands.nodes[-1]]
        power = scale * (turned_lines.real**2 + turned_lines.imag**2)
        found[:2, i] = _windowed(power, bands)
        found[2:, i] = _windowed(0.5 * power**2, bands)
    return found


def _windowed(values: Array, bands: Bands) -> Array:
    """Sum of the values of all lines in each window (2, B), and that of the values times their places.

    A window rises over one interval, with the weight t, and falls over the next one, with 1 - t; its centre lies
    between them.
    """
    nodes, sums = bands.nodes, []
    lines = values[nodes[0] : nodes[-1]]
    for _ in range(3):
        sums.append(np.diff(np.concatenate([[0.0], np.cumsum(lines)])[nodes - nodes[0]]))
        lines = lines * bands.place
    none, first, second = sums
    whole = first[:-1] + none[1:] - first[1:]
    return np.array([whole, second[:-1] - first[:-1] + first[1:] - second[1:]])


def _weights(low: float, high: float) -> Array:
    """How much of each line from the first to the last lies between two places, in lines."""
    k = np.arange(math.floor(low + 0.5), math.floor(high + 0.5) + 1)
    return np.asarray(np.minimum(k + 0.5, high) - np.maximum(k - 0.5, low))


def _scatter(weights: Array) -> NoiseScatter:
    """Of a weighted sum of neighbouring lines of white noise: a sum of exponential variables, whose scales are the
    eigenvalues of their covariance."""
    times = len(weights) / MANY_LINES if len(weights) > MANY_LINES else 1.0
    root = np.sqrt(weights[:MANY_LINES])
    apart = np.abs(np.subtract.outer(np.arange(len(root)), np.arange(len(root))))
    correlation = np.array([*HANN, 0.0])[np.minimum(apart, len(HANN))]
    scales = np.linalg.eigvalsh(root[:, None] * correlation * root)
    first, second, third = (float(np.sum(scales**power)) for power in (1, 2, 3))
    return NoiseScatter(math.sqrt(second / times) / first, times * second**3 / third**2)
