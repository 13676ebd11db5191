"""The CPU time of a window that contradicts, beside that of a good one: `python -m benchmarks.contradicting`.

A building moves without a pause for windows of a minute. Every tenth window is another than the ones before, in one
way for each row; the search for another lag is a part of its cost.
"""

from __future__ import annotations

import os
from typing import Any

from numpy.typing import NDArray

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as in every entry point of the product; must be set before numpy is loaded

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from agent.core.events import WindowReport
from benchmarks.online.config import building_config
from benchmarks.online.node import Node, Stated, Timing, node
from benchmarks.online.runner import Run, visits
from calib.model import Array
from hw.block import SampleBlock
from hw.virtual.building import Building
from hw.virtual.building_motion import BuildingSpectrum
from hw.virtual.schedule import rotation

WINDOWS, EVERY, FIRST = 49, 10, 8  # one of the windows 8, 18, 28, ... contradicts; before, S and the response are found
WINDOW_S, APART_S, LEAD_S = 60.0, 180.0, 3.0
SEED = 1
SIZES = ((100.0, 12.0), (1000.0, 40.0))  # sampling rate and upper end of the motion in Hz

# Of a block of the sensor, by its arrivals in s since the window.
Change = Callable[[SampleBlock, NDArray[Any]], SampleBlock]


def shifted(by_s: float, since_s: float = -np.inf, until_s: float = np.inf) -> Change:
    """Arrivals are later by `by_s` between two times."""

    def change(block: SampleBlock, arrival_s: Array) -> SampleBlock:
        by_ns = np.where((arrival_s >= since_s) & (arrival_s < until_s), round(1e9 * by_s), 0)
        return replace(block, burst_t_monotonic_ns=np.maximum.accumulate(block.burst_t_monotonic_ns + by_ns))

    return change


def multiplied(matrix: Array) -> Change:
    """The output is another one."""
    return lambda block, _: replace(block, indications=block.indications @ matrix.T)


def transient(block: SampleBlock, arrival_s: Array) -> SampleBlock:
    """From 30 s on the sensor rings at 4 Hz for some seconds, as if it alone were struck."""
    t = arrival_s[-1] - np.arange(len(block.indications))[::-1] / block.nominal_rate_hz - 30.0
    rings = 0.3 * np.exp(-np.maximum(t, 0.0) / 1.5) * (t > 0.0) * np.sin(2.0 * np.pi * 4.0 * t)
    return replace(block, indications=block.indications + rings[:, None])


CHANGES: Mapping[str, Change] = {
    "stamps 12 ms later, and back": shifted(0.012),
    "stamps 95 ms later, which nobody stated": shifted(0.095),
    "stamps 50 ms later for 10 s": shifted(0.05, 20.0, 30.0),
    "S 0.5 % larger": multiplied(1.005 * np.eye(3)),
    "S 3 % larger": multiplied(1.03 * np.eye(3)),
    "turned by 0.3 deg": multiplied(rotation(np.array([0.0, 1.0, 0.0]), np.deg2rad(0.3))),
    "the sensor rings": transient,
}


@dataclass(frozen=True, slots=True)
class Cost:
    """CPU time in s of each window of a run, and whether it was used."""

    cpu_s: Array
    used: Array

    @property
    def whole_s(self) -> float:
        """Of all windows from the first contradicting one on."""
        return float(self.cpu_s[FIRST:].sum())


def drawn(rate_hz: float, to_hz: float) -> Node:
    """A building whose sensor and reference have this rate, and that moves up to `to_hz`."""
    made = node(SEED, all_axes=True, stated=Stated(lag_s=0.02), timing=Timing(WINDOW_S, APART_S, WINDOWS))
    p = made.building.parameters
    sensor, reference = (replace(i, clock=replace(i.clock, nominal_rate_hz=rate_hz)) for i in (p.sensor, p.reference))
    building = Building(replace(p, sensor=sensor, reference=reference, band=BuildingSpectrum(0.5, to_hz)), SEED)
    return replace(made, building=building, config=building_config(building, **made.stated.keys()))


def measured(rate_hz: float, to_hz: float, change: Change | None) -> Cost:
    """The cost of each window where every tenth one is changed."""
    made = drawn(rate_hz, to_hz)
    run, cpu_s, used = Run(made.config), np.zeros(WINDOWS), np.zeros(WINDOWS, dtype=bool)
    for event in visits(made.building, range(WINDOWS)):
        visit = min(int(event.t_monotonic_ns * 1e-9 // APART_S), WINDOWS - 1)
        wrong = change is not None and visit >= FIRST and (visit - FIRST) % EVERY == 0
        if wrong and isinstance(event, SampleBlock) and event.device == "sensor":
            arrival_s = event.burst_t_monotonic_ns * 1e-9 - visit * APART_S - LEAD_S
            assert change is not None
            event = change(event, arrival_s)
        begin = time.process_time()
        results = run.feed(event)
        cpu_s[visit] += time.process_time() - begin
        reports = [r.used for r in results if isinstance(r, WindowReport)]
        used[visit] = all(reports) if reports else used[visit]
    return Cost(cpu_s, used)


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    print("| rate, motion up to | every tenth window | a good one, ms | the tenth, ms | all over all good | used |")
    print("| --- | --- | --- | --- | --- | --- |")
    for rate_hz, to_hz in SIZES:
        good = measured(rate_hz, to_hz, None)
        good_ms = 1e3 * float(np.median(good.cpu_s[FIRST:]))
        for name, change in CHANGES.items():
            found = measured(rate_hz, to_hz, change)
            tenth_ms = 1e3 * float(np.median(found.cpu_s[FIRST::EVERY]))
            print(
                f"| {rate_hz:g} Hz, {to_hz:g} Hz | {name} | {good_ms:.0f} | {tenth_ms:.0f} "
                f"| {found.whole_s / good.whole_s:.2f} | {np.mean(found.used):.0%} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
