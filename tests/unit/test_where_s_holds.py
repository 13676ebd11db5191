"""At which frequency S is told, in which band it is right, and what is said where no response can be told."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from calib import calibrate
from calib.estimate.nuisances import Priors
from calib.geometry import clamp
from calib.recorded.adjusting import adjusted
from calib.recorded.outcome import Outcome
from calib.signal.known_response import UNKNOWN, KnownResponse, known_response_of
from tests.pair import Filter, Pair, flat, lowpass, pair

RATE_HZ, STAY_S, TURN_S, GRAVITY_MPS2, TONE_HZ = 100.0, 8.0, 2.0, 9.81, 7.8


def turned_by_hand(response: Filter, shaken_mps2: float, one_in: int, **stated: Any) -> tuple[Outcome, np.ndarray]:  # type: ignore[type-arg]
    """Two triads on one board in 14 stays, turned by hand between them; one in `one_in` of the stays is shaken with
    TONE_HZ. `response` is that of the sensor. The outcome, and S at 0 Hz."""
    random = np.random.default_rng(0)
    S = np.eye(3) + 0.02 * random.normal(size=(3, 3))
    ways = random.normal(size=(15, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    stay, turn = int(STAY_S * RATE_HZ), int(TURN_S * RATE_HZ)
    rise = (0.5 - 0.5 * np.cos(np.pi * np.arange(turn) / turn))[:, None]
    t = np.arange(stay - 250) / RATE_HZ
    parts = []
    for k, (here, there) in enumerate(itertools.pairwise(ways)):
        a = np.tile(GRAVITY_MPS2 * here, (stay, 1))
        wave = np.sin(2.0 * np.pi * TONE_HZ * t[:, None] + random.uniform(0.0, 6.28, 3))
        a[150:-100] += shaken_mps2 * wave * np.hanning(len(t))[:, None] ** 0.25 * (k % one_in == 0)
        v = here + rise * (there - here)
        parts += [a, GRAVITY_MPS2 * v / np.linalg.norm(v, axis=1)[:, None]]
    a = np.concatenate(parts)
    frequency_hz = np.fft.rfftfreq(2 * len(a), 1.0 / RATE_HZ)  # there and back, so that no end jumps
    frequency_hz[0] = 1e-9
    lines = np.fft.rfft(np.concatenate([a, a[::-1]]), axis=0) * response(frequency_hz)[:, None]
    felt = np.fft.irfft(lines, axis=0)[: len(a)]
    V, u = (x + 0.01 * random.normal(size=a.shape) for x in (felt @ S.T + 0.1, a))
    t = np.arange(len(a)) / RATE_HZ
    reference = {"time_s": t, "ax": u[:, 0], "ay": u[:, 1], "az": u[:, 2]}
    return calibrate((t, V), reference, rotation=np.eye(3), u_reference_pct=0.02, **stated), S


STATED = {"sensor_filter": "lowpass order=2 corner_hz=9", "reference_filter": "flat"}


@pytest.mark.two_cases
@pytest.mark.parametrize(
    ("response", "stated", "shaken_mps2", "one_in"),
    [
        (lowpass(2, 9.0), {}, 2.0, 2),
        (lowpass(1, 12.0), {}, 0.2, 5),
        (lowpass(2, 10.0), STATED, 0.2, 5),  # the filter is not what is stated
    ],
)
def test_s_at_0_hz_is_told_by_rests_alone(
    response: Filter, stated: dict[str, str], shaken_mps2: float, one_in: int
) -> None:
    """A corner near the only tone: how far S changes from 7.8 Hz to 0 Hz is a prior, and S at 0 Hz was up to 16 % (9 U)
    off. Rests are right, whatever a filter does to the tone."""
    found, S = turned_by_hand(response, shaken_mps2, one_in, **stated)
    assert found.status == "valid", found.reasons
    assert found.reference_frequency_hz == 0.0
    away = np.abs(found.sensitivity - S)
    assert away.max() < 2e-3
    assert np.all(away.ravel() < found.expanded_uncertainty[:9])
    assert "S holds at 0 Hz, told by rests alone" in found.where_it_holds


@pytest.mark.two_cases
@pytest.mark.parametrize(
    ("response", "shaken_mps2"),
    [
        (lowpass(1, 22.4), 2.8),
        (lowpass(2, 11.1), 1.0),
        (lowpass(1, 24.0), 0.21),
        (lowpass(2, 25.4), 0.87),
        (lowpass(4, 12.0), 0.1),
    ],
)
def test_one_tone_in_all_stays_tells_s_at_its_frequency(response: Filter, shaken_mps2: float) -> None:
    """Each window of a tone on an ellipse fits several lags, each with another S. The search gave each window a lag of
    its own before it had found the common one, and S was 7 to 24 u off and valid in each of these."""
    found, S = turned_by_hand(response, shaken_mps2, 1)
    assert found.status == "valid", found.reasons
    at_hz = found.reference_frequency_hz
    assert at_hz == pytest.approx(TONE_HZ, abs=0.02)
    away = np.abs(found.sensitivity - S * abs(response(np.array([TONE_HZ]))[0])).ravel()
    assert np.all(away < 4.0 * found.standard_uncertainty[:9])


@pytest.mark.nightly
def test_a_reversed_reference_is_no_lag_of_half_a_period() -> None:
    """Half a period later, a tone of the other sign fits as well: what is refused for its sign stays refused."""
    random = np.random.default_rng(16)
    t, values, motion, poses = np.arange(2000) / RATE_HZ, [], [], []
    for k, alpha_deg in enumerate((0.0, 30.0, 90.0, 150.0, 180.0, 240.0, 270.0, 330.0)):
        pose = clamp(np.deg2rad(40.2), np.deg2rad(alpha_deg + 0.2 * random.normal()))
        a = 3.83 * np.sin(2.0 * np.pi * 4.4 * t + random.uniform(0.0, 6.28)) * np.hanning(len(t)) ** 0.15
        lines = np.fft.rfft(np.concatenate([a, a[::-1]])) * lowpass(1, 10.2)(np.fft.rfftfreq(2 * len(a), 1.0 / RATE_HZ))
        felt = np.fft.irfft(lines)[: len(a)]
        values.append(np.outer(felt, pose.direction) + pose.gravity_mps2 + 0.1)
        motion.append(-a)
        poses.append({"start_s": 20.0 * k + 0.5, "stop_s": 20.0 * k + 19.5, "theta_deg": 40.0, "alpha_deg": alpha_deg})
    V, u = np.concatenate(values), np.concatenate(motion)
    V, u = V + 0.005 * random.normal(size=V.shape), u + 0.001 * random.normal(size=u.shape)
    t = np.arange(len(u)) / RATE_HZ
    found = calibrate((t, V), {"time_s": t, "a": u}, poses=poses)
    assert found.status == "refused"
    assert "polarity of the reference reversed" in found.reasons[0]


def test_two_tones_tell_s_at_their_mean_frequency_by_power() -> None:
    """Three axes of two tones have four independent parts, with their derivatives: what one part alone tells of the
    frequency may lie far outside of them (here 10.3 Hz)."""
    random = np.random.default_rng(37)
    t = np.arange(6000) / RATE_HZ
    tones = [1.5 * np.sin(2.0 * np.pi * hz * t[:, None] + random.uniform(0.0, 6.28, 3)) for hz in (6.4, 8.3)]
    a = tones[0] + tones[1]
    V, u = (x + 0.02 * random.normal(size=a.shape) for x in (a, a))
    found = calibrate((t, V), {"time_s": t, "ax": u[:, 0], "ay": u[:, 1], "az": u[:, 2]}, rotation=np.eye(3))
    assert found.reference_frequency_hz == pytest.approx(np.sqrt((6.4**2 + 8.3**2) / 2.0), rel=0.02)


@pytest.mark.slow
def test_s_at_a_stated_frequency_stays_there() -> None:
    found, _ = turned_by_hand(lowpass(1, 100.0), 0.2, 5, reference_frequency_hz=TONE_HZ)
    assert found.reference_frequency_hz == TONE_HZ
    assert "S holds at 7.8 Hz" in found.where_it_holds


def tones(u_reference_pct: float, **stated: Any) -> Outcome:
    """Motion of 3 Hz and 9 Hz, along one axis after the other."""
    random, stamps, given, poses = np.random.default_rng(0), [], [], []
    S = np.eye(3) + 0.02 * random.normal(size=(3, 3))
    for k in range(6):
        t = np.arange(4000) / 200.0 + 25.0 * k
        a = np.sin(2.0 * np.pi * 3.0 * t) + 0.25 * np.sin(2.0 * np.pi * 9.0 * t)
        along = np.eye(3)[k % 3]
        stamps.append(t)
        given.append(np.column_stack([np.outer(a, S @ along), a]) + 0.005 * random.normal(size=(len(t), 4)))
        poses.append({"start_s": t[0], "stop_s": t[-1], "dx": along[0], "dy": along[1], "dz": along[2]})
    t, rows = np.concatenate(stamps), np.concatenate(given)
    return calibrate(
        (t, rows[:, :3]),
        {"time_s": t, "a": rows[:, 3]},
        poses,
        coupling="ac",
        u_reference_pct=u_reference_pct,
        **stated,
    )


@pytest.mark.slow
@pytest.mark.parametrize("u_reference_pct", [0.1, 0.5])
def test_the_band_in_which_s_is_right_is_judged_for_each_element(u_reference_pct: float) -> None:
    """u of a transverse element decided on the main ones: "from 3.49 to 3.78 Hz" excluded the motion that was used."""
    found = tones(u_reference_pct)
    low_hz, high_hz = found.more["valid_band_hz"]
    if u_reference_pct == 0.5:
        assert low_hz == 0.0
        assert high_hz == pytest.approx(5.94, abs=0.05)
    attenuation = next(n for n in found.nuisances if n.name == "attenuation")
    most = abs(attenuation.value) + found.coverage_factor * attenuation.standard_uncertainty
    told = np.isfinite(found.values[:9])
    off = most * abs((high_hz / found.reference_frequency_hz) ** 2 - 1.0) * np.abs(found.values[:9][told])
    over = off / (found.expanded_uncertainty[:9][told] / 3.0)
    assert over.max() == pytest.approx(1.0, rel=0.01)  # of the element that decides


def test_s_at_0_hz_is_printed_beside_another_frequency() -> None:
    found = tones(0.1)
    steady = found.more["sensitivity_at_0hz"]["sensitivity"]
    assert "S holds at 3.64 Hz" in repr(found)
    assert f"at 0 Hz: Sxx {steady[0, 0]:.4f} ± " in repr(found)


def test_a_stated_band_leaves_the_motion_beyond_it_out() -> None:
    found = tones(0.1, band_hz=(1.0, 5.0))
    assert found.reference_frequency_hz == pytest.approx(3.0, abs=0.05)
    assert "only motion from 1 to 5 Hz was used" in repr(found)


def weak(known: KnownResponse) -> tuple[Pair, Outcome]:
    """30 s of slow motion beside noise of the same size in the sensor, and an eighth of it in the reference."""
    made = pair(
        2, flat, band_hz=(0.3, 2.0), rate_hz=20.0, seconds=30.0, noise_mps2=0.8, reference_noise_mps2=0.1, known=known
    )
    main = np.eye(3).ravel() > 0.0
    covariance = np.diag(np.append(np.where(main, 0.05, 0.03) ** 2, np.full(3, np.inf)))
    stated = Priors(parameters=np.append(np.eye(3).ravel(), np.zeros(3)), covariance=covariance)
    return made, adjusted(made.files, stated.beside_known(known) if known.is_stated else stated)


@pytest.mark.slow
def test_a_response_that_noise_makes_up_is_refused_with_a_remedy_that_works() -> None:
    """Terms of the response up to ten times what filters have; with none left to the data S is right."""
    _, found = weak(UNKNOWN)
    (reason,) = found.reasons
    assert "state `sensor_filter` flat `reference_filter` flat" in reason
    made, found = weak(known_response_of(["flat"], ["flat"]))
    assert found.status == "valid"
    away = np.abs(found.sensitivity - made.sensitivity).ravel()
    assert np.all(away < found.expanded_uncertainty[:9])


@pytest.mark.thorough
def test_the_remedy_is_not_named_where_it_would_not_work() -> None:
    """A resonance within the motion is no flat filter."""
    made = pair(3, lambda f: 1.0 / (1.0 - (f / 4.0) ** 2 + 0.1j * f / 4.0))
    (reason,) = adjusted(made.files, Priors()).reasons
    assert "flat" not in reason
