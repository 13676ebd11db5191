"""Which stop a sensor stands in, and a clamp's angles, by its mean output under a calibration that is roughly known."""

from __future__ import annotations

import numpy as np
import pytest

from calib.excitation.placing import WIDER, MeanOutput, PlacingUncertainty, clamp_angles, mean_output, nearest_stop
from calib.geometry import at_rest
from calib.model import Calibration, Pose
from tests.clamp_windows import frame

G_MPS2 = 9.80665
DEGREE = np.deg2rad(1.0)
KNOWLEDGE = PlacingUncertainty(angle_rad=0.3 * DEGREE, gravity_mps2=0.03, offset=0.05)
EXACT = PlacingUncertainty(angle_rad=0.0, gravity_mps2=0.0, offset=1e-9)
NOTHING = np.zeros((3, 3))
GOOD = (0.003, 0.003, 0.02)  # u of main and transverse sensitivities, and of Q in m/s2
POOR = (0.05, 0.03, 0.5)  # a data sheet's


def knowing(u: tuple[float, float, float], scale: float = 1.0) -> Calibration:
    sd = scale * np.append(np.where(np.eye(3).ravel() > 0, u[0], u[1]), np.full(3, u[2]))
    return Calibration(scale * np.eye(3), np.zeros(3), np.diag(sd**2), np.ones(12, dtype=bool), np.inf, "")


def leaning(degrees: float) -> Pose:
    return at_rest(G_MPS2 * np.array([np.sin(degrees * DEGREE), 0.0, np.cos(degrees * DEGREE)]), f"{degrees:g} deg")


def drawn(known: Calibration, random: np.random.Generator) -> np.ndarray:
    return np.append(known.sensitivity.ravel(), known.offset) + np.sqrt(np.diag(known.covariance)) * random.normal(
        size=12
    )


def reading(x: np.ndarray, gravity: np.ndarray) -> MeanOutput:
    return MeanOutput(x[:9].reshape(3, 3) @ gravity + x[9:], NOTHING)


@pytest.mark.parametrize("seed", range(5))
def test_two_stops_five_degrees_apart_are_undecided_until_the_offset_is_known(seed: int) -> None:
    stops, random = [leaning(0.0), leaning(5.0)], np.random.default_rng(seed)
    mean = reading(drawn(knowing(GOOD), random), stops[1].gravity_mps2)
    poor = nearest_stop(mean, stops, knowing(POOR), KNOWLEDGE)
    assert poor.pose is None
    assert "0 deg" in poor.reason
    assert "5 deg" in poor.reason
    assert "1000 to 1 are needed" in poor.reason
    assert 0.0 <= poor.numbers["position_log_odds"] < np.log(1000.0)
    good = nearest_stop(mean, stops, knowing(GOOD), KNOWLEDGE)
    assert good.pose is stops[1]
    assert good.numbers["position_log_odds"] > np.log(1000.0)


@pytest.mark.parametrize("scale", [1.0, 26_000.0])
def test_a_stop_that_nobody_stated_is_refused_with_the_numbers(scale: float) -> None:
    stops, known = [leaning(0.0), leaning(30.0)], knowing(GOOD, scale)
    knowledge = PlacingUncertainty(KNOWLEDGE.angle_rad, KNOWLEDGE.gravity_mps2, scale * KNOWLEDGE.offset)
    mean = MeanOutput(scale * leaning(15.0).gravity_mps2, NOTHING)
    found = nearest_stop(mean, stops, known, knowledge)
    assert found.pose is None
    assert found.reason.startswith("the sensor stands at none of the stated positions")
    # 15 deg are 2.6 m/s2, u is 0.09: 0.03 of Q, 0.03 of S, 0.05 of the offset, 0.05 of the angle.
    assert 400.0 < found.numbers["position_chi2"] < 2000.0
    assert nearest_stop(MeanOutput(scale * stops[1].gravity_mps2, NOTHING), stops, known, knowledge).pose is stops[1]


