"""A noisy reference beside a structure that hardly moves: its noise attenuates S, and that is corrected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.adjustment.adjustment import adjust
from calib.estimate.nuisances import Priors
from calib.model import Pose, Window
from tests.clamp_windows import S_TRUE, Faults, clamp_points, window_of

RATE_HZ, SECONDS, STRETCH_S = 100.0, 300.0, 10.0
BESIDE = Pose("beside", np.eye(3), np.full(3, np.nan))
FREE_LAG = Priors.none().with_values({"lag_s": 0.02})


def _band(random: np.random.Generator, rms: float) -> tuple[np.ndarray, np.ndarray]:
    """Three channels of random motion from 1 to 20 Hz and their derivatives."""
    n = int(SECONDS * RATE_HZ)
    f = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    lines = np.where((f > 1.0) & (f < 20.0), 1.0, 0.0)[:, None] * (random.normal(size=(len(f), 3, 2)) @ [1.0, 1.0j])
    x, dx = (np.fft.irfft(part, n, axis=0) for part in (lines, 2j * np.pi * f[:, None] * lines))
    return rms * x / x.std(), rms * dx / x.std()


def _windows(random: np.random.Generator) -> list[Window]:
    """Stretches of rms 0.02, reference noise 0.006 m/s2 in the same band, its power told."""
    (a, da), (noise, d_noise) = _band(random, 0.02), _band(random, 0.006)
    told = np.full((2, 3), [[0.006], [d_noise.std()]])
    windows = []
    for k in range(0, int(SECONDS / STRETCH_S), 2):
        part = slice(int(k * STRETCH_S * RATE_HZ), int((k + 1) * STRETCH_S * RATE_HZ))
        V = a[part] @ S_TRUE.T + 0.002 * random.normal(size=(part.stop - part.start, 3))
        u, du = a[part] + noise[part], da[part] + d_noise[part]
        windows.append(replace(window_of(BESIDE, u, du, V, 10), reference_noise=told))
    return windows


@pytest.mark.slow
def test_the_attenuation_is_taken_out_and_u_says_what_is_left():
    errors, lost, pulls = [], [], []
    for seed in range(20):
        windows = _windows(np.random.default_rng([30, seed]))
        found = adjust(windows, FREE_LAG)
        without = adjust([replace(w, reference_noise=None) for w in windows], FREE_LAG)
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
    V = (a * only_x) @ S_TRUE.T + 0.002 * random.normal(size=a.shape)
    window = window_of(BESIDE, a * only_x + noise, da * only_x + d_noise, V, 30)
    told = np.full((2, 3), [[0.006], [d_noise.std()]])
    found = adjust([replace(window, reference_noise=told)], FREE_LAG)
    assert found.rank == 1
    assert found.calibration.determined.tolist() == [True, False, False] * 3 + [False] * 3
    np.testing.assert_allclose(found.calibration.sensitivity[:, 0], S_TRUE[:, 0], rtol=0, atol=0.03)


@pytest.mark.slow
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
