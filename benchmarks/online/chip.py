"""A sensor with the ADXL355's own filters beside a reference without any: stated by its driver, and not stated.

At an output data rate of 125 Hz the chip attenuates 12 Hz by 3 % and is 12 ms late; at 62.5 Hz it attenuates 12 Hz by
12 %, 18 Hz by 24 %, and is 24 ms late. Its driver states the filters with the uncertainty that the data sheet allows;
the certificate of the reference states `flat`, or nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.core.events import CalibrationUpdate, StatusChange, WindowReport
from benchmarks.online.node import Stated, Timing, adxl355, node
from benchmarks.online.runner import EPOCH_NS, Run, visits
from calib.model import Array
from hw.virtual.building import Building
from hw.virtual.building_motion import BuildingSpectrum

SEED, RUNS = 95_000, 20  # runs of each line
TIMING = Timing(20.0, 60.0, 10)
MAIN = [0, 4, 8]
Case = tuple[float, float, float]
# Output data rate and upper end of the motion in Hz; u of the lag of the clocks in s, as stated and as drawn.
CASES: tuple[Case, ...] = ((125.0, 12.0, 0.015), (62.5, 12.0, 0.015), (62.5, 18.0, 0.015), (62.5, 12.0, 0.003))
Job = tuple[Case, str, int]
KINDS = {
    "nothing": "nothing",
    "sensor": "by the driver of the sensor",
    "both": "by the driver of the sensor; `flat` by the certificate of the reference",
}


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """One run: (12,) errors over U; U of the main sensitivities (3,) of the first calibration and of the last; (9,)
    errors over U at 0 Hz; main sensitivities (3,) less the reference's error; windows used; whether it ended HELD."""

    job: Job
    over_u: Array
    first_u: Array
    last_u: Array
    over_u_at_0hz: Array
    main: Array
    used: int
    held: bool


def one(job: Job) -> Outcome:
    """Simulate one run."""
    (rate_hz, to_hz, u_lag_s), kind, seed = job
    stated = Stated(main_pct=3.0, transverse_pct=1.5, offset_mps2=0.5, lag_s=u_lag_s)
    drawn = node(seed, all_axes=True, stated=stated, timing=TIMING)
    parameters = drawn.building.parameters
    sensor = adxl355(parameters.sensor, rate_hz)
    sensor = replace(sensor, filters=sensor.filters if kind != "nothing" else ())
    reference = replace(parameters.reference, filters=("flat",) if kind == "both" else ())
    building = Building(
        replace(parameters, band=BuildingSpectrum(0.5, to_hz), sensor=sensor, reference=reference), seed
    )
    run, first, update, status, used = Run(drawn.config), None, None, "", 0
    for event in visits(building, range(TIMING.windows)):
        for result in run.feed(event):
            if isinstance(result, CalibrationUpdate):
                first, update = first or result, result
            elif isinstance(result, StatusChange):
                status = result.status
            used += isinstance(result, WindowReport) and result.used
    run.close()
    if first is None or update is None:
        over_u, first_u, last_u, over_u_at_0hz, main = (np.full(n, np.nan) for n in (12, 3, 3, 9, 3))
        return Outcome(job, over_u, first_u, last_u, over_u_at_0hz, main, used, status == "HELD")
    truth = building.truth((update.t_utc_ns - EPOCH_NS) * 1e-9)
    size = building.size(update.reference_frequency_hz)
    S, true_S = np.array(update.sensitivity).ravel(), truth.sensitivity.ravel()
    error = np.append(S - size * true_S, np.array(update.offset) - truth.offset_at_mean)
    first_u, expanded = (one.coverage_factor * np.array(one.standard_uncertainty) for one in (first, update))
    steady = update.sensitivity_at_0hz
    u_steady = update.coverage_factor * np.array(steady.standard_uncertainty).ravel()
    main = S[MAIN] * np.diag(parameters.reference_sensitivity) / (size * true_S[MAIN]) - 1.0
    return Outcome(
        job, np.where(update.determined, error / expanded, np.nan), first_u[MAIN], expanded[MAIN],
        (np.array(steady.sensitivity).ravel() - true_S) / u_steady, main, used, status == "HELD",
    )  # fmt: skip


def jobs(runs: int) -> list[Job]:
    """All runs; the same seeds for each kind."""
    return [(case, kind, SEED + run) for case in CASES for kind in KINDS for run in range(runs)]


def table(found: Sequence[Outcome]) -> str:
    """One row for each case and each kind of statement."""
    lines = [
        "| output data rate, Hz | motion to, Hz | u of the lag, ms | filters stated | windows used "
        "| RMS of S less the reference's error, % | median U of main S at first, % | at last, % "
        "| within U | most / U | within U at 0 Hz | most / U at 0 Hz | HELD |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for case, kind in dict.fromkeys(o.job[:2] for o in found):
        own = [o for o in found if o.job[:2] == (case, kind)]
        (rate_hz, to_hz, u_lag_s), used = case, sum(o.used for o in own)
        rms = np.sqrt(np.nanmean(np.square([o.main for o in own])))
        first_u, last_u = (np.nanmedian(values) for values in ([o.first_u for o in own], [o.last_u for o in own]))
        covered = [_covered(np.array(values)) for values in ([o.over_u for o in own], [o.over_u_at_0hz for o in own])]
        held = f"{sum(o.held for o in own)} of {len(own)}"
        lines.append(
            f"| {rate_hz:g} | {to_hz:g} | {1e3 * u_lag_s:g} | {KINDS[kind]} | {used} | {100.0 * rms:.3f} "
            f"| {100.0 * first_u:.2f} | {100.0 * last_u:.2f} | {' | '.join(covered)} | {held} |"
        )
    return "\n".join(lines)


def _covered(over_u: Array) -> str:
    told = np.abs(over_u[np.isfinite(over_u)])
    return f"{(told <= 1.0).sum()} of {told.size} | {told.max(initial=0.0):.2f}"
