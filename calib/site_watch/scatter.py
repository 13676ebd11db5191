"""How far the scatter of days is from independent, learned from what each day differs from its expectation.

Standardised one-day residuals of a sound model are independent with variance 1. Sums over 1, 7 and 28 days, divided
by the root of their number, then have variance 1 too. Where days depend on each other (AR(1) of the scatter, a norm
that does not fit the season) longer sums have more. The ratio is the inflation of the variance of a mean over so
many days. It is a median over sensors, so a sensor that changes does not loosen the test of the others.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.model import Array

LAGS_DAYS = (1, 7, 28)
PRIOR_BLOCKS = 5.0  # by which a sensor's own inflation is drawn to the median of all
FEWEST_BLOCKS = 6.0  # that a memory holds, of the longest lag too
CLIP = 4.0  # standard deviations of a residual or block


class Blocks:
    """Sums of standardised residuals over blocks of `lags` days; `shape`: of what is summed, sensors first.

    `memory_days`: time constant with which blocks are forgotten, or FEWEST_BLOCKS of them where these are longer;
    `prior_blocks`: by which a sensor's own inflation is drawn to the median of all.
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        lags: tuple[int, ...] = LAGS_DAYS,
        memory_days: float = np.inf,
        prior_blocks: float = PRIOR_BLOCKS,
    ) -> None:
        self.lags, self.prior_blocks = lags, prior_blocks
        self.keep = [float(np.exp(-1.0 / max(memory_days, FEWEST_BLOCKS * lag))) for lag in lags]
        self.sums, self.days, self.squares, self.count, self.total = (np.zeros((len(lags), *shape)) for _ in range(5))
        self.past: dict[int, tuple[Array, Array, Array]] = {}

    def update(self, z: Array, there: NDArray[np.bool_]) -> None:
        """Take the residuals of a day; `there`: which of them count."""
        for k, lag in enumerate(self.lags):
            self.sums[k] += np.where(there, z, 0.0)
            self.days[k] += there
            full = self.days[k] >= lag
            block = np.clip(self.sums[k], -CLIP * lag**0.5, CLIP * lag**0.5)
            self.squares[k] = self.keep[k] * self.squares[k] + np.where(full, block**2 / lag, 0.0)
            self.total[k] = self.keep[k] * self.total[k] + np.where(full, block, 0.0)
            self.count[k] = self.keep[k] * self.count[k] + full
            self.sums[k][full] = self.days[k][full] = 0.0

    def inflation(self, squares: Array | None = None, count: Array | None = None) -> Array:
        """(lags, ...): variance ratio of each lag, the median over sensors; 1 where nothing is known, never less.

        Of today, or of the `squares` and `count` of another day.
        """
        squares, count = (self.squares, self.count) if squares is None or count is None else (squares, count)
        some = count > 0
        each = np.where(some, squares / np.where(some, count, 1.0), np.nan)
        known = some.sum(axis=1) > 0
        middle = np.ones(known.shape)
        for k in range(len(self.lags)):
            if known[k].any():
                number = np.maximum(np.median(count[k], axis=0), 1.0)[known[k]]
                # The median of chi-squared over its degrees of freedom (Wilson and Hilferty).
                middle[k][known[k]] = np.nanmedian(each[k][:, known[k]], axis=0) / (1.0 - 2.0 / (9.0 * number)) ** 3
        return np.maximum.accumulate(np.maximum(middle, 1.0), axis=0)

    def remember(self, begins: list[int]) -> None:
        """Keep what is known today, at the last of these begins of steps, and at the others what was known then."""
        self.past[begins[-1]] = self.squares.copy(), self.count.copy(), self.total.copy()
        self.past = {begin: self.past[begin] for begin in begins}

    def over(self, today: int, begins: list[int]) -> Array:
        """Inflation of the means from these days until today, (k, n, ...), by the longest lag that is not longer.

        A sensor's own, drawn to the median of all as by `prior_blocks`; both as they were before the begin, since the
        others differ from a sensor that changes. The median is that of today where none was known.
        """
        now, told = self.inflation(), []
        for begin in begins:
            k = int(np.searchsorted(self.lags, today - begin + 1, side="right")) - 1
            squares, count, _ = self.past[begin]
            middle = np.where(count[k].max(axis=0) >= 1.0, self.inflation(squares, count)[k], now[k])
            told.append(self._drawn(squares[k], count[k], middle))
        return np.array(told)

    def today(self) -> Array:
        """Inflation of today by the longest lag, (n, ...)."""
        return self._drawn(self.squares[-1], self.count[-1], self.inflation()[-1])

    def without_steps(self, begins: list[int]) -> Array:
        """As `today`, where a step at each of these begins is no scatter: (k, n, ...).

        The blocks since the begin count by what they differ from their mean. Only where nothing is forgotten.
        """
        past = np.array([[count[-1], total[-1]] for _, count, total in (self.past[begin] for begin in begins)])
        since, moved = self.count[-1] - past[:, 0], self.total[-1] - past[:, 1]
        explained = moved**2 / (self.lags[-1] * np.maximum(since, 1.0))
        squares = np.maximum(self.squares[-1] - explained, 0.0)
        return self._drawn(squares, self.count[-1] - (since > 0.0), self.inflation()[-1])

    def _drawn(self, squares: Array, count: Array, middle: Array) -> Array:
        """A sensor's own inflation, drawn to the median of all as by `prior_blocks`; never less than 1."""
        return np.asarray(np.maximum((squares + self.prior_blocks * middle) / (count + self.prior_blocks), 1.0))

    def snapshot(self) -> dict[str, Any]:
        """All state as plain arrays."""
        now = {name: getattr(self, name).copy() for name in _STATE}
        past = np.array(list(self.past.values())).reshape(len(self.past), 3, *self.squares.shape)
        return {**now, "begins": np.array(list(self.past), dtype=np.int64), "past": past}

    def load(self, told: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        for name in _STATE:
            setattr(self, name, told[name].copy())
        self.past = {int(begin): (past[0].copy(), past[1].copy(), past[2].copy())
                     for begin, past in zip(told["begins"], told["past"], strict=True)}  # fmt: skip


_STATE = ("sums", "days", "squares", "count", "total")
