"""Describes results and their publication in words for people."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from agent.core.events import (
    CalibrationUpdate,
    ClockReport,
    DriftReport,
    Estimate,
    Gap,
    Result,
    SelfTestReport,
    StatusChange,
    WatchReport,
    WindowReport,
)
from agent.terminal.held import is_held
from agent.terminal.quantity import counted, size
from calib.model import Array
from calib.output_unit import shown_in
from calib.rounding import plus_minus

if TYPE_CHECKING:
    from agent.delivery.publication import PublicationState
    from agent.terminal.state import RecordingState, ShownTruth

COVERAGE_FACTOR = 2.0  # of U in texts, for about 95 % coverage
STATUS_STYLES = {"VALID": "bold green", "HELD": "yellow", "RECALIBRATING": "yellow", "INVALID": "bold red"}


def result_lines(result: Result, truth: ShownTruth | None) -> list[str]:
    """A result as lines of text."""
    match result:
        case WindowReport():
            return [f"{result.sensor}: window {window_span(result)} at {result.position}: {verdict(result)}"]
        case StatusChange():
            return [f"{result.sensor}: {result.status}{f', {result.reason}' if result.reason else ''}"]
        case DriftReport():
            return [f"{result.sensor}: {result.parameter} {result.verdict}: {result.reason}"]
        case Estimate():
            lines = [f"{result.sensor}: estimate {result.sequence}, not in force: {result.reason}"]
            return lines + [f"  {row}" for row in calibration_rows(result.calibration)]
        case ClockReport():
            return [f"{result.sensor}: {clock_words(result)}"]
        case WatchReport():
            return [f"{result.sensor}: {watch_words(result)}"]
        case SelfTestReport():
            return [f"{result.sensor}: {self_test_words(result)}"]
        case CalibrationUpdate():
            lines = [f"{result.sensor}: calibration from {result.windows} windows, {uncertainty_words(result)}"]
            lines += [f"  {row}" for row in calibration_rows(result)]
            return lines + ([f"  {truth_line(result, truth)}"] if truth else [])
        case _:
            return [f"{result.sensor}: {', '.join([result.what, *_fields(result)])}"]


def _fields(result: Result) -> list[str]:
    """Name and value of each field, for results without a text of their own. `u_x` is shown as U after `x`."""
    common = Result.__struct_fields__
    values = {name: value for name, value in msgspec.structs.asdict(result).items() if name not in common}
    words = []
    for name, value in values.items():
        if f"u_{name}" in values:
            words.append(f"{name} {plus_minus(value, COVERAGE_FACTOR * values[f'u_{name}'])}")
        elif not (name.startswith("u_") and name[2:] in values):
            words.append(f"{name} {value:.6g}" if isinstance(value, float) else f"{name} {value}")
    return words


def clock_words(clock: ClockReport) -> str:
    """The clock of a device: its rate beside the nominal one, how its bursts arrive, and the lag where it is known."""
    rate = plus_minus(clock.rate_hz, COVERAGE_FACTOR * clock.u_rate_hz)
    words = (
        f"clock of {clock.device}: {rate} Hz, nominal {clock.nominal_rate_hz:g} Hz; bursts come "
        f"{1e3 * clock.offset_s:.2g} ms late and scatter by {1e3 * clock.jitter_s:.2g} ms"
    )
    if not math.isfinite(clock.lag_s):
        return words
    return f"{words}; lag {plus_minus(1e3 * clock.lag_s, 1e3 * COVERAGE_FACTOR * clock.u_lag_s)} ms"


def watch_words(watch: WatchReport) -> str:
    """An hour of a sensor without a reference: mean, noise, what was wrong with samples, and what the mean says."""
    begin = datetime.fromtimestamp(watch.hour_utc_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M UTC")
    words = f"hour from {begin}: {watch.segments} minutes used"
    if watch.segments:
        mean, noise = (", ".join(f"{x:.{n}g}" for x in values) for values, n in (
            (watch.mean_mps2, 6), (np.sqrt(watch.noise_psd).tolist(), 2)))  # fmt: skip
        words += f"; mean {mean} m/s²; noise {noise} m/s²/√Hz"
    if math.isfinite(watch.temperature_degc):
        words += f"; {watch.temperature_degc:.1f} °C"
    wrong = [f"{count} {name}" for name in ("missing", "clipped", "stuck") if (count := getattr(watch, name))]
    words += f"; samples: {', '.join(wrong)}" if wrong else ""
    return f"{words}; {watch.gravity}" if watch.gravity else words


def self_test_words(told: SelfTestReport) -> str:
    """The response of each axis with U of its scatter, and what is wrong with it; or why there is none."""
    if told.reason:
        return f"self-test: {told.reason}"
    axes = zip("xyz", told.response_mps2, told.u_response_mps2, strict=True)
    words = ", ".join(f"{axis} {plus_minus(value, COVERAGE_FACTOR * u)}" for axis, value, u in axes)
    words = f"self-test: {words} m/s²"
    if math.isfinite(told.temperature_degc):
        words += f" at {told.temperature_degc:.1f} °C"
    return "; ".join([words, *told.faults])


def gap_line(gap: Gap) -> str:
    """What was lost between a device and the pipeline, and why."""
    return f"{gap.device}: {counted(gap.dropped, gap.unit)} dropped: {gap.reason}"


def verdict(window: WindowReport) -> str:
    """Whether the window was used, with its number of points, or why not."""
    left_out = f", {window.left_out} left out" if window.left_out else ""
    if window.used:
        return f"used, {window.points} points{left_out}"
    return f"{'held' if is_held(window) else 'refused'}: {window.reason}"


def window_span(window: WindowReport) -> str:
    """Start and stop of the window in seconds since the sensor's first sample."""
    return f"{window.start_s:.1f} to {window.stop_s:.1f} s"


