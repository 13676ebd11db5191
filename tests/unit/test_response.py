"""Instruments that respond differently over frequency: S is right at its frequency, or the data are refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from agent.cli.calibrate import calibrate
from calib import calibrate as calibrated_arrays
from calib.adjustment.adjustment import adjust
from calib.distributions import chi2_quantile
from calib.estimate.nuisances import Priors
from calib.recorded.adjusting import adjusted
from calib.recorded.outcome import Outcome
from calib.signal.response import POWERS, Response, passed
from calib.windows.banded import Factors, _projected
from calib.windows.bands import band_sums
from hw.virtual.bench import Bench
from hw.virtual.presets import COUNTS_PER_MPS2, plain
from hw.virtual.schedule import Schedule, clamped
from tests.pair import Filter, Pair, decimator, flat, highpass, lowpass, moving_mean, pair, resonance, sinc3

EXACT: dict[str, Any] = {"reference": 1e-9, "rotation_rad": 1e-9, "lag_axis_s": 1e-9}
ALIKE = {
    "nothing": flat,
    "low-pass, order 1": lowpass(1, 15.0),
    "low-pass, order 2": lowpass(2, 15.5),
    "low-pass, order 4": lowpass(4, 15.0),
    "mean of 32 ms": moving_mean(0.032),
    "sinc3": sinc3(0.0175),
    "resonance": resonance(22.0, 10.0),
}


def calibrated(made: Pair, **stated: Any) -> Outcome:
    return adjusted(made.files, Priors(**{**EXACT, "reference_frequency_hz": made.reference_frequency_hz, **stated}))


def not_limited(made: Pair, **stated: Any) -> Outcome:
    """No narrower band is tried: the one that is stated holds all motion."""
    at_hz: dict[str, Any] = {**EXACT, "reference_frequency_hz": made.reference_frequency_hz, **stated}
    return adjusted(made.files, Priors(**at_hz), band_hz=(0.0, 1e3))


def errors(made: Pair, found: Outcome) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    assert found.calibration is not None, found.reasons
    return found.calibration.sensitivity - made.sensitivity, found.calibration.standard_uncertainty[:9].reshape(3, 3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ALIKE)
def test_s_is_right_at_its_frequency(name: str) -> None:
    made = pair(1, ALIKE[name])
    error, u = errors(made, calibrated(made))
    assert np.abs(error).max() < 1e-3
    assert np.abs(error / u).max() < 4.0


@pytest.mark.slow
def test_a_sensor_that_is_late_by_a_sixth_of_a_cycle() -> None:
    """75 ms at 2 Hz: at first hardly a window can be used, so the response is told only when the lag is known."""
    made = pair(0, lowpass(2, 3.0), band_hz=(0.3, 2.0), rate_hz=20.0, seconds=200.0)
    error, u = errors(made, calibrated(made))
    assert np.abs(error).max() < 1e-3
    assert np.abs(error / u).max() < 4.0


@pytest.mark.one_case
@pytest.mark.parametrize("side", ["sensor", "reference"])
def test_a_delay_of_two_and_a_half_periods_of_the_motion(side: str) -> None:
    """A linear-phase filter of 63 taps comes 258 ms late, 13 times the usual standard uncertainty of a lag."""
    late = decimator(15.0)
    made = pair(8, late if side == "sensor" else lambda f: 1.0 / late(f))
    found = calibrated(made)
    error, u = errors(made, found)
    assert found.lag_s == pytest.approx(31.0 / 120.0 if side == "sensor" else -31.0 / 120.0, abs=2e-4)
    assert np.abs(error).max() < 1e-3
    assert np.abs(error / u).max() < 4.0


def test_a_constant_s_would_be_wrong() -> None:
    """The same data, taken for instruments that respond alike: the tests above fail without the response."""
    made = pair(1, ALIKE["low-pass, order 2"])
    windows = [w for w in made.files.windows() if w.used]
    found = adjust(windows, Priors(**EXACT)).calibration
    assert np.abs(np.diag(found.sensitivity - made.sensitivity)).min() > 0.01


@pytest.mark.slow
def test_u_covers_with_the_error_of_the_reference() -> None:
    """One element of ten runs over seven filters: all nine share the reference's error."""
    random, squares = np.random.default_rng(7), 0.0
    filters = list(ALIKE.values())
    for seed in range(10):
        made = pair(100 + seed, filters[seed % len(filters)], reference_error=2e-4 * random.normal(), seconds=60.0)
        error, u = errors(made, calibrated(made, reference=2e-4))
        squares += (error[0, 0] / u[0, 0]) ** 2
    assert squares < chi2_quantile(0.999, 10)


