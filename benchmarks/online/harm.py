"""Faults of sensor or reference (harm): none may change the calibration in force; other windows must be used."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from agent.core.events import CalibrationUpdate, DriftReport, Estimate, Result, StatusChange, WindowReport
from benchmarks.online.node import Node, Timing, node
from benchmarks.online.runner import EPOCH_NS, Run, visits
from calib.model import PARAMETERS
from hw.virtual.harm import HARMLESS
from hw.virtual.harm_kinds import KINDS

SEED = 20_000
TIMING = Timing(20.0, 60.0, 12)
CHIP_HZ = 125.0  # output data rate of the sensor, an ADXL355
KNOWN_WINDOWS = 4  # windows before the fault, in every other run
# A parameter is wrong if it differs from the truth by more standard uncertainties (for k = 2; else in proportion)
FACTOR_U = 4.0
UNSUPPORTED = ("the reference is calm here",)  # reasons of windows that are not expected to be used
MAIN = np.eye(3, dtype=bool)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a run. `wrong`: the first wrong calibration that was accepted, or ""; the counts start at the fault."""

    kind: str
    name: str
    seed: int
    wrong: str
    status: str
    windows: int
    used: int
    updates: int
    estimates: int
    drifts: int
    reasons: tuple[tuple[str, int], ...]


def harmed(kind: str, seed: int, timing: Timing = TIMING) -> Outcome:
    """Simulate one run with a fault of this kind ("" for none); everything is drawn from the seed."""
    random = np.random.default_rng([seed, 7])
    harm = KINDS[kind](random) if kind else HARMLESS
    since = KNOWN_WINDOWS * int(random.integers(2)) if kind else 0
    drawn = node(seed, all_axes=bool(random.integers(2)), harm=harm, harmed_from=since, timing=timing, chip_hz=CHIP_HZ)
    run = Run(drawn.config)
    results = [r for event in visits(drawn.building, range(timing.windows)) for r in run.feed(event)]
    return _outcome(kind, harm.name, seed, drawn, since, results)


def _outcome(kind: str, name: str, seed: int, drawn: Node, since: int, results: list[Result]) -> Outcome:
    from_s = drawn.building.span(since)[0]
    later = [r for r in results if (r.t_utc_ns - EPOCH_NS) * 1e-9 >= from_s and not isinstance(r, DriftReport)]
    windows = [r for r in later if isinstance(r, WindowReport) and r.start_s >= from_s - 1.0]
    windows = [w for w in windows if w.reason not in UNSUPPORTED]
    updates = [r for r in later if isinstance(r, CalibrationUpdate)]
    statuses = [r for r in results if isinstance(r, StatusChange)]
    reasons = Counter(plain(w.reason) for w in windows)
    return Outcome(
        kind or "none", name, seed,
        wrong=next((why for update in updates if (why := wrong(update, drawn, name != "none"))), ""),
        status=statuses[-1].status if statuses else "",
        windows=len(windows), used=sum(w.used for w in windows), updates=len(updates),
        estimates=sum(isinstance(r, Estimate) for r in later),
        drifts=sum(isinstance(r, DriftReport) for r in results),
        reasons=tuple(sorted(reasons.items(), key=lambda item: -item[1])),
    )  # fmt: skip


def wrong(update: CalibrationUpdate, drawn: Node, harmed: bool) -> str:
    """Why a calibration in force is wrong, or "".

    It is wrong if a determined parameter is off the truth, or if S is further from its nominal value than max_change.
    """
    building = drawn.building
    output = building.harm.output if harmed else np.eye(3)
    true = building.truth((update.t_utc_ns - EPOCH_NS) * 1e-9)
    size = building.size(update.reference_frequency_hz)
    truth = np.concatenate([(size * output @ true.sensitivity).ravel(), output @ true.offset_at_mean])
    value = np.concatenate([np.ravel(update.sensitivity), update.offset])
    determined = np.array(update.determined)
    u = update.coverage_factor / 2.0 * np.array(update.standard_uncertainty)
    gate = drawn.config.channels[0].gate
    limit = np.where(MAIN, gate.max_change_main_pct, gate.max_change_transverse_pct) / 100
    off = np.where(determined, np.abs(value - truth) / u, 0.0)
    far = np.where(determined[:9], np.abs(value[:9] - np.eye(3).ravel()) / limit.ravel(), 0.0)
    if off.max() > FACTOR_U:
        return f"{PARAMETERS[int(off.argmax())]} is off the truth by {off.max():.1f} u"
    if far.max() > 1.0:
        return f"{PARAMETERS[int(far.argmax())]} is further than max_change: {far.max():.2f} of it"
    return ""


def plain(reason: str) -> str:
    """A reason without its numbers and parameters, for counting."""
    words = re.split(r"; |: (?=[SQ][xyz]|common)", reason)[0]
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", words)


def table(outcomes: Iterable[Outcome]) -> str:
    """One row per kind: runs, wrong acceptances, final statuses, most frequent reasons."""
    by_kind: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        by_kind.setdefault(outcome.kind, []).append(outcome)
    lines = [
        "| harm | runs | wrong acceptances | windows refused or held | status at the end | commonest reasons |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for kind, runs in by_kind.items():
        windows, used = sum(o.windows for o in runs), sum(o.used for o in runs)
        statuses = Counter(o.status for o in runs)
        reasons: Counter[str] = Counter()
        for outcome in runs:
            reasons.update(dict(outcome.reasons))
        said = "; ".join(f"{r or 'taken'} ({100 * n / windows:.0f} %)" for r, n in reasons.most_common(3))
        states = ", ".join(f"{status} {n}" for status, n in statuses.most_common())
        refused = f"{100 * (1 - used / windows):.1f} %" if windows else "no window"
        lines.append(f"| {kind} | {len(runs)} | {sum(bool(o.wrong) for o in runs)} | {refused} | {states} | {said} |")
    return "\n".join(lines)