@pytest.mark.slow
def test_a_data_sheet_tells_stops_thirty_degrees_apart_and_never_a_wrong_one() -> None:
    """500 sensors within their data sheet, at seven distances: a likelihood ratio of 1000 may err once in 10,000."""
    random, known = np.random.default_rng(1), knowing(POOR)
    told = dict.fromkeys((2.0, 5.0, 8.0, 12.0, 15.0, 20.0, 30.0), 0)
    for apart_deg in told:
        stops = [leaning(apart_deg * k) for k in range(3)]
        for _ in range(500):
            mean = reading(drawn(known, random), stops[1].gravity_mps2)
            found = nearest_stop(mean, stops, known, KNOWLEDGE)
            assert found.pose in (None, stops[1])
            told[apart_deg] += found.pose is not None
    assert told[30.0] >= 495
    assert told[20.0] >= 400
    assert told[2.0] == 0


@pytest.mark.slow
def test_sound_windows_are_not_refused() -> None:
    """2000 draws of all that was stated: one in 10,000 may be beyond the chi-squared limit; 3 are beyond 99.9 %."""
    random, known, stop = np.random.default_rng(2), knowing(GOOD), leaning(40.0)
    refused, chi2 = 0, []
    for _ in range(2000):
        turned = stop.gravity_mps2 + np.cross(KNOWLEDGE.angle_rad * random.normal(size=3), stop.gravity_mps2)
        turned *= 1.0 + KNOWLEDGE.gravity_mps2 * random.normal() / G_MPS2
        mean = reading(drawn(known, random), turned)
        mean = MeanOutput(mean.value + KNOWLEDGE.offset * random.normal(size=3), NOTHING)
        found = nearest_stop(mean, [stop, leaning(-40.0)], known, KNOWLEDGE)
        refused += found.pose is None
        chi2.append(found.numbers["position_chi2"])
    assert refused <= 3
    assert abs(np.mean(chi2) - 3.0) < 4.0 * np.sqrt(6.0 / 2000)  # chi-squared of three degrees of freedom


