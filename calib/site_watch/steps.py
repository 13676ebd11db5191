"""A regression for each channel of each sensor, and what a step on any earlier day would explain.

The norm of a channel is linear in what is seen of the day (`x`: constant, temperature, its square, levels of the
excitation). A step at the begin of day t adds z = 1 from t on. With weights w and sums over all days

    A = sum w x x^T + ridge,  b = sum w x y,  v = sum_{>= t} w x,  c = sum_{>= t} w y

the step's least-squares estimate, together with the norm, is

    information = v_0 - v^T A^-1 v,  step = (c - v^T A^-1 b) / information        (x_0 = 1)

(Frisch, Waugh, Lovell; the variance is the channel's variance over the information). So the same days teach the norm
and show the step, and a day outside the temperatures that were seen tells little of a step. Of each t only v and c
are kept, as the sums before t. The ridge is a prior on the coefficients of temperature and level.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.model import Array

TERMS = 5
# Standard uncertainty of the coefficients before any data: of the log amplitude per 10 K, per (10 K)², per unit of
# the log of a level, per unit of the other one. The constant is free.
PRIOR = np.array([1e3, 0.02, 0.01, 0.05, 0.05])
PRIOR_DEGREES = 10.0  # of freedom of the prior of a channel's variance
HUBER = 3.0  # standard deviations from which a day weighs less
THIN = 6.0  # begins of steps are kept so close as their age over this


class Steps:
    """Sums of the regressions of C channels, and of the steps that can still be asked for."""

    def __init__(self, channels: int, prior_scale: float = 1.0) -> None:
        self.A = np.zeros((TERMS, TERMS, channels))
        self.b = np.zeros((TERMS, channels))
        self.squares = np.zeros(channels)
        self.days = np.zeros(channels)
        self.begins: list[int] = []
        self.before: list[Array] = []  # (TERMS + 2, channels): v, c and the number of days before the begin
        self.prior_scale = prior_scale
        self._solve()

    def expected(self, x: Array) -> tuple[Array, Array]:
        """Expected value of each channel on a day with regressors `x` (TERMS, C), and u² of it over the variance."""
        moved = np.einsum("pqc,qc->pc", self.inverse, x)
        return np.einsum("pc,pc->c", x, self.beta), np.einsum("pc,pc->c", x, moved)

    def update(self, day: int, x: Array, y: Array, weight: Array) -> None:
        """Take a day; `weight` (C,) is 0 where a channel does not count. Days must come in order."""
        self.begins.append(day)
        self.before.append(np.concatenate([self.A[0], self.b[:1], self.days[None]]))
        self._thin(day)
        there = weight > 0.0
        y = np.where(there, y, 0.0)
        x = np.where(there, x, 0.0)
        wx = weight * x
        for p in range(TERMS):
            self.A[p] += wx[p] * x
        self.b += wx * y
        self.squares += weight * y * y
        self.days += there
        self._solve()

    def restart(self, channels: NDArray[np.bool_]) -> None:
        """Forget these channels (a mask): a visit has changed what they indicate."""
        for each in (self.A, self.b, self.squares, self.days, *self.before):
            each[..., channels] = 0.0

    def step(self, which: list[int]) -> tuple[Array, Array, Array]:
        """Of steps at `begins[k]`, k in `which`: size, information over the variance, days since, (k, C) each."""
        now = np.concatenate([self.A[0], self.b[:1], self.days[None]])
        since = now - np.array([self.before[k] for k in which]).reshape(-1, *now.shape)
        v, c = since[:, :TERMS], since[:, TERMS]
        u = sum(self.inverse[:, q] * v[:, q, None] for q in range(TERMS))
        information = np.maximum(v[:, 0] - np.sum(u * v, axis=1), 0.0)
        few = information < 1e-9 * np.maximum(v[:, 0], 1e-300)
        size = np.where(few, 0.0, c - np.sum(u * self.b, axis=1)) / np.where(few, 1.0, information)
        return size, np.where(few, 0.0, information), since[:, TERMS + 1]

    def norm_since(self, which: list[int], size: Array) -> tuple[Array, Array]:
        """Of the days since `begins[k]`, k in `which`: their mean regressors (k, TERMS, C), and what the norm without a
        step of `size` (k, C) expects of them (k, C); 0 and NaN where no day counts."""
        v = self.A[0] - np.array([self.before[k][:TERMS] for k in which])
        there = v[:, 0] > 0.0
        x = np.where(there[:, None], v, 0.0) / np.where(there, v[:, 0], 1.0)[:, None]
        moved = np.einsum("pqc,kqc,kc->kpc", self.inverse, v, size, optimize=True)
        return x, np.where(there, np.sum(x * (self.beta - moved), axis=1), np.nan)

    def rest(self) -> tuple[Array, Array]:
        """Weighted sum of squares that the norm leaves, and its degrees of freedom."""
        left = self.squares - np.einsum("pc,pc->c", self.beta, self.b)
        return np.maximum(left, 0.0), np.maximum(self.days - TERMS, 0.0)

    def snapshot(self) -> dict[str, Any]:
        """All state as plain arrays."""
        return {"A": self.A.copy(), "b": self.b.copy(), "squares": self.squares.copy(), "days": self.days.copy(),
                "begins": np.array(self.begins, dtype=np.int64),
                "before": np.array(self.before).reshape(len(self.begins), TERMS + 2, -1)}  # fmt: skip

    def load(self, told: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self.A, self.b, self.squares, self.days = (told[name].copy() for name in ("A", "b", "squares", "days"))
        self.begins, self.before = [int(day) for day in told["begins"]], [each.copy() for each in told["before"]]
        self._solve()

    def _solve(self) -> None:
        ridge = self.prior_scale / PRIOR**2
        self.inverse = inverted(self.A + np.diag(ridge)[:, :, None])
        self.beta = np.einsum("pqc,qc->pc", self.inverse, self.b)

    def _thin(self, day: int) -> None:
        """Leave out each begin whose neighbours are closer than their age allows."""
        k = 1
        while k < len(self.begins) - 1:
            if self.begins[k + 1] - self.begins[k - 1] <= (day - self.begins[k]) / THIN:
                del self.begins[k], self.before[k]
            else:
                k += 1


def inverted(A: Array) -> Array:
    """Inverse of symmetric positive definite matrices (p, p, C), for all C at once (Gauss-Jordan, without pivots)."""
    A = A.copy()
    for k in range(len(A)):
        pivot = 1.0 / A[k, k]
        row = A[k] * pivot
        row[k] = pivot
        for i in range(len(A)):
            if i != k:
                factor = A[i, k].copy()
                A[i, k] = 0.0
                A[i] -= factor * row
        A[k] = row
    return A
