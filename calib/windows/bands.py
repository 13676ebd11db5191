"""Sums of a window in bands of frequency, beside its sums over time (calib.windows.sums).

Two instruments respond alike at one frequency only. The sums of a band tell the slopes of V on u and on du/dt in that
band. u, du/dt and V are tapered alike, so that a linear relation between them stays what it is. By Parseval's theorem
the sums of all bands together are the centred sums over time of the tapered window.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calib.model import Array, BandSums, Window, own_channels
from calib.signal.band import hanning
from calib.signal.order_statistics import distinct, median
from calib.signal.response import Complex

BANDS_AN_OCTAVE = 6
HANN = 0.5
TAPER = 0.1  # of the window, at each end: longer than the impulse response of any filter of an instrument
MORE_LINES = 6  # in a band, beside those that the regression on u and du/dt uses; a band with fewer joins the next one
FEWEST_BANDS = 4
RELATED = 1e-9  # relative eigenvalue of the channels' scatter below which a direction was not excited
# A band is used if the motion is so many times the reference's noise, in power: the correction leaves a tenth of it.
OVER_NOISE = 100.0
# A response is told by motion that has so large a share of its power in so many third octaves.
LEAST_SHARE, FEWEST_THIRDS = 1e-2, 4
# Ratio of frequencies without motion between them: no smooth response is told across it. The motion below counts where
# it holds so much of the power.
GAP, BELOW_GAP = 4.0, 0.05
LEAST_SHOWN = 0.25  # of V in a band, by the motion: with less, the reference's noise may look like motion
HIGHEST = 1.001  # times the upper end of the motion: a band that ends there is rounded
LEAKED = 1.0  # of the power of a band, that may be of motion at other frequencies: with more, it shows their response
NEAR_LINES = 3  # around a line that it has itself: the main lobe of a taper
LEAST_LEAK = 1e-12  # of a line's power, in another one: what is less is beyond the numbers
ALIKE = 0.8  # least cosine of the angle between the slopes of V and the motion, as if the outputs were the axes
LASTS = 0.25  # of its mean power that a band has for half of the time: with less, its motion comes and goes
BELOW, ABOVE = 1e-2, 1e-3  # shares of the motion's power outside its band: a response differs more above than below


def band_sums(u: Array, du: Array, V: Array, rate_hz: float, share: float = TAPER) -> BandSums | None:
    """Band sums of evenly sampled u (n, m) in m/s2, du (n, m) in m/s3 and V (n, 3) in output unit.

    `share` of the window is tapered at each end. With HANN motion that is much stronger at other frequencies does not
    leak into a band; the sums then have the weight of half of the points. Bands in which more than LEAKED of the power
    leaks from elsewhere are left out: of two tones, those between them show the response at the tones. u may hold the
    integrals of a reference as well (calib.signal.corner). None where the window is too short for a few bands, and
    without a reference.
    """
    n, m = u.shape
    fewest = 2 * own_channels(m) + MORE_LINES
    if not m or n < 2 * FEWEST_BANDS * fewest:
        return None
    taper, density = _taper(n, share)
    rows = np.vstack([u.T, du.T, V.T])
    rows -= (rows @ taper / taper.sum())[:, None]
    rows *= taper
    lines = np.fft.rfft(rows, axis=1)[:, 1:]
    frequency_hz: Array = np.fft.rfftfreq(n, 1.0 / rate_hz)[1:].astype(np.float64)
    edges = _edges(frequency_hz, fewest)
    own = [lines[:, a:b] for a, b in itertools.pairwise(edges.tolist())]
    products = np.array([(part @ part.conj().T).real for part in own])
    ends_hz = np.append(frequency_hz, 0.5 * rate_hz)[edges]
    nothing, moved = np.zeros((len(products), 2 * m + 3)), own_channels(m)
    lasting = np.array([_lasting(part[:moved]) for part in own])
    made = BandSums(m, ends_hz[:-1], ends_hz[1:], 2.0 * np.diff(edges), density, 2.0 / n * products, nothing, lasting)
    power = np.sum(np.abs(lines[:moved]) ** 2, axis=0)
    leaks = np.add.reduceat(_leaking(power, n, share), edges[:-1])
    return parts(made, leaks <= LEAKED * np.add.reduceat(power, edges[:-1]))


def _leaking(power: Array, n: int, share: float) -> Array:
    """(L,) what of the power (L,) of the lines of n points leaks from other lines at most, for `_taper(n, share)`."""
    size = 1 << (2 * len(power)).bit_length()
    return np.asarray(np.fft.irfft(np.fft.rfft(power, size) * _leak(len(power), n, share), size)[: len(power)])


@lru_cache(maxsize=4)
def _leak(lines: int, n: int, share: float) -> Complex:
    """The spectrum of the share of a line's power that leaks into a line so many further, which is at most that of the
    highest side lobe from there on: a tone may lie between two lines."""
    taper, _ = _taper(n, share)
    lobes = np.abs(np.fft.rfft(taper, 2 * n)) ** 2
    envelope = np.maximum.accumulate(lobes[::-1])[::-1][: 2 * lines : 2] / lobes[0]
    envelope[:NEAR_LINES] = 0.0
    around = np.zeros(1 << (2 * lines).bit_length())
    around[: len(envelope)] = np.where(envelope > LEAST_LEAK, envelope, 0.0)
    around[1:] += around[:0:-1].copy()
    spectrum = np.fft.rfft(around)
    spectrum.flags.writeable = False
    return np.asarray(spectrum)


def _lasting(lines: Complex) -> float:
    """The median over time of the power of a band, over its mean. `lines` (m, L) are those of the motion in the band;
    their envelope has one point for each line. The power of noise has a median of 0.7 to 0.9 times its mean, a sine has
    1, and bumps that take a small part of the time have almost nothing (scipy/scipy pull request 8970 averages spectra
    so)."""
    power = np.sum(np.abs(np.fft.ifft(lines * hanning(lines.shape[1] + 2)[1:-1], axis=1)) ** 2, axis=0)
    return float(median(power) / max(power.mean(), np.finfo(float).tiny))


def parts(bands: BandSums, kept: NDArray[np.bool_] | slice) -> BandSums:
    """Some of the bands."""
    names = ("low_hz", "high_hz", "points", "products", "noise", "lasting")
    return replace(bands, **{name: getattr(bands, name)[kept] for name in names})


def beside_noise(bands: BandSums, sensor_noise: Array) -> BandSums:
    """The same bands with the white noise of V: `sensor_noise` (3,) is its rms of a point: 0 where nobody knows it,
    inf where all noise that is not the reference's white noise is V's."""
    noise = bands.noise.copy()
    noise[:, -3:] = bands.points[:, None] * sensor_noise**2
    return replace(bands, noise=noise)


def along_motion(bands: BandSums, direction: Array) -> BandSums:
    """The bands of a uniaxial reference with one output in the place of three: V along the motion, `direction` (3,).

    Motion across, which such a reference does not measure, is another one in each band: the sensor's outputs across
    show it as if they had another response over frequency there. Where no axis of the sensor is the output that it
    is taken for, V is taken along the slopes.
    """
    u, m = bands.products[:, 0, 0].sum(), bands.reference_channels
    slopes = bands.products[:, 0, 2 * m :].sum(axis=0) / max(float(u), np.finfo(float).tiny)
    length = max(float(np.linalg.norm(slopes)), np.finfo(float).tiny)
    way = direction if abs(slopes @ direction) > ALIKE * length else slopes / length
    to = np.zeros((2 * m + 1, 2 * m + 3))
    to[: 2 * m, : 2 * m], to[2 * m, 2 * m :] = np.eye(2 * m), way
    products = to @ bands.products @ to.T
    return replace(bands, products=products, noise=bands.noise @ (to**2).T)


def without_integrals(bands: BandSums) -> BandSums:
    """The bands of the reference's own channels, without their integrals (calib.signal.corner)."""
    channels, m = bands.reference_channels, own_channels(bands.reference_channels)
    if channels == m:
        return bands
    kept = np.r_[0:m, channels : channels + m, 2 * channels : bands.products.shape[1]]
    products = bands.products[:, kept[:, None], kept]
    return replace(bands, reference_channels=m, products=products, noise=bands.noise[:, kept])


