"""Noise of the sensor that is far stronger at some frequencies than at others: hum, rattle, a band that is incoherent.

Least squares over all points weighs all frequencies alike, so that one bad band costs all others. V = S a + Q holds for
filtered signals as well, whatever the filter is, if both pass the same one. So sensor and reference pass a filter
without phase shift that attenuates each band by as much as its noise is stronger: the bad bands are lost and no others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.excitation.detection import RELATED, incoherent_by_band
from calib.excitation.turning import is_turned
from calib.excitation.windows import Points
from calib.model import Array, BandSums
from calib.signal.band import convolved, hanning
from calib.signal.order_statistics import distinct
from calib.signal.response import Complex
from calib.windows.bands import parts

SEGMENTS = 8  # Hann segments, half overlapped, in which the noise is looked for
CELL = 2  # lines of each segment
BANDS_AN_OCTAVE = 6
FEWEST_LINES = 4  # in a band, of each segment
LEAST_GAIN = 4.0  # variance of the slopes without the filter over that with it: standard uncertainties halve
LOUD = 10.0  # times the noise in the motion: a band without motion that is so loud looks like knocks
INCOHERENT = 0.02  # of the motion in a band: less noise may be a response that changes within a few lines
MOVES = 1e-3  # of the strongest band's motion: a band that holds less of it tells nothing
CYCLES = 3.0  # of the lowest motion, which the filter reaches to each side
MOST_LOST = 0.1  # of the samples at each end
LEAST_WEIGHT = 1e-3
STRAYS = 1e-3  # of the motion: more of the reference's noise at frequencies without motion makes S smaller
MATTERS = 1e-4  # of the power of the reference: less of its noise moves S by less than that
CLEARLY = 2.0  # times: white noise of both instruments never looks so
MORE_POINTS = 4  # in a band, beside those that the regression on u and du/dt uses
TINY = 1e-300


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFilter:
    """Taps (2 k + 1,) of the filter; at frequencies (F,) from 0 to half the sampling rate its amplitude (F,), and the
    power of a line of the motion and of the noise before it (2, F); the rms (2, m) of the reference's noise in u and
    du/dt before it, and the part (2, m) of both that it leaves."""

    taps: Array
    frequency_hz: Array
    amplitude: Array
    spectra: Array
    reference_noise: Array
    noise_left: Array

    def passed(self, columns: Array) -> Array:
        """Samples (n, k) after the filter. A mean stays what it is; rows near an end or a missing sample are NaN."""
        mean = np.nanmean(columns, axis=0)
        return np.asarray(convolved(columns - mean, self.taps) + mean)

    def independent(self, to_hz: float) -> float:
        """The share of the points that count as independent after this filter and one that ends at `to_hz`.

        The noise at the frequencies of the motion makes the slopes uncertain, and the filter passes these best: with
        spectra of motion and noise as they are after it, the variance of a slope is sum(motion noise) / sum(motion)^2.
        """
        motion, noise = self.amplitude**2 * self.spectra * (self.frequency_hz <= to_hz)
        return float(motion.sum() * noise.sum() / (len(self.amplitude) * max(float(motion @ noise), TINY)))

    def before(self, reference_noise: Array) -> Array:
        """The reference's noise (2, m) before the filter, from that after it."""
        return reference_noise / self.noise_left

    def left_in(self, bands: BandSums) -> BandSums:
        """Bands of what passed the filter, with the points that stay independent in each; those that keep too few are
        lost."""
        power = np.append(0.0, np.cumsum(self.amplitude**2)), np.append(0.0, np.cumsum(self.amplitude**4))
        first = np.minimum(np.searchsorted(self.frequency_hz, bands.low_hz), len(self.amplitude) - 1)
        stop = np.maximum(np.searchsorted(self.frequency_hz, bands.high_hz), first + 1)
        own, square = (part[stop] - part[first] for part in power)
        points = bands.points * own**2 / np.maximum((stop - first) * square, TINY)
        kept = points >= 2 * bands.reference_channels + MORE_POINTS
        noise = bands.noise * (own / (stop - first))[:, None]
        return parts(replace(bands, points=points, noise=noise), kept)