@pytest.mark.slow
def test_the_response_is_told_as_it_is() -> None:
    response = ALIKE["low-pass, order 2"]
    made = pair(2, response)
    told = calibrated(made).more
    assert told["reference_frequency_hz"] == pytest.approx(made.reference_frequency_hz)
    low_hz, high_hz = told["valid_band_hz"]
    assert low_hz < made.reference_frequency_hz < high_hz < 10.0
    at_reference = abs(response(np.array([made.reference_frequency_hz]))[0])
    for band in told["response"]:
        middle_hz = np.sqrt(band["low_hz"] * band["high_hz"])
        true = abs(response(np.array([middle_hz]))[0]) / at_reference * made.sensitivity[0, 0]
        found = abs(band["sensitivity_re"][0, 0] + 1j * band["sensitivity_im"][0, 0])
        assert found == pytest.approx(true, abs=4.0 * band["standard_uncertainty"][0, 0])
    at_0hz = told["sensitivity_at_0hz"]
    away = at_0hz["sensitivity"][0, 0] - made.sensitivity[0, 0] / at_reference
    assert abs(away) < 4.0 * at_0hz["standard_uncertainty"][0, 0]


@pytest.mark.two_cases
@pytest.mark.parametrize(
    "response",
    [lowpass(2, 7.0), lowpass(4, 10.0), lowpass(4, 8.0), resonance(7.0, 10.0), resonance(10.5, 30.0), highpass(0.2)],
)
def test_near_a_corner_or_a_resonance_s_is_right_or_refused(response: Filter) -> None:
    made = pair(3, response)
    found = calibrated(made)
    assert (found.calibration is None) == bool(found.reasons)
    if found.calibration is not None:
        error, u = errors(made, found)
        assert np.abs(error / u).max() < 4.0


@pytest.mark.two_cases
@pytest.mark.parametrize("response", [highpass(0.2), lowpass(4, 8.0), resonance(7.0, 10.0)])
def test_what_no_smooth_response_explains_is_refused(response: Filter) -> None:
    assert not_limited(pair(3, response)).reasons


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [2, 3, 4, 17])
def test_a_resonance_of_the_reference_within_slow_motion_is_refused(seed: int) -> None:
    """Once a response is taken out, less than four thirds of an octave move: no band was seen any more, S was told as a
    constant, and was 1.3 to 5 % off (3 to 8 u)."""
    made = pair(seed, lambda f: 1.0 / resonance(1.4, 50.0)(f), band_hz=(0.3, 2.0), rate_hz=20.0, seconds=300.0)
    assert not_limited(made, reference=1e-3).calibration is None


@pytest.mark.two_cases
@pytest.mark.parametrize("side", ["sensor", "reference"])
@pytest.mark.parametrize("seed", [1, 5])
def test_a_resonance_at_one_and_a_half_times_slow_motion(side: str, seed: int) -> None:
    """Before the response is taken out, the sensor's mean seems to change; a short window has wide bands."""
    near = resonance(3.0, 10.0)
    response: Filter = near if side == "sensor" else lambda f: 1.0 / near(f)
    made = pair(seed, response, band_hz=(0.3, 2.0), rate_hz=20.0, seconds=300.0)
    error, u = errors(made, calibrated(made))
    assert np.abs(np.diag(error)).max() < 1e-3
    assert np.abs(error / u).max() < 4.5


@pytest.mark.two_cases
@pytest.mark.parametrize("side", ["sensor", "reference"])
@pytest.mark.parametrize("order", [1, 2])
def test_an_unknown_corner_at_a_fifth_of_slow_motion(order: int, side: str) -> None:
    """An AC-coupled instrument; the same data without this knowledge are 0.1 % off at best, or refused."""
    corner = highpass(0.06, order)
    response: Filter = corner if side == "sensor" else lambda f: 1.0 / corner(f)
    made = pair(2, response, band_hz=(0.3, 2.0), rate_hz=20.0, seconds=300.0)
    found = calibrated(made, corner_unknown=True)
    error, u = errors(made, found)
    assert np.abs(np.diag(error)).max() < 4e-4
    assert np.abs(error / u).max() < 4.5
    low = found.more["response"][0]
    at_hz = np.sqrt(low["low_hz"] * low["high_hz"])
    true = response(np.array([at_hz]))[0] / abs(response(np.array([made.reference_frequency_hz]))[0])
    told = low["sensitivity_re"][0, 0] + 1j * low["sensitivity_im"][0, 0]
    assert abs(told / made.sensitivity[0, 0] - true) < 5e-3


@pytest.mark.slow
def test_an_unknown_corner_beside_a_filter_near_the_motion() -> None:
    both = highpass(0.1, 2), lowpass(2, 16.0)
    made = pair(3, lambda f: both[0](f) * both[1](f))
    error, u = errors(made, calibrated(made, corner_unknown=True))
    assert np.abs(np.diag(error)).max() < 1e-3
    assert np.abs(error / u).max() < 4.5


