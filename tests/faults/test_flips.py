"""Flipped bits, in small numbers; `make faults` flips the full number."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults import flips

pytestmark = pytest.mark.faults


def test_of_the_state_file(tmp_path: Path) -> None:
    outcome = flips.of_state(tmp_path, 300)
    assert outcome.good, outcome


def test_starts(tmp_path: Path) -> None:
    outcome = flips.at_starts(tmp_path, 3)
    assert outcome.good, outcome


def test_of_a_recording(tmp_path: Path) -> None:
    outcome = flips.of_recording(tmp_path, 100, 50_000, edge_bytes=8)
    assert outcome.good, outcome
