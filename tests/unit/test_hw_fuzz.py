"""A short form of benchmarks/fuzz_drivers: 10^4 random and mutated streams, shared out over all parsers."""

from __future__ import annotations

import pytest

from benchmarks.fuzz_drivers import fuzz, parsers


@pytest.mark.parametrize("seed", [1])
def test_no_exception_and_no_growth(seed: int) -> None:
    rows = fuzz(10_000 // len(parsers()), seed)
    assert sum(row.streams for row in rows) >= 9_990
    # A burst of 200 bytes kept in every stream would be 200 kB; what a parser may keep is an unfinished line or frame.
    assert {row.parser: row.grown_bytes for row in rows if row.grown_bytes > 20_000} == {}