@pytest.mark.slow
def test_an_ac_coupled_reference_needs_no_option_but_its_coupling(tmp_path: Path) -> None:
    """The sensor responds to constants, so what the corner does at the frequency of S is the reference's."""
    corner = highpass(0.1)
    made = pair(4, lambda f: 1.0 / corner(f), seconds=120.0)
    sensor, reference = made.files._sensor, made.files._reference
    assert reference is not None
    stream: Any
    for name, head, stream in (("sensor", "time_s,vx,vy,vz", sensor), ("reference", "time_s,ax,ay,az", reference)):
        rows = np.column_stack([np.arange(len(stream._values)) / 100.0, stream._values])
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header=head, comments="")
    command = ["--sensor", str(tmp_path / "sensor.csv"), "--reference", str(tmp_path / "reference.csv")]
    hz = f"--reference-frequency-hz={made.reference_frequency_hz}"
    ran = CliRunner().invoke(
        calibrate, [*command, "--rotation", "1,0,0,0,1,0,0,0,1", "--reference-coupling", "ac", hz, "--json", "-"]
    )
    assert ran.exit_code == 0, ran.output
    told = json.loads(ran.stdout)
    assert "response_-1" in told["nuisances"]
    true = made.sensitivity * abs(corner(np.array([made.reference_frequency_hz]))[0])
    off = np.diag(np.array(told["sensitivity"], dtype=float) / true) - 1.0
    assert np.abs(off).max() < 5e-4


@pytest.mark.slow
def test_a_few_points_by_chance_are_no_result() -> None:
    """In all but ten seconds the sensor does not follow: the wire of the reference was loose."""
    made = pair(0, flat, seconds=300.0)
    loose: Any = made.files._reference
    loose._values[1000:] = np.random.default_rng(1).normal(size=loose._values[1000:].shape)
    (pose,) = made.files.poses
    made.files.poses = [replace(pose, stop_s=10.0), replace(pose, start_s=10.0)]
    (reason,) = calibrated(made).reasons
    assert "points in motion can be used, at least 5% are needed" in reason


@pytest.mark.slow
def test_a_band_that_deviates_is_named() -> None:
    def notched(frequency_hz: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        return np.asarray(1.0 - 0.3 * np.exp(-0.5 * ((frequency_hz - 6.0) / 0.3) ** 2) + 0j)

    (reason,) = not_limited(pair(4, notched)).reasons
    assert "no smooth response over frequency" in reason
    assert "they deviate by 2.4%, limit 1%, and most of it comes from 6.35 Hz" in reason


@pytest.mark.slow
def test_a_small_deviation_is_in_u() -> None:
    made = pair(5, resonance(13.5, 10.0))
    error, u = errors(made, calibrated(made))
    assert np.abs(np.diag(error)).max() > 1e-4  # twice what noise leaves
    assert np.abs(np.diag(error) / np.diag(u)).max() < 2.0


@pytest.mark.slow
def test_noise_of_the_reference_does_not_look_like_a_response() -> None:
    made = pair(6, ALIKE["low-pass, order 2"], reference_noise_mps2=0.03)
    error, u = errors(made, calibrated(made))
    assert np.abs(error / u).max() < 4.0
    assert np.abs(error).max() < 3e-3


@pytest.mark.parametrize("rate_hz", [50.0, 1000.0])
def test_the_filter_is_the_response_within_the_motion(rate_hz: float) -> None:
    omega = 2.0 * np.pi * 15.0
    terms = tuple((-1.0) ** k / (k * omega**k) for k in POWERS)
    response = Response(terms, 10.0)
    t = np.arange(int(20.0 * rate_hz)) / rate_hz
    for frequency_hz in (0.5, 3.0, 9.9):
        h = np.exp(sum(c * (2j * np.pi * frequency_hz) ** k for c, k in zip(terms, POWERS, strict=True)))
        wave = np.exp(2j * np.pi * frequency_hz * t)
        found = passed(np.column_stack([wave.real, wave.imag]), rate_hz, response)
        sound = np.isfinite(found).all(axis=1)
        assert sound.mean() > 0.9
        np.testing.assert_allclose(found[sound, 0] + 1j * found[sound, 1], (h * wave)[sound], atol=1e-4)


def test_bands_add_up_to_the_tapered_window() -> None:
    """Parseval's theorem, with a taper and a mean that are made here anew."""
    random = np.random.default_rng(8)
    u, du, V = random.normal(size=(500, 1)), random.normal(size=(500, 1)), random.normal(size=(500, 3))
    sums = band_sums(u, du, V, 100.0)
    assert sums is not None
    ramp = 0.5 - 0.5 * np.cos(np.pi * (np.arange(50) + 0.5) / 50)
    taper = np.concatenate([ramp, np.ones(400), ramp[::-1]])
    taper /= np.sqrt(np.mean(taper**2))
    rows = np.hstack([u, du, V])
    rows = (rows - taper @ rows / taper.sum()) * taper[:, None]
    # The line at half the rate counts twice in the bands.
    last = rows.T @ np.cos(np.pi * np.arange(500))
    np.testing.assert_allclose(sums.products.sum(axis=0), rows.T @ rows + np.outer(last, last) / 500, atol=1e-9)


def test_a_window_whose_motion_is_in_one_band_has_finite_derivatives() -> None:
    """The powers of several bands are made like those of the whole window; with one band there is nothing to change."""
    t = np.arange(2000) / 100.0
    u = np.random.default_rng(1).normal(size=(2000, 1))
    bands = band_sums(u, np.gradient(u, t, axis=0), np.repeat(u, 3, axis=1), 100.0)
    assert bands is not None
    factors = Factors(bands, np.array([8]))
    with np.errstate(all="raise"):
        found = _projected(factors, len(POWERS), 1.3 * factors.omega**2)
    np.testing.assert_allclose(found[0, 0], -(factors.omega**2), rtol=1e-9)


def test_a_channel_with_less_power_than_its_noise_is_silent() -> None:
    """Where the noise that was subtracted is more than what the channel shows, its powers are below 0 in most bands:
    they are no shares of its power, and their squares overflowed."""
    u = np.random.default_rng(2).normal(size=(2000, 3))
    bands = band_sums(u, np.gradient(u, 0.01, axis=0), np.repeat(u[:, :1], 3, axis=1), 100.0)
    assert bands is not None
    products = bands.products.copy()
    products[:, 2] = products[:, :, 2] = 0.0
    products[::2, 2, 2], products[1::2, 2, 2] = -2e-5, 1e-5
    factors = Factors(replace(bands, products=products), np.arange(4, 12))
    with np.errstate(all="raise"):
        found = _projected(factors, len(POWERS), 1.3 * factors.omega[3] ** 2 * np.ones(3))
    assert np.all(np.isfinite(found))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4, 8])
