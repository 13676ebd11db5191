"""Motion in a plane or along a line that is not along the axes: what no direction excites stays unknown, whatever the
reference's noise says of it. Before, a tone on an ellipse was "valid" with 9 of 9 elements, S wrong by 0.8 (34 U)."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent.core.snapshot import pack, unpack
from calib.adjustment.adjustment import adjust
from calib.estimate.nuisances import Priors
from calib.estimate.wander import TemperatureModel
from calib.model import Window
from calib.recorded.notebook import calibrate
from calib.recorded.outcome import Outcome
from calib.state.state import State
from calib.windows.record import Record
from tests.building_windows import building_window
from tests.planar_world import Made, World, calibrated, made
from tests.unit.test_state import FIXED, MEAN, STILL, U

NORMAL = re.compile(r"\((-?[\d.e-]+), (-?[\d.e-]+), (-?[\d.e-]+)\) in the sensor's axes x, y, z")


def named(outcome: Outcome) -> np.ndarray:
    """The direction that the refusal names."""
    found = NORMAL.search(outcome.reasons[0])
    assert found, outcome.reasons
    return np.array([float(part) for part in found.groups()])


def z_of(outcome: Outcome, of: Made) -> np.ndarray:
    """Errors over standard uncertainties of the elements of S that are determined."""
    told = outcome.determined[:9]
    return ((outcome.values[:9] - of.sensitivity.ravel()) / outcome.standard_uncertainty[:9])[told]


@pytest.mark.two_cases
@pytest.mark.parametrize("kind", ["ellipse", "tones", "band"])
@pytest.mark.parametrize("starts_and_stops", [False, True])
def test_a_plane_tells_no_element_and_its_normal_is_named(kind: str, starts_and_stops: bool) -> None:
    world = World(kind, starts_and_stops)  # type: ignore[arg-type]
    for seed in range(1 if kind == "ellipse" else 2):
        of = made(world, seed)
        outcome = calibrated(world, of)
        assert outcome.status == "refused"
        assert not outcome.determined.any()
        # The gains of the reference's channels, known to 0.1 %, turn the normal; its noise does so by 1e-5.
        assert np.abs(np.abs(named(outcome)) - np.abs(of.axes[:, 2])).max() < 4e-3
        assert np.abs(outcome.more["unexcited_directions"] @ of.axes[:, 2]) == pytest.approx([1.0], abs=1e-5)


@pytest.mark.one_case
@pytest.mark.parametrize("starts_and_stops", [False, True])
def test_a_tone_is_told_at_its_own_frequency(starts_and_stops: bool) -> None:
    """Before, at 10 to 28 Hz, where there is noise alone."""
    world = World("ellipse", starts_and_stops)
    outcome = calibrated(world, made(world, 1))
    assert outcome.reference_frequency_hz == pytest.approx(6.0, abs=0.01)


@pytest.mark.slow
def test_one_direction_is_named_as_such() -> None:
    world = World("band", directions=1)
    of = made(world, 3)
    outcome = calibrated(world, of)
    assert "all motion that the reference measures is along one direction" in outcome.reasons[0]
    assert np.abs(np.abs(named(outcome)) - np.abs(of.axes[:, 0])).max() < 4e-3


def test_planes_that_change_determine_everything_together() -> None:
    for world in (World("band", planes=2), World("tones", planes=3)):
        of = made(world, 1)
        outcome = calibrated(world, of)
        assert outcome.determined[:9].all()
        assert np.abs(z_of(outcome, of)).max() < 4.0
        assert outcome.standard_uncertainty[:9].max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("third", "determined"), [(1.0, 0), (10.0, 9), (30.0, 9)])
def test_a_weak_motion_along_the_normal_counts_where_it_is_more_than_noise(third: float, determined: int) -> None:
    world = World("band", third=third)
    of = made(world, 2)
    outcome = calibrated(world, of)
    assert np.count_nonzero(outcome.determined[:9]) == determined
    assert np.abs(z_of(outcome, of)).max(initial=0.0) < 4.0


@pytest.mark.slow
def test_what_is_known_of_combinations_goes_into_the_next_calibration() -> None:
    """Each of two recordings in two planes determines no element; the second one with the first as prior, all."""
    first = made(World("band"), 11)
    second = made(World("band"), 12, first.sensitivity)
    options = {"reference_coupling": "ac", "rotation": np.eye(3)}
    before, alone = (calibrate((of.time_s, of.V), (of.time_s, of.u), **options) for of in (first, second))
    assert not before.determined.any()
    assert not alone.determined.any()
    for prior in (before, json.loads(before.to_json())):
        both = calibrate((second.time_s, second.V), (second.time_s, second.u), prior=prior, **options)
        assert both.determined[:9].all()
        assert np.abs(z_of(both, second)).max() < 4.0
        assert both.standard_uncertainty[:9].max() < 0.01
        assert both.more["joint"] is None


def windows_along(direction: np.ndarray, count: int, seed: int, S: np.ndarray) -> list[Window]:
    """Windows of 0.1 m/s2 along a direction, beside a reference with noise of 1 mm/s2."""
    random, sigma = np.random.default_rng(seed), 1e-3
    noise = np.array([np.full(3, sigma), np.zeros(3)])
    windows = (building_window(random, reference_noise_mps2=sigma, S=S, direction=direction) for _ in range(count))
    return [replace(window, reference_noise=noise) for window in windows]


@pytest.mark.one_case
@pytest.mark.parametrize("direction", [(0.003, 1.0, -0.002), (0.6, 0.64, 0.48)])
def test_noise_tells_nothing_of_s_across_the_motion_however_many_windows_there_are(
    direction: tuple[float, ...],
) -> None:
    """Before, windows moved S across the motion by 0.5 of its prior u towards 0, and without a prior to 0."""
    along, u = np.array(direction) / np.linalg.norm(direction), np.where(np.eye(3), 0.02, 0.01)
    S = np.eye(3) + u * np.random.default_rng(4).normal(size=(3, 3))
    windows = windows_along(along, 120, 5, S)
    covariance = np.diag(np.append(u.ravel(), np.full(3, 0.5)) ** 2)
    stated: dict[str, Any] = {"offset_mps2": 0.002, "gravity_direction_rad": 0.002}
    known = adjust(windows, Priors({}, np.append(np.eye(3), np.zeros(3)), covariance, **stated))
    across = np.linalg.svd(along[None])[2][1:]
    of_row = [known.mean[3 * i : 3 * i + 3] - np.eye(3)[i] for i in range(3)]
    told = [own @ np.linalg.inv(np.diag(u[i] ** 2)) @ way for i, own in enumerate(of_row) for way in across]
    # What correlates with S along the motion moves with it; what does not, across the motion in units of u, stays.
    size = [np.linalg.norm(way / u[i]) for i in range(3) for way in across]
    assert np.abs(np.array(told) / size).max() < 0.02
    unknown = adjust(windows)
    assert not unknown.calibration.determined[[0, 2, 3, 5, 6, 8]].any()
    assert unknown.rank == 2


@pytest.mark.one_case
@pytest.mark.parametrize("fixed", [True, False])
def test_on_line_s_across_the_motion_stays_at_the_prior_through_days_and_a_restart(fixed: bool) -> None:
    """Noise turns the directions of each window. Before, 120 windows moved S across the motion by a third of its u.
    At the end of each day old windows are merged."""
    along = np.array([0.6, 0.64, 0.48])
    S = MEAN[:9].reshape(3, 3) + 0.03 * np.random.default_rng(6).normal(size=(3, 3))

    def begun() -> State:
        return State(MEAN, U, FIXED, STILL, TemperatureModel(), fixed=fixed)

    found, far = begun(), []
    for k, window in enumerate(windows_along(along, 60, 7, S)):
        if k == 30:
            state = unpack(pack(found.snapshot()))
            found = begun()
            found.load(state)
        found.update(Record.of(window, k / 24))
        far.append(found.result().sensitivity)
    across = np.linalg.svd(along[None])[2][1:]
    assert np.abs((far[-1] - far[0]) @ across.T).max() < 0.05 * 0.03
    assert np.abs((far[-1] - S) @ along).max() < 4e-3
    assert len(found.unexcited) == 2
    assert np.abs(found.unexcited @ along).max() < 4e-3
