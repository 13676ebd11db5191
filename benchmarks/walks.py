"""Drift far beyond what is stated, and sensors that are sound: is U right, what is told, and how often falsely?

Records are drawn, not samples: a year of a sensor takes seconds. `python -m benchmarks.walks [NAME ...] [--runs N]`
prints the tables of docs/drift.md:

- `defaults`: both default walks, `process.sensitivity_pct` and `certificate.stability_pct`, judged together
- `rows`: drifts of S, a mount that tilts, a step of the reference
- `sound`: 20 years of sensors that walk as it is stated
- `alarms`: the test of net changes alone, for many more years
"""

from __future__ import annotations

import argparse
import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as in every entry point of the product; must be set before numpy is loaded

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.config import Channel
from agent.config.knowledge import Certificate, Process
from agent.core.estimation import Estimation
from calib.drift.drift import DriftVerdict
from calib.drift.net_changes import LONGEST_DAYS, NetChanges, ReferenceView
from calib.estimate.quantities import YEAR_DAYS
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.windows.record import Record
from tests.building_windows import building_window

Array = NDArray[np.float64]
Course = Callable[[float], Array]
GRAVITY = np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2])
STILL = np.zeros(3)
MAIN = [0, 4, 8]
RATES_PCT = (0.5, 2.0, 10.0)  # a year, of S_xx, S_yy, S_zz: three channels of the reference, each of its own
DAYS = (30.0, 120.0, 365.0)
U_REFERENCE_PCT = 0.3
WALK_PCT, STABILITY_PCT = Process().sensitivity_pct, Certificate().stability_pct
EACH_DAY, THEN_DAYS = 40, 12.0  # a record each day at first, later every twelve days
DEFAULTS = ((0.005, 0.5), (0.052, 0.5), (0.026, 0.5), (WALK_PCT, STABILITY_PCT))
SEED = 90_000


class Drawn(Estimation):
    """An estimation whose windows are records already."""

    def _record(self, *_: object) -> Record:
        return self.drawn

    def take(self, record: Record) -> list[DriftVerdict]:
        """Judge one record."""
        self.drawn = record
        window = replace(WINDOW, sums=replace(WINDOW.sums))  # another object: it is another window
        return list(self.judge(window, record.day, 0.0, 20.0).drift)


WINDOW = building_window(np.random.default_rng(1), level_mps2=(0.1, 0.1, 0.1), S=np.eye(3), Q=np.zeros(3))
TEMPLATE = Record.of(WINDOW, 0.0, 0.0, 20.0, "A")


def channel(walk_pct: float, stability_pct: float) -> Channel:
    """A building beside a triad that is known to 0.3 %; all other settings default."""
    return Channel.model_validate({
        "sensor": "s", "reference": "A", "rotation": np.eye(3).ravel().tolist(), "window_s": 60.0,
        "rotation_gravity_mps2": GRAVITY.tolist(), "process": {"sensitivity_pct": walk_pct},
        "prior": {"sensitivity": 1.0, "u_main_pct": 1.0, "u_transverse_pct": 0.5, "u_offset_mps2": 0.5},
        "certificate": {"u_sensitivity_pct": U_REFERENCE_PCT, "stability_pct": stability_pct},
    })  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Life:
    """By window (W,): days, errors and standard uncertainties (W, 12) of the calibration in force, whether walks were
    widened; and what was told, with its day."""

    days: Array
    errors: Array
    u: Array
    widened: Array
    told: Sequence[tuple[float, DriftVerdict]]

    def told_of(self, parameter: str) -> float:
        """The day on which a drift of a parameter was told; NaN if never."""
        days = (day for day, verdict in self.told if verdict.parameter == parameter and verdict.verdict == "drifting")
        return next(days, np.nan)


def lived(
    stated: Channel, days: Array, seed: int, S: Course, reference: Course, mean: Course, windows: int = 1
) -> Life:
    """A life of one record, of so many windows, on each of `days`. On a day S (3, 3) is that of the sensor, the
    reference indicates 1 + `reference` (3,) times too much, and `mean` (3,) is added to the mean output."""
    random, found = np.random.default_rng([SEED, seed]), Drawn(stated, None)
    found.meet("A", "", 1.0)
    errors, u, widened, told = [], [], [], []
    for day in days.tolist():
        record = drawn(random, day, S(day), windows, reference(day), mean(day))
        told += [(day, verdict) for verdict in found.take(record)]
        errors.append(np.append(found.in_force.sensitivity - S(day), found.in_force.offset))
        u.append(found.in_force.standard_uncertainty)
        widened.append(bool(found.net_changes.widened))
    return Life(days, np.array(errors), np.array(u), np.array(widened), told)


