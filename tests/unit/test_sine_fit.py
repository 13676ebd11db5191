"""Sine fit against the Cramér-Rao bound and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from calib.paper.sine_fit import acceleration, cycle_edges, four_parameter, three_parameter

A, NOISE = 2.0, 0.02


def bound(tau: np.ndarray, f: float, phase: float) -> np.ndarray:
    """Cramér-Rao SDs of (amplitude, phase, frequency) for y = A cos(2 pi f tau + phase) + c in white noise."""
    angle = 2 * np.pi * f * tau + phase
    J = np.column_stack([np.cos(angle), -A * np.sin(angle), -2 * np.pi * A * tau * np.sin(angle), np.ones_like(tau)])
    return NOISE * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[:3]


@pytest.mark.two_cases
@pytest.mark.parametrize(
    ("cycles", "per_cycle", "fits"),
    [(1, 333.33, 400), (1.3, 333.33, 400), (2.5, 100, 400), (6, 333.33, 300), (10.7, 166.67, 300), (100.37, 20, 200),
     (1000, 8, 40), (1000.5, 8, 40)],
)  # fmt: skip
def test_amplitude_phase_and_frequency_reach_the_cramer_rao_bound(cycles: float, per_cycle: float, fits: int) -> None:
    # z-scores at the true bound: mean square of `fits` normals. 99.9 % bands, Bonferroni over 8 rows x 3 parameters.
    rng = np.random.default_rng(round(10 * cycles))
    f, n = 3.0, round(cycles * per_cycle)
    t = 100.0 + np.arange(n) / (f * per_cycle)
    z = np.empty((fits, 3))
    for k in range(fits):
        phase = rng.uniform(-np.pi, np.pi)
        tau = t - t.mean()
        fit = four_parameter(t, A * np.cos(2 * np.pi * f * tau + phase) + 9.8 + NOISE * rng.normal(size=n))
        off = np.angle(np.exp(1j * (fit.phase_rad[0] - phase)))
        z[k] = np.array([fit.amplitude[0] - A, off, fit.frequency_hz - f]) / bound(tau, f, phase)
    width = 4.3 * np.sqrt(2 / fits)  # 4.3 SDs: 1e-3 / 24 on each side, chi-squared near enough normal from 40 on
    assert np.all(np.abs((z**2).mean(axis=0) - 1) < width)
    assert np.all(np.abs(z.mean(axis=0)) < 4.3 / np.sqrt(fits))  # no bias


@pytest.mark.parametrize("phase", [0.0, 0.7, 1.5])
@pytest.mark.parametrize("cycles", [0.8, 1, 1.3, 6, 100.37])
def test_stated_uncertainty_is_the_bound_at_the_residual_found(cycles: float, phase: float) -> None:
    rng = np.random.default_rng(2)
    f, n = 3.0, round(cycles * 200)
    t = np.arange(n) / 600.0
    tau = t - t.mean()
    fit = four_parameter(t, A * np.cos(2 * np.pi * f * tau + phase) + NOISE * rng.normal(size=n))
    stated = np.array([fit.u_amplitude[0], fit.u_phase_rad[0], fit.u_frequency_hz]) * NOISE / fit.residual_sd[0]
    # the bound at the values found instead of the true ones: below one cycle these are off by some per cent
    assert_allclose(stated, bound(tau, f, phase), rtol=0.01 if cycles > 1 else 0.1)
    assert fit.residual_sd[0] == pytest.approx(NOISE, rel=4 / np.sqrt(2 * n))  # 4 SDs


@given(
    cycles=st.floats(1.0, 30.0), phase=st.floats(-3.1, 3.1), f=st.floats(0.1, 200.0), constant=st.floats(-100.0, 100.0)
)
@settings(deadline=None, max_examples=60)
def test_without_noise_the_sine_is_found_exactly(cycles: float, phase: float, f: float, constant: float) -> None:
    t = np.linspace(5.0, 5.0 + cycles / f, 60 + round(20 * cycles))
    y = 3.0 * np.cos(2 * np.pi * f * (t - t.mean()) + phase) + constant
    fit = four_parameter(t, y)
    # constant up to 33 amplitudes: rounding of 1e-14 through a condition of some thousand at one cycle
    assert fit.frequency_hz == pytest.approx(f, rel=1e-8)
    assert_allclose(fit.phasor[0], 3.0 * np.exp(1j * phase), atol=1e-7)
    assert fit.constant[0] == pytest.approx(constant, abs=1e-7)
    assert_allclose(fit.derivative(t, 0)[:, 0] + fit.constant, y, atol=1e-6)


def test_three_parameters_are_the_fft_line_of_whole_cycles_and_do_not_leak_otherwise() -> None:
    f, rate = 3.0, 600.0
    t = np.arange(1200) / rate  # six cycles of 200 samples
    rng = np.random.default_rng(3)
    y = 5 * np.sin(2 * np.pi * f * t + 0.4) + 0.5 * np.sin(2 * np.pi * 2 * f * t) + 2 + 0.1 * rng.normal(size=1200)
    line = 2 * np.fft.rfft(y)[6] / 1200
    fit = three_parameter(t, y, f)
    assert fit.amplitude[0] == pytest.approx(abs(line), rel=1e-12)
    odd = 5 * np.sin(2 * np.pi * f * t[:1100]) + 2  # 5.5 cycles
    leaking = 2 * np.abs(np.fft.rfft(odd)).max() / 1100
    assert three_parameter(t[:1100], odd, f).amplitude[0] == pytest.approx(5, abs=1e-12)
    assert abs(np.sort(2 * np.abs(np.fft.rfft(odd)) / 1100)[-2] - 5) > 1  # the line itself would be far off
    assert leaking > 3


def test_several_signals_at_uneven_times() -> None:
    rng = np.random.default_rng(4)
    t = np.sort(rng.uniform(0, 3, 500))
    phasors = np.array([1 + 2j, -0.3j, 4.0])
    y = (np.exp(2j * np.pi * 2.7 * (t - t.mean()))[:, None] * phasors).real + np.array([1, 2, 3])
    fit = three_parameter(t, y, 2.7)
    assert_allclose(fit.phasor, phasors, atol=1e-12)
    assert_allclose(fit.constant, [1, 2, 3], atol=1e-12)
    assert np.all(fit.residual_sd < 1e-12)
    assert fit.u_frequency_hz == 0.0


def test_derivatives_of_the_fit() -> None:
    t = np.arange(400) / 200.0
    omega = 2 * np.pi * 3.0
    fit = four_parameter(t, 0.5 * np.sin(omega * t))
    assert_allclose(fit.derivative(t, 1)[:, 0], 0.5 * omega * np.cos(omega * t), atol=1e-6)
    assert_allclose(fit.derivative(t, 2)[:, 0], -0.5 * omega**2 * np.sin(omega * t), atol=1e-4)


def test_equation_12_is_amplitude_times_omega_and_a_quarter_turn_ahead() -> None:
    t = np.arange(1000) / 1000.0
    omega = 2 * np.pi * 3
    velocity, a = 0.4 * np.sin(omega * t), 0.4 * omega * np.cos(omega * t)
    both = three_parameter(t, np.column_stack([velocity, a]), 3.0)
    found = acceleration(both.phasor[0], 3.0)
    assert abs(found) == pytest.approx(omega * 0.4)
    assert found == pytest.approx(both.phasor[1])


@pytest.mark.parametrize(("n", "cycles"), [(1998, 6), (2000, 6), (2100, 6), (1660, 4), (334, 1), (2333, 7)])
def test_whole_cycles_of_333_samples(n: int, cycles: int) -> None:
    edges = cycle_edges(7.0 + np.arange(n) / 1000.0, 3.0)
    assert len(edges) == cycles + 1
    assert edges[0] == 0
    assert np.all(np.abs(np.diff(edges) - 1000 / 3) < 2.4)  # whole samples; the last may lack 1 % of a cycle
    assert edges[-1] <= n


@pytest.mark.parametrize(
    ("t", "y", "message"),
    [
        (np.arange(3.0), np.arange(3.0), "four points, there are 3"),
        (np.arange(10.0), np.arange(9.0), "shapes do not fit"),
        (np.arange(10.0), np.full(10, np.nan), "must be finite"),
        (np.zeros(10), np.arange(10.0), "same time"),
        (np.arange(10.0), np.ones(10), "does not move"),
        (np.arange(4.0), np.array([0, 1.0, 0, -1]), "need five points"),
        (np.arange(10.0), np.ones((10, 2)), "one signal has one frequency"),
    ],
)
def test_what_carries_no_sine_is_refused(t: np.ndarray, y: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        four_parameter(t, y)


def test_no_whole_cycle_and_no_frequency_are_refused() -> None:
    with pytest.raises(ValueError, match="no whole cycle of 3 Hz"):
        cycle_edges(np.arange(300) / 1000, 3.0)
    with pytest.raises(ValueError, match="frequency must be positive, is -1 Hz"):
        three_parameter(np.arange(10.0), np.arange(10.0), -1.0)
