"""How far a response may bend within a band: an eighth of the second difference of neighbouring bands."""

from __future__ import annotations

import numpy as np

from calib.adjustment.response_by_band import _within


def test_two_bands_tell_no_bend_and_three_tell_one() -> None:
    told = np.zeros((3, 3, 3), dtype=complex)
    told[1] = 4.0j
    assert not _within(told[:2]).any()
    np.testing.assert_allclose(_within(told), 1.0)