def drawn(
    random: np.random.Generator,
    day: float,
    S: Array,
    windows: int = 1,
    reference: Array = STILL,
    mean: Array = STILL,
) -> Record:
    """One record of so many windows of a sensor with the sensitivity `S` (3, 3) beside a reference that indicates
    1 + `reference` (3,) times too much; `mean` (3,) is added to the mean output."""
    own = replace(TEMPLATE, root=TEMPLATE.root * np.sqrt(windows), count=TEMPLATE.count * windows, windows=windows)
    slopes = own.root[:, :3] @ (S / (1.0 + reference)).T + own.noise * random.normal(size=(6, 3))
    means = S @ GRAVITY + mean + 0.05 / np.sqrt(windows) * random.normal(size=3)  # the scatter of windows, as stated
    return replace(own, day=day, days=(day, day), slopes=slopes, means=means[None])


def none(_: float) -> Array:
    """Nothing changes."""
    return STILL


def drifting(day: float) -> Array:
    """S whose main elements drift by RATES_PCT."""
    return np.diag(1.0 + np.array(RATES_PCT) / 100.0 * day / YEAR_DAYS)


def year() -> Array:
    """The days of the records of a year."""
    return np.append(np.arange(float(EACH_DAY)), np.arange(float(EACH_DAY), YEAR_DAYS + THEN_DAYS, THEN_DAYS))


def defaults(_: int) -> None:
    """u after 30 sound days, and error over u at three drifts, for pairs of default walks."""
    at = " | ".join(f"{rate:g} %" for rate in RATES_PCT)
    print(f"| walk of S, % a root day (a root year) | reference | u after 30 sound days, % | {at} | told, day |")
    print("| --- | --- | --- |" + " --- |" * (len(RATES_PCT) + 1))
    for walk, stability in DEFAULTS:
        stated = channel(walk, stability)
        sound = lived(stated, np.arange(31.0), 1, lambda _: np.eye(3), none, none, 12)
        life = lived(stated, year(), 1, drifting, none, none, 12)
        ratio = np.abs(life.errors / life.u)[:, MAIN]
        rows = [np.searchsorted(life.days, day) for day in DAYS]
        by_rate = [", ".join(f"{ratio[row, k]:.1f}" for row in rows) for k in range(3)]
        told = ", ".join(f"{life.told_of(p):.0f}".replace("nan", "never") for p in ("Sxx", "Syy", "Szz"))
        u = 100.0 * sound.u[-1, MAIN].mean()
        print(f"| {walk:g} ({walk * YEAR_DAYS**0.5:.2f}) | {stability:g} | {u:.3f} | {' | '.join(by_rate)} | {told} |")


def rows(runs: int) -> None:
    """Each line of the issue, `runs` seeds."""
    stated = channel(WALK_PCT, STABILITY_PCT)
    print("| what happens | runs | told, day (all runs) | largest error over u | windows beyond 2 u | runs with such |")
    print("| --- | --- | --- | --- | --- | --- |")
    lives = [lived(stated, year(), seed, drifting, none, none, 12) for seed in range(runs)]
    for rate, k, name in zip(RATES_PCT, MAIN, ("Sxx", "Syy", "Szz"), strict=True):
        _row(f"S drifts by {rate:g} % a year, 365 days", lives, [k], name)
    leaning = np.deg2rad(1.0) / 30.4 * STANDARD_GRAVITY_MPS2
    days = np.arange(45.0)
    lives = [
        lived(stated, days, seed, lambda _: np.eye(3), none, lambda day: np.array([leaning * day, 0.0, 0.0]), 12)
        for seed in range(runs)
    ]
    _row("the mount tilts by 1 deg a month, 45 days", lives, [9, 10, 11], "Qx")
    step = 12.0
    lives = [
        lived(
            stated, np.arange(0.0, 20.0, 0.25), seed, lambda _: np.eye(3),
            lambda day: np.array([0.0, 0.007 * (day >= step), 0.0]), none,
        )
        for seed in range(runs)
    ]  # fmt: skip
    _row("reference y steps by 0.7 % on day 12, four windows a day", lives, [4], "Syy")
    grown = [life.u[-1, 4] / life.u[life.days < step][-1, 4] for life in lives]
    print(f"\nu(S_yy) after the step over u before it: {min(grown):.2f} to {max(grown):.2f}")


