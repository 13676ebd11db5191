"""The comparison lets nothing pass: bits, NaN, missing and extra results, decisions on the edge."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from agent.core.events import CalibrationUpdate, Result, StatusChange, WindowReport
from agent.recording.comparison import OTHER_CPU, compare, differences
from tests.replay.stand_in import CONFIG, StandIn, block

NAN = float("nan")


@pytest.fixture
def results() -> list[Result]:
    """A window and a calibration of the stand-in pipeline."""
    pipeline, rng = StandIn(CONFIG), np.random.default_rng(1)
    for number in range(5):
        pipeline.step(block("acc", number, rng))
    return pipeline.step(block("acc", 5, rng))


def changed(results: list[Result], at: int, **fields: Any) -> list[Result]:
    return [*results[:at], msgspec.structs.replace(results[at], **fields), *results[at + 1 :]]


def test_the_same_results_are_equal(results: list[Result]) -> None:
    assert [type(result) for result in results] == [WindowReport, CalibrationUpdate]
    assert compare("f", 1, results, list(results), 0.0) is None


@pytest.mark.parametrize("tolerance", [0.0, OTHER_CPU])
def test_missing_and_extra_results_differ(results: list[Result], tolerance: float) -> None:
    assert compare("f", 1, results[:1], results, tolerance) is not None
    assert compare("f", 1, results, results[:1], tolerance) is not None
    assert compare("f", 1, [], results, tolerance) is not None
    assert compare("f", 1, results, [], tolerance) is not None
    assert compare("f", 1, results[::-1], results, tolerance) is not None


def test_a_torn_recording_may_lack_the_last_results_but_has_none_too_many(results: list[Result]) -> None:
    assert compare("f", 1, results[:1], results, 0.0, complete=False) is None
    assert compare("f", 1, results, results[:1], 0.0, complete=False) is not None


def test_one_bit_is_a_difference_and_its_place_is_told(results: list[Result]) -> None:
    update = results[1]
    assert isinstance(update, CalibrationUpdate)
    rows = [list(row) for row in update.sensitivity]
    rows[1][2] = float(np.nextafter(rows[1][2], np.inf))
    found = compare("f", 7, results, changed(results, 1, sensitivity=rows), 0.0)
    assert found is not None
    assert (found.event_sequence, found.what, found.field) == (7, "/bridge-1/calibration", "sensitivity[1][2]")
    assert not found.undecidable
    assert compare("f", 7, results, changed(results, 1, sensitivity=rows), OTHER_CPU) is None


@pytest.mark.parametrize(
    ("a", "b", "exact", "close"),
    [
        (NAN, NAN, True, True),
        (NAN, -NAN, False, True),
        (NAN, 1.0, False, False),
        (0.0, -0.0, False, True),
        (1.0, 1.0 + 0.5e-9, False, True),
        (1.0, 1.0 + 2e-9, False, False),
        (float("inf"), float("inf"), True, True),
        (float("inf"), 1e308, False, False),
        (1e-13, 9e-13, False, True),  # what is left where numbers of order one cancel
        ([1.0, 1e-12], [1.0, 5e-10], False, True),  # a small element beside a large one
        ([1.0, 1e-12], [1.0, 5e-9], False, False),
        ([1.0], [1.0, 1.0], False, False),
        ([], [1.0], False, False),
        ({"a": 1.0}, {"b": 1.0}, False, False),
        ({"a": 1.0}, {}, False, False),
        (1, 1.0, False, False),
        (True, 1, False, False),
        ("a", "b", False, False),
    ],
)
def test_values(a: Any, b: Any, exact: bool, close: bool) -> None:
    for x, y in ((a, b), (b, a)):
        assert (not list(differences(x, y, 0.0))) == exact
        assert (not list(differences(x, y, OTHER_CPU))) == close


@pytest.mark.parametrize(
    ("level", "tolerance", "undecidable"),
    [
        (1e3 * (1 + 0.5e-9), OTHER_CPU, True),
        (1e3 * (1 + 3e-9), OTHER_CPU, False),  # not close: the decision was changed
        (1e3 * (1 + 0.5e-9), 0.0, False),  # the same CPU takes the same branch
    ],
)
def test_a_decision_on_the_edge_is_undecidable_on_another_cpu(
    results: list[Result], level: float, tolerance: float, undecidable: bool
) -> None:
    numbers = {"level_counts2": level, "level_counts2_threshold": 1e3}
    recorded = changed(results, 0, numbers=numbers)
    found = compare("f", 1, recorded, changed(recorded, 0, used=False)[:1], tolerance)
    assert found is not None
    assert found.field == "used"
    assert found.undecidable == undecidable


def test_a_changed_value_is_never_undecidable(results: list[Result]) -> None:
    numbers = {"level_counts2": 1e3, "level_counts2_threshold": 1e3}
    recorded = changed(results, 0, numbers=numbers)
    found = compare("f", 1, recorded, changed(recorded, 0, stop_s=1e6), OTHER_CPU)
    assert found is not None
    assert not found.undecidable


def test_results_of_another_kind_or_sensor_differ(results: list[Result]) -> None:
    common = {"run_id": "r", "sequence": 1, "sensor": "bridge-1", "t_utc_ns": 1}
    status = StatusChange(**common, status="VALID", before="", reason="")  # type: ignore[arg-type]
    assert compare("f", 1, [status], results[:1], 0.0) is not None
    assert compare("f", 1, [status], [msgspec.structs.replace(status, sensor="other")], 0.0) is not None
