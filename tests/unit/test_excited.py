"""Which channels of a reference were excited: one motion askew to the channels is one, however many show it."""

from __future__ import annotations

import numpy as np
import pytest

from calib.estimate.condense import condense
from calib.excitation.excited import excited
from calib.excitation.sums import window_sums
from calib.geometry import beside
from calib.model import Window

NOISE_MPS2 = 0.001
S = np.array([[1.01, 0.02, 0.0], [0.0, 0.99, -0.01], [0.03, 0.0, 1.02]])
RATE_HZ = 100.0


def window(directions: np.ndarray, level_mps2: float = 0.1, n: int = 6000) -> Window:
    """A minute of motion along these directions (k, 3), independent ones, seen by a reference with noise."""
    random = np.random.default_rng(1)
    lines = np.fft.rfftfreq(n, 1 / RATE_HZ)
    shape = ((lines > 0.5) & (lines < 10.0))[:, None]
    signal = np.fft.irfft(shape * (random.normal(size=(len(lines), len(directions), 2)) @ [1, 1j]), n, axis=0)
    rate = np.fft.irfft(np.fft.rfft(signal, axis=0) * (2j * np.pi * lines[:, None]), n, axis=0)
    scale = level_mps2 / signal.std()
    a, da = scale * signal @ directions, scale * rate @ directions
    u = a + NOISE_MPS2 * random.normal(size=a.shape)
    du = da + NOISE_MPS2 * 30.0 * random.normal(size=a.shape)
    V = a @ S.T + 0.005 * random.normal(size=a.shape)
    sums = window_sums(u, du, V, np.arange(0, n + 1, 50))
    noise = np.array([np.full(3, NOISE_MPS2), np.full(3, 30.0 * NOISE_MPS2)])
    return Window(0.0, 60.0, beside(np.eye(3)), sums, True, "", n, 0, reference_noise=noise)


def slopes(found: Window) -> tuple[np.ndarray, np.ndarray]:
    """S D of the channels that moved (3, k), and the variance ratio of the slopes by segments."""
    data = condense([found])
    live = np.flatnonzero(np.diag(data.root[0])[:3])
    x = np.linalg.solve(data.root[0][np.ix_(live, live)], data.slopes[0][live])
    return x.T, np.diag(data.type_a.slopes)


@pytest.mark.parametrize(
    "direction", [(0.0, 1.0, 0.0), (0.05, 0.6, 0.8), (-0.7, 0.1, 0.7), (0.6, -0.64, 0.48), (0.99, 0.1, 0.1)]
)
def test_a_motion_in_one_direction_is_one_channel_whichever_way_it_goes(direction: tuple[float, ...]) -> None:
    along = np.array(direction) / np.linalg.norm(direction)
    found = excited(window(along[None]))
    assert found.directions.shape == (3, 1)
    # 6000 points at 0.1 m/s2: the reference's noise turns the direction by 2e-4 rad, four of them
    assert abs(found.directions[:, 0] @ along) > 1 - 0.5 * (8e-4) ** 2
    seen, scatter = slopes(found.window)
    strongest = int(np.argmax(np.abs(along)))
    # sensor's noise 0.005 over 0.1 m/s2 and 6000 points: 7e-4 relative, four of them, over the channel's own share
    assert np.abs(seen[:, 0] - S @ along / along[strongest]).max() < 4 * 7e-4 / abs(along[strongest])
    assert scatter.max() < 3.0  # white noise: 1; a collinear channel left in made it 1e3 to 1e8


@pytest.mark.parametrize(("directions", "channels"), [(np.eye(3), 3), (np.array([[1.0, 0, 0], [0, 0.6, 0.8]]), 2)])
def test_independent_motions_are_as_many_channels(directions: np.ndarray, channels: int) -> None:
    found = excited(window(directions))
    assert found.directions.shape == (3, channels)
    inside = found.directions @ found.directions.T @ directions.T
    assert np.abs(inside - directions.T).max() < 2e-3
    assert found.attenuation < 1e-4


def test_noise_alone_is_no_motion() -> None:
    found = excited(window(np.array([[0.0, 1.0, 0.0]]), level_mps2=0.002))
    assert found.directions.shape[1] == 0
