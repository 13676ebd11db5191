"""A year in a building: at every window the calibration in force is compared with the truth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.config import Config
from agent.core.events import CalibrationUpdate, DriftReport, StatusChange, WindowReport
from benchmarks.online.config import building_config
from benchmarks.online.node import adxl355
from benchmarks.online.runner import EPOCH_NS, Run, visits
from hw.virtual.building import DAY_S, Building, BuildingParameters

Array = NDArray[np.float64]
MONTH_DAYS = 30.4
CHIP_HZ = 250.0  # output data rate of the sensor, an ADXL355
STEP_DAY = 150.0  # in month 5
STEP = 0.01  # change of S_yy
LOUD_MPS2 = 0.1
LOUD_WINDOWS = 10  # windows in which the step must be found
SYY, QZ = 4, 11
GRAVITY = np.array([0.0, 0.0, 9.80665])  # as stated in the configuration


def parameters(seed: int, elsewhere: float = 0.0) -> BuildingParameters:
    """The building of docs/online-evidence.md; quantities that are not known exactly are drawn."""
    random = np.random.default_rng([seed, 3])
    sensitivity = np.eye(3) + np.where(np.eye(3), 0.01, 0.005) * random.standard_normal((3, 3))
    step = np.zeros((3, 3))
    step[1, 1] = STEP * sensitivity[1, 1]
    axis = random.standard_normal(3) * [1.0, 1.0, 0.0]
    return BuildingParameters(
        sensor=adxl355(BuildingParameters().sensor, CHIP_HZ),
        elsewhere=elsewhere,
        sensitivity=sensitivity,
        steps=((STEP_DAY * DAY_S, step),),
        offset=0.1 * random.standard_normal(3),
        offset_a_day=np.array([0.02, -0.02, 0.02]) / MONTH_DAYS,
        offset_per_k=np.array([0.0098, -0.0049, 0.0098]),
        lag_s=0.0015,
        tilt_rad_a_day=np.deg2rad(0.05) / 365.0 * axis / np.linalg.norm(axis),
        reference_sensitivity=np.diag(1 + 1e-3 * random.standard_normal(3)),
    )


def config(building: Building, **keys: Any) -> Config:
    """The operator's configuration. `keys` are further keys of the channel, or replace its sections."""
    stated = {
        "prior": {"sensitivity": 1.0, "u_main_pct": 2.0, "u_transverse_pct": 1.0, "u_offset_mps2": 0.5},
        "certificate": {"u_sensitivity_pct": 0.1, "noise_mps2": 0.001, "stability_pct": 0.0},
        "uncertainty": {"offset_mps2": 0.002, "tilt_deg": 0.1, "gravity_mps2": 0.005},
        "temperature": {"offset_order": 1, "reference_degc": building.parameters.weather.mean_degc},
    }
    return building_config(building, **stated | keys)


