"""A sensor that is turned and nobody tells: blocks into the pipeline, positions out of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from agent.config import Config, ConfigError, parse_config
from agent.core.events import Command, DeviceChange, Output, StatusChange, WindowReport
from agent.core.pipeline import Pipeline
from agent.core.positions import FoundPositions
from hw.block import BlockFlags, DeviceInfo, SampleBlock

SECOND = 1_000_000_000
EPOCH_NS = 1_790_000_000 * SECOND
RATE_HZ = 50.0
G_MPS2 = 9.80665
FACES = G_MPS2 * np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, -1, 0]])
STAY_S, TURN_S = 17.0, 3.0
# A change is found to two means of 0.25 s; a window at rest begins and ends with whole pieces of rest, 0.3 s.
FOUND_S, TRIMMED_S, GUARD_S = 0.5, 0.5, 0.5
OFFSET_MPS2 = np.array([0.1, -0.2, 0.15])
NAMES = ("rest (0, 0, 9.80665)", "rest (9.80665, 0, 0)", "rest (0, 9.80665, 0)", "rest (0, -9.80665, 0)")


def configured(**keys: Any) -> Config:
    channel: dict[str, Any] = {
        "sensor": "s",
        "prior": {"u_offset_mps2": 0.5},
        "positions": [{"gravity_mps2": face} for face in FACES.tolist()],
    }
    devices = [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": RATE_HZ}} for n in "sr"]
    return parse_config({"devices": devices, "channels": [channel | keys]}, "test")


def turned(faces: np.ndarray | Sequence[np.ndarray], seed: int = 1) -> np.ndarray:
    """Indications (n, 3): each face for STAY_S, from one to the next in TURN_S."""
    times, forms = [], []
    for k, face in enumerate(faces):
        times += [k * (STAY_S + TURN_S), k * (STAY_S + TURN_S) + STAY_S]
        forms += [face, face]
    t = np.arange(round(times[-1] * RATE_HZ)) / RATE_HZ
    signal = np.column_stack([np.interp(t, times, np.array(forms)[:, i]) for i in range(3)])
    return signal + OFFSET_MPS2 + 0.01 * np.random.default_rng(seed).normal(size=signal.shape)


def opened(serial_number: str = "1", t_ns: int = 0) -> DeviceChange:
    info = DeviceInfo("serial-csv", "serial-csv", serial_number, "m/s2", 3, RATE_HZ)
    return DeviceChange(
        device="s", state="open", t_monotonic_ns=t_ns, t_utc_ns=EPOCH_NS + t_ns, info_json=json.dumps(asdict(info))
    )


def blocks(values: np.ndarray, *, late_s: float = 0.001, lost: Sequence[slice] = ()) -> list[SampleBlock]:
    """Half a second each, every sample in a burst of its own; the samples of `lost` never come."""
    size, made, come = round(RATE_HZ / 2), [], np.ones(len(values), dtype=bool)
    for gap in lost:
        come[gap] = False
    for first in range(0, len(values), size):
        part = first + np.flatnonzero(come[first : first + size])
        for run in np.split(part, np.flatnonzero(np.diff(part) > 1) + 1):
            if len(run):
                arrivals = np.round(((run + 1) / RATE_HZ + late_s) * SECOND).astype(np.int64)
                flags = BlockFlags.NONE if run[0] == 0 or come[run[0] - 1] else BlockFlags.GAP
                count, utc_ns = np.arange(1, len(run) + 1, dtype=np.int32), EPOCH_NS + int(arrivals[-1])
                made.append(SampleBlock("s", "boot", utc_ns, int(run[0]), RATE_HZ, arrivals, count, values[run], flags))
    return made


def played(pipeline: Pipeline, events: Sequence[Any]) -> list[Output]:
    return [result for event in events for result in pipeline.step(event)]


def windows(values: np.ndarray, config: Config | None = None, **keys: Any) -> list[WindowReport]:
    pipeline = Pipeline.begin(config or configured(), "run", 0, 0, {})
    found = played(pipeline, [opened(), *blocks(values, **keys)])
    return [r for r in found if isinstance(r, WindowReport)]


@pytest.mark.slow
def test_each_stay_is_one_window_in_the_right_position_a_guard_from_the_turning() -> None:
    order = [0, 1, 2, 3, 0, 2]
    found = windows(turned([FACES[k] for k in order]))
    assert [w.position for w in found] == [NAMES[k] for k in order[:-1]]  # the last stay has no end yet
    assert all(w.used for w in found)
    for k, window in enumerate(found):
        begin_s = k * (STAY_S + TURN_S)
        end_s = begin_s + STAY_S
        assert begin_s + GUARD_S - 0.25 <= window.start_s <= begin_s + GUARD_S + FOUND_S + TRIMMED_S + 0.25
        assert end_s - GUARD_S - FOUND_S - TRIMMED_S <= window.stop_s <= end_s - GUARD_S + 0.25
        assert window.numbers["position_chi2"] < 21.2


@pytest.mark.slow
def test_times_of_a_change_are_those_of_the_samples_however_late_they_arrive() -> None:
    values = turned(FACES[:3])
    early, late = windows(values), windows(values, late_s=3.0)
    assert [w.position for w in early] == [w.position for w in late]
    np.testing.assert_allclose([w.start_s for w in early], [w.start_s for w in late], atol=1e-3)
    np.testing.assert_allclose([w.stop_s for w in early], [w.stop_s for w in late], atol=1e-3)


@pytest.mark.slow
def test_a_long_stay_is_cut_into_windows() -> None:
    stay = np.tile(FACES[0] + OFFSET_MPS2, (round(100 * RATE_HZ), 1))
    found = windows(stay, configured(window_s=20))
    np.testing.assert_allclose([w.start_s for w in found], [0.5, 20.5, 40.5, 60.5], atol=TRIMMED_S)
    np.testing.assert_allclose([w.stop_s for w in found], [20.5, 40.5, 60.5, 80.5], atol=TRIMMED_S)


@pytest.mark.slow
def test_a_position_that_nobody_stated_is_unknown_and_its_window_refused() -> None:
    askew = G_MPS2 * np.array([0.6, 0.0, 0.8])
    found = windows(turned([FACES[0], FACES[1], askew, FACES[2], FACES[3]]))
    assert [w.used for w in found] == [True, True, False, True]
    assert found[2].position == "unknown"
    assert "none of the stated positions" in found[2].reason
    assert found[2].numbers["position_chi2"] > 21.2


@pytest.mark.slow
def test_what_comes_after_a_slip_is_refused_until_the_sensor_is_turned() -> None:
    slip_rad = np.deg2rad(1.5)
    slipped = G_MPS2 * np.array([np.sin(slip_rad), 0.0, np.cos(slip_rad)])
    stays = [turned([face], seed=k) for k, face in enumerate((FACES[0], slipped))]
    found = windows(np.vstack([*stays, turned([slipped, FACES[1], FACES[0], FACES[2]], seed=2)]))
    by_position = [(w.position, w.used) for w in found]
    assert by_position == [(NAMES[0], True), ("unknown", False), (NAMES[1], True), (NAMES[0], True)]
    assert f"the sensor slipped at {NAMES[0]}: its mean changed by 0.25" in found[1].reason
    assert found[1].numbers["slipped_mps2"] == pytest.approx(G_MPS2 * slip_rad, abs=0.01)


@pytest.mark.slow
def test_two_stops_near_each_other_are_told_apart_once_the_offset_is_known() -> None:
    lean = G_MPS2 * np.array([np.sin(np.deg2rad(5.0)), 0.0, np.cos(np.deg2rad(5.0))])
    stops = [*FACES, -FACES[0], -FACES[1], lean]
    config = configured(positions=[{"gravity_mps2": stop.tolist()} for stop in stops])
    order = [6, 1, 2, 3, 4, 5, 0, 6, 0]
    found = windows(turned([stops[k] for k in order]), config)
    assert [w.used for w in found] == [False, True, True, True, True, True, True, True]
    assert "1000 to 1 are needed" in found[0].reason
    assert found[6].position == NAMES[0]
    assert found[7].position == f"rest ({lean[0]:.6g}, 0, {lean[2]:.6g})"


@pytest.mark.slow
@pytest.mark.parametrize("window_s", [14.0, 16.6, 17.5, 19.0])
def test_no_window_reaches_into_a_turning_wherever_it_would_end(window_s: float) -> None:
    found = windows(turned(FACES), configured(window_s=window_s))
    assert {w.position for w in found if w.used} == set(NAMES[:3])
    for window in found:
        stay = int(window.start_s // (STAY_S + TURN_S))
        assert window.stop_s <= stay * (STAY_S + TURN_S) + STAY_S - GUARD_S + 0.25


@pytest.mark.slow
def test_samples_lost_here_and_there_change_no_times() -> None:
    values = turned(FACES[:3])
    lost = [slice(k, k + 3) for k in range(40, len(values) - 3, 30)]  # one in ten
    whole, holed = windows(values), windows(values, lost=lost)
    assert [w.position for w in whole] == [w.position for w in holed]
    np.testing.assert_allclose([w.stop_s for w in holed], [w.stop_s for w in whole], atol=0.51)  # a piece of rest


def test_lost_samples_end_a_stretch_and_the_same_stop_is_found_again() -> None:
    stay = np.tile(FACES[1] + OFFSET_MPS2, (round(60 * RATE_HZ), 1))
    lost = slice(round(20 * RATE_HZ), round(21 * RATE_HZ))
    found = windows(stay, configured(window_s=25), lost=[lost])
    assert len(found) == 2
    times = [(w.start_s, w.stop_s) for w in found]
    np.testing.assert_allclose(times, [(0.5, 19.5), (21.5, 46.5)], atol=TRIMMED_S + 0.01)
    assert {w.position for w in found} == {NAMES[1]}


def test_a_snapshot_brings_back_every_number() -> None:
    found = FoundPositions(configured().channels[0])
    state = found.snapshot()
    state |= {"before": [17.5, FACES[1]], "stood": [2, NAMES[1], True], "edges_s": [16.0, 3.0], "serial": 2}
    later = FoundPositions(configured().channels[0])
    later.load(state)
    np.testing.assert_equal(later.snapshot(), state)


def test_an_operators_pose_holds_until_the_next_change() -> None:
    askew = G_MPS2 * np.array([0.6, 0.0, 0.8])
    pipeline = Pipeline.begin(configured(), "run", 0, 0, {})
    events: list[Any] = [opened(), *blocks(turned([FACES[0], askew, FACES[1], FACES[2]]))]
    told_ns = round((STAY_S + TURN_S + 4.0) * SECOND)
    command = Command(
        sensor="s", verb="pose", t_monotonic_ns=told_ns, t_utc_ns=EPOCH_NS + told_ns,
        arguments_json=json.dumps({"gravity_mps2": askew.tolist(), "position": "askew"}),
    )  # fmt: skip
    at = next(k for k, e in enumerate(events) if e.t_monotonic_ns > told_ns)
    events.insert(at, command)
    results = played(pipeline, events)
    found = [r for r in results if isinstance(r, WindowReport)]
    assert any(isinstance(r, StatusChange) and "askew" in r.reason for r in results)
    assert [w.position for w in found] == [NAMES[0], "unknown", "askew", NAMES[1]]
    before, after = found[1], found[2]
    assert before.stop_s == pytest.approx(told_ns / SECOND - GUARD_S, abs=0.05)
    assert 0.0 <= after.start_s - (told_ns / SECOND + GUARD_S) <= TRIMMED_S
    assert after.used


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"coupling": "ac"}, "does not measure"),
        ({"poses": [{"start_s": 0, "stop_s": 9, "gravity_mps2": [0, 0, 9.8]}]}, "give only one of positions"),
        ({"positions": [{"gravity_mps2": [0, 0, 9.8]}]}, "there is only one"),
        ({"positions": [{"gravity_mps2": [0, 0, 9.8]}, {"gravity_mps2": [0.1, 0, 9.8]}]}, "positions.0 and"),
        ({"positions": [{"gravity_mps2": [0, 0, 9.8]}, {"gravity_mps2": [0, 0, 0]}]}, "positions.1"),
        ({"positions": [{"theta_deg": 35, "alpha_deg": 0}, {"theta_deg": 35, "alpha_deg": 90}]}, "needs a reference"),
        ({"positions": [{"gravity_mps2": g} for g in FACES.tolist()], "reference": "r"}, "without a reference"),
        ({"positions": [{"direction": [1, 0, 0]}] * 2, "reference": "r"}, "needs gravity_mps2"),
        ({"positions": "free"}, "needs a reference"),
        ({"positions": "free", "reference": "r", "clamp_theta_deg": 2}, "gravity cannot show alpha"),
        ({"clamp_theta_deg": 35}, 'needs positions = "free"'),
        ({"positions": [{"start_s": 0, "gravity_mps2": [0, 0, 9.8]}] * 2}, "positions.0.start_s"),
    ],
)  # fmt: skip
def test_a_configuration_that_cannot_be_is_refused(keys: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError) as error:
        configured(**keys)
    assert any(words in fault for fault in error.value.faults), error.value.faults


def test_another_device_stands_nowhere_until_it_has_shown_it() -> None:
    """What the one before read is no part of its windows, though it counts its samples on."""
    pipeline = Pipeline.begin(configured(), "run", 0, 0, {})
    made = blocks(turned([FACES[0], FACES[0], FACES[1]]))  # turned once, from 37 to 40 s
    at = next(k for k, block in enumerate(made) if block.t_monotonic_ns > 10 * SECOND)
    events: list[Any] = [opened(), *made[:at], opened("2", made[at - 1].t_monotonic_ns), *made[at:]]
    [window] = [r for r in played(pipeline, events) if isinstance(r, WindowReport)]
    assert window.position == NAMES[0]
    assert 10.0 + GUARD_S - 0.25 <= window.start_s <= 10.0 + GUARD_S + FOUND_S + TRIMMED_S + 0.25
    assert window.stop_s <= 37.0 - GUARD_S + 0.25