def beside_reference_noise(bands: BandSums, reference_noise: Array, points: float, derivatives: int = 0) -> BandSums:
    """The same bands with the white noise of the reference, of a quantity that was differentiated so often to give u.

    `reference_noise` (2, m): its rms of a point in u and du/dt, whose ratio tells up to which frequency it is;
    `points`: of the whole window. A band that reaches beyond that frequency has none: `without_noise` does not keep it.
    """
    channels, noise = bands.reference_channels, bands.noise.copy()
    of_u, of_rate = 2 * derivatives + 1, 2 * derivatives + 3  # powers of the frequency up to which it is summed
    for k in np.flatnonzero(reference_noise[0] > 0.0).tolist():
        u, rate = reference_noise[:, k].tolist()
        end_hz = np.sqrt(of_rate / of_u) * rate / u / (2.0 * np.pi)
        low, high = (np.where(bands.high_hz <= end_hz, edge, 0.0) / end_hz for edge in (bands.low_hz, bands.high_hz))
        noise[:, k] = points * u**2 * (high**of_u - low**of_u)
        noise[:, channels + k] = points * rate**2 * (high**of_rate - low**of_rate)
    return replace(bands, noise=noise)


def without_noise(bands: BandSums) -> BandSums:
    """The bands with motion, the power of the reference's white noise subtracted."""
    channels, m = bands.reference_channels, own_channels(bands.reference_channels)
    own, noise = bands.products.diagonal(axis1=1, axis2=2)[:, : 2 * channels], bands.noise[:, : 2 * channels]
    of_u, of_rate = noise[:, :m], noise[:, channels : channels + m]
    moved, moved_rate = (own[:, of : of + m].sum(axis=1, keepdims=True) for of in (0, channels))
    kept = ((of_u > 0.0) | ~of_u.any(axis=0)).all(axis=1)
    kept &= ((moved > OVER_NOISE * of_u) & (moved_rate > OVER_NOISE * of_rate) | (of_u == 0.0)).all(axis=1)
    products, size = bands.products.copy(), range(2 * channels)
    products[:, size, size] -= noise
    for k in range(m, channels):  # an integral has the noise of its channel, at each frequency
        for i, j, times in ((k - m, channels + k, 2.0 * np.pi), (k, channels + k - m, -2.0 * np.pi)):
            products[:, i, j] -= times * noise[:, k - m]
            products[:, j, i] = products[:, i, j]
    return parts(replace(bands, products=products), kept)


