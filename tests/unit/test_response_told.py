"""What is told of a response: sensitivities at 0 Hz and in bands follow from S at its frequency."""

from __future__ import annotations

import numpy as np

from calib.estimate.response_told import response_of

REFERENCE_HZ, BAND_HZ = 8.0, (1.0, 16.0)
OF_S2 = 2e-5  # of a filter well above the motion
TERMS = np.array([[OF_S2, 0.0, 0.0, 0.0, 0.0]])
S = np.array([[1.0, 0.01, -0.02], [0.0, 1.1, 0.03], [0.02, 0.0, 0.9]])


def test_s_and_u_at_0_hz_are_those_at_its_frequency_over_the_size_of_the_response_there() -> None:
    """The response is known here, so that all of u is that of S."""
    u = 0.01 * np.arange(1.0, 10.0)
    told = response_of(
        np.append(S.ravel(), 1.0), np.diag(np.append(u**2, 0.0)), TERMS, REFERENCE_HZ, BAND_HZ, coverage_factor=2.0
    )
    size = np.exp(-OF_S2 * (2.0 * np.pi * REFERENCE_HZ) ** 2)  # ln h is OF_S2 s^2
    np.testing.assert_allclose(told.at_0hz, S / size, rtol=1e-9)
    np.testing.assert_allclose(told.u_at_0hz, u.reshape(3, 3) / size, rtol=1e-9)
