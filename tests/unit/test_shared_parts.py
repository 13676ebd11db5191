"""Order statistics are those of numpy."""

from __future__ import annotations

import numpy as np
import pytest

from calib.signal.order_statistics import FEW, distinct, median, quantile


@pytest.mark.parametrize("n", [1, 2, 3, 16, 17, FEW, FEW + 1, FEW + 2, 1001])
def test_order_statistics_are_those_of_numpy(n: int) -> None:
    values = np.random.default_rng(n).normal(size=(3, 2, n))
    np.testing.assert_array_equal(median(values), np.median(values, axis=-1))
    assert quantile(values[0, 0], 0.25) == np.quantile(values[0, 0], 0.25)
    assert quantile(values[0, 0], 0.9) == np.quantile(values[0, 0], 0.9)
    rounded = np.round(10.0 * values[0, 0]).astype(np.int64)
    np.testing.assert_array_equal(distinct(rounded), np.unique(rounded))
