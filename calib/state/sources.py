"""What makes U of S and Q on-line: a standard uncertainty for each source, named as those of files are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from calib.estimate.rows import TYPE_A
from calib.model import Array


@dataclass(frozen=True, slots=True, eq=False)
class Sources:
    """`by_source`: standard uncertainties (12,) of S row by row, then Q; their squares add up to the variances.

    `degrees_of_freedom` (12,): effective ones (Welch-Satterthwaite, GUM G.2b); inf where noise, the only source with a
    finite number, has no share.
    `coverage_factor`: for about 95 %.
    """

    by_source: Mapping[str, Array]
    degrees_of_freedom: Array
    coverage_factor: float

    @classmethod
    def of(cls, variances: Mapping[str, Array], freedom: float, coverage_factor: float) -> Self:
        """Of variances (12,) by source, the largest source first; `freedom`: degrees of freedom of the noise."""
        told = {source: np.sqrt(variance) for source, variance in variances.items() if variance.any()}
        total = np.asarray(sum(variances.values()))
        ordered = sorted(told, key=lambda source: -float(np.max(told[source] ** 2 / total)))
        with np.errstate(divide="ignore", over="ignore"):
            effective = freedom * (total / variances[TYPE_A]) ** 2
        return cls({source: told[source] for source in ordered}, effective, coverage_factor)

    @property
    def standard_uncertainty(self) -> Array:
        """(12,) of all sources together."""
        return np.asarray(np.sqrt(sum(u**2 for u in self.by_source.values())))