def test_short_stops_beside_an_ac_coupled_reference_settle(seed: int) -> None:
    """Three stops of 4 s, the last one at the end of the recording, with both instruments alike. A filter below the
    motion costs the end of the last stop, which changes what the bands show: the search went to and fro between the
    longer and the shorter window, and ended without a result."""
    bench, hold_s = plain(seed), 4.1
    stands = tuple(clamped(theta, alpha, hold_s) for theta, alpha in ((55.0, 45.0), (35.0, 180.0), (35.0, 270.0)))
    of_250_hz = [replace(device.clock, nominal_rate_hz=250.0) for device in (bench.sensor, bench.reference)]
    sensor, reference = replace(bench.sensor, clock=of_250_hz[0]), replace(bench.reference, clock=of_250_hz[1])
    bench = replace(bench, schedule=Schedule(stands, 2.4, 1.0), sensor=sensor, reference=reference)
    seen = Bench(bench, seed).recording(1.0 + 3 * (hold_s + 2.4) + 0.5)
    poses = [
        {"start_s": p.start_s, "stop_s": p.stop_s, "theta_deg": p.theta_deg, "alpha_deg": p.alpha_deg}
        for p in seen.poses
    ]
    found = calibrated_arrays(
        (seen.sensor_stamp_s, seen.v), (seen.reference_stamp_s, seen.reference), poses,
        gravity=bench.gravity_mps2, nominal=COUNTS_PER_MPS2, u_nominal_pct=5.0,
    )  # fmt: skip
    assert found.status == "valid", found.reasons
    assert np.abs((found.sensitivity - seen.truth.sensitivity).ravel() / found.standard_uncertainty[:9]).max() < 3.0


@pytest.mark.thorough
def test_what_is_refused_tells_its_response_band_by_band() -> None:
    """A resonance within the motion: no S, but each band tells its own sensitivity, right within its uncertainty."""
    shape = resonance(14.0, 5.0)
    made = pair(1, shape, band_hz=(0.5, 20.0), rate_hz=200.0, seconds=300.0)
    found = not_limited(made)
    assert found.calibration is None
    at_reference = abs(shape(np.array([made.reference_frequency_hz]))[0])
    away = []
    for band in found.more["response"]:
        middle_hz = np.array([np.sqrt(band["low_hz"] * band["high_hz"])])
        told = np.abs(np.array(band["sensitivity_re"]) + 1j * np.array(band["sensitivity_im"])).diagonal()
        true = made.sensitivity.diagonal() * abs(shape(middle_hz)[0]) / at_reference
        away += ((told - true) / np.array(band["standard_uncertainty"]).diagonal()).tolist()
        assert np.abs(told / true - 1.0).max() < 0.08  # at the peak the response bends within a band
    assert len(away) >= 75
    assert np.nanmax(np.abs(away)) < 4.0
