"""A structure that also moves across a uniaxial reference, another way in each window and at each frequency."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.online import bridge
from benchmarks.online.life import MAIN, House
from calib import calibrate
from calib.model import Array, BandSums, Pose
from calib.signal.response import POWERS
from calib.windows.banded import Banded, banded
from calib.windows.bands import along_motion, band_sums
from calib.windows.condense import condense
from tests.clamp_windows import S_TRUE, window_of

RATE_HZ, SECONDS = 100.0, 120
DIRECTION = np.array([0.6, 0.0, 0.8])
HOURS = 8


def moved(
    seed: int, across: float, noise: float, S: Array = S_TRUE, way: Array = DIRECTION
) -> tuple[Array, Array, Array]:
    """u (n, 1), du (n, 1) and V (n, 3): motion to 20 Hz, and across it another one, of which a part follows u in a way
    that changes from octave to octave."""
    random, n = np.random.default_rng(seed), round(RATE_HZ * SECONDS)
    hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    within = (hz > 0.5) & (hz < 20.0)
    lines = np.fft.rfft(random.standard_normal((n, 3)), axis=0) * within[:, None]
    follows = random.standard_normal((8, 2))[np.clip(np.log2(np.maximum(hz, 0.5)) + 1.0, 0, 7).astype(int)]
    lines[:, 1:] = across * (follows * lines[:, :1] + lines[:, 1:])
    own, one, other = np.fft.irfft(lines, n, axis=0).T
    du = np.fft.irfft(2j * np.pi * hz * lines[:, 0], n)
    ways = np.linalg.svd(way[None])[2][1:]
    a = np.outer(own, way) + np.outer(one, ways[0]) + np.outer(other, ways[1])
    return own[:, None], du[:, None], a @ S.T + noise * random.standard_normal((n, 3))


def told(bands: BandSums) -> Banded:
    omega2 = np.array([(2.0 * np.pi * 12.0) ** 2])
    return banded([bands], 1, 20.0, omega2, omega2[:, None], powers=len(POWERS))


def test_motion_across_is_no_response_over_frequency() -> None:
    """With three outputs the bands deviate by tens of per cent from one response; along the motion by what S, which is
    not the identity, mixes into it."""
    for seed in range(6):
        bands = band_sums(*moved(seed, 0.4, 1e-3), RATE_HZ)
        assert bands is not None
        assert told(bands).between.relative_u > 0.1, seed
        one = told(along_motion(bands, DIRECTION)).between
        assert one.relative_u < 0.03, seed


@pytest.mark.slow
@pytest.mark.parametrize("turned", [False, True], ids=["as it stands", "outputs exchanged"])
def test_response_is_told_as_well_by_the_output_along_the_motion(turned: bool) -> None:
    """Without motion across, the response is told to the same from one output as from three, also where the outputs are
    other ones than the axes. 8 windows each, U of what they tell within 3 %."""
    S = S_TRUE[[2, 0, 1]] if turned else S_TRUE
    for seed in range(8):
        bands = band_sums(*moved(seed, 0.0, 0.02, S), RATE_HZ)
        assert bands is not None
        three, one = told(bands), told(along_motion(bands, DIRECTION))
        sizes = [np.sqrt(np.sum(found.moves**2, axis=0)) for found in (three, one)]
        assert sizes[1] == pytest.approx(sizes[0], rel=0.1), seed
        assert one.between.relative_u == 0.0, seed


def test_a_windows_bands_are_those_along_its_motion() -> None:
    """The condensed windows of a uniaxial reference use them."""
    u, du, V = moved(1, 0.4, 1e-3)
    bands = band_sums(u, du, V, RATE_HZ)
    pose = Pose("along", DIRECTION[:, None], np.full(3, np.nan))
    window = replace(window_of(pose, u, du, V, 12), bands=bands)
    data = condense([window], response_hz=20.0)
    assert data.bands is not None
    assert data.bands.between.relative_u < 0.03


@pytest.mark.one_case
@pytest.mark.parametrize("across", [0.0, 0.3])
def test_calibrate_counts_the_motion_across_that_the_sensor_shows(across: float) -> None:
    """With the default of 1 %: S of a sensor along z, of which the outputs x and y show motion across. What it tells of
    S is right, and there is a warning; none where nothing moves across. 3 recordings."""
    for seed in range(3):
        S = np.eye(3) + 0.01 * np.random.default_rng([seed, 1]).standard_normal((3, 3))
        u, _, V = moved(seed, across, 0.01, S, np.array([0.0, 0.0, 1.0]))
        time_s = np.arange(len(u)) / RATE_HZ
        poses = [{"start_s": 1.0, "stop_s": SECONDS - 1.0, "dx": 0.0, "dy": 0.0, "dz": 1.0}]
        told = calibrate((time_s, V), {"time_s": time_s, "a": u[:, 0]}, poses=poses, reference_coupling="dc")
        known = np.array(told.determined)[:9]
        error = (np.array(told.sensitivity) - S).ravel()[known] / np.array(told.standard_uncertainty)[:9][known]
        assert told.status == "valid", told.reasons
        assert known[8]
        assert np.abs(error).max() < 3.5, seed
        assert any("across" in warning for warning in told.warnings) == (across > 0.0), seed


def beside_one_axis(u: Array, V: Array) -> Any:
    time_s = np.arange(len(u)) / RATE_HZ
    poses = [{"start_s": 1.0, "stop_s": SECONDS - 1.0, "dx": 0.0, "dy": 0.0, "dz": 1.0}]
    return calibrate((time_s, V), {"time_s": time_s, "a": u[:, 0]}, poses=poses, reference_coupling="dc")


@pytest.mark.slow
def test_outputs_that_are_copies_are_no_motion_across() -> None:
    """A logger that has one channel three times: what the outputs have in common is not taken out of the one along."""
    u, _, V = moved(1, 0.5, 0.01, np.eye(3), np.array([0.0, 0.0, 1.0]))
    told = beside_one_axis(u, V[:, [2, 2, 2]] + 1e-3 * np.random.default_rng(7).standard_normal(V.shape))
    assert told.status == "refused"
    assert "the sensor is turned against what was stated" in told.reasons[0]


@pytest.mark.slow
@pytest.mark.parametrize("across", [0.5, 1.5])
def test_s_along_the_reference_is_right_where_a_structure_moves_as_much_across(across: float) -> None:
    """What it moves across follows what it moves along differently in each octave, by its modes. S is off by 3 % in
    each element: uncorrected, 1.5 times that would be in S_zz. 3 recordings of two minutes."""
    for seed in range(3):
        S = np.eye(3) + 0.03 * np.random.default_rng([seed, 1]).standard_normal((3, 3))
        u, _, V = moved(seed, across, 0.01, S, np.array([0.0, 0.0, 1.0]))
        told = beside_one_axis(u, V)
        assert told.status == "valid", told.reasons
        assert list(np.flatnonzero(told.determined.ravel()[:9])) == [8]
        assert told.standard_uncertainty[8] < 0.005
        assert abs(told.sensitivity[2, 2] - S[2, 2]) < 3.5 * told.standard_uncertainty[8], seed
        assert "was taken out of output z" in told.warnings[0]


@pytest.mark.slow
def test_one_mode_alone_tells_s_along_only_as_well_as_transverse_sensitivities_are_known() -> None:
    """x moves half as much as z, and only with it: V_z shows S_zz + 0.5 S_zx."""
    for seed in range(3):
        random = np.random.default_rng([seed, 2])
        S = np.eye(3) + 0.03 * random.standard_normal((3, 3))
        u, _, _ = moved(seed, 0.0, 0.0, S, np.array([0.0, 0.0, 1.0]))
        V = u * [0.5, 0.0, 1.0] @ S.T + 0.01 * random.standard_normal((len(u), 3))
        told = beside_one_axis(u, V)
        assert told.status == "valid", told.reasons
        assert 0.01 < told.standard_uncertainty[8] < 0.03
        assert abs(told.sensitivity[2, 2] - S[2, 2]) < 3.0 * told.standard_uncertainty[8], seed


def hours(transverse_pct: float) -> House:
    """The bridge beside a vertical reference for some windows, an hour apart."""
    made = bridge.world(bridge.SEED + 1, "vertical", bridge.SENSORS[0], transverse_pct)
    channel = made.config.channels[0]
    gate = channel.gate.model_copy(update={"explain_after_s": 3600.0})
    config = made.config.model_copy(update={"channels": (channel.model_copy(update={"gate": gate}),)})
    house = House(made.bridge, config)
    for _ in range(HOURS):
        house.visit()
    return house


@pytest.mark.thorough
def test_a_bridge_beside_a_vertical_reference_is_calm_where_its_motion_across_is_stated() -> None:
    gateway = hours(50.0).gateway
    update = gateway.in_force
    assert update is not None
    assert gateway.status == "VALID"
    judged = [report for report in gateway.reports if "innovation_chi2" in report.numbers]
    assert len(judged) >= HOURS
    assert all(report.used for report in judged)
    truth = gateway.truth.copy()
    u = np.array(update.standard_uncertainty)
    assert list(np.array(update.determined)[MAIN]) == [False, False, True]
    assert abs(np.ravel(update.sensitivity)[8] - truth[8]) < 3.0 * u[8]
    assert u[8] < 0.003


@pytest.mark.thorough
def test_motion_across_that_is_not_stated_is_named_and_not_an_inverted_output() -> None:
    reasons = hours(1.0).gateway.reasons
    assert any("moves across the reference" in reason and "transverse_motion_pct to" in reason for reason in reasons)
    assert not any("inverted" in reason for reason in reasons)