def uncertainty_words(calibration: CalibrationUpdate) -> str:
    """The meaning of the number after ±, and the largest of main and transverse sensitivities, relative to the main
    one of the row."""
    words = f"U with k = {calibration.coverage_factor:.3g}, {calibration.uncertainty_kind}"
    if not all(calibration.determined[:9]):
        return words
    main = np.abs(np.diag(np.array(calibration.sensitivity)))
    u = np.reshape(calibration.standard_uncertainty[:9], (3, 3)) / main[:, None]
    largest = (100.0 * calibration.coverage_factor * np.max(u[found]) for found in (np.eye(3) > 0, np.eye(3) == 0))
    return words + ": main {:.2g} %, transverse {:.2g} %".format(*largest)


def calibration_cells(calibration: CalibrationUpdate) -> list[list[str]]:
    """Three rows x, y, z of S_x, S_y, S_z and Q, each with its expanded uncertainty, in the units of `shown_in`."""
    factors = shown_in(calibration.output_unit).factors
    values = (factors * np.append(np.ravel(calibration.sensitivity), calibration.offset)).tolist()
    expanded = (factors * calibration.coverage_factor * np.array(calibration.standard_uncertainty)).tolist()
    told = zip(values, expanded, calibration.determined, strict=True)
    cells = [plus_minus(value, U) if found else "not known" for value, U, found in told]
    return [[*cells[3 * i : 3 * i + 3], cells[9 + i]] for i in range(3)]


def calibration_rows(calibration: CalibrationUpdate) -> list[str]:
    """The cells as text, one line for each axis."""
    names = [(f"S{axis}x", f"S{axis}y", f"S{axis}z", f"Q{axis}") for axis in "xyz"]
    return [
        "  ".join(f"{name} {cell}" for name, cell in zip(row_names, cells, strict=True))
        for row_names, cells in zip(names, calibration_cells(calibration), strict=True)
    ]


def truth_line(calibration: CalibrationUpdate, truth: ShownTruth) -> str:
    """Largest errors of S and Q against a virtual sensor; S in percent of the main sensitivity of its row, Q in
    m/s2."""
    main = np.diag(truth.sensitivity)
    error = 100 * (np.array(calibration.sensitivity) - truth.sensitivity) / main[:, None]
    found = np.array(calibration.determined)
    error[~found[:9].reshape(3, 3)] = np.nan
    q = np.where(found[9:], (np.array(calibration.offset) - truth.offset) / main, np.nan)
    main_error, transverse = np.diag(error), error[~np.eye(3, dtype=bool)]
    return (
        f"largest errors: S main {_largest(main_error, 3)} "
        f"%, transverse {_largest(transverse, 3)} %,"
        f" Q {_largest(q, 4)} m/s²"
    )


def publication_line(publication: PublicationState) -> str:
    """What is published, and to which routers."""
    where = ", ".join(publication.endpoints) or "nowhere"
    link = "connected" if publication.connected else "no router answers; results wait in the store"
    return f"{publication.key}/** to {where} ({publication.fault or link})"


def recording_line(recording: RecordingState) -> str:
    """The recording of the raw data."""
    refused = "" if recording.recording else " (NOT recording: writing to the disk failed)"
    return f"{recording.path}, {size(recording.size_bytes)}{refused}"


def _largest(values: Array, decimals: int) -> str:
    known = values[np.isfinite(values)]
    return f"{np.abs(known).max():.{decimals}f}" if known.size else "–"
