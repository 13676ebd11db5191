"""Faults of the sensor, the router and the clock, in small numbers; `make faults` injects them in full number."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults import clock, routing, unplug
from tests.faults.needs import require

pytestmark = pytest.mark.faults


# The longest of all: begun first.
def test_router_away(tmp_path: Path) -> None:
    outcome = routing.away(tmp_path, 300, 20)
    assert outcome.good, outcome


def test_unplugged(tmp_path: Path) -> None:
    outcome = unplug.unplugged(tmp_path, 6)
    assert outcome.good, outcome


def test_clock_stepped(tmp_path: Path) -> None:
    require("gcc")
    outcome = clock.stepped(tmp_path)
    assert outcome.good, outcome
