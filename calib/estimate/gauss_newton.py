"""Gauss-Newton over a chain of epochs: of one epoch for files, of many on-line.

Each pass linearises all lines at the estimate of the last one, and QR eliminates epoch after epoch
(calib.estimate.chain). A step is halved where chi-squared would grow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calib.estimate.chain import EpochLink, Passage, backward, forward, solved
from calib.model import Array

MOST_PASSES = 30
CONVERGED = 1e-6  # standard uncertainties. The passes shrink a step a hundred times, so that the next is 1e-8
MOST_HALVINGS = 8
ROUNDING = 1e-9  # of chi-squared: a smaller increase is a rounding error
# Derivatives at the mean of a walk (calib.estimate.rows) lead to a point that is not exactly the least of chi-squared.
BESIDE = 1e-3  # of chi-squared by which it may be larger there; halved steps would never arrive


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """All lines linearised at values x (K, N), acting on deviations from them: `root` (N, N + 1) of the priors, `rows`
    (r, N + 1) of each of K epochs, and the `passages` from each one to the next."""

    root: Array
    rows: Sequence[Array]
    passages: Sequence[Passage] = ()

    @property
    def chi2(self) -> float:
        """The sum of squares at x, but for what walks and steps have moved."""
        return float(sum(float(own[:, -1] @ own[:, -1]) for own in (self.root, *self.rows)))


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """The values `x` (K, N) where the passes ended, with the `lines` there; `root` (N, N + 1) the triangle of the last
    epoch, `links` those between epochs; `chi2` the sum of squares of all lines."""

    x: Array
    lines: Linearised
    root: Array
    links: Sequence[EpochLink]
    chi2: float
    passes: int


def gauss_newton(
    lines_at: Callable[[Array], Linearised],
    x: Array,
    *,
    floor: Array | float = 0.0,
    follows: bool = True,
    alike: bool = True,
) -> Minimum:
    """Passes from the values `x` (K, N) until no unknown moves by more than CONVERGED, or by more than `floor` (N,).

    `follows`: `x` goes from one epoch to the next as the passages say. `alike`: the weights of the lines do not depend
    on the values; else chi-squared is not compared.
    """
    walked, best, least = 0.0, None, np.inf
    for passes in range(1, MOST_PASSES + 1):
        lines = lines_at(x)
        for _ in range(MOST_HALVINGS):
            larger = lines.chi2 + walked - least * (1.0 + ROUNDING)
            if best is None or larger <= (BESIDE if lines.passages else ROUNDING):
                break
            x, walked = 0.5 * (x + best[0]), 0.5 * (walked + best[1])
            lines = lines_at(x)
        least = lines.chi2 + walked
        best = (x, walked) if alike and (follows or passes > 1) else None
        root, links = forward(lines.root, lines.rows, lines.passages)
        back, (_, factor) = backward(root, links), solved(root)
        if (np.abs(back).max(axis=0) <= np.maximum(CONVERGED * np.linalg.norm(factor, axis=1), floor)).all():
            break
        x, walked = x + back, _squares(links, back)
    return Minimum(x, lines, root, links, least, passes)


def _squares(links: Sequence[EpochLink], back: Array) -> float:
    """The sum of squares of what walks and steps have moved."""
    moved = (np.linalg.solve(link.own, link.z - link.next @ d) for link, d in zip(links, back[1:], strict=True))
    return float(sum(float(w @ w) for w in moved))
