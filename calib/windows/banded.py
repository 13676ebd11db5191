"""What the bands of windows say of the response over frequency (calib.signal.response) that is left in their data.

In each window V is B (h u), with B (3, M) the same in all its bands. A window whose B and lags are free tells the terms
of ln h alone: what it tells is independent of the slopes of the whole window, from which S is estimated. The front end
takes out what is known of h; what is left is small, so that all is linear in its terms.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.model import Array, BandSums, own_channels
from calib.signal.order_statistics import distinct
from calib.signal.response import POWERS, Complex, by_term
from calib.windows.bands import HIGHEST, RELATED
from calib.windows.deviations import BetweenBands, Deviations, LeftOpen
from calib.windows.sums import NOISE_FLOOR

TINY = float(np.finfo(float).tiny)
U_WHITE = 0.1  # relative standard uncertainty of the power of white noise, from a spectrum of some hundred lines
NARROW = 1e-3  # SD of omega^2 relative to its mean
MOST_TAPERED = 2.0  # times: power of a band in the whole window over that in the tapered one


@dataclass(frozen=True, slots=True, eq=False)
class Banded:
    """What the bands of W windows with M channels say of the K terms of the response that is left.

    `projected` (W, K, 2M, M): derivatives, by the terms, of the slopes of h u on [u, du/dt] of the whole window.
    `residual` (R,) and `moves` (R, K): whitened rows of the terms alone, of all windows together; where the bands
    deviate by more than their noise, their noise is taken as much larger. `left_open`: what the bands cannot tell.
    """

    projected: Array
    residual: Array
    moves: Array
    deviations: Deviations
    left_open: LeftOpen

    @property
    def between(self) -> BetweenBands:
        """How far the bands deviate from one response."""
        return self.deviations.between


def banded(
    bands: Iterable[BandSums | None],
    channels: int,
    to_hz: float,
    mean_omega2: Array,
    omega2: Array,
    *,
    one_frequency: bool = False,
    powers: int = len(POWERS),
) -> Banded:
    """The `bands` up to `to_hz` of W windows with `channels` reference channels at most.

    The power of du/dt over that of u, in rad2/s2: `mean_omega2` (W,) of all channels of a window together, at which a
    window without such bands moves, and `omega2` (W, M) of each channel. `one_frequency`: the bands are those of a few
    sines and of their harmonics, which tell no term of the response. `powers`: how many terms there are.
    """
    projected = np.array([_at_one_frequency(np.sqrt(square), channels, powers) for square in mean_omega2.tolist()])
    together, left_open = _PooledBands(powers), LeftOpen()
    for w, own in enumerate(bands):
        if own is None or own.reference_channels != channels:
            continue
        kept = np.flatnonzero(own.high_hz <= HIGHEST * to_hz)
        if kept.size:
            factors = Factors(own, kept)
            projected[w] = _projected(factors, powers, omega2[w])
            left_open = left_open.plus(_left_open(factors, powers))
            if not one_frequency:
                together.add(_explained_power(factors, powers))
    return together.result(projected, left_open)


class Factors:
    """The regressions of V on u and du/dt in B bands of a window; V has A outputs, three or that along the motion.

    Of a reference with N own channels and their integrals M is 2 N, else N. Integrals are no regressors: in a band they
    are the derivatives, and their own derivatives are the channels, but for what interpolation errs.

    `gram` (B, 2M, 2M) is that of [u, du/dt] of the M channels, `root` (B, 2N, 2M) a factor of what of it the regressors
    show, `slopes` (B, 2N, A) = root b, `noise` (B, A) their noise. `omega` (B,) in rad/s is that of the motion in the
    band, `middle_hz` (B,) the band's middle. `told` and `left` (B, A): the power of V that the motion explains, and the
    rest; `white` (B, A): what white noise of sensor and reference has in it. Of the `points` (B,), the rest has `free`
    (B,) degrees of freedom.
    """

    def __init__(self, bands: BandSums, kept: NDArray[np.int64]) -> None:
        m, real, products = bands.reference_channels, own_channels(bands.reference_channels), bands.products[kept]
        own = np.r_[0:real, m : m + real]
        self.gram = products[:, : 2 * m, : 2 * m]
        powers = np.diagonal(products, axis1=1, axis2=2)
        self.omega = np.sqrt(powers[:, m : m + real].sum(axis=1) / powers[:, :real].sum(axis=1))
        self.middle_hz = np.sqrt(bands.low_hz[kept] * bands.high_hz[kept])
        scale = _unit(powers[:, own])
        values, vectors = np.linalg.eigh(self.gram[:, own[:, None], own] / (scale[:, :, None] * scale[:, None]))
        live = values > RELATED * values[:, -1:]
        inverse = np.divide(1.0, np.sqrt(np.maximum(values, 0.0)), out=np.zeros_like(values), where=live)
        whitened = inverse[..., None] * vectors.transpose(0, 2, 1) / scale[:, None]
        self.root, self.slopes = whitened @ self.gram[:, own], whitened @ products[:, own, 2 * m :]
        b = whitened.transpose(0, 2, 1) @ self.slopes
        total = powers[:, 2 * m :]
        reference = np.einsum("br,bri->bi", bands.noise[kept[:, None], own], b**2)
        left = np.maximum(total - np.sum(self.slopes**2, axis=1) + reference, NOISE_FLOOR**2 * total)
        self.told, self.left = np.maximum(total - left, 0.0), left
        self.points, self.white = bands.points[kept], reference + bands.noise[kept, 2 * m :]
        # The mean of 1 / noise^2 is right if two degrees of freedom fewer are counted (the inverse of a chi-squared).
        freedom = bands.points[kept] - np.count_nonzero(live, axis=1) - 2.0
        self.free = freedom + 2.0
        self.noise = np.maximum(np.sqrt(left / freedom[:, None] / bands.independent), TINY)

    def seen(self, response: Complex) -> Array:
        """(..., A, 2 N B, M) whitened slopes of each axis, by channel, if V is `response` (..., B) times u."""
        m = self.root.shape[2] // 2
        rows = response.real[..., None, None] * self.root[..., :m]
        rows += (response.imag / self.omega)[..., None, None] * self.root[..., m:]
        rows = rows[..., None, :, :, :] / self.noise.T[:, :, None, None]
        return np.asarray(rows.reshape(*response.shape[:-1], self.noise.shape[1], -1, m))

    def observed(self) -> Array:
        """(A, 2 N B) whitened slopes of each axis."""
        return np.asarray((self.slopes / self.noise[:, None, :]).transpose(2, 0, 1).reshape(self.noise.shape[1], -1))

    def by_row(self, values: Array) -> Array:
        """Values of the bands (..., B) for each of the rows (..., 2 N B)."""
        return np.repeat(values, self.root.shape[1], axis=-1)


def _unit(powers: Array) -> Array:
    """The root of each power, 1 where there is none: a unit in which no column is much larger than the others."""
    return np.where(powers > 0.0, np.sqrt(np.maximum(powers, 0.0)), 1.0)


def _at_one_frequency(omega: float, channels: int, powers: int) -> Array:
    """(K, 2M, M) see Banded."""
    terms, per_omega = by_term(np.array(omega), powers), 1.0 / omega if omega else 0.0
    return np.stack([np.vstack([h.real * np.eye(channels), h.imag * per_omega * np.eye(channels)]) for h in terms])


def _projected(factors: Factors, powers: int, omega2: Array) -> Array:
    """(K, 2M, M) see Banded. `omega2` (M,) is that of each channel in the whole window."""
    bands, m = _as_in_the_window(factors, omega2), factors.gram.shape[1] // 2
    gram, real = bands.sum(axis=0), own_channels(m)
    for k in range(real, m):  # below the bands an integral has noise, which makes the slope on it smaller
        gram[k, k] = max(gram[k, k], gram[m + k, m + k] / omega2[k] if omega2[k] > 0.0 else 0.0)
    gram[m + real :] = gram[:, m + real :] = 0.0  # an integral's derivative is no other motion
    scale = _unit(np.diag(gram))
    inverse = np.linalg.pinv(gram / np.outer(scale, scale), RELATED, hermitian=True) / np.outer(scale, scale)
    terms = by_term(factors.omega, powers)
    moved = np.einsum("bk,brm->krm", terms.real, bands[..., :m])
    moved += np.einsum("bk,brm->krm", terms.imag / factors.omega[:, None], bands[..., m:])
    return np.asarray(inverse @ moved)


def _as_in_the_window(factors: Factors, omega2: Array) -> Array:
    """(B, 2M, 2M) of [u, du/dt] in the bands as they are in the whole window, not in the tapered one.

    The power of each channel is multiplied by 1 + b (omega^2 - <omega^2>), with b such that the power of its du/dt over
    that of u is `omega2` (M,), 0 where the channel is silent. A channel that has no more power than its
    noise, which was subtracted, is silent as well. An integral has the motion of its own channel.
    """
    m = factors.gram.shape[1] // 2
    real = own_channels(m)
    powers, omega2 = np.diagonal(factors.gram, axis1=1, axis2=2), omega2[:real]
    power, rate_power = powers[:, :real], powers[:, m : m + real]
    square = np.divide(rate_power, power, out=np.zeros_like(power), where=power > 0.0)
    total = power.sum(axis=0)
    share = np.divide(power, total, out=np.zeros_like(power), where=total > 0.0)
    mean = np.sum(share * square, axis=0)
    spread = np.sum(share * (square - mean) ** 2, axis=0)
    told = (omega2 > 0.0) & (spread > (NARROW * mean) ** 2)  # in a narrow band nothing can be made wider
    wider = np.divide(omega2 - mean, spread, out=np.zeros_like(mean), where=told)
    times = (1.0 + wider * (square - mean)).clip(1.0 / MOST_TAPERED, MOST_TAPERED)
    root = np.tile(np.sqrt(times), 2 * m // real)
    return np.asarray(root[:, :, None] * root[:, None] * factors.gram)


@dataclass(frozen=True, slots=True, eq=False)
class _WindowBands:
    """What the three axes of a window say of the terms, whatever their rows of B and their lags are.

    `residual` (R,) and `moves` (R, K) are whitened, and orthogonal to all that B and the lag can do. `signal` (R,) is
    what they can do of the row, `at_hz` (R,) its frequency, `noise` (R,) what it was divided by, `free` the number of
    unknowns that were projected out. The noise of `residual` and that of `signal` are not correlated. `moved`: the sum
    of the products of residual, signal and noise^2 has this variance.
    """

    residual: Array
    moves: Array
    signal: Array
    at_hz: Array
    noise: Array
    free: int
    moved: float


def _explained_power(factors: Factors, powers: int) -> _WindowBands:
    terms = by_term(factors.omega, powers)
    own = factors.seen(np.ones(len(terms), dtype=complex))
    lagged = factors.seen(-1j * factors.omega)
    observed = factors.observed()
    live = own.any(axis=(0, 1))
    moving = own[..., live]
    gain = np.zeros((len(observed), own.shape[2], 1))
    gain[:, live] = _fitted(moving, observed)
    # With the lag in the fit, a lag that is left does not reduce the gain.
    gain[:, live] = _fitted(np.concatenate([moving, lagged @ gain], axis=2), observed)[:, :-1]
    free = np.concatenate([moving / _length(moving), lagged @ gain], axis=2)
    ways, _ = np.linalg.qr(free)
    rows = np.concatenate([observed[..., None], *(factors.seen(terms.T) @ gain)], axis=2)
    rows = (rows - ways @ (ways.transpose(0, 2, 1) @ rows)).reshape(-1, 1 + powers)
    at_hz, noise = np.tile(factors.by_row(factors.middle_hz), len(observed)), factors.by_row(factors.noise.T).ravel()
    signal = np.where(observed.ravel() != 0.0, observed.ravel() - rows[:, 0], 0.0)
    weighted = (signal * noise**2).reshape(len(observed), -1, 1)
    moved = float(np.sum((weighted - ways @ (ways.transpose(0, 2, 1) @ weighted)) ** 2))
    return _WindowBands(rows[:, 0], rows[:, 1:], signal, at_hz, noise, len(observed) * free.shape[2], moved)


def _left_open(factors: Factors, powers: int) -> LeftOpen:
    rest = factors.left * (factors.points / factors.free)[:, None]
    white = np.where(np.isfinite(factors.white), factors.white, rest)
    chance = 2.0 * rest**2 / factors.free[:, None] + (U_WHITE * white) ** 2
    silent = np.zeros((len(rest), 3 - rest.shape[1]))
    rows = np.hstack([part for own in (factors.told, rest - white, chance) for part in (own, silent)])
    third = _third(factors.middle_hz)
    thirds = [(k, tuple(rows[third == k].sum(axis=0).tolist())) for k in distinct(third).tolist()]
    moments = factors.told.sum(axis=1) @ by_term(factors.omega, powers).real
    return LeftOpen(tuple(thirds), tuple(moments.tolist()))


def _third(frequency_hz: Array) -> NDArray[np.int64]:
    """The numbers of the thirds of an octave."""
    return np.round(3.0 * np.log2(frequency_hz)).astype(np.int64)


def _length(columns: Array) -> Array:
    """(A, 1, p) length of each column (A, R, p), 1 where it is zero."""
    return _unit(np.sum(columns**2, axis=1, keepdims=True))


def _fitted(columns: Array, observed: Array) -> Array:
    """(A, p, 1) least squares of `observed` (A, R) on columns (A, R, p)."""
    unit = _length(columns)
    return np.asarray((np.linalg.pinv(columns / unit, RELATED) @ observed[..., None]) / unit.transpose(0, 2, 1))


class _PooledBands:
    """What the windows say of the terms together: only what the terms can change is kept of the rows of all windows,
    as many rows as there are terms, and the sums of Deviations. So memory does not grow with the windows."""

    def __init__(self, powers: int) -> None:
        self._powers, self._rows, self._free = powers, 0, 0
        self._triangle = np.zeros((0, powers + 1))  # R of the rows [moves, residual]
        self._sums = np.zeros(4)  # of size, size variance, the variance of what is moved, and of the rows with a signal
        # For each third of an octave: sums of signal variance [moves, residual], and of size variance.
        self._thirds: dict[int, Array] = {}

    def add(self, told: _WindowBands) -> None:
        """Add what a window says."""
        rows = np.column_stack([told.moves, told.residual])
        self._triangle = np.asarray(np.linalg.qr(np.vstack([self._triangle, rows]), mode="r"), dtype=np.float64)
        size, variance = told.signal**2, told.noise**2
        parts = (size.sum(), size @ variance, told.moved, np.count_nonzero(size))
        self._sums += np.array(parts, dtype=np.float64)
        self._rows, self._free = self._rows + len(rows), self._free + told.free
        moved = np.column_stack([(told.signal * variance)[:, None] * rows, size * variance])
        third = _third(told.at_hz)
        for k in distinct(third).tolist():
            self._thirds[k] = self._thirds.get(k, np.zeros(self._powers + 2)) + moved[third == k].sum(axis=0)

    def result(self, projected: Array, left_open: LeftOpen) -> Banded:
        """What the bands say; `projected` and `left_open` as in Banded."""
        size = self._powers
        if not self._thirds:
            return Banded(projected, np.zeros(0), np.zeros((0, size)), Deviations(), left_open)
        triangle = self._triangle.copy()
        moves, residual = triangle[:, :size], triangle[:, size]
        scale = _unit(np.sum(moves**2, axis=0))
        fitted, *_ = np.linalg.lstsq(moves / scale, residual, rcond=self._rows * np.finfo(float).eps)
        fitted = fitted / scale
        deviations = self._deviations(fitted, float(np.sum((residual - moves @ fitted) ** 2)))
        triangle /= np.sqrt(deviations.times_noise)
        return Banded(projected, triangle[:size, size], triangle[:size, :size], deviations, left_open)

    def _deviations(self, fitted: Array, square: float) -> Deviations:
        """The sums of what the best response, with the terms `fitted` (K,), leaves; `square` is that of the rows."""
        signal, power, variance, rows = self._sums.tolist()
        freedom = rows - self._free - self._powers
        moved = {k: float(own[-2] - own[:-2] @ fitted) for k, own in self._thirds.items()}
        worst = max(sorted(moved), key=lambda k: abs(moved[k]))
        largest = abs(moved[worst]) / max(float(self._thirds[worst][-1]), TINY)
        return Deviations(
            freedom, square, signal, sum(moved.values()), power, variance, float(np.exp2(worst / 3.0)), largest
        )