@dataclass(slots=True)
class Year:
    """Observations by window. Errors are value in force minus true value; `u` are standard uncertainties."""

    time_s: list[float] = field(default_factory=list)
    syy_error: list[float] = field(default_factory=list)
    u_syy: list[float] = field(default_factory=list)
    mean_error_mps2: list[Array] = field(default_factory=list)
    offset_error: list[Array] = field(default_factory=list)
    u_offset: list[Array] = field(default_factory=list)
    columns: list[Array] = field(default_factory=list)
    drifts: list[DriftReport] = field(default_factory=list)
    statuses: list[StatusChange] = field(default_factory=list)
    windows: int = 0
    used: int = 0

    def step_found_after(self, building: Building) -> int | None:
        """Number of windows of level 0.1 or more from the step of S_yy to its report; None if it was not reported."""
        p = building.parameters
        at_s = STEP_DAY * DAY_S
        found = [d for d in self.drifts if d.parameter == "Syy" and d.verdict == "stepped"]
        found_s = [seconds(d.t_utc_ns) for d in found if seconds(d.t_utc_ns) >= at_s]
        if not found_s:
            return None
        visits_since = range(int(np.ceil(at_s / p.every_s)), int(found_s[0] // p.every_s) + 1)
        return sum(building.level_mps2(visit) >= LOUD_MPS2 for visit in visits_since)

    def alarms_before(self) -> list[DriftReport]:
        """Verdicts "stepped", or "drifting" of S, before the true step."""
        return [
            d
            for d in self.drifts
            if d.verdict != "stable"
            and seconds(d.t_utc_ns) < STEP_DAY * DAY_S
            and (d.parameter.startswith("S") or d.verdict == "stepped")
        ]


def seconds(t_utc_ns: int) -> float:
    """Seconds of the building's clock."""
    return (t_utc_ns - EPOCH_NS) * 1e-9


def at_temperature(update: CalibrationUpdate, degc: float) -> Array:
    """Q (3,) at the temperature `degc`."""
    offset = np.array(update.offset)
    for power, coefficients in enumerate(update.offset_temperature, start=1):
        offset = offset + np.array(coefficients) * (degc - update.reference_temperature_degc) ** power
    return offset


def whole(building: Building, numbers: range) -> Year:
    """Run the agent over these visits."""
    run, year = Run(config(building)), Year()
    for event in visits(building, numbers):
        for result in run.feed(event):
            if isinstance(result, CalibrationUpdate):
                _note(year, building, result)
            elif isinstance(result, DriftReport):
                year.drifts.append(result)
            elif isinstance(result, StatusChange):
                year.statuses.append(result)
            elif isinstance(result, WindowReport):
                year.windows += 1
                year.used += result.used
    return year


def settled_s(building: Building) -> float:
    """End of the windows in which the step must be found, s."""
    every_s = building.parameters.every_s
    visit, loud = int(np.ceil(STEP_DAY * DAY_S / every_s)), 0
    while loud < LOUD_WINDOWS:
        loud += building.level_mps2(visit) >= LOUD_MPS2
        visit += 1
    return visit * every_s


def facts(building: Building, year: Year) -> dict[str, str]:
    """Results as texts with numbers."""
    time_s = np.array(year.time_s)
    syy, u_syy = np.abs(year.syy_error), np.array(year.u_syy)
    mean = np.abs(year.mean_error_mps2).max(axis=1)
    offset = np.abs(np.array(year.offset_error)) / (2 * np.array(year.u_offset))
    after = time_s > settled_s(building)
    found = year.step_found_after(building)
    return {
        "windows, and how many of them were used": f"{year.windows}, {year.used}",
        f"step of {100 * STEP:g} % in S_yy on day {STEP_DAY:g} was detected after": (
            "never" if found is None else f"{found} windows of level {LOUD_MPS2:g} or more"
        ),
        "verdicts of the drift test before the step": "; ".join(d.reason for d in year.alarms_before()) or "none",
        f"largest error of S_yy, beginning {LOUD_WINDOWS} such windows after the step": (
            f"{100 * syy[after].max():.3f} %" if after.any() else ""
        ),
        "u(S_yy) at the end": f"{100 * u_syy[-1]:.3f} %",
        "largest error of the mean output (of 99 % of the windows)": (
            f"{1e3 * mean.max():.2f} ({1e3 * np.quantile(mean, 0.99):.2f}) mm/s2"
        ),
        "largest error of Q, divided by its U": f"{offset.max():.2f}",
        "U(Q) at the end": ", ".join(f"{2e3 * u:.0f}" for u in year.u_offset[-1]) + " mm/s2",
        "largest change of columns x and z of S": f"{np.abs(np.array(year.columns) - year.columns[0]).max():.1e}",
        "last changes of status": ", ".join(
            f"{s.status} ({seconds(s.t_utc_ns) / DAY_S:.1f} d)" for s in year.statuses[-6:]
        ),
    }


def table(found: dict[str, dict[str, str]]) -> str:
    """One column per run."""
    lines = ["| | " + " | ".join(found) + " |", "| --- |" + " --- |" * len(found)]
    first = next(iter(found.values()))
    lines += [f"| {name} | " + " | ".join(column[name] for column in found.values()) + " |" for name in first]
    return "\n".join(lines)


def _note(year: Year, building: Building, update: CalibrationUpdate) -> None:
    now_s = seconds(update.t_utc_ns)
    truth = building.truth(now_s)
    S, u = np.array(update.sensitivity), np.array(update.standard_uncertainty)
    year.time_s.append(now_s)
    true_syy = building.size(update.reference_frequency_hz) * truth.sensitivity[1, 1]
    year.syy_error.append(S[1, 1] / true_syy - 1)
    year.u_syy.append(u[SYY])
    held = np.array(update.sensitivity_at_0hz.sensitivity or update.sensitivity)
    if update.sensitivity_per_k:
        held = held + np.array(update.sensitivity_per_k) * (truth.temperature_degc - update.reference_temperature_degc)
    year.mean_error_mps2.append(held @ GRAVITY + at_temperature(update, truth.temperature_degc) - truth.mean_output)
    year.offset_error.append(np.array(update.offset) - truth.offset_at_mean)
    year.u_offset.append(u[9:])
    year.columns.append(S[:, [0, 2]])


def quicker(parameters: BuildingParameters, every_s: float, window_s: float) -> BuildingParameters:
    """The same building with fewer and shorter windows, for tests."""
    return replace(parameters, every_s=every_s, window_s=window_s)
