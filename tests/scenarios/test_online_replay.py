"""A recording of every scenario, made by the test, replays bit for bit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from agent.audit.engines import Engines
from agent.audit.replaying import Replayer
from agent.config import Config
from agent.core.events import Event, Result, RunStart
from agent.core.pipeline import Pipeline
from agent.recording.fingerprint import fingerprint
from agent.recording.reading import RecordingReader
from benchmarks.online import harm, year
from benchmarks.online.node import Timing, node
from benchmarks.online.runner import Run, visits
from hw.virtual.building import Building
from hw.virtual.harm import HARMLESS
from hw.virtual.harm_kinds import KINDS

TIMING = Timing(12.0, 60.0, 6)
SEED = 3


def worlds() -> Iterator[tuple[str, Building, Config]]:
    """A short version of each scenario."""
    for kind in ("", *KINDS):
        befalls = KINDS[kind](np.random.default_rng(SEED)) if kind else HARMLESS
        drawn = node(SEED, all_axes=kind != "", harm=befalls, harmed_from=2, timing=TIMING)
        yield kind or "nothing wrong", drawn.building, drawn.config
    building = Building(year.quicker(year.parameters(SEED, 0.3), 600.0, 12.0), SEED)
    yield "a year", building, year.config(building)


WORLDS = {name: (building, config) for name, building, config in worlds()}
# With lost samples, another time, another sensor and none: what the recording holds besides samples.
AT_LEAST = {"nothing wrong", "10 % lost", "clock step", "reference unplugged", "a year"}


@pytest.mark.parametrize(
    "name", [name if name in AT_LEAST else pytest.param(name, marks=pytest.mark.nightly) for name in WORLDS]
)
def test_a_recording_replays_bit_for_bit(name: str, tmp_path: Path) -> None:
    building, config = WORLDS[name]
    recorded = played(Run(config, tmp_path), visits(building, range(TIMING.windows)))
    (path,) = tmp_path.glob("*.mcap")
    found = Replayer(Engines(Pipeline.restore), fingerprint(), elsewhere=0.0).run(path).file
    assert found.first_difference is None
    assert found.equal
    assert found.results == len(recorded) > TIMING.windows  # window reports and status changes


def test_going_on_from_any_window_equals_going_on(tmp_path: Path) -> None:
    """A pipeline that is restored from its snapshot between two visits gives the same results, bit for bit."""
    building, config = WORLDS["nothing wrong"]
    played(Run(config, tmp_path), visits(building, range(TIMING.windows)))
    (path,) = tmp_path.glob("*.mcap")
    whole = Pipeline.begin(config, "run-1", 0, 0, {})
    restored, compared = whole, 0
    for number, step in enumerate(RecordingReader(path).steps()):
        if isinstance(step.event, RunStart):
            continue
        if number % 40 == 0:
            restored = Pipeline.restore(config.model_dump_json(), whole.snapshot())
        expected = whole.step(step.event)
        again = expected if restored is whole else restored.step(step.event)
        assert repr(again) == repr(expected)  # NaN equals NaN there
        compared += len(again)
    assert compared > TIMING.windows


@pytest.mark.thorough
def test_a_harmed_run_says_the_same_twice() -> None:
    assert harm.harmed("clock step", 11) == harm.harmed("clock step", 11)


def played(run: Run, events: Iterable[Event]) -> list[Result]:
    """Run a pipeline to the end of its events; returns all results."""
    results = [result for event in events for result in run.feed(event)]
    run.close()
    return results