@lru_cache(maxsize=4)
def _taper(n: int, share: float) -> tuple[Array, float]:
    """A cosine taper (n,) with mean square 1, and the share of the points that it leaves independent."""
    ramp = max(int(share * n), 1)
    taper = np.ones(n)
    taper[:ramp] = 0.5 - 0.5 * np.cos(np.pi * (np.arange(ramp) + 0.5) / ramp)
    taper[n - ramp :] = taper[:ramp][::-1]
    taper /= np.sqrt(np.mean(taper**2))
    taper.flags.writeable = False
    return taper, float(1.0 / np.mean(taper**4))


def _edges(frequency_hz: Array, fewest: int) -> NDArray[np.int64]:
    """Numbers of the lines at which bands begin, and the number of lines; each band has `fewest` lines or more."""
    octave = np.floor(BANDS_AN_OCTAVE * np.log2(frequency_hz / frequency_hz[0])).astype(np.int64)
    starts = [0]
    for k in (np.flatnonzero(np.diff(octave)) + 1).tolist():
        if k - starts[-1] >= fewest:
            starts.append(k)
    if len(starts) > 1 and len(frequency_hz) - starts[-1] < fewest:
        starts.pop()
    return np.array([*starts, len(frequency_hz)])


def share_above(bands: BandSums | None, to_hz: float) -> float:
    """The share of a window's motion, in power, that is above a frequency; 0 where the window has no `bands`.

    The power of a band is taken to be even over it: a band that hardly reaches above the frequency hardly counts.
    """
    if bands is None:
        return 0.0
    m = own_channels(bands.reference_channels)
    power = np.trace(bands.products[:, :m, :m], axis1=1, axis2=2)
    part = ((bands.high_hz - to_hz) / (bands.high_hz - bands.low_hz)).clip(0.0, 1.0)
    return float(power @ part / max(power.sum(), np.finfo(float).tiny))