def _row(what: str, lives: Sequence[Life], which: Sequence[int], parameter: str) -> None:
    told = [life.told_of(parameter) for life in lives]
    ratio = np.array([np.abs(life.errors / life.u)[:, which].max(axis=1) for life in lives])
    days = (
        "never"
        if np.isnan(told).all()
        else f"{np.nanmin(told):.0f} to {np.nanmax(told):.0f} ({np.isfinite(told).sum()})"
    )
    beyond = ratio > 2.0
    print(
        f"| {what} | {len(lives)} | {days} | {ratio.max():.2f} | {beyond.sum()} of {beyond.size} "
        f"| {beyond.any(axis=1).sum()} |", flush=True,
    )  # fmt: skip


def sound(runs: int) -> None:
    """Sensors that walk as stated, with their references and mounts, four years each."""
    stated, years, each_days = channel(WALK_PCT, STABILITY_PCT), 4.0, 7.0
    alarms, widened, beyond, windows = [], [], 0, 0
    for seed in range(runs):
        random = np.random.default_rng([SEED, 1, seed])
        days = np.arange(0.0, years * YEAR_DAYS, each_days)
        walks = random.normal(size=(len(days), 9)) * WALK_PCT / 100.0 * np.sqrt(each_days)
        S = dict(zip(days.tolist(), np.eye(3) + np.cumsum(walks, axis=0).reshape(-1, 3, 3), strict=True))
        walks = random.normal(size=(len(days), 3)) * STABILITY_PCT / 100.0 * np.sqrt(each_days / YEAR_DAYS)
        reference = dict(zip(days.tolist(), np.cumsum(walks, axis=0), strict=True))
        process = Process()
        walks = random.normal(size=(len(days), 3)) * process.offset_mps2 * np.sqrt(each_days)
        mean = random.normal(size=3) * process.offset_rate_mps2 * days[:, None] + np.cumsum(walks, axis=0)
        means = dict(zip(days.tolist(), mean, strict=True))
        life = lived(stated, days, seed, S.__getitem__, reference.__getitem__, means.__getitem__, 12)
        alarms += [f"{verdict.parameter} {verdict.verdict}" for _, verdict in life.told if verdict.verdict != "stable"]
        widened.append(life.widened.mean())
        ratio = np.abs(life.errors / life.u)[:, :9]
        beyond, windows = beyond + int((ratio > 2.0).sum()), windows + ratio.size
    print(
        f"{runs * years:g} years of sound sensors: {len(alarms)} alarms ({', '.join(alarms)}); widened "
        f"{100 * np.mean(widened):.0f} % of the time; S within 2 u: {100 * (1 - beyond / windows):.1f} %"
    )


def alarms(runs: int) -> None:
    """The test of net changes on values that walk as stated, a value a day, as one reference shows them."""
    rate, told, wide, days = 0.05, 0, 0, 2 * LONGEST_DAYS
    a_day = np.append(np.full(9, 1.0), np.full(3, 1.0))
    zero = np.zeros(12)
    for seed in range(runs):
        values = np.cumsum(np.random.default_rng([SEED, 2, seed]).normal(size=(days, 12)), axis=0)
        net = NetChanges(rate)
        makers = [{f"{p}": (1.0, 1.0), "r": (1.0, 1.0)} for p in range(12)]
        for day, value in enumerate(values):
            shown = ReferenceView(float(day), value, zero, zero, a_day, zero, zero, makers, True)
            told += len([v for v in net.update({"A": shown}) if v.verdict == "drifting"])
            wide += bool(net.widened)
            if net.drifting:
                net.restart()
    years = runs * days / YEAR_DAYS
    share = 100 * wide / (runs * days)
    print(
        f"{years:.0f} sensor-years: {told} alarms, {rate * years:.0f} by the formula; widened {share:.0f} % of the time"
    )


NAMES: dict[str, Callable[[int], None]] = {"defaults": defaults, "rows": rows, "sound": sound, "alarms": alarms}


def main() -> None:
    """Print the tables that are named, or all."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.walks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--runs", type=int, help="seeds (20; `sound`: 5; `alarms`: 25)")
    chosen: Any = parser.parse_args()
    for name in chosen.names or NAMES:
        NAMES[name](chosen.runs or {"sound": 5, "alarms": 25}.get(name, 20))


if __name__ == "__main__":
    main()
