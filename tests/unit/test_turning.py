"""Slow turning beside a DC-coupled reference: right or refused, never an error (a short `benchmarks.turning`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.turning import Counts, one
from calib.adjustment.adjustment import adjust
from calib.estimate.nuisances import Priors
from tests.clamp_windows import clamp_points


@pytest.mark.thorough
@pytest.mark.parametrize("axes", [1, 2, 3])
def test_slow_turning(axes: int) -> None:
    """To and fro, without a stop, and in steps; before, some of these ended with LinAlgError."""
    counts = Counts()
    for seed in range(9):
        one(seed, axes, counts)
    assert counts.crashed == 0
    assert counts.wrong == []
    assert counts.valid >= 3
    assert counts.coverage > 0.95


def test_a_channel_that_hardly_moves() -> None:
    """Two axes, the third shows 2 % of the motion, most of it slower than a segment; before, S_xx was 5.1 u off."""
    counts = Counts()
    one(96, 2, counts)
    assert (counts.valid, counts.wrong) == (1, [])
    assert counts.worst_u < 3.0


def test_what_is_not_finite_is_refused_and_so_is_a_u_above_the_main_sensitivity() -> None:
    grounds = adjust(clamp_points(np.random.default_rng(1)).windows, Priors()).grounds
    assert grounds.reasons == ()
    nothing = replace(grounds.solution, x=np.full_like(grounds.solution.x, np.nan))
    assert "no solution in numbers" in replace(grounds, solution=nothing).reasons[0]
    wide = grounds.shares.covariance.copy()
    wide[1, 1] = grounds.solution.x[0] ** 2
    (reason,) = replace(grounds, shares=replace(grounds.shares, covariance=wide)).reasons
    assert reason.startswith("U(Sxy) is ")
    assert "above the largest main sensitivity" in reason
