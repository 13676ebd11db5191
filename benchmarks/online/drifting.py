"""A sensor whose sensitivity drifts far faster than the configuration states: is U right, and is the drift found?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.core.events import CalibrationUpdate, DriftReport, StatusChange, WindowReport
from benchmarks.online.config import building_config
from benchmarks.online.node import Timing, node
from benchmarks.online.runner import Run, visits
from hw.virtual.building import Building

SEED, RUNS = 60_000, 20  # of each kind
TIMING = Timing(20.0, 6 * 3600.0, 480)
PROCESS_PCT = 0.005  # per square-root day, as stated: 0.1 % a year
RATE_PCT = 10.0  # of S_yy a year
SYY = 4
BEYOND_U = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Drifted:
    """A run. `errors` (W, 12) are errors over u of the calibration in force after each window with the status VALID or
    RECALIBRATING, NaN where a parameter is not determined. `held` windows did not fit, of `windows`. `found` are the
    verdicts "stepped" and "drifting", each with its parameter."""

    errors: NDArray[np.float64]
    windows: int
    held: int
    found: Sequence[tuple[str, str]]

    @property
    def beyond(self) -> int:
        """Windows after which a parameter was wrong by more than BEYOND_U."""
        return int(np.sum(np.any(np.abs(self.errors) > BEYOND_U, axis=1)))


def one(seed: int, rate_pct: float, timing: Timing = TIMING) -> Drifted:
    """One building whose faults are drawn from the stated uncertainties; S_yy drifts by `rate_pct` a year."""
    drawn = node(seed, all_axes=True, timing=timing)
    a_day = np.zeros((3, 3))
    a_day.flat[SYY] = rate_pct / 100 / 365.25
    building = Building(replace(drawn.building.parameters, sensitivity_a_day=a_day), seed)
    keys = drawn.stated.keys()
    run = Run(building_config(building, **keys | {"process": keys["process"] | {"sensitivity_pct": PROCESS_PCT}}))
    errors, found, windows, held, status = [], [], 0, 0, ""
    update: CalibrationUpdate | None = None
    for event in visits(building, range(timing.windows)):
        results = run.feed(event)
        for result in results:
            if isinstance(result, CalibrationUpdate):
                update = result
            elif isinstance(result, StatusChange):
                status = result.status
            elif isinstance(result, DriftReport) and result.verdict != "stable":
                found.append((result.parameter, result.verdict))
        for report in (result for result in results if isinstance(result, WindowReport)):
            windows, held = windows + 1, held + ("innovation_chi2" in report.numbers and not report.used)
            if update is not None and status in ("VALID", "RECALIBRATING"):
                errors.append(_error(building, update, run.now_s))
    return Drifted(np.array(errors), windows, held, found)


def _error(building: Building, update: CalibrationUpdate, now_s: float) -> NDArray[np.float64]:
    """(12,) errors over u of the calibration in force, at this moment."""
    truth = building.truth(now_s)
    value = np.append(np.ravel(update.sensitivity), update.offset)
    error = value - np.append(truth.sensitivity.ravel(), truth.offset_at_mean)
    return np.where(update.determined, error / np.array(update.standard_uncertainty), np.nan)


def table(runs: Sequence[Drifted], rate_pct: float) -> str:
    """One row."""
    errors = np.concatenate([run.errors for run in runs])
    known = np.abs(errors[np.isfinite(errors)])
    windows, held, beyond, verdicts = (
        sum(each) for each in zip(*((r.windows, r.held, r.beyond, len(r.found)) for r in runs), strict=True)
    )
    inside = f"{100 * np.mean(known <= 2):.1f} %"
    row = (f"{rate_pct:g} % a year", len(runs), windows, held, len(errors), beyond, f"{known.max():.2f} u", inside)
    return f"| {' | '.join(str(part) for part in (*row, verdicts))} |"


HEADER = (
    "| S_yy drifts by | runs | windows | held | VALID | error > 3 u | largest error | within 2 u | verdicts |"
    "\n| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)
