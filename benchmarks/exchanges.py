"""Are exchanged outputs named? Windows of a building at the level of the agent's sums, changed after ten of them.

    python -m benchmarks.exchanges [--seeds 20] [--write]

Counted: how often the change is named first, how often after another one that fits as well. Steps of S of 3 to 60 %,
turns of 5 to 40 deg and dead outputs must not be called an exchange.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from agent.core.estimation import Estimation
from agent.core.exchanges import Exchange, exchanged
from benchmarks.page import machine, write_part
from calib.geometry import STANDARD_GRAVITY_MPS2 as G
from calib.model import Array, Window
from calib.windows.record import Record
from hw.virtual.schedule import rotation
from tests.building_windows import building_window
from tests.clamp_windows import S_TRUE
from tests.unit.test_estimation import estimation, hours

LEVELS, BEFORE, HELD = (0.1, 0.1, 0.1), 10, 5
EYE, MAIN, TRANSVERSE = np.eye(3), 0.01, 0.005  # scatter of S between sensors
CASES: Mapping[str, Exchange] = {
    "range of the sensor doubled": Exchange(0.5 * EYE),
    "range of the sensor a quarter": Exchange(4.0 * EYE),
    "range of 16 g in place of 4 g (LIS3DH)": Exchange(EYE / 6.0),
    "sensor in g": Exchange(EYE / G),
    "sensor in mg": Exchange(1000.0 * EYE),
    "x and y of the sensor exchanged": Exchange(EYE[[1, 0, 2]]),
    "y and z of the sensor exchanged": Exchange(EYE[[0, 2, 1]]),
    "x of the sensor inverted": Exchange(np.diag([-1.0, 1.0, 1.0])),
    "outputs of the sensor in turn": Exchange(EYE[[1, 2, 0]]),
    "sensor turned by 90 deg about x": Exchange(
        np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), "mount"
    ),
    "sensor turned by 90 deg about z": Exchange(
        np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), "mount"
    ),
    "reference in g": Exchange(EYE / G, "reference"),
    "range of the reference halved": Exchange(2.0 * EYE, "reference"),
    "x and y of the reference exchanged": Exchange(EYE[[1, 0, 2]], "reference"),
    "z of the reference inverted": Exchange(np.diag([1.0, 1.0, -1.0]), "reference"),
}
NONE: Mapping[str, Array] = {
    "steps of S of 3, 10, 30 and 60 %": np.array([1.03, 1.1, 1.3, 1.6])[:, None, None] * EYE,
    "turns of 5, 10, 20 and 40 deg": np.array(
        [rotation(np.array([0.6, 0.0, 0.8]), np.deg2rad(angle)) for angle in (5.0, 10.0, 20.0, 40.0)]
    ),
    "x, y or z dead": np.array([np.diag([float(k != dead) for k in range(3)]) for dead in range(3)]),
}


def changed(random: np.random.Generator, cause: Exchange, S: Array = S_TRUE) -> Window:
    """A window of a building after this change of a sensor that has S (3, 3)."""
    turned = cause.matrix if cause.of == "mount" else EYE
    window = building_window(random, level_mps2=LEVELS, S=S @ turned)
    by, sums = np.eye(9), window.sums
    if cause.of == "sensor":
        by[6:, 6:] = cause.matrix
    elif cause.of == "reference":
        by[:3, :3] = by[3:6, 3:6] = cause.matrix
    scatter = np.einsum("ab,kbc,dc->kad", by, sums.scatter, by)
    return replace(window, sums=replace(sums, mean=sums.mean @ by.T, scatter=scatter))


def settled(random: np.random.Generator, S: Array = S_TRUE, windows: int = BEFORE) -> Estimation:
    """An estimation that has taken sound windows of a sensor that has S (3, 3)."""
    found = estimation()
    hours(found, [building_window(random, level_mps2=LEVELS, S=S) for _ in range(windows)])
    return found


def record_of(found: Estimation, random: np.random.Generator, cause: Exchange, hour: int, S: Array = S_TRUE) -> Record:
    """The record of a window after this change."""
    at = found.state.lag_s(), 20.0, found.state.reference(), found.state.motion_to_hz
    return Record.of(changed(random, cause, S), hour / 24, *at)


def explained(
    found: Estimation, random: np.random.Generator, cause: Exchange, count: int = HELD, S: Array = S_TRUE
) -> list[Exchange]:
    """The causes by which so many windows after this change are explained, in the order in which they are told."""
    held = [record_of(found, random, cause, BEFORE + k, S) for k in range(count)]
    told = exchanged(found.state, held, found.gate.limit)
    return [] if told is None else list(told.causes)


def table(seeds: int) -> str:
    """A row for each change."""
    counts, called = {name: Counter[str]() for name in CASES}, Counter[str]()
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        S = EYE + MAIN * np.diag(random.standard_normal(3)) + TRANSVERSE * random.standard_normal((3, 3))
        found = settled(random, S)
        for name, case in CASES.items():
            causes = explained(found, random, case, S=S)
            told = [cause.of == case.of and np.array_equal(cause.matrix, case.matrix) for cause in causes]
            how = "first" if told[:1] == [True] else "alike" if any(told) else "other" if told else "none"
            counts[name][how] += 1
        for name, matrices in NONE.items():
            called[name] += sum(bool(explained(found, random, Exchange(matrix), S=S)) for matrix in matrices)
    rows = ["| change | named first | as fitting alike | another one | none |", "| --- " * 5 + "|"]
    for name, n in counts.items():
        rows.append(f"| {name} | {' | '.join(str(n[how]) for how in ('first', 'alike', 'other', 'none'))} |")
    rows += ["", "| no exchange | windows | called an exchange |", "| --- | --- | --- |"]
    rows += [f"| {name} | {HELD * seeds * len(matrices)} | {called[name]} |" for name, matrices in NONE.items()]
    return "\n".join(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    text = f"`python -m benchmarks.exchanges`, {machine()}. {given.seeds} seeds.\n\n{table(given.seeds)}"
    if given.write:
        write_part("exchanges", text)
    else:
        print(text)