def against_noise(points: Points, reference_noise: Array, *, knocked: bool, derivatives: int = 0) -> NoiseFilter | None:
    """The filter for these points; None where all bands are about as noisy, or where there are too few points to tell.
    `reference_noise` (2, m) is that of the first m channels, which count, whose quantity was differentiated so often.
    `knocked`: many points look like knocks, perhaps because of noise beside the motion."""
    channels = reference_noise.shape[1]
    u, rate_hz = points.u[:, :channels], float((len(points.u) - 1) / (points.time_s[-1] - points.time_s[0]))
    size = 2 * (len(u) // (SEGMENTS + 1))
    edges = _edges(size // 2)
    if len(edges) < 3 or is_turned(u, rate_hz):  # a filter would spread each turn
        return None
    motion, noise, alone = _powers(np.hstack([points.V, u]), size, edges)
    lines = np.diff(edges).astype(np.float64)
    moved = motion > MOVES * motion.max()
    if not (motion > noise).any() or not (noise > 0.0).all():
        return None
    told = np.where(moved, motion * lines, 0.0)
    usual = float(told.sum() / np.sum(told / noise))  # the noise that counts when each band weighs by its own
    noise = np.where(noise < INCOHERENT * motion, np.minimum(noise, usual), noise)
    gain = float(np.sum(told * noise) / told.sum()) / usual
    loud = ~moved & (noise > LOUD * usual)
    rattles = knocked and bool(np.sum((noise * lines)[loud]) > np.sum((noise * lines)[moved]))
    strays = bool(np.sum((alone * lines)[~moved]) > STRAYS * told.sum())
    if gain < LEAST_GAIN and not rattles and not strays:
        return None
    # Noise of the reference beside hardly any motion tells nothing and makes S smaller.
    weights = np.clip(np.sqrt(np.minimum(usual / noise, 1.0) * motion / (motion + noise)), LEAST_WEIGHT, 1.0)
    weights[: int(np.flatnonzero(moved)[0])] = 1.0  # slow changes of the mean are judged, not hidden
    lowest_hz = float(edges[np.flatnonzero(moved)[0]]) * rate_hz / size
    spectra = np.stack([motion, noise])
    return _filter(weights, edges, size, rate_hz, lowest_hz, len(u), spectra, reference_noise, derivatives)


def not_more_than_incoherent(noise: Array, u: Array, V: Array, rate_hz: float, derivatives: int) -> Array:
    """The reference's noise (2, m) in u and du/dt, no larger than what of u the sensor does not show.

    Noise that is thought to be white may be coloured, or a motion that fills the spectrum. Where both contradict each
    other clearly at the frequencies of the motion, half of what is incoherent there counts as white noise. Of a
    quantity that was differentiated so often the noise is white; in u it grows with the frequency.
    """
    power = noise[0] ** 2
    if not len(u) or np.all(power <= MATTERS * np.var(u, axis=0)) or (told := incoherent_by_band(u, V)) is None:
        return noise
    alone, moved = told[0], np.maximum(told[1] - told[0], 0.0)
    rate = np.divide(noise[1], noise[0], out=np.zeros_like(power), where=power > 0.0)
    end_hz = np.sqrt((2 * derivatives + 3) / (2 * derivatives + 1)) * rate / (2.0 * np.pi)
    bands = np.clip(2.0 * end_hz / rate_hz, 1.0 / len(alone), 1.0) * len(alone)  # that have this noise
    at = np.minimum((np.arange(len(alone))[:, None] + 0.5) / bands, 1.0)
    white = (2 * derivatives + 1) * at ** (2 * derivatives) / bands  # of the noise, the part in each band
    most = np.sum(moved * alone, axis=0) / np.maximum(np.sum(moved * white, axis=0), TINY)
    size = np.sqrt(np.divide(0.5 * most, power, out=np.ones_like(power), where=power > CLEARLY * most))
    return np.asarray(noise * size)


def _edges(lines: int) -> NDArray[np.int64]:
    """Numbers of the spectral lines at which bands begin and end, from line 1 to `lines`."""
    if lines < 4 * FEWEST_LINES:
        return np.zeros(0, dtype=np.int64)
    wanted = np.exp2(np.arange(0.0, np.log2(lines), 1.0 / BANDS_AN_OCTAVE))
    starts = [1]
    for k in wanted.round().astype(int).tolist():
        if k - starts[-1] >= FEWEST_LINES and lines - k >= FEWEST_LINES:
            starts.append(k)
    return np.array([*starts, lines], dtype=np.int64)


def _powers(rows: Array, size: int, edges: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """The power of V, the first three columns of `rows` (n, 3 + m), a line in each band: what the motion explains at
    any lag, the noise, and what of the reference V does not show.

    Both are found in cells of CELL lines, in which no response changes much: two instruments that respond differently
    are not noisy. The noise is that of V, or that of the reference as V would show it, whichever is stronger.
    """
    window, starts = hanning(size), range(0, len(rows) - size + 1, size // 2)
    cut = np.stack([rows[k : k + size].T for k in starts], axis=1)
    lines = np.fft.rfft((cut - cut.mean(axis=2, keepdims=True)) * window, axis=2).transpose(2, 0, 1)[: edges[-1]]
    cells = distinct(np.concatenate([np.arange(edges[0], edges[-1], CELL), edges[:-1]]))
    cross = np.add.reduceat(lines @ lines.conj().transpose(0, 2, 1), cells, axis=0)
    count = np.diff(np.append(cells, edges[-1])) * len(starts)
    felt, told = _parted(cross[:, :3, :3], cross[:, 3:, 3:], cross[:, :3, 3:], count)
    shown, alone = _parted(cross[:, 3:, 3:], cross[:, :3, :3], cross[:, 3:, :3], count)
    scale = felt.sum() / max(float(shown.sum()), TINY)  # of V over the reference, squared
    first = np.searchsorted(cells, edges[:-1])
    parts = (felt, np.maximum(told, scale * alone), scale * alone)
    of_each = np.diff(edges) * len(starts)
    motion, noise, alone = (np.add.reduceat(part, first) / of_each for part in parts)
    return motion, noise, alone


def _parted(power: Complex, other: Complex, both: Complex, count: NDArray[np.int64]) -> tuple[Array, Array]:
    """(B,) the power of some channels that other ones explain, and the rest, from their cross-spectra in B cells that
    are sums over `count` (B,) lines."""
    total = np.trace(power, axis1=1, axis2=2).real
    inverse = np.linalg.pinv(other, RELATED, hermitian=True)
    explained = np.sum((both @ inverse) * both.conj(), axis=(1, 2)).real
    rest = np.maximum(total - explained, 0.0) * count / (count - other.shape[1])
    return np.maximum(total - rest, 0.0), rest


def _filter(
    weights: Array, edges: NDArray[np.int64], size: int, rate_hz: float, lowest_hz: float, samples: int, spectra: Array,
    noise: Array, derivatives: int,
) -> NoiseFilter:  # fmt: skip
    """A filter with these weights in the bands, of linear phase around its middle tap; `spectra` (2, B) of motion and
    noise and `noise` (2, m) before it."""
    frequency_hz = np.arange(size // 2 + 1) * rate_hz / size
    rows = np.vstack([spectra, weights])
    lines = np.hstack([np.repeat(rows[:, :1], edges[0], axis=1), np.repeat(rows, np.diff(edges), axis=1), rows[:, -1:]])
    spectra, amplitude = lines[:2], lines[2]
    half = int(min(CYCLES * rate_hz / lowest_hz, MOST_LOST * samples, size // 2 - 1))
    taps = np.roll(np.fft.irfft(amplitude, size), half)[: 2 * half + 1] * hanning(2 * half + 3)[1:-1]
    passed = np.abs(np.fft.rfft(np.roll(np.pad(taps, (0, size - len(taps))), -half)))
    left = _left_of(noise, frequency_hz, passed, derivatives)
    return NoiseFilter(taps, frequency_hz, passed, spectra, noise, left)


def _left_of(noise: Array, frequency_hz: Array, amplitude: Array, derivatives: int) -> Array:
    """(2, m) what a filter leaves of the rms of `noise` (2, m) in u and du/dt, of a quantity that was differentiated so
    often. The ratio of both tells up to which frequency it is."""
    out = np.ones_like(noise)
    of_u, of_rate = 2 * derivatives + 1, 2 * derivatives + 3
    for k in np.flatnonzero(noise[0] > 0.0):
        end_hz = np.sqrt(of_rate / of_u) * noise[1, k] / noise[0, k] / (2.0 * np.pi)
        inside = np.maximum(1, np.searchsorted(frequency_hz, end_hz))
        power, f = amplitude[:inside] ** 2, frequency_hz[:inside]
        of_each = f ** (of_u - 1), f ** (of_rate - 1)
        out[:, k] = np.sqrt([power @ weight / max(weight.sum(), TINY) for weight in of_each])
    return out
