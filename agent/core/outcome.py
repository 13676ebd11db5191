"""Makes results from what an estimation found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from agent.config.knowledge import Certificate
from agent.core.events import (
    BandResponse,
    CalibrationUpdate,
    DriftReport,
    Estimate,
    SharedError,
    StatusChange,
    SteadySensitivity,
    WindowReport,
)
from calib.drift.drift import DriftVerdict
from calib.estimate.quantities import RATES, SENSITIVITY_PER_K, offset_temperature
from calib.estimate.reference_share import ReferenceShare
from calib.estimate.response_told import ResponseTold
from calib.model import Array, Calibration, Window
from calib.state.sources import Sources
from calib.state.state import FIRST, State

UNCERTAINTY = "combined"
MOST_TEMPERATURE_ORDER = 2


@dataclass(frozen=True, slots=True)
class ResultSource:
    """The sensor of the results and the time at which they are made. The pipeline adds run and sequence."""

    sensor: str
    identity: str
    output_unit: str
    t_utc_ns: int


def calibration_update(
    source: ResultSource,
    calibration: Calibration,
    state: State,
    shares: Sequence[ReferenceShare],
    certificate_of: Callable[[str], Certificate | None],
    place: int = FIRST,
) -> CalibrationUpdate:
    """S and Q with temperature coefficients, drift rates, the number of windows, and the response beside the reference
    at a place.

    `shares`: what S and Q owe to the references, empty where that is not known. `certificate_of` a reference: None if
    it is not connected.
    """
    names = state.names(place)
    powers = [k for k in range(1, MOST_TEMPERATURE_ORDER + 1) if offset_temperature(k)[0] in names]
    by_power = [_both(state, offset_temperature(k)) for k in powers]
    rows = [SENSITIVITY_PER_K[k : k + 3] for k in range(0, 9, 3)] if SENSITIVITY_PER_K[0] in names else []
    by_row = [_both(state, row) for row in rows]
    rate, u_rate = _both(state, RATES)
    low, high = state.temperature_range_degc
    return CalibrationUpdate(
        run_id="", sequence=0, sensor=source.sensor, t_utc_ns=source.t_utc_ns,
        sensitivity=calibration.sensitivity.tolist(), offset=calibration.offset.tolist(),
        standard_uncertainty=calibration.standard_uncertainty.tolist(), covariance=calibration.covariance.tolist(),
        coverage_factor=state.coverage_factor, determined=calibration.determined.tolist(),
        method=calibration.method, uncertainty_kind=UNCERTAINTY, windows=state.windows,
        residual_sd=state.residual_sd.tolist(), output_unit=source.output_unit, identity=source.identity,
        reference_temperature_degc=state.reference_temperature_degc,
        temperature_low_degc=low, temperature_high_degc=high,
        offset_temperature=[value for value, _ in by_power], u_offset_temperature=[u for _, u in by_power],
        sensitivity_per_k=[value for value, _ in by_row], u_sensitivity_per_k=[u for _, u in by_row],
        offset_rate=rate, u_offset_rate=u_rate, references=[name for name in state.references if name],
        reference_frequency_hz=state.reference_frequency_hz, **_over_frequency(state.response_over_frequency(place)),
        shared_errors=_shared_errors(shares, certificate_of),
    )  # fmt: skip


def with_budget(update: CalibrationUpdate, budget: Sources | None) -> CalibrationUpdate:
    """The update with what makes its U, where that is known."""
    if budget is None:
        return update
    told = {source: u.tolist() for source, u in budget.by_source.items()}
    return msgspec.structs.replace(update, budget=told, degrees_of_freedom=budget.degrees_of_freedom.tolist())


def _shared_errors(
    shares: Sequence[ReferenceShare], certificate_of: Callable[[str], Certificate | None]
) -> list[SharedError]:
    found = []
    for share in shares:
        certificate = certificate_of(share.reference)
        told = ("", "") if certificate is None else (certificate.serial_number, certificate.sha256)
        found.append(SharedError(**share.as_object(*told)))
    return found


def _over_frequency(told: ResponseTold | None) -> dict[str, Any]:
    """The fields of an update that tell the response over frequency."""
    if told is None:
        return {}
    return {
        "valid_band_hz": list(told.valid_band_hz),
        "sensitivity_at_0hz": SteadySensitivity(
            sensitivity=told.at_0hz.tolist(), standard_uncertainty=told.u_at_0hz.tolist()
        ),
        "response": [
            BandResponse(
                low_hz=band.low_hz,
                high_hz=band.high_hz,
                sensitivity_re=band.sensitivity.real.tolist(),
                sensitivity_im=band.sensitivity.imag.tolist(),
                standard_uncertainty=band.standard_uncertainty.tolist(),
            )
            for band in told.bands
        ],
    }


def again(update: CalibrationUpdate, before: CalibrationUpdate) -> CalibrationUpdate:
    """`update` for a calibration that comes into force again.

    It keeps the identity, the date, the shared errors and the budget that it has in `before`.
    """
    run_id, sequence = before.made
    return msgspec.structs.replace(
        update, made_run_id=run_id, made_sequence=sequence, made_utc_ns=before.date_utc_ns,
        made_engine=before.by_engine,
        shared_errors=before.shared_errors, budget=before.budget, degrees_of_freedom=before.degrees_of_freedom,
    )  # fmt: skip


def calibration_of(update: CalibrationUpdate) -> Calibration:
    """The calibration in an update."""
    return Calibration(
        np.array(update.sensitivity), np.array(update.offset), np.array(update.covariance),
        np.array(update.determined, dtype=bool), np.inf, update.method,
    )  # fmt: skip


def estimate(source: ResultSource, reason: str, update: CalibrationUpdate) -> Estimate:
    """A proposal that an operator can accept."""
    return Estimate(
        run_id="", sequence=0, sensor=source.sensor, t_utc_ns=source.t_utc_ns, reason=reason, calibration=update
    )


def drift_report(
    source: ResultSource, verdict: DriftVerdict, false_alarms_a_year: float, origin_utc_ns: int
) -> DriftReport:
    """A verdict of the sequential test, with its onset in UTC."""
    onset = round(verdict.onset_s * 1e9) + origin_utc_ns if np.isfinite(verdict.onset_s) else 0
    return DriftReport(
        run_id="", sequence=0, sensor=source.sensor, t_utc_ns=source.t_utc_ns, parameter=verdict.parameter,
        verdict=verdict.verdict, change=verdict.change, u_change=verdict.u_change, rate=verdict.rate,
        u_rate=verdict.u_rate, onset_utc_ns=onset, statistic=verdict.statistic, threshold=verdict.threshold,
        false_alarms_a_year=false_alarms_a_year, reason=verdict.reason,
    )  # fmt: skip


def window_report(
    source: ResultSource, window: Window, *, used: bool, reason: str, numbers: dict[str, float], fault: str = ""
) -> WindowReport:
    """The verdict on a window. Its numbers are those of the excitation, then those of the gate."""
    return WindowReport(
        run_id="", sequence=0, sensor=source.sensor, t_utc_ns=source.t_utc_ns, start_s=window.start_s,
        stop_s=window.stop_s, position=window.pose.position, used=used, reason=reason, points=window.points,
        left_out=window.left_out, numbers={**window.numbers, **numbers}, fault=fault,
    )  # fmt: skip


def status_change(source: ResultSource, status: str, before: str, reason: str) -> StatusChange:
    """A change of status, or news while the status stays: for example why a command was refused."""
    return StatusChange(
        run_id="", sequence=0, sensor=source.sensor, t_utc_ns=source.t_utc_ns,
        status=status, before=before, reason=reason,  # type: ignore[arg-type]
    )  # fmt: skip


def _both(state: State, names: Sequence[str]) -> tuple[list[float], list[float]]:
    found: Array = np.array([state.quantity(name) for name in names])
    return found[:, 0].tolist(), found[:, 1].tolist()