@pytest.mark.parametrize("alpha_deg", [0.0, 100.0, 210.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_angles_of_a_clamp_come_out_of_an_exact_sensor(alpha_deg: float, sign: int) -> None:
    e = frame(35.0 * DEGREE, alpha_deg * DEGREE)[1]
    mean = MeanOutput(sign * G_MPS2 * e, NOTHING)
    known = knowing((1e-9, 1e-9, 1e-9))
    found = clamp_angles(mean, known, EXACT, (G_MPS2, sign), None, "p").pose
    assert found is not None
    assert found.theta_rad == pytest.approx(35.0 * DEGREE, abs=1e-9)
    assert np.cos(found.alpha_rad - alpha_deg * DEGREE) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(found.direction[:, 0], frame(35.0 * DEGREE, alpha_deg * DEGREE)[0], atol=1e-8)
    np.testing.assert_allclose(found.gravity_mps2, mean.value, atol=1e-7)
    leant = clamp_angles(mean, known, EXACT, (G_MPS2, sign), -35.0 * DEGREE, "p").pose
    assert leant is not None  # gravity is the same, the motion goes the other way
    np.testing.assert_allclose(leant.direction, -found.direction, atol=1e-8)
    np.testing.assert_allclose(leant.gravity_mps2, mean.value, atol=1e-7)


@pytest.mark.slow
def test_stated_uncertainty_of_angles_is_their_scatter() -> None:
    """2000 sensors drawn from what is known of them: chi-squared of alpha and theta is 1 each, within 4 SD of it."""
    random, known, pulls = np.random.default_rng(3), knowing((0.01, 0.01, 0.1)), []
    e = frame(35.0 * DEGREE, 60.0 * DEGREE)[1]
    for _ in range(2000):
        found = clamp_angles(reading(drawn(known, random), G_MPS2 * e), known, EXACT, (G_MPS2, 1), None, "p")
        assert found.pose is not None
        n = found.numbers
        pulls.append(
            [
                (n["found_theta_deg"] - 35.0) / n["u_found_theta_deg"],
                (n["found_alpha_deg"] - 60.0) / n["u_found_alpha_deg"],
            ]
        )
        assert found.pose.u_alpha_rad == pytest.approx(WIDER * n["u_found_alpha_deg"] * DEGREE)
    assert np.all(np.abs(np.mean(np.square(pulls), axis=0) - 1.0) < 4.0 * np.sqrt(2.0 / 2000))


def test_what_no_clamp_can_be_is_refused_with_the_numbers() -> None:
    known, e = knowing(GOOD), frame(35.0 * DEGREE, 60.0 * DEGREE)[1]

    def angles(value: np.ndarray, theta_rad: float | None = None, u: Calibration = known) -> str:
        placed = clamp_angles(MeanOutput(value, NOTHING), u, KNOWLEDGE, (G_MPS2, 1), theta_rad, "p")
        assert placed.pose is None
        return placed.reason

    assert "8.8" in angles(0.9 * G_MPS2 * e)
    assert "static_sign" in angles(-G_MPS2 * e)
    assert "35" in angles(G_MPS2 * e, 40.0 * DEGREE)
    assert "10 deg is the limit" in angles(G_MPS2 * e, None, knowing((0.05, 0.03, 20.0)))
    flat = frame(0.5 * DEGREE, 0.0)[1]
    assert "alpha" in angles(G_MPS2 * flat)


@pytest.mark.parametrize("frequency_hz", [0.5, 0.7, 5.0])
@pytest.mark.parametrize("duration_s", [4.0, 10.0, 30.0])
def test_the_mean_is_right_while_it_shakes(frequency_hz: float, duration_s: float) -> None:
    """The worst of 24 phases against the stated standard uncertainty, which is a bound divided by sqrt(2)."""
    t = np.arange(round(duration_s * 100)) / 100
    for phase in np.linspace(0.0, 2 * np.pi, 24):
        shaking = 10.0 * np.sin(2 * np.pi * frequency_hz * t + phase)
        mean = mean_output(np.array([1.0, 2.0, 3.0]) + shaking[:, None] * np.array([0.0, 0.0, 1.0]), 100.0)
        assert mean is not None
        off = mean.value - np.array([1.0, 2.0, 3.0])
        assert abs(off[2]) <= 1.5 * np.sqrt(mean.covariance[2, 2]) + 1e-9
        assert np.sqrt(mean.covariance[2, 2]) < (0.4 if duration_s == 4.0 else 0.05)


@pytest.mark.parametrize("frequency_hz", [0.17, 0.2, 0.3])
@pytest.mark.parametrize("duration_s", [12.0, 18.0, 30.0])
def test_the_mean_of_slow_motion_needs_longer_data(frequency_hz: float, duration_s: float) -> None:
    """As above with periods three times as long, and data three times as long."""
    t = np.arange(round(duration_s * 100)) / 100
    for phase in np.linspace(0.0, 2 * np.pi, 24):
        slow = np.sin(2 * np.pi * frequency_hz * t + phase)[:, None] * np.array([0.0, 0.0, 1.0])
        mean = mean_output(np.array([1.0, 2.0, 3.0]) + slow, 100.0, 12.0)
        assert mean is not None
        assert abs(mean.value[2] - 3.0) <= 1.5 * np.sqrt(mean.covariance[2, 2]) + 1e-9
        assert np.sqrt(mean.covariance[2, 2]) < 0.04
    assert mean_output(np.zeros((1100, 3)), 100.0, 12.0) is None


def test_missing_samples_are_left_out_and_too_few_are_no_mean() -> None:
    values = np.tile([1.0, 2.0, 3.0], (600, 1))
    values[::7] = np.nan
    mean = mean_output(values, 100.0)
    assert mean is not None
    np.testing.assert_allclose(mean.value, [1.0, 2.0, 3.0], rtol=1e-12)
    assert mean_output(values[:400], 100.0) is None
