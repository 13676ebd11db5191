"""A short run of the benchmark "a day at 1 kHz": it must run the whole pipeline, otherwise its time means nothing."""

from __future__ import annotations

from benchmarks.online import day


def test_all_windows_of_the_schedule_are_used() -> None:
    cycles = 2
    cpu_s, windows, updates = day.measure(cycles * day.bench().parameters.schedule.period_s + day.BLOCK_S)
    assert windows == 4 * cycles
    assert updates >= windows - 3  # the first three do not determine all parameters
    assert cpu_s > 0.0
