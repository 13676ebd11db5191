"""Seconds in which the arrivals of the sensor are late, and samples that are lost uncounted: `python -m
benchmarks.late_bursts`.

A building moves without a pause for windows of a minute at 100 Hz. From 5 min on, at random times, every arrival of ten
seconds is 50 ms late, or five samples are lost that the sensor's count does not show.
"""

from __future__ import annotations

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as in every entry point of the product; must be set before numpy is loaded

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from agent.core.events import CalibrationUpdate, Event, StatusChange, WindowReport
from benchmarks.online.node import Stated, Timing, node
from benchmarks.online.runner import EPOCH_NS, Run, visits
from calib.model import Array
from hw.block import SampleBlock

RUNS, WINDOWS, WINDOW_S = 20, 24, 60.0
FIRST_S, APART_S = 300.0, 150.0  # the first time, and the mean of the pauses between two
LATE_S, LASTS_S, LOST = 0.05, 10.0, 5

Blocks = Iterable[Event]


def late(events: Blocks, times_s: Array, device: str = "sensor") -> Iterator[Event]:
    """A device's arrivals are late for a while from these times on; none overtakes one before."""
    newest_ns = 0
    for event in events:
        if isinstance(event, SampleBlock) and event.device == device:
            since_s = event.burst_t_monotonic_ns[:, None] * 1e-9 - times_s
            by_ns = round(LATE_S * 1e9) * ((since_s >= 0.0) & (since_s < LASTS_S)).any(axis=1)
            arrival_ns = np.maximum.accumulate(np.maximum(event.burst_t_monotonic_ns + by_ns, newest_ns))
            newest_ns = int(arrival_ns[-1])
            yield replace(event, burst_t_monotonic_ns=arrival_ns, t_utc_ns=EPOCH_NS + newest_ns)
        else:
            yield event


def lossy(events: Blocks, times_s: Array) -> Iterator[Event]:
    """At each of these times samples of the sensor are lost, which its count does not show."""
    due, lost = times_s.tolist(), 0
    for event in events:
        if isinstance(event, SampleBlock) and event.device == "sensor":
            shown, count, before = event.indications, event.burst_count.copy(), lost
            while due and event.burst_t_monotonic_ns[-1] * 1e-9 > due[0]:
                burst = int(np.searchsorted(event.burst_t_monotonic_ns * 1e-9, due.pop(0)))
                shown = np.delete(shown, slice(count[burst] - LOST, count[burst]), axis=0)
                count[burst:] -= LOST
                lost += LOST
            yield replace(event, first_index=event.first_index - before, indications=shown, burst_count=count)
        else:
            yield event


KINDS: Mapping[str, Callable[[Blocks, Array], Iterator[Event]]] = {
    "50 ms late for 10 s": late,
    "5 samples lost": lossy,
    "neither": lambda events, _: iter(events),
}


@dataclass(frozen=True, slots=True)
class Outcome:
    """Of one run: the share of windows used, that of the time HELD, and the largest error of S and Q over u."""

    used: float
    held: float
    error_over_u: float


def one(kind: str, seed: int) -> Outcome:
    """One run."""
    drawn = node(seed, all_axes=True, stated=Stated(lag_s=0.02), timing=Timing(WINDOW_S, 0.0, WINDOWS))
    pauses_s = LASTS_S + np.random.default_rng([seed, 77]).exponential(APART_S, WINDOWS)
    times_s = FIRST_S + np.cumsum(pauses_s)
    run, used, held_s, status, since_s = Run(drawn.config), list[bool](), 0.0, "", 0.0
    update: CalibrationUpdate | None = None
    for event in KINDS[kind](visits(drawn.building, range(WINDOWS)), times_s[times_s < WINDOWS * WINDOW_S - LASTS_S]):
        for result in run.feed(event):
            if isinstance(result, WindowReport):
                used.append(result.used)
            elif isinstance(result, CalibrationUpdate):
                update = result
            elif isinstance(result, StatusChange):
                held_s += run.now_s - since_s if status == "HELD" else 0.0
                status, since_s = result.status, run.now_s
    held_s += run.now_s - since_s if status == "HELD" else 0.0
    assert update is not None
    true = drawn.building.truth(run.now_s)
    error = np.append(update.sensitivity, update.offset) - np.append(true.sensitivity, true.offset_at_mean)
    largest = float(np.max(np.abs(error) / update.standard_uncertainty))
    return Outcome(float(np.mean(used)), held_s / run.now_s, largest)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=RUNS)
    runs = parser.parse_args().runs
    print("| the sensor's samples | runs | windows used | time HELD | runs never HELD | largest error, u |")
    print("| --- | --- | --- | --- | --- | --- |")
    for kind in KINDS:
        found = [one(kind, seed) for seed in range(1, runs + 1)]
        never = sum(o.held == 0.0 for o in found)
        print(
            f"| {kind} | {runs} | {np.mean([o.used for o in found]):.1%} | {np.mean([o.held for o in found]):.1%} "
            f"| {never} | {max(o.error_over_u for o in found):.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
