"""The virtual bench compared with closed forms, written here by hand."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, radians, sin, sqrt
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hw.virtual.bench import Bench
from hw.virtual.motion import ambient, multisine, orbit, sine
from hw.virtual.parameters import (
    BenchParameters,
    ClampErrors,
    Knocks,
    ReferenceParameters,
    SensorParameters,
    TemperatureSwing,
)
from hw.virtual.scene import Scene
from hw.virtual.schedule import Schedule, clamped, directed, resting

G = 9.80665
STILL = 1e-12  # rounding of sums of a few numbers of about 10


def one_position(theta_deg: float = 35.0, alpha_deg: float = 30.0, **changes: Any) -> BenchParameters:
    """3 Hz, 10 m/s2, one position from 0 s on."""
    schedule = Schedule((clamped(theta_deg, alpha_deg, hold_s=100.0),), turn_s=1.0, start_s=0.0)
    return replace(BenchParameters(schedule=schedule), **changes)


@pytest.mark.parametrize(("theta_deg", "alpha_deg"), [(35, 0), (35, 30), (35, 120), (35, 210), (20, 75), (70, 301)])
def test_input_is_equations_9_to_11(theta_deg: float, alpha_deg: float) -> None:
    bench = Bench(one_position(theta_deg, alpha_deg), seed=1)
    t, v = bench.sensor_times(0, 1000), bench.sensor_values(0, 1000)
    theta, alpha = radians(theta_deg), radians(alpha_deg)
    a_ref = 10 * np.sin(2 * pi * 3 * t)
    assert_allclose(v[:, 0], -a_ref * sin(alpha) * cos(theta) - G * sin(theta) * sin(alpha), atol=STILL)  # Eq. (9)
    assert_allclose(v[:, 1], -a_ref * cos(alpha) * cos(theta) - G * sin(theta) * cos(alpha), atol=STILL)  # Eq. (10)
    assert_allclose(v[:, 2], a_ref * sin(theta) - G * cos(theta), atol=STILL)  # Eq. (11)
    assert_allclose(bench.reference_values(0, 1000)[:, 0], a_ref, atol=STILL)


def test_output_is_equation_8() -> None:
    S = np.array([[1.02, 0.03, -0.01], [-0.02, 0.97, 0.04], [0.05, -0.06, 1.01]])
    Q = np.array([0.3, -0.2, 0.5])
    a = Bench(one_position(), 1).sensor_values(0, 50)
    v = Bench(one_position(sensor=SensorParameters(sensitivity=S, offset=Q)), 1).sensor_values(0, 50)
    for row in range(50):
        for i in range(3):
            expected = S[i, 0] * a[row, 0] + S[i, 1] * a[row, 1] + S[i, 2] * a[row, 2] + Q[i]
            assert v[row, i] == pytest.approx(expected, abs=STILL)


def test_static_sign_turns_gravity_alone() -> None:
    inward = Bench(one_position(motion=sine(3, 0.0)), 1).sensor_values(0, 3)
    outward = Bench(one_position(motion=sine(3, 0.0), static_sign=-1), 1).sensor_values(0, 3)
    assert_allclose(outward, -inward, atol=STILL)
    assert_allclose(np.linalg.norm(inward, axis=1), G, atol=STILL)


@pytest.mark.parametrize(
    "motion", [multisine(np.random.default_rng(3)), ambient(np.random.default_rng(4), rms_mps2=1.0)]
)
def test_velocity_and_acceleration_are_derivatives_also_while_fading(motion) -> None:
    scene = Scene(BenchParameters(motion=motion), seed=1)
    h = 1e-4
    t = np.arange(0.2, 9.0, 0.0137)  # fade-in before 1 s, two holds, fade-out and fade-in around the turns
    velocity, acceleration = scene.slide(t)
    ahead, behind = scene.slide(t + h)[0], scene.slide(t - h)[0]
    # h^2/6 of a third derivative: (2 pi 10)^2 * 3 m/s2 in the steady part, a few hundred m/s4 in the fades
    assert_allclose((ahead - behind) / (2 * h), acceleration, atol=1e-4)
    displacement, steady_velocity, _ = motion.evaluate(t)
    assert_allclose((motion.evaluate(t + h)[0] - motion.evaluate(t - h)[0]) / (2 * h), steady_velocity, atol=1e-6)
    assert np.abs(displacement).max() > 1e-4
    assert np.abs(velocity).max() > 0.01


def test_velocity_reference_reads_the_slides_velocity() -> None:
    bench = Bench(one_position(reference=ReferenceParameters(quantity="velocity")), 1)
    t = bench.reference_times(0, 700)
    omega = 2 * pi * 3
    assert_allclose(bench.reference_values(0, 700)[:, 0], -10 / omega * np.cos(omega * t), atol=STILL)


def test_lag_is_a_pure_delay_of_each_axis() -> None:
    lag = (0.001, 0.005, 0.012)
    plain = Bench(one_position(), 1)
    late = Bench(one_position(sensor=SensorParameters(lag_s=lag)), 1).sensor_values(500, 500)
    for axis, delay_ms in enumerate((1, 5, 12)):  # at 1 kHz a delay is a shift by whole samples
        assert_allclose(late[:, axis], plain.sensor_values(500 - delay_ms, 500)[:, axis], atol=1e-9)


@pytest.mark.parametrize("order", [1, 2])
def test_lowpass_changes_amplitude_and_phase_not_gravity(order) -> None:
    corner = 40.0
    bench = Bench(one_position(sensor=SensorParameters(lowpass_hz=corner, lowpass_order=order)), 1)
    t, z = bench.sensor_times(0, 1000), bench.sensor_values(0, 1000)[:, 2]
    r = 3 / corner
    if order == 1:
        amplitude, phase = 1 / sqrt(1 + r**2), -np.arctan(r)
    else:
        amplitude, phase = 1 / sqrt(1 + r**4), -np.arctan2(sqrt(2) * r, 1 - r**2)
    expected = 10 * amplitude * np.sin(2 * pi * 3 * t + phase) * sin(radians(35)) - G * cos(radians(35))
    assert_allclose(z, expected, atol=1e-10)


def test_ac_coupled_sensor_and_reference_lose_gravity_and_lead() -> None:
    corner = 0.16
    parameters = one_position(
        sensor=SensorParameters(highpass_hz=corner), reference=ReferenceParameters(highpass_hz=corner)
    )
    bench = Bench(parameters, 1)
    t = bench.sensor_times(0, 1000)
    r = corner / 3
    filtered = 10 / sqrt(1 + r**2) * np.sin(2 * pi * 3 * t + np.arctan(r))
    assert_allclose(bench.sensor_values(0, 1000)[:, 2], filtered * sin(radians(35)), atol=1e-10)
    assert_allclose(bench.reference_values(0, 1000)[:, 0], filtered, atol=1e-10)


def test_clamp_errors_are_those_of_a_differently_set_clamp_and_repeat_with_the_position() -> None:
    nominal = BenchParameters(
        schedule=Schedule((clamped(35, 0, 2.0), clamped(35, 120, 2.0)), turn_s=1.0, start_s=0.0),
        clamp=ClampErrors(0.2, 0.1, theta_by_position_deg=(0.03, -0.04), alpha_by_position_deg=(0.5, -0.3)),
    )
    really = replace(
        nominal,
        schedule=Schedule((clamped(35.23, 0.6, 2.0), clamped(35.16, 119.8, 2.0)), turn_s=1.0, start_s=0.0),
        clamp=ClampErrors(),
    )
    wrong, right = Bench(nominal, 1), Bench(really, 1)
    assert_allclose(wrong.sensor_values(0, 12000), right.sensor_values(0, 12000), atol=1e-9)
    assert_allclose(wrong.truth.theta_error_deg, [0.23, 0.16])
    assert_allclose(wrong.truth.alpha_error_deg, [0.6, -0.2])
    assert [pose.alpha_deg for pose in wrong.poses] == [0, 120]
    # 6 s is one repetition, 18 cycles of 3 Hz: the second repetition equals the first
    assert_allclose(wrong.sensor_values(6000, 2000), wrong.sensor_values(0, 2000), atol=1e-9)


def test_offset_by_position_in_output_unit_and_repeated() -> None:
    offsets = np.array([[0.05, 0.0, -0.02], [0.0, 0.07, 0.01]])
    schedule = Schedule((clamped(35, 0, 1.0), clamped(35, 120, 1.0)), turn_s=1.0, start_s=0.0)
    sensor = SensorParameters(sensitivity=100 * np.eye(3), nominal_sensitivity=100.0)
    base = BenchParameters(schedule=schedule, sensor=sensor)
    shifted = replace(base, sensor=replace(sensor, offset_by_position_mps2=offsets))
    difference = Bench(shifted, 1).sensor_values(0, 8000) - Bench(base, 1).sensor_values(0, 8000)
    for start, position in ((0, 0), (2000, 1), (4000, 0), (6000, 1)):
        assert_allclose(difference[start : start + 1000], 100 * np.tile(offsets[position], (1000, 1)), atol=1e-9)
    assert_allclose(Bench(shifted, 1).truth.offset_by_position, 100 * offsets)


@pytest.mark.slow
def test_offset_by_window_is_constant_in_a_window_and_has_the_stated_sd() -> None:
    schedule = Schedule((clamped(35, 0, 0.5), clamped(35, 120, 0.5)), turn_s=0.5, start_s=0.0)
    base = BenchParameters(schedule=schedule)
    shifted = replace(base, sensor=SensorParameters(offset_by_window_mps2=0.05))
    windows = 200
    difference = Bench(shifted, 2).sensor_values(0, 1000 * windows) - Bench(base, 2).sensor_values(0, 1000 * windows)
    held = difference.reshape(windows, 1000, 3)[:, :500]
    assert np.ptp(held, axis=1).max() < STILL
    # 600 independent normals: chi-squared with 600 degrees of freedom, 99.9 % band 0.817..1.202 of the variance
    assert 0.817 < np.mean(held[:, 0] ** 2) / 0.05**2 < 1.202


def test_knocks_hit_the_sensor_alone_at_the_stated_rate_and_size() -> None:
    base = one_position()
    hit = replace(base, knocks=Knocks(rate_hz=2.0, peak_mps2=6.0, duration_s=0.02))
    n = 90_000
    quiet, loud = Bench(base, 5), Bench(hit, 5)
    blow = np.linalg.norm(loud.sensor_values(0, n) - quiet.sensor_values(0, n), axis=1)
    assert np.array_equal(loud.reference_values(0, n), quiet.reference_values(0, n))
    # 180 expected; each lasts 20 samples and few overlap. Poisson 99.9 %: 137..226
    assert 137 * 20 * 0.95 < np.count_nonzero(blow) < 226 * 20
    peaks = blow.reshape(-1, 1000).max(axis=1)
    assert peaks.max() < 12.0  # no more than two at once
    assert np.count_nonzero(peaks > 3.0) > 40  # in 90 s with 2 per second, 57 % of them above 3


def test_saturation_and_quantisation() -> None:
    sensor = SensorParameters(sensitivity=np.eye(3), resolution=0.01, limit=8.0, noise_mps2=0.003)
    bench = Bench(one_position(sensor=sensor), 1)
    v, counts = bench.sensor_values(0, 1000), bench.sensor_counts(0, 1000)
    assert v.min() == -8.0
    assert counts.dtype == np.int32
    assert counts.min() == -800
    assert_allclose(v, counts * 0.01, atol=STILL)
    free = Bench(replace(bench.parameters, sensor=replace(sensor, resolution=0.0)), 1).sensor_values(0, 1000)
    assert 0.0 < np.abs(v - free).max() <= 0.005 + STILL
    with pytest.raises(ValueError, match="no counts"):
        Bench(one_position(), 1).sensor_counts(0, 1)


def test_temperature_moves_q_and_s() -> None:
    warm = TemperatureSwing(mean_degc=20.0, swing_k=5.0, period_s=40.0)
    sensor = SensorParameters(
        offset_per_k_mps2=(0.01, 0.02, -0.03), sensitivity_per_k=1e-3, offset=np.array([1.0, 1.0, 1.0])
    )
    bench = Bench(one_position(sensor=sensor, temperature=warm), 1)
    a = Bench(one_position(), 1).sensor_values(10_000, 1)[0]  # a quarter of the period: 5 K warmer
    v = bench.sensor_values(10_000, 1)[0]
    assert_allclose(v, a * (1 + 5e-3) + [1.05, 1.10, 0.85], atol=1e-9)
    assert_allclose(bench.recording(10.1).temperature_degc[10_000], 25.0)


def test_transverse_motion_is_felt_across_and_not_seen_by_a_uniaxial_reference() -> None:
    alpha, theta = radians(30), radians(35)
    base = one_position()
    moved = Bench(replace(base, motion=base.motion.with_transverse(lateral=0.05, vertical=0.02)), 1)
    plain = Bench(base, 1)
    a_ref = plain.reference_values(0, 500)
    assert np.array_equal(moved.reference_values(0, 500), a_ref)
    lateral = np.array([-cos(alpha), sin(alpha), 0.0])
    vertical = np.array([-sin(theta) * sin(alpha), -sin(theta) * cos(alpha), -cos(theta)])
    expected = a_ref * (0.05 * lateral + 0.02 * vertical)
    assert_allclose(moved.sensor_values(0, 500) - plain.sensor_values(0, 500), expected, atol=STILL)


@pytest.mark.slow
@pytest.mark.parametrize("feels_gravity", [True, False])
def test_triaxial_reference_beside_the_sensor(feels_gravity) -> None:
    turn = radians(20)
    R = np.array([[cos(turn), -sin(turn), 0.0], [sin(turn), cos(turn), 0.0], [0.0, 0.0, 1.0]])
    motion = ambient(np.random.default_rng(1), rms_mps2=0.02)
    bench = Bench(
        one_position(
            motion=motion, reference=ReferenceParameters(rotation=R, feels_gravity=feels_gravity), knocks=Knocks(0.0)
        ),
        1,
    )
    felt, seen = bench.sensor_values(0, 60_000), bench.reference_values(0, 60_000)
    theta, alpha = radians(35), radians(30)
    gravity = G * np.array([-sin(theta) * sin(alpha), -sin(theta) * cos(alpha), -cos(theta)])
    assert_allclose(felt, seen @ R.T + (0.0 if feels_gravity else gravity), atol=STILL)
    # rms of 64 incommensurate lines over 60 s: within 2 % of the stated one in every channel
    assert_allclose(np.sqrt(np.mean((felt - gravity) ** 2)), 0.02, rtol=0.02)


def test_orbit_is_a_circle() -> None:
    bench = Bench(one_position(motion=orbit(2.0, 0.7), gravity_mps2=0.0), 1)
    assert_allclose(np.linalg.norm(bench.sensor_values(0, 999), axis=1), 0.7, atol=STILL)


def test_any_direction_of_motion_and_gravity() -> None:
    d, e = np.array([2.0, -1.0, 2.0]) / 3, np.array([0.0, 0.6, 0.8])
    bench = Bench(replace(one_position(), schedule=Schedule((directed(d, e, 10.0),), start_s=0.0)), 1)
    a_ref = bench.reference_values(0, 400)
    assert_allclose(bench.sensor_values(0, 400), a_ref * d + G * e, atol=STILL)
    assert_allclose(bench.parameters.schedule.poses(10.0)[0].direction, d, atol=STILL)
    vertical = Bench(replace(one_position(), schedule=Schedule((directed(e, e, 10.0),), start_s=0.0)), 1)
    assert_allclose(vertical.sensor_values(0, 400), (a_ref + G) * e, atol=STILL)


def test_turning_by_hand_keeps_gravity_and_is_smooth_even_through_180_degrees() -> None:
    up = [np.array(v) for v in ([1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0])]
    schedule = Schedule(tuple(resting(v, 1.0) for v in up), turn_s=2.0, start_s=0.0)
    bench = Bench(BenchParameters(schedule=schedule, handling_mps2=0.0), 1)
    v = bench.sensor_values(0, 12_000)
    for index, vector in enumerate(up):
        assert_allclose(v[3000 * index : 3000 * index + 1000], np.tile(G * vector, (1000, 1)), atol=STILL)
    assert_allclose(np.linalg.norm(v, axis=1), G, atol=1e-9)
    # pi in 2 s through a quintic step: at most 1.875 * pi / 2 rad/s
    assert np.abs(np.diff(v, axis=0)).max() < 1e-3 * G * 1.875 * pi / 2 * 1.001
    shaken = Bench(BenchParameters(schedule=schedule, handling_mps2=0.5), 1).sensor_values(0, 12_000) - v
    assert np.abs(shaken[:1000]).max() == 0.0
    assert 0.4 < np.abs(shaken[1000:3000]).max() < 0.5 + STILL


def test_nothing_moves_before_the_start_and_the_motion_is_full_in_every_hold() -> None:
    bench = Bench(BenchParameters(), seed=1)  # starts at 1 s, holds of 2 s, turns of 1 s
    a = bench.reference_values(0, 12_000)[:, 0]
    assert np.abs(a[:600]).max() == 0.0
    assert [(p.start_s, p.stop_s, p.alpha_deg) for p in bench.poses] == [
        (1, 3, 0),
        (4, 6, 30),
        (7, 9, 120),
        (10, 12, 210),
    ]
    for pose in bench.poses:
        first, last = round(1000 * pose.start_s), round(1000 * pose.stop_s)
        t = bench.reference_times(first, last - first)
        assert_allclose(a[first:last], 10 * np.sin(2 * pi * 3 * t), atol=1e-10)
    assert np.abs(a[3500]) == 0.0  # the slide is at rest in the middle of the first turn


def test_contradicting_parameters_are_refused() -> None:
    with pytest.raises(ValueError, match="for 4 positions"):
        Bench(BenchParameters(clamp=ClampErrors(alpha_by_position_deg=(0.1, 0.2))), 1)
    with pytest.raises(ValueError, match="got -1"):
        Bench(one_position(sensor=SensorParameters(noise_mps2=0.1)), -1).sensor_values(0, 1)
    with pytest.raises(ValueError, match="positions on the clamp"):
        Bench(replace(one_position(clamp=ClampErrors(0.1)), schedule=Schedule((resting(np.ones(3), 1.0),))), 1)
    with pytest.raises(ValueError, match="must measure acceleration"):
        Bench(one_position(reference=ReferenceParameters(rotation=np.eye(3), quantity="velocity")), 1)
