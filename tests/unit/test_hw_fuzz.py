"""Short form of benchmarks/fuzz_drivers: 10^4 random and mutated streams, divided among all parsers."""

from __future__ import annotations

import pytest

from benchmarks.fuzz_drivers import fuzz, parsers


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1])
def test_no_exception_and_no_growth(seed: int) -> None:
    rows = fuzz(10_000 // len(parsers()), seed)
    assert sum(row.streams for row in rows) >= 9_990
    # A parser may keep unfinished lines or frames, and examples. If it kept a burst of 200 bytes per stream, memory
    # would grow by more than 100 kB; 41 kB were seen.
    assert {row.parser: row.grown_bytes for row in rows if row.grown_bytes > 60_000} == {}
