"""The cost of a window hardly grows with the number of windows before it; docs/performance.md has ten thousand."""

from __future__ import annotations

import itertools
import sys
from typing import Any

import pytest

from agent.core.events import WindowReport
from benchmarks.online.node import Timing, node
from benchmarks.online.runner import Run, visits

WINDOWS = 170
EARLY, LATE = range(60, 70), range(150, 160)  # of one day; the newest 48 windows and one record an hour are kept
LARGEST = 1_500_000  # bytes of a state with a record an hour for two weeks, of which 170 are here


@pytest.mark.thorough
def test_work_and_state_are_flat() -> None:
    """Python function calls for each window, and bytes of the snapshot. Unlike time, they do not depend on load."""
    drawn = node(2, all_axes=True, timing=Timing(10.0, 3600.0, WINDOWS))
    run = Run(drawn.config)
    calls = itertools.count()

    def counting(_frame: Any, what: str, _argument: Any) -> None:
        if what == "call":
            next(calls)

    at, sizes = [0], []
    for event in visits(drawn.building, range(WINDOWS)):
        sys.setprofile(counting)
        results = run.feed(event)
        sys.setprofile(None)
        if any(isinstance(result, WindowReport) and result.used for result in results):
            at.append(next(calls))
            sizes.append(len(run.pipeline.snapshot()))
    assert len(sizes) > 0.95 * WINDOWS
    early, late = (sum(at[k + 1] - at[k] for k in part) for part in (EARLY, LATE))
    assert late < 1.1 * early  # about a thousand calls for each window
    assert max(sizes[k] for k in LATE) < LARGEST
