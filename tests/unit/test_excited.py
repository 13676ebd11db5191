"""Which channels of a reference were excited: one motion askew to the channels is one, however many show it."""

from __future__ import annotations

import numpy as np
import pytest

from calib.adjustment.equations import Equations
from calib.adjustment.slope_scatter import SlopeScatter
from calib.estimate.nuisances import Applied, Priors
from calib.geometry import beside
from calib.model import Window
from calib.windows.condense import condense
from calib.windows.excited import Excitation, excited
from calib.windows.sums import window_sums

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


def slopes(found: Excitation) -> tuple[np.ndarray, np.ndarray]:
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
    seen, scatter = slopes(found)
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


def test_what_a_silent_channel_shares_is_that_of_slow_motion_too() -> None:
    """Slow turning moves more between segments than within them, and a silent channel may share more of the slow motion
    than of the fast one. Before, the share within segments was taken for that of all: S was 1.6 % wrong here."""
    random, t = np.random.default_rng(1), np.arange(6000) / RATE_HZ
    omega = 2.0 * np.pi * np.array([0.05, 3.0])
    slow, fast = (np.sin(w * t) for w in omega)
    a = np.column_stack([0.02 * slow, slow + 0.1 * fast, np.zeros(len(t))])
    du = np.column_stack([0.02 * omega[0] * np.cos(omega[0] * t), np.cos(omega * t[:, None]) @ (omega * [1, 0.1])])
    u = a + NOISE_MPS2 * random.normal(size=a.shape)
    du = np.pad(du, ((0, 0), (0, 1))) + NOISE_MPS2 * 30.0 * random.normal(size=a.shape)
    sums = window_sums(u, du, a @ S.T, np.arange(0, len(t) + 1, 50))
    noise = np.array([np.full(3, NOISE_MPS2), np.full(3, 30.0 * NOISE_MPS2)])
    found = excited(Window(0.0, 60.0, beside(np.eye(3)), sums, True, "", len(t), 0, reference_noise=noise))
    assert found.live.tolist() == [False, True, False]
    assert found.pose.along is not None
    seen, _ = slopes(found)
    assert seen[:, 0] == pytest.approx(S @ found.pose.along[:, 1], abs=2e-4)  # noise 1e-3 over 0.7 and 6000 points


def test_noise_alone_is_no_motion() -> None:
    found = excited(window(np.array([[0.0, 1.0, 0.0]]), level_mps2=0.002))
    assert found.directions.shape[1] == 0


@pytest.mark.parametrize("share", [0.0094, 0.0097, 0.01, 0.0103, 0.0106])
def test_what_is_excited_stays_so_in_the_equations(share: float) -> None:
    """A weak motion of 1 % with ten times the power of its noise: subtracting that noise must not make it silent."""
    found = excited(window(np.array([[0.0, 1.0, 0.0], [share, 0.0, 0.0]]), level_mps2=0.35))
    rows = int(np.count_nonzero(np.diag(condense([found]).root[0])[:3]))
    assert rows == found.directions.shape[1]