def motion_band_hz(windows: Sequence[Window], *, lasting: bool = False) -> tuple[float, float] | None:
    """The band in Hz of the motion of all windows. None where no window has bands, or where the motion is in a few
    narrow bands only (sines), which cannot tell a response over frequency. `lasting`: of a band in which the motion
    comes and goes, only the power counts that is there for half of the time; and only motion below a gap of two
    octaves, such as between the waves that move a platform and the engine on it."""
    bands = [w.bands for w in windows if w.bands is not None and len(w.bands.points)]
    if not bands:
        return None
    low, high = (np.concatenate([getattr(b, name) for b in bands]) for name in ("low_hz", "high_hz"))
    each = [_powers(b, lasting=lasting) for b in bands]
    power, square = (np.concatenate(part) for part in zip(*each, strict=True))
    if not power.sum() > 0.0:
        return None
    third = np.round(3.0 * np.log2(np.sqrt(low * high))).astype(np.int64)
    end_hz = _end_below_gap(bands, each) if lasting else None
    if end_hz is not None and _tells_response(third, np.where(high <= end_hz, power, 0.0)):
        within = [b.high_hz <= end_hz for b in bands]
        each = [(np.where(own, a, 0.0), np.where(own, b, 0.0)) for own, (a, b) in zip(within, each, strict=True)]
        power, square = (np.concatenate(part) for part in zip(*each, strict=True))
    if not _tells_response(third, power):
        return None
    below, above = _narrowed(low, high, power, square)
    surely_low = max(_end(b.low_hz, b.low_hz, own, BELOW) for b, (own, _) in zip(bands, each, strict=True))
    surely_high = min(_end(b.high_hz, -b.high_hz, own, ABOVE) for b, (own, _) in zip(bands, each, strict=True))
    low_hz, high_hz = _end(below, below, power, BELOW), _end(above, -above, power, ABOVE)
    return min(low_hz, surely_low), max(high_hz, surely_high)


def _tells_response(third: NDArray[np.int64], power: Array) -> bool:
    """Whether motion with this `power` in bands of these third octaves is in FEWEST_THIRDS of them."""
    shares = np.array([power[third == k].sum() for k in distinct(third)]) / power.sum()
    return bool(np.count_nonzero(shares > LEAST_SHARE) >= FEWEST_THIRDS)


def _end_below_gap(bands: Sequence[BandSums], each: Sequence[tuple[Array, Array]]) -> float | None:
    """Where motion with at least the share BELOW_GAP of the power ends in Hz, below a gap of at least the ratio GAP;
    None where there is no such gap. `each`: the powers of the bands of a window, as `_powers` gives them."""
    low, high = (np.concatenate([getattr(b, name) for b in bands]) for name in ("low_hz", "high_hz"))
    power = np.concatenate([own for own, _ in each])
    moved = np.concatenate([own > ABOVE * own.sum() for own, _ in each])
    order = np.argsort(low[moved], kind="stable")
    ends_hz = np.maximum.accumulate(high[moved][order])
    for end_hz, next_hz in zip(ends_hz, low[moved][order][1:], strict=False):
        if next_hz > GAP * end_hz and power[high <= end_hz].sum() >= BELOW_GAP * power.sum():
            return float(end_hz)
    return None


def below_gap_hz(windows: Sequence[Window]) -> float | None:
    """Where the motion of the longest of these windows ends below a gap of two octaves; None where there is no gap. The
    bands of a short window are too wide to tell."""
    bands = [w.bands for w in windows if w.bands is not None and len(w.bands.points)]
    if not bands:
        return None
    longest = max(bands, key=lambda own: float(own.points.sum()))
    return _end_below_gap([longest], [_powers(longest)])


