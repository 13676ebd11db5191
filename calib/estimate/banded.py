"""What the bands of windows say of the response over frequency (calib.signal.response) that is left in their data.

In each window V is B (h u), with B (3, M) the same in all its bands. A window whose B and lags are free tells the terms
of ln h alone: what it tells is independent of the slopes of the whole window, from which S is estimated. The front end
takes out what is known of h; what is left is small, so that all is linear in its terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.distributions import chi2_quantile
from calib.excitation.sums import NOISE_FLOOR
from calib.model import Array, BandSums, Window
from calib.signal.response import POWERS, by_term

HIGHEST = 1.001  # times the upper end of the motion: a band that ends there is rounded
PROBABILITY = 0.99  # confidence of the test for scatter between bands
RELATED = 1e-9  # relative eigenvalue of the channels' scatter below which a direction was not excited


@dataclass(frozen=True, slots=True, eq=False)
class BetweenBands:
    """How far bands deviate, beyond their noise, from the response that fits all of them best.

    `scatter` is the relative SD, 0 where noise explains all. A narrow feature raises the noise of its band and so has
    little weight in it: `shift` is how far the deviations move the slopes of whole windows, relative; 0 where noise
    explains that. `at_hz` is the frequency that contributes most, and `largest` the deviation there.
    """

    scatter: float = 0.0
    shift: float = 0.0
    at_hz: float = 0.0
    largest: float = 0.0

    @property
    def relative_u(self) -> float:
        """Relative standard uncertainty of S."""
        return max(self.scatter, self.shift)


@dataclass(frozen=True, slots=True, eq=False)
class Banded:
    """What the bands of W windows with M channels say of the K terms of the response that is left.

    `projected` (W, K, 2M, M): derivatives, by the terms, of the slopes of h u on [u, du/dt] of the whole window.
    `residual` (R,) and `moves` (R, K): whitened rows of the terms alone, of all windows together.
    """

    projected: Array
    residual: Array
    moves: Array
    between: BetweenBands


def banded(windows: Sequence[Window], channels: int, to_hz: float) -> Banded:
    """The bands up to `to_hz` of windows with `channels` reference channels at most; some windows may have none."""
    projected = np.zeros((len(windows), len(POWERS), 2 * channels, channels))
    found = []
    for w, window in enumerate(windows):
        if window.bands is None or window.bands.reference_channels != channels:
            continue
        kept = np.flatnonzero(window.bands.high_hz <= HIGHEST * to_hz)
        if kept.size:
            factors = [_Factor(window.bands, b) for b in kept.tolist()]
            projected[w] = _projected(factors)
            found += [_told(factors, axis) for axis in range(3)]
    if not found:
        return Banded(projected, np.zeros(0), np.zeros((0, len(POWERS))), BetweenBands())
    residual, moves = np.concatenate([t.residual for t in found]), np.vstack([t.moves for t in found])
    # Only what the terms can change is kept: as many rows as there are terms.
    scale = _unit(np.sum(moves**2, axis=0))
    triangle = np.asarray(np.linalg.qr(np.column_stack([moves / scale, residual]), mode="r"), dtype=np.float64)
    fitted, *_ = np.linalg.lstsq(moves / scale, residual, rcond=None)
    left = residual - moves / scale @ fitted
    size = len(POWERS)
    return Banded(projected, triangle[:size, size], triangle[:size, :size] * scale, _between(found, left))


class _Factor:
    """The regression of V on u and du/dt in one band: `root` (2M, 2M), `slopes` (2M, 3) = root b, `noise` (3,)."""

    def __init__(self, bands: BandSums, b: int) -> None:
        m = bands.reference_channels
        self.gram, cross = bands.products[b, : 2 * m, : 2 * m], bands.products[b, : 2 * m, 2 * m :]
        powers = np.diag(self.gram)
        self.omega = float(np.sqrt(powers[m:].sum() / powers[:m].sum()))
        self.middle_hz = float(np.sqrt(bands.low_hz[b] * bands.high_hz[b]))
        scale = _unit(powers)
        values, vectors = np.linalg.eigh(self.gram / np.outer(scale, scale))
        live = values > RELATED * values[-1]
        root = np.where(live, np.sqrt(np.maximum(values, 0.0)), 0.0)
        inverse = np.divide(1.0, root, out=np.zeros_like(root), where=live)
        self.root = root[:, None] * vectors.T * scale
        self.slopes = inverse[:, None] * (vectors.T @ (cross / scale[:, None]))
        total = np.diag(bands.products[b])[-3:]
        b_of = np.linalg.pinv(self.root, RELATED) @ self.slopes
        left = total - np.sum(self.slopes**2, axis=0) + bands.noise[b] @ b_of**2
        left = np.maximum(left, NOISE_FLOOR**2 * total)
        # The mean of 1 / noise^2 is right if two degrees of freedom fewer are counted (the inverse of a chi-squared).
        freedom = bands.points[b] - np.count_nonzero(live) - 2.0
        self.noise = np.maximum(np.sqrt(left / freedom / bands.independent), np.finfo(float).tiny)

    def seen(self, response: complex, axis: int) -> Array:
        """(2M, M) whitened slopes of an axis if V is `response` times u, by channel."""
        m = len(self.root) // 2
        rows = response.real * self.root[:, :m] + response.imag / self.omega * self.root[:, m:]
        return np.asarray(rows / self.noise[axis])


def _unit(powers: Array) -> Array:
    """The root of each power, 1 where there is none: a unit in which no column is much larger than the others."""
    return np.where(powers > 0.0, np.sqrt(np.maximum(powers, 0.0)), 1.0)


def _projected(factors: Sequence[_Factor]) -> Array:
    """(K, 2M, M) see Banded."""
    gram = np.sum([f.gram for f in factors], axis=0)
    scale = _unit(np.diag(gram))
    inverse = np.linalg.pinv(gram / np.outer(scale, scale), RELATED, hermitian=True) / np.outer(scale, scale)
    terms, m = by_term(np.array([f.omega for f in factors])), len(gram) // 2
    moved = sum(
        terms[b].real[:, None, None] * f.gram[:, :m] + (terms[b].imag / f.omega)[:, None, None] * f.gram[:, m:]
        for b, f in enumerate(factors)
    )
    return np.asarray(inverse @ moved)


@dataclass(frozen=True, slots=True, eq=False)
class _Told:
    """What one axis of a window says of the terms, whatever its row of B and its lag are.

    `residual` (R,) and `moves` (R, K) are whitened, and orthogonal to all that B and the lag can do. `signal` (R,) is
    the row without that projection, `at_hz` (R,) its frequency, `noise` (R,) what it was divided by, `free` the number
    of unknowns that were projected out.
    """

    residual: Array
    moves: Array
    signal: Array
    at_hz: Array
    noise: Array
    free: int


def _told(factors: Sequence[_Factor], axis: int) -> _Told:
    terms = by_term(np.array([f.omega for f in factors]))
    own = np.vstack([f.seen(1.0 + 0.0j, axis) for f in factors])
    lagged = np.vstack([f.seen(-1j * f.omega, axis) for f in factors])
    observed = np.concatenate([f.slopes[:, axis] / f.noise[axis] for f in factors])
    moved = [np.vstack([f.seen(complex(terms[b, k]), axis) for b, f in enumerate(factors)]) for k in range(len(POWERS))]
    live = own.any(axis=0)
    moving = own[:, live] / _unit(np.sum(own[:, live] ** 2, axis=0))
    gain = np.zeros(own.shape[1])
    gain[live] = _fitted(own[:, live], observed)
    # With the lag in the fit, a lag that is left does not reduce the gain.
    gain[live] = _fitted(np.column_stack([own[:, live], lagged @ gain]), observed)[:-1]
    free, _ = np.linalg.qr(np.column_stack([moving, lagged @ gain]))
    rows = np.column_stack([observed, *(part @ gain for part in moved)])
    rows -= free @ (free.T @ rows)
    at_hz, noise = (
        np.repeat(values, len(factors[0].root))
        for values in ([f.middle_hz for f in factors], [f.noise[axis] for f in factors])
    )
    return _Told(rows[:, 0], rows[:, 1:], observed, at_hz, noise, free.shape[1])


def _fitted(columns: Array, observed: Array) -> Array:
    """Least squares of `observed` (R,) on columns (R, p)."""
    unit = _unit(np.sum(columns**2, axis=0))
    solution, *_ = np.linalg.lstsq(columns / unit, observed, rcond=RELATED)
    return np.asarray(solution / unit)


def _between(found: Sequence[_Told], left: Array) -> BetweenBands:
    """The scatter of what the best response leaves; noise alone shows as much in one of 100 cases."""
    signal, at_hz, noise = (
        np.concatenate([getattr(part, of) for part in found]) for of in ("signal", "at_hz", "noise")
    )
    square, size = left**2, signal**2
    freedom = float(np.count_nonzero(size) - sum(part.free for part in found) - len(POWERS))
    if freedom < 1.0:
        return BetweenBands()
    excess = float(square.sum()) - freedom
    seen = square.sum() > chi2_quantile(PROBABILITY, freedom)
    scatter = float(np.sqrt(max(excess, 0.0) / size.sum())) if seen else 0.0
    power = size * noise**2
    moved = left * signal * noise**2 / power.sum()
    variance = float(np.sum(size * noise**4)) / float(power.sum()) ** 2
    shift = float(moved.sum())
    shifted = shift**2 > chi2_quantile(PROBABILITY, 1.0) * variance
    third: NDArray[np.int64] = np.round(3.0 * np.log2(at_hz)).astype(np.int64)
    own = {k: third == k for k in np.unique(third).tolist()}
    by = {k: abs(float(moved[rows].sum())) for k, rows in own.items()}
    worst = max(by, key=lambda k: by[k])
    largest = by[worst] * float(power.sum()) / float(power[own[worst]].sum())
    return BetweenBands(scatter, abs(shift) if shifted else 0.0, float(np.exp2(worst / 3.0)), largest)
