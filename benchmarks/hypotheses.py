"""Which device has changed? Two references beside one sensor at the level of records; steps of one device.

    python -m benchmarks.hypotheses [--seeds 20] [--write]

Windows of both references take turns. A window that contradicts the state is held; five held ones are judged as the
agent does it (agent/core/hypotheses.py). Right: the device is named. Wrong: another one is. Undecided: neither, or
fewer than five windows contradict within the thirty after the step, which is then a change that U covers.

And what does a change look like, twelve windows after it, beside one reference? Right: its shape is told, alone or with
others that fit alike. Wrong: another shape alone.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np

from agent.core.hypotheses import Devices, confirmed, shape_of_change
from benchmarks.page import machine, write_part
from calib.distributions import chi2_quantile
from calib.estimate.nuisances import Priors
from calib.estimate.wander import TemperatureModel, Wander
from calib.state.state import State
from calib.windows.record import Record
from hw.virtual.schedule import rotation
from tests.building_windows import building_window

SIZES, KINDS = (0.003, 0.005, 0.01, 0.03), ("sensor", "reference in use", "check reference", "mount")
BEFORE, AFTER, HELD, LEVEL = 20, 30, 5, (0.3, 0.3, 0.3)
WEAK, SINCE = (0.03, 0.03, 0.03), 12  # motion of a bridge on a calm day, and windows since a change
SHAPES = {  # and what tells them
    "turn": "a turn of the sensor", "one output": "output y of the sensor", "all outputs": "all outputs",
    "one element": "", "nothing": "",
}  # fmt: skip
MEAN = np.append(np.eye(3).ravel(), np.zeros(3))
U = np.append(np.where(np.eye(3).ravel() > 0, 0.02, 0.01), np.full(3, 0.5))
TURNS = "ABBABAABBAABABBA"  # Thue and Morse
PRIORS = Priors(reference=1e-3, reference_drift=5e-3, rotation_rad=3e-3, offset_mps2=0.01)


def limit(degrees_of_freedom: float) -> float:
    """Of chi-squared: one sound window in 10,000 has more."""
    return chi2_quantile(1.0 - 1e-4, degrees_of_freedom)


def verdict(kind: str, size: float, seed: int) -> str:
    """What the agent says after the step: right, wrong or undecided."""
    random = np.random.default_rng([seed, KINDS.index(kind), round(size * 1e4)])
    state = State(MEAN, U, PRIORS, Wander(), TemperatureModel(), fixed=True, check=[PRIORS])
    errors = {name: 1.0 + 1e-3 * random.standard_normal(3) for name in "AB"}
    S = np.eye(3) + 0.01 * random.standard_normal((3, 3))
    for place, name in enumerate("AB"):
        state.meet(name, place=place)
    held: list[Record] = []
    stepped = "A" if kind == "reference in use" else "B"
    for k in range(BEFORE + AFTER):
        name, day = TURNS[k % len(TURNS)], k / 24.0
        if k == BEFORE and kind == "sensor":
            S = S * (1.0 + size)
        elif k == BEFORE and kind == "mount":
            S = S @ rotation(np.array([0.6, 0.0, 0.8]), size)
        elif k == BEFORE:
            errors[stepped] = errors[stepped] * (1.0 + size)
        window = building_window(random, level_mps2=LEVEL, S=S, reference_error=errors[name] - 1.0)
        record = Record.of(window, day, reference=name, to_hz=state.motion_to_hz)
        told = state.innovation(record)
        if told.statistic <= limit(told.degrees_of_freedom) or k < BEFORE:
            state.update(record)
            continue
        held.append(record)
        if len(held) == HELD:
            other = "B" if name == "A" else "A"
            adopted, who = confirmed(state, held, Devices(name, other, 5e-3, "AB".index(name)), limit)
            if adopted is None or not who or "tells whether" in who:
                return "undecided"
            named = "sensor" if "the sensor has changed" in who else f"reference {who.split('the reference ')[1][0]}"
            right = "sensor" if kind in ("sensor", "mount") else f"reference {stepped}"
            return "right" if named == right else "wrong"
    return "undecided"


def shape(kind: str, size: float, seed: int) -> str:
    """What the agent says of the shape of a change: right, alike, wrong or none."""
    random = np.random.default_rng([seed, list(SHAPES).index(kind), round(size * 1e4)])
    state = State(MEAN, U, PRIORS, Wander(), TemperatureModel(), fixed=True)
    state.meet("A")
    error, S, axis = 1e-3 * random.standard_normal(3), np.eye(3) + 0.01 * random.standard_normal((3, 3)), 1
    way = random.standard_normal(3)
    after = {
        "turn": S @ rotation(way / np.linalg.norm(way), size), "one output": S + size * np.diag(np.eye(3)[axis]) @ S,
        "all outputs": S * (1.0 + size), "one element": S + size * np.outer(np.eye(3)[0], np.eye(3)[2]), "nothing": S,
    }[kind]  # fmt: skip
    for k in range(BEFORE + SINCE):
        window = building_window(random, level_mps2=WEAK, S=S if k < BEFORE else after, reference_error=error)
        state.update(Record.of(window, k / 24.0, reference="A", to_hz=state.motion_to_hz))
    told = shape_of_change(state, BEFORE / 24.0, np.eye(3), limit)
    if not told or SHAPES[kind] not in told or not SHAPES[kind]:
        return "wrong" if told else "none"
    return "right" if " or " not in told else "alike"


def table(head: str, judged: Callable[[str, float, int], str], kinds: Iterable[str], seeds: int, *words: str) -> str:
    """A row for each kind, a column for each size: how often each of the `words` was the verdict of that many seeds."""
    rows = [
        f"| {head} | " + " | ".join(f"{100 * size:g} %" for size in SIZES) + " |",
        "| --- " * (len(SIZES) + 1) + "|",
    ]
    for kind in kinds:
        counts = [Counter(judged(kind, size, seed) for seed in range(seeds)) for size in SIZES]
        rows.append(f"| {kind} | {' | '.join(', '.join(str(count[word]) for word in words) for count in counts)} |")
    return "\n".join(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    text = f"`python -m benchmarks.hypotheses`, {machine()}. Right, wrong, undecided of {given.seeds}.\n\n"
    text += table("step of", verdict, KINDS, given.seeds, "right", "wrong", "undecided")
    text += f"\n\nOf a shape: right, as fitting alike, another one, none, of {given.seeds}.\n\n"
    text += table("change", shape, SHAPES, given.seeds, "right", "alike", "wrong", "none")
    if given.write:
        write_part("hypotheses", text)
    else:
        print(text)
