"""Short form of benchmarks/fuzz_drivers: random and mutated streams, divided among all parsers."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from agent.acquisition.stalls import few_objects
from benchmarks.fuzz_drivers import fuzz, parsers


@pytest.fixture(autouse=True)
def _nothing_of_other_tests() -> Iterator[None]:
    """Garbage is collected twice for each parser: what is there before need not be looked at."""
    with few_objects():
        yield


@pytest.mark.slow
def test_no_exception() -> None:
    assert sum(row.streams for row in fuzz(1_000 // len(parsers()), seed=1)) >= 1_000 - len(parsers())


@pytest.mark.thorough
def test_no_exception_and_no_growth() -> None:
    rows = fuzz(10_000 // len(parsers()), seed=1)
    assert sum(row.streams for row in rows) >= 9_990
    # A parser may keep unfinished lines or frames, and examples. If it kept a burst of 200 bytes per stream, memory
    # would grow by more than 100 kB; 41 kB were seen.
    assert {row.parser: row.grown_bytes for row in rows if row.grown_bytes > 60_000} == {}
