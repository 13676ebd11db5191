"""Is noise that grows told, and sound noise never? Windows as the numbers that the agent keeps of them.

    python -m benchmarks.noise [--seeds 20] [--write]

Each window has a level of motion, and residuals in each output: a floor of 5 mm/s2, a part of the motion, and a scatter
of the noise from window to window (relative SD, and its correlation from one window to the next). An hour lies between
two windows. False alarms are counted in a year of sound windows. Then the floor doubles at once, or every 12 h, after
the windows from which the agent learns: after how many windows that is told, the median and the worst of the seeds.
"""

from __future__ import annotations

import os
from typing import Any

from numpy.typing import NDArray

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from agent.core.noise_watch import FIRST, NoiseHistory
from benchmarks.page import machine, write_part
from calib.model import Array

FLOOR_MPS2, LEVEL_MPS2 = 0.005, 0.02
YEAR, LATER = 8760, 240  # windows


@dataclass(frozen=True, slots=True)
class Sound:
    """Of the windows: the ratio of the largest level to the least one, the part of the motion that is left as residual,
    the scatter of the noise, and its correlation from window to window."""

    levels: float
    part: float
    scatter: float
    correlation: float = 0.0


SOUND = (
    Sound(1.0, 0.0, 0.03),
    Sound(10.0, 0.0, 0.03),
    Sound(10.0, 0.02, 0.03),
    Sound(10.0, 0.1, 0.03),
    Sound(1.0, 0.02, 0.1),
    Sound(10.0, 0.02, 0.1),
    Sound(10.0, 0.02, 0.1, 0.9),
    Sound(10.0, 0.02, 0.3),
)


def drawn(random: np.random.Generator, sound: Sound, times: Array) -> Iterator[tuple[float, Array]]:
    """Motion and noise (3,) in m/s2 of windows whose floor is so many `times` (n,) the usual one."""
    own = np.zeros(3)
    for factor in times.tolist():
        fresh = np.sqrt(1.0 - sound.correlation**2) * sound.scatter * random.standard_normal(3)
        own = sound.correlation * own + fresh
        motion = LEVEL_MPS2 * sound.levels ** random.uniform()
        yield motion, np.hypot(factor * FLOOR_MPS2, sound.part * motion) * np.exp(own)


def told(random: np.random.Generator, sound: Sound, times: NDArray[Any]) -> list[int]:
    """The numbers of the windows at which something is told."""
    watch = NoiseHistory()
    windows = enumerate(drawn(random, sound, times))
    return [k for k, (motion, noise) in windows if watch.update(float(np.log(motion)), np.log(noise))]


def row(sound: Sound, seeds: int) -> str:
    """The row of the table."""
    alarms, first = 0, list[list[int]]([[], []])
    for seed in range(seeds):
        random = np.random.default_rng([seed, SOUND.index(sound)])
        alarms += len(told(random, sound, np.ones(YEAR)))
        later = np.maximum(np.arange(LATER) - FIRST, 0.0)
        for found, times in zip(first, (1.0 + (later > 0.0), 2.0 ** (later / 12.0)), strict=True):
            found.append(next((k - FIRST for k in told(random, sound, times) if k > FIRST), LATER))
    ends = [f"{np.median(found):.0f}, {max(found)}".replace(str(LATER), "not") for found in first]
    return (
        f"| {sound.levels:g} | {100.0 * sound.part:g} % | {100.0 * sound.scatter:g} % | {sound.correlation:g} "
        f"| {alarms} in {seeds * YEAR} | {ends[0]} | {ends[1]} |"
    )


def table(seeds: int) -> str:
    """A row for each kind of sound windows."""
    head = "levels to", "residual of the motion", "scatter", "correlation", "false alarms", "doubled", "every 12 h"
    return "\n".join([f"| {' | '.join(head)} |", "| --- " * len(head) + "|", *(row(sound, seeds) for sound in SOUND)])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    text = f"`python -m benchmarks.noise`, {machine()}. {given.seeds} seeds, an hour between windows.\n\n"
    text += table(given.seeds)
    if given.write:
        write_part("noise", text)
    else:
        print(text)
