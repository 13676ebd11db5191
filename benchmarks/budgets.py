"""What a budget in each result would cost: time of one core, and bytes.

    python -m benchmarks.budgets [--write]

The state has so many windows beside one reference, at a mount that does not turn. A budget needs all epochs, also where
the solution of the whole is known.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time

import msgspec
import numpy as np

from benchmarks.dates import MEAN, U, window
from benchmarks.page import machine, write_part
from calib.estimate.nuisances import Priors
from calib.estimate.wander import TemperatureModel, Wander
from calib.state.state import State

COUNTS, REPEATS = (50, 100, 300), 5
PRIORS = Priors(reference=1e-3, rotation_rad=3e-3, offset_mps2=0.01)


def row(count: int) -> str:
    """A line of the table: with so many windows."""
    random = np.random.default_rng(1)
    state = State(MEAN, U, PRIORS, Wander(), TemperatureModel(), fixed=True)
    state.meet("A")
    state.take_also([window(random, np.eye(3), k / 24.0) for k in range(count)], [])
    whole = state.estimate()
    found = state.budget(whole)
    told = {source: u.tolist() for source, u in found.by_source.items()}
    octets = len(msgspec.json.encode([told, found.degrees_of_freedom.tolist()]))
    begun = time.process_time()
    for _ in range(REPEATS):
        state.budget(whole)
    taken_ms = 1e3 * (time.process_time() - begun) / REPEATS
    return f"| {count} | {len(whole.unknowns)} | {taken_ms:.0f} | {len(told)} | {octets} |"


def table() -> str:
    """A row for each number of windows."""
    rows = [
        "| windows | unknowns | ms of a budget | sources | bytes in JSON |",
        "| --- | --- | --- | --- | --- |",
    ]
    return "\n".join([*rows, *map(row, COUNTS)])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    text = f"`python -m benchmarks.budgets`, {machine()}.\n\n{table()}"
    if given.write:
        write_part("budget cost", text)
    else:
        print(text)
