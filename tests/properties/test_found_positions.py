"""Positions found from gravity over runs as they never should be: all of it is in the snapshot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from agent.config import Config, parse_config
from agent.core.events import Event, WindowReport
from agent.core.pipeline import Pipeline
from hw.block import SampleBlock
from tests.properties.happenings import ORIGIN_NS, RATE_HZ, SECOND, happenings

EVENTS = 400
STAY_S = 11.0
FACES = 9.8 * np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, -1, 0]])


def config(free: bool) -> Config:
    """Four faces at rest, or a clamp at any angles."""
    positions = "free" if free else [{"gravity_mps2": face} for face in FACES.tolist()]
    channel = {"sensor": "s", "prior": {"u_offset_mps2": 0.3}, "late_horizon_s": 2, "silence_s": 2, "guard_s": 0.2}
    channel |= {"positions": positions, "window_s": 6.0} | ({"reference": "r"} if free else {})
    devices = [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": RATE_HZ}} for n in "sr"]
    return parse_config({"devices": devices, "channels": [channel]}, "test")


def turned(seed: int, *, free: bool) -> Iterator[Event]:
    """The happenings of a sensor that is turned each STAY_S."""
    faces = FACES[1:] if not free else 9.8 * np.array([[0.6, 0, -0.8], [0, 0.6, -0.8], [-0.5, 0, -0.866]])
    for event in happenings(seed, EVENTS, moving=free):
        if isinstance(event, SampleBlock) and event.device == "s" and event.indications.shape[1] == 3:
            face = faces[int((event.t_monotonic_ns - ORIGIN_NS) / SECOND / STAY_S) % len(faces)]
            yield replace(event, indications=event.indications + face)
        else:
            yield event


@pytest.mark.slow
@pytest.mark.parametrize("free", [False, True])
def test_restored_at_any_event_it_goes_on_alike(free: bool) -> None:
    seed = 1
    settings_ = config(free)
    config_json = settings_.model_dump_json()
    going_on = Pipeline.begin(settings_, "run", ORIGIN_NS, 7, {})
    restored = Pipeline.begin(settings_, "run", ORIGIN_NS, 7, {})
    places = np.random.default_rng(seed)
    for event in turned(seed, free=free):
        if places.random() < 0.2:
            restored = Pipeline.restore(config_json, restored.snapshot())
        assert repr(restored.step(event)) == repr(going_on.step(event))  # NaN equals NaN there
    assert restored.snapshot() == going_on.snapshot()


@pytest.mark.thorough
def test_the_happenings_hold_positions_that_are_found_and_some_that_are_not() -> None:
    """Without them the property above would say little."""
    for free in (False, True):
        positions = set()
        for seed in range(1, 4):
            pipeline = Pipeline.begin(config(free), "run", ORIGIN_NS, 7, {})
            results = [r for event in turned(seed, free=free) for r in pipeline.step(event)]
            positions |= {r.position for r in results if isinstance(r, WindowReport)}
        assert len(positions) > 2
