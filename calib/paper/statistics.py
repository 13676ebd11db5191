"""Appendix A: the numbers by which the paper compares methods. Percentages are in %, as in its tables.

k is the cycle (n = 6 in the paper), i an axis; functions take arrays and work along the axis named.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib.model import Array

AXES = "xyz"
# Section 2.2: Method 2 holds where transverse sensitivities are negligible, below 5 % of the main ones.
TRANSVERSE_LIMIT_PCT = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Repeatability:
    """Mean, SD (n - 1) and s_rel (%) of the values of n cycles, each of the shape of one value."""

    mean: Array
    standard_deviation: Array
    s_rel_pct: Array
    n: int


def repeatability(per_cycle: ArrayLike) -> Repeatability:
    """Table A1, first three rows, along the first axis: one value a cycle (n, ...).

    Raises ValueError with fewer than two cycles. s_rel keeps the sign of the mean out of it; inf where the mean is 0.
    """
    values = np.asarray(per_cycle, dtype=float)
    if values.shape[0] < 2:
        raise ValueError(f"a standard deviation needs two cycles, there are {values.shape[0]}")
    mean, deviation = values.mean(axis=0), values.std(axis=0, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s_rel = deviation / np.abs(mean) * 100
    return Repeatability(mean, deviation, s_rel, values.shape[0])


def d_rel_pct(s_m: ArrayLike, s_n: ArrayLike) -> Array:
    """Relative difference of methods M and N: (S_M - S_N) over the mean of both, in %."""
    m, n = np.asarray(s_m, dtype=float), np.asarray(s_n, dtype=float)
    return np.asarray((m - n) / ((m + n) / 2) * 100)


def d_rel_32_pct(d_31_pct: ArrayLike, d_21_pct: ArrayLike) -> Array:
    """d_rel of methods 3 and 2, which follows exactly from d_rel of 3 and 1 and of 2 and 1: it checks a table.

    With x = d_rel / 200, S_M / S_1 = (1 + x) / (1 - x), so x_32 = (x_31 - x_21) / (1 - x_31 x_21).
    """
    x31, x21 = np.asarray(d_31_pct, dtype=float) / 200, np.asarray(d_21_pct, dtype=float) / 200
    return np.asarray(200 * (x31 - x21) / (1 - x31 * x21))


def differences_pct(main: Mapping[int, ArrayLike]) -> dict[tuple[int, int], Array]:
    """d_rel for each pair of methods (M, N), M > N, in the paper's order 21, 31, 32; `main` {method: (3,) main S}."""
    pairs = [(m, n) for m, n in ((2, 1), (3, 1), (3, 2)) if m in main and n in main]
    return {(m, n): d_rel_pct(main[m], main[n]) for m, n in pairs}


def rel_s_pct(sensitivity: ArrayLike) -> Array:
    """Relative transverse sensitivities (3, 3) in %, each over the main sensitivity of its row; NaN on the diagonal."""
    S = np.asarray(sensitivity, dtype=float)
    relative = S / np.diag(S)[:, None] * 100
    np.fill_diagonal(relative, np.nan)
    return np.asarray(relative)


def transverse_excess(sensitivity: ArrayLike, limit_pct: float = TRANSVERSE_LIMIT_PCT) -> dict[str, float]:
    """The periodic verification for Method 2 (section 2.2): {name of rel_S: its value in %} of those above the limit.

    `sensitivity` (3, 3) is from Method 1 or 3. A transverse sensitivity that is not known (NaN) counts as above the
    limit, because it is not verified.
    """
    relative = rel_s_pct(sensitivity)
    return {
        f"rel_S{AXES[i]}{AXES[j]}": float(relative[i, j])
        for i in range(3)
        for j in range(3)
        if i != j and not abs(relative[i, j]) < limit_pct
    }
