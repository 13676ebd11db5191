"""Gathers the content of a report from results, recordings or a data directory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from agent.calibrate.origin import SourceFile, source_file
from agent.config.files import read_file
from agent.config.strict_json import strict
from agent.core.events import CalibrationUpdate, StatusChange, WindowReport
from agent.core.memory import Memory
from agent.core.outcome import with_budget
from agent.core.past import PastError, budget_in_force
from agent.delivery.calibrations import calibrations, first_in_force
from agent.delivery.evidence import evidence
from agent.delivery.history import FILE_NAME, History, StoredResult, StoreError
from agent.recording.files import recordings
from agent.report.recorded import RecordedSensor, RecordingError, in_order_of, read_recordings, sensors_of
from agent.report.result import (
    CalibrationResult,
    ResultError,
    WindowVerdict,
    from_update,
    parse,
    undetermined,
)
from agent.report.retraced import retrace
from agent.report.trace import Trace
from agent.terminal.held import is_held

Kind = TypeVar("Kind")

LARGEST_RESULT = 64 << 20  # bytes of a RESULT.json, which lists all its windows
MOST_HISTORY = 1000  # newest calibrations and windows of a data directory
MOST_RECORDINGS = 2  # newest files whose windows are computed again point by point; each takes about a second
RECORDING_ENDINGS = (".mcap", ".mcap.active")


class MaterialError(Exception):
    """The input cannot be used. The message names the file, the field and what is wrong."""


@dataclass(slots=True)
class Material:
    """Content of a report.

    `results`: the calibrations, several if methods are compared. `history`: earlier calibrations in order of time.
    `traces`: windows point by point, by position. `facts`: sensor, devices and program, by name. `notices`: what is
    missing in the report, and why. `serial_numbers`: of the sensor, "instrument", and of its "reference", as their
    drivers tell them; "" where a driver tells none.
    """

    sensor: str
    results: list[CalibrationResult]
    history: list[CalibrationUpdate] = field(default_factory=list)
    traces: dict[str, Trace] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
    files: list[SourceFile] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    serial_numbers: Mapping[str, str] = field(default_factory=dict)


def gather(inputs: Sequence[Path], sensor: str | None) -> Material:
    """Read results (JSON), recordings of one sensor, or one data directory. Raises MaterialError."""
    kinds = {_kind(path) for path in inputs}
    if len(kinds) > 1 or (kinds == {"directory"} and len(inputs) > 1):
        raise MaterialError(
            "the inputs are of several kinds; give only results (JSON), or only "
            "recordings (.mcap), or one data directory"
        )
    try:
        if kinds == {"directory"}:
            return _from_directory(inputs[0], sensor)
        if kinds == {"recording"}:
            return _from_recordings(inputs, sensor)
        return _from_results(inputs, sensor)
    except (StoreError, RecordingError) as error:
        raise MaterialError(str(error)) from None


def _kind(path: Path) -> str:
    if path.is_dir():
        return "directory"
    return "recording" if path.name.endswith(RECORDING_ENDINGS) else "result"


def _from_results(paths: Sequence[Path], sensor: str | None) -> Material:
    material = Material(sensor or "", [])
    for path in paths:
        material.results.append(_read_result(path))
        material.files.append(source_file(path))
        material.files += material.results[-1].files
    material.traces, hindrances = retrace(material.results[0], paths[0].parent)
    material.notices += hindrances
    labels = [result.label for result in material.results]
    if len(set(labels)) < len(labels):
        named = [f"{label}, {path.stem}" for label, path in zip(labels, paths, strict=True)]
        material.results = [replace(result, label=name) for result, name in zip(material.results, named, strict=True)]
    return material


def _read_result(path: Path) -> CalibrationResult:
    try:
        fields = strict(read_file(path, LARGEST_RESULT))
        if not isinstance(fields, dict):
            raise ValueError(f"Expected `object`, got `{type(fields).__name__}`")
        return parse(fields, path.stem)
    except OSError as error:
        raise MaterialError(f"{path}: {error.strerror or error}") from None
    except ResultError as error:
        raise MaterialError(f"{path}: {error}") from None
    except ValueError as error:
        raise MaterialError(f"{path}: the file is not a JSON object with a calibration: {error}") from None


def _from_recordings(paths: Sequence[Path], sensor: str | None) -> Material:
    chosen = _chosen(sensor, list(dict.fromkeys(name for path in paths for name in sensors_of(path))), str(paths[0]))
    paths = in_order_of(paths)
    recorded = read_recordings(paths, chosen)
    material = _of(recorded, [window_verdict(window) for window in recorded.windows], recorded.calibrations)
    material.history = list({update.made: update for update in recorded.calibrations[::-1]}.values())[::-1]
    material.files = [source_file(path) for path in paths]
    return material


def _with_kept_budget(update: CalibrationUpdate, memories: Sequence[Memory]) -> tuple[CalibrationUpdate, str]:
    """The calibration with the budget of all kept windows, and how its u compares. Raises PastError."""
    found = budget_in_force(update, memories)
    ratio = found.standard_uncertainty / np.array(update.standard_uncertainty)
    times = f"{ratio.min():.4f} to {ratio.max():.4f} times u in force"
    return with_budget(update, found), f"of all kept windows, solved anew; its u is {times}"


def _from_directory(directory: Path, sensor: str | None) -> Material:
    with History(directory / FILE_NAME) as history:
        names = sorted({name for name, what in history.channels() if name and what in ("window", "calibration")})
        chosen = _chosen(sensor, names, str(directory))
        in_force, memories = history.in_force(chosen), history.memories()
        kept = calibrations(history, chosen, limit=MOST_HISTORY)[::-1]
        seen = history.newest(chosen, "window", limit=MOST_HISTORY, run_id=_run_of(history, chosen, in_force))[::-1]
        status = next(iter(history.newest(chosen, "status", limit=1)), None)
        shown = [*kept, *seen, *(record for record in (in_force, status) if record is not None)]
        said = evidence(history, shown, directory)
    windows = [window_verdict(report) for report in _results(seen, WindowReport)]
    wanted = list(dict.fromkeys(w.recording for w in seen if w.fields.get("used")))
    paths, lost = _present(directory, wanted[-MOST_RECORDINGS:])
    recorded = read_recordings(paths, chosen) if paths else RecordedSensor(chosen)
    recorded.status = next(iter(_results([status], StatusChange)), recorded.status)
    newest = _results([in_force], CalibrationUpdate)
    missing, facts = list[str](), dict[str, Any]()
    if newest and not newest[0].budget:
        try:
            newest[0], facts["uncertainty budget"] = _with_kept_budget(newest[0], memories)
        except PastError as error:
            missing.append(f"the uncertainty budget is not known: {error}")
    material = _of(recorded, windows, newest)
    material.notices += missing
    material.facts |= facts
    material.history = _results(kept, CalibrationUpdate)
    material.files = [source_file(path) for path in paths]
    material.notices += said
    material.notices += [
        f"the recording {name} does not exist any more, so its windows are not shown point by point" for name in lost
    ]
    return material


def _results(records: Iterable[StoredResult | None], kind: type[Kind]) -> list[Kind]:
    """The results of this kind in the records."""
    return [record.result for record in records if record is not None and isinstance(record.result, kind)]


def _run_of(history: History, sensor: str, in_force: StoredResult | None) -> str:
    """The run in which the calibration in force was made. If none is in force, the run of the newest window."""
    if in_force is not None:
        return first_in_force(in_force)[0]
    return next((window.run_id for window in history.newest(sensor, "window", limit=1)), "")


def _present(directory: Path, names: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Paths of the recordings with these names, finished or not, and the names of those that do not exist."""
    there = {path.name.removesuffix(".active"): path for _, path in recordings(directory)}
    names = [name.removesuffix(".active") for name in names]
    return [there[name] for name in names if name in there], [name for name in names if name not in there]


