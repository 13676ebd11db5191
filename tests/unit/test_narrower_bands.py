"""Motion that reaches into a filter's edge or a resonance: a narrower band is right, or the data are refused."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from calib.estimate.nuisances import Priors
from calib.recorded.adjusting import adjusted
from calib.recorded.errors import OptionError
from calib.recorded.options import Options
from calib.recorded.outcome import Outcome
from calib.signal.band import without_slow
from calib.signal.known_response import known_response_of
from tests.pair import Complex, Filter, Pair, decimator, flat, lowpass, pair, resonance

U_REFERENCE = 1e-3
TO_HZ = 8.0


def earthquake(seed: int, response: Filter, skirts: int) -> Pair:
    """Motion whose power falls with the 2 * `skirts`-th power of the frequency above 8 Hz."""
    return pair(seed, response, band_hz=(0.3, TO_HZ), rate_hz=100.0, seconds=120.0, skirts=skirts)


def relative(made: Pair, response: Filter, found: Outcome) -> tuple[float, float]:
    """The largest error of a main sensitivity, relative, and the largest error of all over its U."""
    assert found.calibration is not None, found.reasons
    at, stated = (abs(response(np.array([f]))[0]) for f in (found.reference_frequency_hz, made.reference_frequency_hz))
    away = found.sensitivity - made.sensitivity * at / stated
    return float(np.abs(np.diag(away)).max()), float(np.nanmax(np.abs(away.ravel()) / found.expanded_uncertainty[:9]))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("response", "skirts"),
    [(lowpass(2, 1.56 * TO_HZ), 2), (resonance(3.0 * TO_HZ, 5.0), 4)],
)
def test_motion_that_reaches_into_a_filter_is_used_below_it(response: Filter, skirts: int) -> None:
    """All were refused: "calibrate with motion at lower frequencies", or "no smooth response explains the bands"."""
    made = earthquake(0, response, skirts)
    stated = Priors(reference=U_REFERENCE)
    assert adjusted(made.files, stated, band_hz=(0.0, 50.0)).calibration is None
    found = adjusted(made.files, stated)
    error, over_u = relative(made, response, found)
    assert error < 5e-4
    assert over_u < 1.0
    low_hz, high_hz = found.more["band_hz"]
    assert low_hz == 0.0
    assert TO_HZ < high_hz < 3.0 * TO_HZ


@pytest.mark.thorough
def test_a_resonance_that_hides_the_motion_in_all_windows() -> None:
    """Q 50 at 1.5 times the upper end: no window follows the reference, unless it is limited."""
    response = resonance(1.5 * TO_HZ, 50.0)
    made = earthquake(0, response, 2)
    found = adjusted(made.files, Priors(reference=U_REFERENCE))
    error, over_u = relative(made, response, found)
    assert error < 1e-3
    assert over_u < 1.0
    again = adjusted(made.files, Priors(reference=U_REFERENCE), band_hz=found.more["band_hz"])
    np.testing.assert_array_equal(again.values, found.values)  # what was tried before leaves no trace


@pytest.mark.slow
def test_a_resonance_contradicts_filters_that_are_stated_flat() -> None:
    """The reference's resonance of Q 33 at 2.8 Hz, in motion to 10 Hz: with filters stated flat S was valid and -19.8
    +- 1.0, and the refusal without them said to state so."""
    own = resonance(2.8352614484851757, 33.43576076232283)
    made = pair(25, band_hz=(0.5, 10.0), rate_hz=100.0, seconds=60.0, skirts=4, response=lambda f: 1.0 / own(f))
    flat_filters = Priors(reference=1e-3).beside_known(known_response_of(["flat"], ["flat"]))
    (reason,) = adjusted(made.files, flat_filters).reasons
    assert reason.startswith("the data contradict the stated filters of sensor and reference: chi-squared ")


def test_motion_that_fills_the_spectrum_is_no_noise_of_the_reference() -> None:
    """The skirt of the motion at half the sampling rate was taken for white noise of the reference, 0.5 % of its power:
    S was 0.47 % too large, 4 u."""
    made = earthquake(0, flat, 2)
    error, over_u = relative(made, flat, adjusted(made.files, Priors(reference=U_REFERENCE)))
    assert error < 3e-4  # 0.15 u at most; five seeds 0.7e-4 to 2.4e-4
    assert over_u < 1.0


@pytest.mark.slow
def test_a_pair_that_passes_at_once_is_limited_to_no_band() -> None:
    made = earthquake(1, decimator(2.0 * TO_HZ), 4)
    found = adjusted(made.files, Priors(reference=U_REFERENCE))
    assert found.status == "valid"
    assert found.more["band_hz"] is None
    unlimited = adjusted(made.files, Priors(reference=U_REFERENCE), band_hz=(0.0, 50.0))
    np.testing.assert_array_equal(found.calibration.covariance, unlimited.calibration.covariance)  # type: ignore[union-attr]
    np.testing.assert_array_equal(found.values, unlimited.values)


def notched(frequency_hz: np.ndarray) -> Complex:  # type: ignore[type-arg]
    """A third less in a narrow band at 6 Hz."""
    return np.asarray(1.0 - 0.3 * np.exp(-0.5 * ((frequency_hz - 6.0) / 0.3) ** 2) + 0j)


@pytest.mark.thorough
def test_a_notch_just_above_the_narrower_band_does_not_bend_s() -> None:
    """Limited to 5.4 Hz the bands deviate by less than 0.1 % from one response, and S is 0.2 % off (7 u): 3.8 Hz shows
    it."""
    made = pair(3, notched)
    exact: dict[str, Any] = {"reference": 1e-9, "rotation_rad": 1e-9, "lag_axis_s": 1e-9}
    at_hz = Priors(reference_frequency_hz=made.reference_frequency_hz, **exact)
    bent = adjusted(made.files, at_hz, band_hz=(0.0, 5.402))
    assert np.abs(np.diag(bent.sensitivity - made.sensitivity)).max() > 1e-3
    (reason,) = adjusted(made.files, at_hz).reasons
    assert "limited to narrower bands" in reason


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"band_hz": (5.0, 2.0)}, "0 <= LOW < HIGH"),
        ({"band_hz": (1.0, 4.0), "reference_frequency_hz": 5.0}, "`reference_frequency_hz` is 5 Hz, outside `band_hz`"),
        ({"band_hz": (1.0, 4.0), "plain": True}, "`band_hz` is for Method 3 with a `reference`, not `plain`"),
    ],
)
def test_a_band_that_cannot_be_used(given: dict[str, Any], told: str) -> None:
    with pytest.raises(OptionError, match=re.escape(told)):
        Options(**given).check(reference=True, poses=False, prior=False)


def test_below_a_band_the_means_stay() -> None:
    """A cosine of half the lower end keeps 6 % of its amplitude, one at the end a half, one of twice that all; a mean
    is not touched."""
    t = np.arange(4000) / 100.0
    for frequency_hz, left in ((0.5, 0.06), (1.0, 0.5), (2.0, 1.0)):
        wave = 3.0 + np.cos(2.0 * np.pi * frequency_hz * t)
        found = without_slow(wave[:, None], 100.0, 1.0)[:, 0]
        sound = np.isfinite(found)
        assert sound.sum() > 3500
        assert np.mean(found[sound]) == pytest.approx(3.0, abs=0.01)
        assert np.ptp(found[sound]) / 2.0 == pytest.approx(left, abs=0.07)
