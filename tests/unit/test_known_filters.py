"""Known filters: h by the line of text that states them, against scipy and closed formulas; faults; what is passed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import butter, freqs, freqz, group_delay

from calib.signal.known_filters import filter_of
from calib.signal.known_response import KnownResponse, known_response_of
from calib.signal.response import in_units

HZ = np.linspace(0.0, 60.0, 121)
TAPS = (0.05, 0.2, 0.5, 0.2, 0.05)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 8])
def test_butterworth(order: int) -> None:
    b, a = butter(order, 2.0 * np.pi * 31.0, analog=True)
    found = filter_of(f"lowpass order={order} corner_hz=31")
    assert np.allclose(found.at(HZ), freqs(b, a, 2.0 * np.pi * HZ)[1], atol=1e-12)
    assert found.group_delay_s == pytest.approx(_slope(found.at(np.array([1e-4]))[0]), rel=1e-6)
    assert abs(found.at(np.array([31.0]))[0]) == pytest.approx(np.sqrt(0.5))


@pytest.mark.parametrize("order", [1, 3, 5])
def test_moving_means_in_a_row(order: int) -> None:
    once = np.ones(16) / 16.0
    taps = once
    for _ in range(order - 1):
        taps = np.convolve(taps, once)
    found = filter_of(f"sinc order={order} points=16 rate_hz=1000")
    assert np.allclose(found.at(HZ), freqz(taps, worN=2.0 * np.pi * HZ / 1000.0)[1], atol=1e-12)
    assert found.group_delay_s == pytest.approx(order * 7.5e-3)
    assert np.allclose(filter_of("mean points=16 rate_hz=1000").at(HZ), filter_of("sinc points=16 rate_hz=1000").at(HZ))


def test_taps() -> None:
    skew = (0.1, 0.6, 0.2, 0.1)
    found = filter_of("fir rate_hz=250 taps=0.2,1.2,0.4,0.2")
    assert np.allclose(found.at(HZ), freqz(skew, worN=2.0 * np.pi * HZ / 250.0)[1], atol=1e-12)
    assert found.group_delay_s == pytest.approx(group_delay((skew, 1.0), w=[1e-6])[1][0] / 250.0)


def test_a_table_gives_its_rows_and_is_smooth_between() -> None:
    """Rows of a first-order filter in third octaves: between them the error is that of a cubic."""
    rows_hz = np.geomspace(1.0, 64.0, 19)
    true = 1.0 / (1.0 + 1j * rows_hz / 80.0)
    words = [
        f"{name}={','.join(map(repr, values.tolist()))}"
        for name, values in (
            ("frequency_hz", rows_hz),
            ("relative_sensitivity", np.abs(true)),
            ("phase_deg", np.degrees(np.angle(true))),
        )
    ]
    found = filter_of(f"table {' '.join(words)} expanded_u_pct={','.join(['0.5'] * 19)}")
    assert np.allclose(found.at(rows_hz), true, atol=1e-12)
    assert np.allclose(found.at(HZ), 1.0 / (1.0 + 1j * HZ / 80.0), atol=1e-3)
    assert found.u_size == pytest.approx(0.0025)


@pytest.mark.parametrize(("text", "told"), [
    ("", "'' is no kind of filter; give one of flat, delay, highpass, lowpass"),
    ("low order=2", "'low' is no kind of filter"),
    ("lowpass", "lowpass needs corner_hz=..."),
    ("lowpass corner_hz=31 q=2", "'q=2': lowpass takes corner_hz=..., order=..., u_corner_pct=..."),
    ("lowpass corner_hz=x", "corner_hz: 'x' is no number"),
    ("lowpass corner_hz=inf", "corner_hz: 'inf' is not finite"),
    ("lowpass corner_hz=31,32", "corner_hz: 2 numbers; give one"),
    ("lowpass corner_hz=0.2", "corner_hz: 0.2; give a number from 1 on"),
    ("highpass corner_hz=0", "corner_hz: 0; give a number above 0"),
    ("highpass corner_hz=0.8 u_corner_pct=51", "u_corner_pct: 51; give a number from 0 to 50"),
    ("lowpass corner_hz=31 order=1.5", "order: 1.5; give a whole number"),
    ("lowpass corner_hz=31 corner_hz=31", "corner_hz is given twice"),
    ("sinc points=0 rate_hz=1", "points: 0; give a number from 1 to 1e+06"),
    ("fir rate_hz=100 taps=1,-1", "taps: their sum is 0"),
    ("table frequency_hz=1,2 relative_sensitivity=1", "relative_sensitivity: 1 values, but frequency_hz has 2"),
    ("table frequency_hz=2,1 relative_sensitivity=1,1", "frequency_hz: must be above 0 and increase"),
])  # fmt: skip
def test_a_line_that_states_no_filter_is_told(text: str, told: str) -> None:
    with pytest.raises(ValueError, match=_exactly(told)):
        filter_of(text)


KNOWN = {
    "low-pass in the sensor": known_response_of(["lowpass order=2 corner_hz=31"], ["flat"]),
    "low-pass in the reference": known_response_of(["flat"], ["lowpass order=2 corner_hz=31"]),
    "both": known_response_of(["sinc order=3 points=8 rate_hz=500", f"fir rate_hz=250 taps={','.join(map(str, TAPS))}"],
                     ["lowpass order=1 corner_hz=40"]),
}  # fmt: skip


@pytest.mark.parametrize("name", KNOWN)
def test_a_sine_is_passed_as_the_filters_say(name: str) -> None:
    known, rate_hz, hz = KNOWN[name], 200.0, 17.0
    time_s = np.arange(2000) / rate_hz
    found = known.passed(np.exp(2j * np.pi * hz * time_s).view(float).reshape(-1, 2), rate_hz)
    whole = np.isfinite(found).all(axis=1)
    lost = round(known.reach_s(rate_hz) * rate_hz)
    assert np.array_equal(np.flatnonzero(whole), np.arange(lost, 2000 - lost))
    late = np.exp(2j * np.pi * hz * known.group_delay_s)
    wanted = ratio(known, hz) * late * np.exp(2j * np.pi * hz * time_s[whole])
    assert np.abs(found[whole] @ [1.0, 1j] - wanted).max() < 2e-4


def ratio(known: KnownResponse, hz: float) -> complex:
    at = np.array([hz])
    of_both = (np.prod([one.at(at)[0] for one in of or ()]) for of in (known.sensor, known.reference))
    sensor, reference = of_both
    return complex(sensor / reference)


def test_what_is_left_of_a_filter_follows_from_its_corner() -> None:
    """A first-order corner that is larger by u changes c_k by -k u c_k: in units of a corner at the motion's end."""
    known = known_response_of(["lowpass corner_hz=100 u_corner_pct=1"], ["flat"])
    terms = 0.01 * np.arange(2, 7) * 0.2 ** np.arange(2, 7)
    assert in_units(20.0)[0] == pytest.approx(0.5 / (2.0 * np.pi * 20.0) ** 2)
    mount = 2.0 * 0.1**2
    assert known.u_response(20.0) == pytest.approx(float(np.hypot(terms.max(), mount)), rel=0.02)
    assert known_response_of(["lowpass corner_hz=100"], None).u_response(20.0) == np.inf


def _slope(h: complex) -> float:
    return float(-np.angle(h) / (2.0 * np.pi * 1e-4))


def _exactly(text: str) -> str:
    import re

    return "^" + re.escape(text)


def test_a_delay_alone_says_nothing_of_the_size_and_leaves_the_samples_as_they_are() -> None:
    delay = "delay delay_s=0.01"
    alone, beside = known_response_of([delay], ["flat"]), known_response_of([delay, "flat u_pct=0.1"], ["flat"])
    assert math.isinf(alone.u_response(10.0))
    assert beside.u_response(10.0) < 0.1
    u = np.random.default_rng(5).normal(size=(200, 1))
    for known in (alone, beside):
        assert known.group_delay_s == pytest.approx(0.01)
        assert np.array_equal(known.passed(u, 100.0), u)
        assert known.reach_s(100.0) == known.most_reach_s == 0.0
