"""A sensor beside two references in a building, from blocks to S: windows in turn, and a step of one reference."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from agent.core.events import CalibrationUpdate, StatusChange, WindowReport
from agent.core.pipeline import Pipeline
from benchmarks.online import references
from benchmarks.online.config import building_config
from benchmarks.online.node import Timing
from benchmarks.online.runner import opened, tick, ticked
from hw.virtual.building import Building, BuildingDevice, BuildingParameters
from hw.virtual.timebase import Clock

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # the second reference stands turned by 90 deg
CONFIG = {
    "prior": {"sensitivity": 1.0, "u_main_pct": 3.0},
    "check_reference": {
        "device": "check",
        "rotation": QUARTER.ravel().tolist(),
        "certificate": {"serial_number": "building-check", "stability_pct": 0.0},
    },
}
VISITS = 8


def site() -> Building:
    parameters = BuildingParameters(
        window_s=20.0, every_s=60.0, all_axes=True, level_mps2=(0.1, 0.3), sensitivity=np.diag([1.01, 0.99, 1.02]),
        check=BuildingDevice(0.001, Clock(200.0, rate_error=0.5e-4, offset_s=0.0007)), check_sensitivity=QUARTER.T,
    )  # fmt: skip
    return Building(parameters, 7)


def run(building: Building, *, cut: int | None = None, serial_number: str = "building-check") -> list[Any]:
    """All results; from visit `cut` on, the pipeline is another one that went on from the snapshot."""
    infos = building.infos()
    infos["check"] = replace(infos["check"], serial_number=serial_number)
    config = building_config(building, **CONFIG)
    pipeline = Pipeline.begin(config, "run", 0, 0, {})
    results: list[Any] = [result for event in opened(infos) for result in pipeline.step(event)]
    for visit in range(VISITS):
        if visit == cut:
            pipeline = Pipeline.restore(config.model_dump_json(), pipeline.snapshot())
        for event in [*ticked(building.visit(visit)), tick(building.span(visit)[1] + 8.0)]:
            results += pipeline.step(event)
    return results


@cache
def undisturbed() -> list[Any]:
    """All results of a run as it should be."""
    return run(site())


def by_reference(results: list[Any]) -> list[int]:
    """Of each piece, which may have several windows, the place of its reference."""
    reports = [result for result in results if isinstance(result, WindowReport)]
    places = {int(report.start_s // 60.0): int(report.numbers.get("check_reference", 0.0)) for report in reports}
    return list(places.values())


def test_the_references_take_turns_and_both_tell_s() -> None:
    results = undisturbed()
    assert by_reference(results)[:8] == [0, 1, 1, 0, 1, 0, 0, 1]
    update = [result for result in results if isinstance(result, CalibrationUpdate)][-1]
    assert len(update.references) == 2
    assert np.abs(np.array(update.sensitivity) - np.diag([1.01, 0.99, 1.02])).max() < 2e-3


def test_a_snapshot_goes_on_bit_for_bit() -> None:
    assert run(site(), cut=3) == undisturbed()


def test_a_second_reference_without_its_certificate_is_not_used() -> None:
    results = run(site(), serial_number="another")
    assert set(by_reference([r for r in results if not isinstance(r, WindowReport) or r.used])) == {0}
    assert any("serial number another" in r.reason for r in results if isinstance(r, StatusChange))


@pytest.mark.two_cases
@pytest.mark.parametrize("name", ["first reference", "sensor", "none"])
def test_the_device_that_stepped_is_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(references, "TIMING", Timing(20.0, 60.0, 24))
    monkeypatch.setattr(references, "STEP_BEFORE", 8)
    role = references.KINDS[name]
    told = references.one((role, references.SEED, True))
    assert told.named == ([] if role is None else [role])
    assert np.all(np.abs(told.errors) < 4.0)
    assert np.all(told.u_pct < 0.08)
