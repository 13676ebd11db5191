"""Recordings and stores of every released format can be read, and replay to the results in `expected.json` beside them.

Where a change of the estimator changes a result on purpose, `python -m tests.replay.golden_files` writes expected.json
anew, and CHANGELOG.md gives the reason.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config import recorded_config
from agent.core.events import CalibrationUpdate, DeviceChange, WindowReport
from agent.core.pipeline import Pipeline
from agent.delivery.history import History
from agent.delivery.store import Store
from agent.recording.reading import RecordingReader
from tests.replay.golden_files import EXPECTED, FORMATS, RECORDING, STATE, config_of, results_of

# Relative. Kernels of other CPUs round differently, which a number that is a small difference of larger ones magnifies:
# between AVX-512 (Xeon) and AVX2 (EPYC) those of DIFFERENCES differ by up to 6e-9, all else by less than 1e-9.
TOLERANCE = 1e-9
OF_DIFFERENCES = 2e-8
DIFFERENCES = re.compile(
    r"(step_mps2|lag_applied_s|innovation_chi2|reference_noise_mps2|reference_rms_mps2_threshold|sensitivity_im)$"
)


def differing(found: Any, expected: Any, path: str = "") -> list[str]:
    """The places where two results differ by more than the tolerance, or only one of them has a field or a number.

    The entries of a matrix are compared with its largest entry, those of a covariance with the standard uncertainties.
    """
    if isinstance(found, dict) and isinstance(expected, dict):
        if found.keys() != expected.keys():
            return [f"{path}: members {sorted(found.keys() ^ expected.keys())}"]
        return [d for name in found for d in differing(found[name], expected[name], f"{path}.{name}")]
    if isinstance(found, list) and isinstance(expected, list):
        if len(found) != len(expected):
            return [f"{path}: {len(found)} entries, {len(expected)} expected"]
        if expected and all(isinstance(value, float | int | list) for value in (*found, *expected)):
            return _differing_arrays(found, expected, path)
        return [d for k, pair in enumerate(zip(found, expected, strict=True)) for d in differing(*pair, f"{path}[{k}]")]
    if isinstance(found, float) and isinstance(expected, float | int):
        alike = math.isclose(found, expected, rel_tol=_tolerance(path), abs_tol=TOLERANCE**2)
        return [] if alike else [f"{path}: {found!r}, {expected!r} expected"]
    return [] if found == expected else [f"{path}: {found!r}, {expected!r} expected"]


def _tolerance(path: str) -> float:
    return OF_DIFFERENCES if DIFFERENCES.search(path) else TOLERANCE


def _differing_arrays(found: list[Any], expected: list[Any], path: str) -> list[str]:
    """The same for arrays of numbers, which may have null entries."""
    one, other = (np.array(values, dtype=float) for values in (found, expected))
    if one.shape != other.shape or np.any(np.isnan(one) != np.isnan(other)):
        return [f"{path}: {found}, {expected} expected"]
    scale: Any = np.nanmax(np.abs(other), initial=TOLERANCE)
    if path.endswith(".covariance"):
        scale = np.sqrt(np.outer(np.diag(other), np.diag(other)))
    tolerance = _tolerance(path)
    places = np.argwhere(np.abs(one - other) > tolerance * scale).tolist()
    return [f"{path}{place}: {one[*place]!r}, {other[*place]!r} expected" for place in places]


@pytest.mark.parametrize("directory", FORMATS, ids=lambda path: path.name)
def test_a_released_format_replays_to_the_results_beside_it(directory: Path) -> None:
    expected = json.loads((directory / EXPECTED).read_text())
    assert sum(r["what"] == "CalibrationUpdate" for r in expected) >= 1
    assert differing(results_of(directory / RECORDING), expected) == []


@pytest.mark.parametrize("directory", FORMATS, ids=lambda path: path.name)
def test_a_state_of_a_released_format_is_brought_up_to_date(directory: Path, tmp_path: Path) -> None:
    (tmp_path / STATE).write_bytes((directory / STATE).read_bytes())
    store = Store(tmp_path, 0)
    assert store.set_aside is None
    config = recorded_config(config_of(directory / RECORDING))
    (sensor,) = [channel.sensor for channel in config.channels]
    with History(store.path) as history:
        kept = {identity: memory.state for identity, memory in history.memories(sensor).items()}
        in_force = history.in_force(sensor)
    store.close()
    assert in_force is not None
    pipeline = Pipeline.begin(config, "later", 0, store.last_sequence(), {sensor: kept})
    events = (step.event for step in RecordingReader(directory / RECORDING).steps())
    opened = next(e for e in events if isinstance(e, DeviceChange) and e.device == sensor)
    (again,) = [result for result in pipeline.step(opened) if isinstance(result, CalibrationUpdate)]
    assert again.sensitivity == in_force.fields["sensitivity"]
    assert again.offset == in_force.fields["offset"]
    assert again.covariance == in_force.fields["covariance"]
    results = [result for event in events for result in pipeline.step(event)]
    windows = [result for result in results if isinstance(result, WindowReport)]
    assert [window.reason for window in windows if not window.used] == []  # the same windows as those before
    assert len(windows) >= 1


def test_a_difference_of_one_part_in_a_million_is_seen() -> None:
    assert differing({"a": [1.0, 2.0]}, {"a": [1.0, 2.0 * (1.0 + 1e-6)]}) != []
    assert differing({"a": 1.0}, {"b": 1.0}) != []
    assert differing([1.0], [1.0, 2.0]) != []
    assert differing(math.nan, 1.0) != []