def _of(recorded: RecordedSensor, windows: list[WindowVerdict], calibrations: list[CalibrationUpdate]) -> Material:
    """The material for the newest calibration of a sensor. If there is none, its reasons say why."""
    versions = recorded.starts[-1].versions if recorded.starts else {}
    if calibrations:
        fields = from_update(calibrations[-1], tuple(windows), versions)
        fields["reference_quantity"] = recorded.reference_quantity
    else:
        reason = recorded.status.reason if recorded.status else "the data hold no calibration"
        refused = [f"window {w.start_s:.1f} to {w.stop_s:.1f} s: {w.reason}" for w in windows if not w.used]
        fields = undetermined((reason, *refused), tuple(windows))
    result = parse(fields, "no calibration")
    facts = _facts(recorded)
    if recorded.status:
        facts["status"] = f"{recorded.status.status}: {recorded.status.reason}"
    notices = [
        f"{path}: the recording ends early, at {fault}; only the data before this place are used"
        for path, fault in recorded.faults
    ]
    return Material(
        recorded.sensor, [result], traces=recorded.traces, facts=facts, notices=notices,
        serial_numbers=_serial_numbers(recorded),
    )  # fmt: skip


def _serial_numbers(recorded: RecordedSensor) -> dict[str, str]:
    roles = {"instrument": recorded.sensor, "reference": recorded.reference}
    told = {role: recorded.devices[name] for role, name in roles.items() if name in recorded.devices}
    return {role: str(msgspec.json.decode(info)["serial_number"]) for role, info in told.items()}


def _facts(recorded: RecordedSensor) -> dict[str, Any]:
    facts: dict[str, Any] = {}
    if recorded.starts:
        start = recorded.starts[-1]
        facts |= {"site": start.site, "gateway": start.gateway, "versions": start.versions}
        facts["numeric fingerprint"] = start.fingerprint
    for name, info in recorded.devices.items():
        facts[f"device {name}"] = msgspec.json.decode(info)
    return facts


def window_verdict(window: WindowReport) -> WindowVerdict:
    """What a report says of a window of the agent."""
    return WindowVerdict(
        window.start_s, window.stop_s, window.used, window.reason, window.points, window.left_out, window.position,
        held=is_held(window),
    )  # fmt: skip


def _chosen(sensor: str | None, names: Sequence[str], where: str) -> str:
    if sensor is not None:
        if sensor not in names:
            raise MaterialError(
                f"{where}: there is no sensor {sensor!r}; the sensors are: {', '.join(names) or 'none'}"
            )
        return sensor
    if len(names) != 1:
        held = f"the sensors {', '.join(names)}: choose one with --sensor" if names else "no results of any sensor"
        raise MaterialError(f"{where}: holds {held}")
    return names[0]
