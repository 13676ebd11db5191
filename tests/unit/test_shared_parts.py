"""What is computed once for many windows is the same as computed anew; order statistics are those of numpy."""

from __future__ import annotations

import numpy as np
import pytest

from calib.estimate.nuisances import Applied, Nuisances, Priors
from calib.geometry import beside
from calib.signal.order_statistics import FEW, distinct, median, quantile
from calib.signal.response import Response


def test_nuisances_with_other_values_removed_are_those_made_anew() -> None:
    pose, priors = beside(np.eye(3), [0.0, 0.0, 9.8]), Priors(lag_s=0.02).with_response((1.0, 20.0))
    first = Nuisances([pose], 3, priors, Applied.of(priors, 0.001), "A")
    applied = Applied.of(priors, 0.002, Response((-1e-5, 2e-8, -3e-10, 4e-12, -5e-14), 20.0))
    shared, anew = first.with_applied(applied), Nuisances([pose], 3, priors, applied, "A")
    assert [t.applied for t in shared.terms] == [t.applied for t in anew.terms]
    assert sum(t.applied != 0.0 for t in shared.terms) == 6
    z = np.linspace(-1e-3, 1e-3, len(anew))
    assert shared.steady(z)[0] == anew.steady(z)[0] != first.steady(z)[0]
    assert [t.applied for t in first.terms].count(0.001) == 1


@pytest.mark.parametrize("n", [1, 2, 3, 16, 17, FEW, FEW + 1, FEW + 2, 1001])
def test_order_statistics_are_those_of_numpy(n: int) -> None:
    values = np.random.default_rng(n).normal(size=(3, 2, n))
    np.testing.assert_array_equal(median(values), np.median(values, axis=-1))
    assert quantile(values[0, 0], 0.25) == np.quantile(values[0, 0], 0.25)
    assert quantile(values[0, 0], 0.9) == np.quantile(values[0, 0], 0.9)
    rounded = np.round(10.0 * values[0, 0]).astype(np.int64)
    np.testing.assert_array_equal(distinct(rounded), np.unique(rounded))
