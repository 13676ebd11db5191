"""A day of 1 kHz in a minute, in short: that it is the whole pipeline which is timed."""

from __future__ import annotations

from benchmarks.online import day


def test_all_windows_of_the_schedule_are_used() -> None:
    cycles = 2
    cpu_s, windows, updates = day.measure(cycles * day.bench().parameters.schedule.period_s + day.BLOCK_S)
    assert windows == 4 * cycles
    assert updates >= windows - 3  # three until all is determined
    assert cpu_s > 0.0
