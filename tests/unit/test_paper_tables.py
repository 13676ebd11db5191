"""Tables 3 and 4 of the paper against themselves: the printed differences of two pairs give the third."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from paper_reproduced.published import DIFFERENCES_PCT, MISPRINT, decimals

from calib.paper.statistics import d_rel_32_pct

ROWS = [(device, f, axis) for device in ("piezo", "mems") for f in (3, 6) for axis in range(3)]


def rounding(text: str) -> float:
    return 0.5 * 10 ** -decimals(text)


def interval(device: str, f: int, axis: int) -> tuple[float, float]:
    """Lowest and highest d_32 that d_31 and d_21 as printed allow."""
    d31, d21 = (DIFFERENCES_PCT[device, f][pair][axis] for pair in ((3, 1), (2, 1)))
    ends = [
        float(d_rel_32_pct(float(d31) + a * rounding(d31), float(d21) + b * rounding(d21)))
        for a, b in itertools.product((-1, 1), repeat=2)
    ]
    return min(ends), max(ends)


@pytest.mark.parametrize(("device", "f", "axis"), [row for row in ROWS if row != MISPRINT])
def test_printed_differences_are_consistent(device: str, f: int, axis: int) -> None:
    low, high = interval(device, f, axis)
    printed = DIFFERENCES_PCT[device, f][3, 2][axis]
    assert low - rounding(printed) <= float(printed) <= high + rounding(printed)


def test_mems_3_hz_szz_has_lost_its_minus_sign() -> None:
    assert MISPRINT == ("mems", 3, 2)
    low, high = interval(*MISPRINT)
    printed = DIFFERENCES_PCT["mems", 3][3, 2][2]
    assert not low - rounding(printed) <= float(printed) <= high + rounding(printed)  # d_31 = 1.1, d_32 = -0.93
    d21 = float(DIFFERENCES_PCT["mems", 3][2, 1][2])
    with_minus = d_rel_32_pct(np.array([-1.15, -1.05]), d21)
    assert with_minus[0] - 0.005 <= float(printed) <= with_minus[1] + 0.005
