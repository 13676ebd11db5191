"""A noisy reference beside a structure that hardly moves: quiet windows take its attenuation out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.estimate.adjustment import adjust
from calib.estimate.nuisances import Priors
from calib.model import Pose, Window
from tests.clamp_windows import S_TRUE, Faults, clamp_points, window_of

RATE_HZ, SECONDS, STRETCH_S = 100.0, 300.0, 10.0
BESIDE = Pose("beside", np.eye(3), np.full(3, np.nan))
FREE_LAG = replace(Priors.none(), lag_s=0.02)


def _band(random: np.random.Generator, rms: float) -> tuple[np.ndarray, np.ndarray]:
    """Three channels of random motion from 1 to 20 Hz and their derivatives."""
    n = int(SECONDS * RATE_HZ)
    f = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    lines = np.where((f > 1.0) & (f < 20.0), 1.0, 0.0)[:, None] * (random.normal(size=(len(f), 3, 2)) @ [1.0, 1.0j])
    x, dx = (np.fft.irfft(part, n, axis=0) for part in (lines, 2j * np.pi * f[:, None] * lines))
    return rms * x / x.std(), rms * dx / x.std()


def _windows(random: np.random.Generator) -> tuple[list[Window], list[Window]]:
    """Loud and calm stretches in turn: rms 0.02, calm at 0.15 of it, reference noise 0.006 m/s2 in the same band."""
    (a, da), (noise, d_noise) = _band(random, 0.02), _band(random, 0.006)
    loud, calm = [], []
    for k in range(int(SECONDS / STRETCH_S)):
        part = slice(int(k * STRETCH_S * RATE_HZ), int((k + 1) * STRETCH_S * RATE_HZ))
        level = 1.0 if k % 2 == 0 else 0.15
        V = level * a[part] @ S_TRUE.T + 0.002 * random.normal(size=(part.stop - part.start, 3))
        u, du = level * a[part] + noise[part], level * da[part] + d_noise[part]
        (loud if k % 2 == 0 else calm).append(window_of(BESIDE, u, du, V, 10))
    return loud, calm


def test_quiet_windows_take_the_attenuation_out_and_u_says_what_is_left():
    errors, lost, pulls = [], [], []
    for seed in range(20):
        loud, calm = _windows(np.random.default_rng([30, seed]))
        found, without = adjust(loud, FREE_LAG, quiet=calm), adjust(loud, FREE_LAG)
        assert found.reasons == ()
        errors.append(found.mean[:9] - S_TRUE.ravel())
        pulls.append(errors[-1] / found.calibration.standard_uncertainty[:9])
        lost.append(1.0 - np.diag(without.mean[:9].reshape(3, 3)) / np.diag(S_TRUE))
    assert 0.07 < np.mean(lost) < 0.10  # 0.09 / 1.09: what plain least squares loses
    # 2 B T = 5700 loud values of reference noise 0.3 of the signal: 0.4 % an element; the mean of 180 errors 0.03 %
    assert np.sqrt(np.mean(np.square(errors))) < 0.005
    assert abs(np.mean([np.diag(e.reshape(3, 3)) for e in errors])) < 0.002
    # 99.9 % band of the root mean square of 180 values, correlated in nines: as for 40
    assert 0.65 < np.sqrt(np.mean(np.square(pulls))) < 1.38


@pytest.mark.parametrize("seed", range(6))
def test_a_direction_with_no_more_than_the_reference_s_noise_is_not_excited(seed):
    """Motion along x alone, a tri-axial reference: the noise of y and z must not pass for motion."""
    random = np.random.default_rng([31, seed])
    (a, da), (noise, d_noise) = _band(random, 0.02), _band(random, 0.006)
    only_x = np.array([1.0, 0.0, 0.0])
    loud, calm = [], []
    half = len(a) // 2
    for level, part, out in ((1.0, slice(0, half), loud), (0.1, slice(half, None), calm)):
        V = level * (a[part] * only_x) @ S_TRUE.T + 0.002 * random.normal(size=a[part].shape)
        u, du = level * a[part] * only_x + noise[part], level * da[part] * only_x + d_noise[part]
        out.append(window_of(BESIDE, u, du, V, 30))
    found = adjust(loud, FREE_LAG, quiet=calm)
    assert found.rank == 1
    assert found.calibration.determined.tolist() == [True, False, False] * 3 + [False] * 3
    np.testing.assert_allclose(found.calibration.sensitivity[:, 0], S_TRUE[:, 0], rtol=0, atol=0.03)


@pytest.mark.parametrize("noise_mps2", [1e-5, 1e-7, 0.0])
def test_data_of_hardly_any_noise_leave_what_the_priors_leave(noise_mps2: float) -> None:
    """Offsets and angles make u; type A at 0.001 m/s2 is a hundredth of it. Simulated data come without noise."""
    ordinary = adjust(clamp_points(np.random.default_rng(60), Faults(noise_mps2=1e-3)).windows)
    found = adjust(clamp_points(np.random.default_rng(60), Faults(noise_mps2=noise_mps2)).windows)
    assert found.reasons == ()
    # no fault but the noise: what little it says of angles and transverse motion is a tenth of what the priors leave
    np.testing.assert_allclose(found.calibration.sensitivity, S_TRUE, atol=1e-3)
    np.testing.assert_allclose(
        found.calibration.standard_uncertainty, ordinary.calibration.standard_uncertainty, rtol=0.01
    )
