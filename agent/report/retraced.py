"""Computes the windows of a result of `fieldcal calibrate` again, point by point, from the files that it names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from agent.calibrate.calibrating import read_files
from agent.calibrate.origin import SourceFile, source_file
from agent.calibrate.stated import FILES
from agent.reading.source import TableError
from agent.report.result import CalibrationResult, WindowVerdict
from agent.report.trace import Trace
from calib.recorded.tables import Tables

MOST_TRACES = 24  # windows with numbers: the newest window of each of so many positions


def retrace(result: CalibrationResult, directory: Path) -> tuple[dict[str, Trace], list[str]]:
    """Traces by position, and reasons why there are none. A file that was moved is looked for in `directory`, where the
    result is."""
    options = result.fields.get("options")
    if not isinstance(options, dict) or not (options.get("poses") or options.get("rotation")):
        return {}, []
    found, hindrances = _find_files(result.files, directory)
    if hindrances:
        return {}, [f"{hindrance}, so indications and residuals are not shown" for hindrance in hindrances]
    try:
        named = {name: found.get(options.get(name)) for name in ("sensor", "reference", "poses")}
        read = read_files(options | named | dict.fromkeys(FILES))
    except (TableError, click.UsageError, KeyError, TypeError, ValueError) as error:
        return {}, [
            f"indications and residuals are not shown: the files cannot be read with the options in the result: {error}"
        ]
    return _traces(read, result), []


def _find_files(files: tuple[SourceFile, ...], directory: Path) -> tuple[dict[Any, Path], list[str]]:
    """The present path of each file, by its path in the result, and the files that are missing or changed."""
    found: dict[Any, Path] = {}
    hindrances = []
    for file in files:
        path = next((p for p in (Path(file.path), directory / Path(file.path).name) if p.is_file()), None)
        if path is None:
            hindrances.append(f"{file.path} does not exist any more")
        elif source_file(path).sha256 != file.sha256:
            hindrances.append(f"{path} has changed since the calibration")
        else:
            found[file.path] = path
    return found, hindrances


def _traces(read: Tables, result: CalibrationResult) -> dict[str, Trace]:
    """The newest used window of each position."""
    newest: dict[str, WindowVerdict] = {}
    for window in result.windows:
        if window.used:
            newest.pop(window.position, None)
            newest[window.position] = window
    traces = {}
    for position, window in list(newest.items())[-MOST_TRACES:]:
        middle_s = 0.5 * (window.start_s + window.stop_s)
        interval = next((p for p in read.poses if p.start_s <= middle_s <= p.stop_s), None)
        points = None if interval is None else read.points(interval, window.start_s, window.stop_s)
        if interval is not None and points is not None and len(points.time_s) > 1:
            traces[position] = Trace(points.time_s, points.V, points.u, points.du, interval.pose)
    return traces