def lowest_hz(windows: Sequence[Window]) -> float:
    """The frequency at which the motion of windows with bands begins, also if it begins within a wide band."""
    bands = [w.bands for w in windows if w.bands is not None and len(w.bands.points)]
    low, high = (np.concatenate([getattr(b, name) for b in bands]) for name in ("low_hz", "high_hz"))
    power, square = (np.concatenate(part) for part in zip(*map(_powers, bands), strict=True))
    below, _ = _narrowed(low, high, power, square)
    return _end(below, below, power, BELOW)


def centre_hz(bands: BandSums, band_hz: tuple[float, float]) -> float:
    """The mean frequency of the motion within a band, by the logarithm and the power: motion that is much faster than
    most of it hardly moves it. 0 where there is no motion."""
    inside = (bands.high_hz > band_hz[0]) & (bands.low_hz < band_hz[1])
    power = np.where(inside, _powers(bands)[0], 0.0)
    if not power.sum() > 0.0:
        return 0.0
    middle_hz = np.sqrt(np.maximum(bands.low_hz, 0.5 * bands.high_hz) * bands.high_hz)
    return float(np.exp(power @ np.log(middle_hz) / power.sum()))


def _narrowed(low_hz: Array, high_hz: Array, power: Array, square: Array) -> tuple[Array, Array]:
    """The ends of bands, nearer to their motion in a wide band of a short window: the derivative tells its frequency.

    `power` is that of the motion, `square` that of its derivative.
    """
    mean_hz = np.sqrt(np.divide(square, power, out=np.zeros_like(power), where=power > 0.0)) / (2.0 * np.pi)
    wide, mean_hz = 2.0 ** (1.0 / BANDS_AN_OCTAVE), np.clip(mean_hz, low_hz, high_hz)
    return np.maximum(low_hz, mean_hz / wide), np.minimum(high_hz, mean_hz * wide)


def _end(edge: Array, order: Array, power: Array, outside: float) -> float:
    """The edge of the first band, in rising order, up to which more than the share `outside` of the power lies."""
    sequence = np.argsort(order)
    share = np.cumsum(power[sequence]) / max(power.sum(), np.finfo(float).tiny)
    return float(edge[sequence][min(int(np.searchsorted(share, outside)), len(edge) - 1)])


def _powers(bands: BandSums, *, lasting: bool = False) -> tuple[Array, Array]:
    """The power of the motion and of its derivative, in each band of a window; 0 in bands that are incoherent.
    `lasting` as in motion_band_hz."""
    bands = without_integrals(bands)
    m, powers = bands.reference_channels, np.diagonal(bands.products, axis1=1, axis2=2)
    power, square = powers[:, :m].sum(axis=1), powers[:, m : 2 * m].sum(axis=1)
    if lasting:
        share = np.where(bands.lasting < LASTS, bands.lasting, 1.0)
        power, square = share * power, share * square
    seen = _coherent(bands)
    return np.where(seen, power, 0.0), np.where(seen, square, 0.0)


def _coherent(bands: BandSums) -> NDArray[np.bool_]:
    """(B,) whether the motion explains at least LEAST_SHOWN of V in a band, at any lag."""
    m, products = bands.reference_channels, bands.products
    x, V, both = products[:, : 2 * m, : 2 * m], products[:, 2 * m :, 2 * m :], products[:, : 2 * m, 2 * m :]
    unit = np.sqrt(np.where((own := np.diagonal(x, axis1=1, axis2=2)) > 0.0, own, 1.0))
    both, x = both / unit[:, :, None], x / (unit[:, :, None] * unit[:, None])
    total = np.trace(V, axis1=1, axis2=2)
    told = np.sum(both * np.linalg.solve(x + RELATED * np.eye(2 * m), both), axis=(1, 2))
    rest = (total - told) * bands.points / (bands.points - 2.0 * m)
    return np.asarray(rest <= (1.0 - LEAST_SHOWN) * total)
