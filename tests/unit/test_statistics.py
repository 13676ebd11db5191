"""Appendix A by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from calib.paper.statistics import d_rel_32_pct, d_rel_pct, differences_pct, rel_s_pct, repeatability, transverse_excess


def test_mean_sd_and_s_rel_of_six_cycles() -> None:
    r = repeatability([[1.0, -10.0], [1.1, -10.0], [0.9, -10.0], [1.0, -10.0], [1.2, -10.6], [0.8, -9.4]])
    assert_allclose(r.mean, [1.0, -10.0])
    # squares 0 .01 .01 0 .04 .04 over n - 1 = 5; and twice .36 over 5
    assert_allclose(r.standard_deviation, [math.sqrt(0.10 / 5), math.sqrt(0.72 / 5)])
    assert_allclose(r.s_rel_pct, [100 * math.sqrt(0.02), 10 * math.sqrt(0.144)])
    assert r.n == 6
    with pytest.raises(ValueError, match="two cycles, there are 1"):
        repeatability([[1.0, 2.0]])


def test_d_rel_is_over_the_mean_of_the_pair() -> None:
    assert d_rel_pct(1.02, 0.98) == pytest.approx(4.0)
    found = differences_pct({1: [1.0, 2.0, 4.0], 2: [1.1, 2.0, 4.0], 3: [0.9, 2.2, 4.0]})
    assert list(found) == [(2, 1), (3, 1), (3, 2)]
    assert_allclose(found[2, 1], [10 / 1.05, 0, 0])
    assert_allclose(found[3, 1], [-10 / 0.95, 20 / 2.1, 0])
    assert_allclose(found[3, 2], [-20.0, 20 / 2.1, 0])
    assert list(differences_pct({1: [1.0], 3: [1.0]})) == [(3, 1)]


@given(st.lists(st.floats(0.5, 2.0), min_size=3, max_size=3))
def test_the_third_difference_follows_from_the_other_two(s: list[float]) -> None:
    one, two, three = s
    assert d_rel_32_pct(d_rel_pct(three, one), d_rel_pct(two, one)) == pytest.approx(
        float(d_rel_pct(three, two)), abs=1e-10
    )


def test_rel_s_is_over_the_main_sensitivity_of_the_row() -> None:
    S = np.array([[2.0, 0.02, -0.04], [0.1, 4.0, 0.0], [0.5, -0.3, 10.0]])
    expected = [[math.nan, 1.0, -2.0], [2.5, math.nan, 0.0], [5.0, -3.0, math.nan]]
    assert_allclose(rel_s_pct(S), expected)
    assert transverse_excess(S) == {"rel_Szx": 5.0}
    assert transverse_excess(S, 2.4) == {"rel_Syx": 2.5, "rel_Szx": 5.0, "rel_Szy": -3.0}
    S[0, 1] = np.nan
    assert list(transverse_excess(S)) == ["rel_Sxy", "rel_Szx"]  # not verified is not negligible