def test_a_silent_channel_that_moves_ahead_of_the_others_turns_the_motion_s_derivative() -> None:
    """0.8 % of the motion along y appears along x, 90 deg ahead of it at 3 Hz: as 0.8 % / omega of its derivative."""
    n, ahead_s, random = 6000, 0.008 / (2 * np.pi * 3.0), np.random.default_rng(1)
    omega = 2 * np.pi * np.array([2.7, 3.0, 3.4])
    phase = np.arange(n)[:, None] / RATE_HZ * omega + random.uniform(0.0, 2 * np.pi, 3)
    y, dy, ddy = np.sin(phase).sum(axis=1), np.cos(phase) @ omega, np.sin(phase) @ -(omega**2)
    a, da = np.column_stack([ahead_s * dy, y, 0 * y]), np.column_stack([ahead_s * ddy, dy, 0 * y])
    u, du = (x + 1e-4 * random.normal(size=x.shape) for x in (a, da))
    V = a @ S.T + 1e-3 * random.normal(size=a.shape)
    sums = window_sums(u, du, V, np.arange(0, n + 1, 50))
    noise = np.full((2, 3), 1e-4)
    found = excited(Window(0.0, 60.0, beside(np.eye(3)), sums, True, "", n, 0, reference_noise=noise))
    assert found.pose.along is not None
    assert found.pose.along_rate_s is not None
    u_slope = 1e-3 / (np.sqrt(n) * y.std())  # of a slope of V on y; that on its derivative is omega times smaller
    assert abs(found.pose.along_rate_s[0, 1] - ahead_s) < 4 * u_slope / omega.mean()
    assert np.abs(found.pose.along[[0, 2], 1]).max() < 4 * u_slope
    data = condense([found])
    equations = Equations(data, [found.pose], Priors.none(), Applied(), SlopeScatter.of(data))
    rows = equations.at(np.append(S.ravel(), np.zeros(3)))
    live = np.diag(data.root[0]) > 0.0
    # Four rows of three outputs at most; without the motion ahead the row of the derivative is 30 SDs off.
    assert np.abs(rows.slope[0][live]).max() < 4.0


@pytest.mark.parametrize(("share", "channels"), [(0.01, 1), (0.09, 2), (1.0, 2)])
def test_a_weak_channel_90_deg_ahead_is_no_motion_of_its_own_unless_the_derivative_leaves_more_than_noise(
    share: float, channels: int
) -> None:
    """x is the motion along y, 90 deg ahead at all frequencies, times `share`: u and du/dt of y explain most of it."""
    n, random = 6000, np.random.default_rng(2)
    lines = np.fft.rfftfreq(n, 1 / RATE_HZ)
    y = ((lines > 0.5) & (lines < 10.0)) * (random.normal(size=(len(lines), 2)) @ [1, 1j])
    a = np.fft.irfft(np.column_stack([1j * share * y, y, 0 * y]), n, axis=0)
    scale = 0.32 / a[:, 1].std()
    da = np.fft.irfft(np.fft.rfft(a, axis=0) * (2j * np.pi * lines[:, None]), n, axis=0)
    u = scale * a + NOISE_MPS2 * random.normal(size=a.shape)
    du = scale * da + NOISE_MPS2 * 30.0 * random.normal(size=a.shape)
    sums = window_sums(u, du, scale * a @ S.T + 0.005 * random.normal(size=a.shape), np.arange(0, n + 1, 50))
    noise = np.array([np.full(3, NOISE_MPS2), np.full(3, 30.0 * NOISE_MPS2)])
    found = excited(Window(0.0, 60.0, beside(np.eye(3)), sums, True, "", n, 0, reference_noise=noise))
    assert found.directions.shape == (3, channels)


def test_motion_slower_than_a_segment_excites_too() -> None:
    """A tower at 0.2 Hz, weakly beside its other axis: within segments of half a second the channel has hardly more
    than its noise, between them thirty times as much. Before, its motion was left to the other channels."""
    random, t = np.random.default_rng(1), np.arange(6000) / RATE_HZ
    omega = 2.0 * np.pi * np.array([0.2, 0.23, 0.26])
    size = np.array([0.03, 0.01, 0.01])
    a, da = size * np.sin(omega * t[:, None]), size * omega * np.cos(omega * t[:, None])
    noise = np.array([np.full(3, NOISE_MPS2), np.full(3, 30.0 * NOISE_MPS2)])
    u, du = (x + own[0] * random.normal(size=a.shape) for x, own in zip((a, da), noise, strict=True))
    sums = window_sums(u, du, a @ S.T, np.arange(0, len(t) + 1, 50))
    found = excited(Window(0.0, 60.0, beside(np.eye(3)), sums, True, "", len(t), 0, reference_noise=noise))
    assert found.live.all()
