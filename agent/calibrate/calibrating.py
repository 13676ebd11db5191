"""Carries out `fieldcal calibrate`: reads the files and the options, and calls `calib`."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from agent.calibrate.faults import as_table_error, with_dashes
from agent.calibrate.poses import PosesFile
from agent.calibrate.stated import FILES, options_of
from agent.calibrate.station import by_metadata, compared, pose_of_station
from agent.calibrate.tables import ReferenceFile, SensorFile, read_reference, read_sensor
from agent.reading.formats import NOT_DESCRIBED, Description
from agent.reading.source import Progress, TableError
from agent.terminal.text import for_drawing, say
from calib.geometry import U_NOMINAL_GRAVITY_MPS2, u_of_gravity_mps2
from calib.recorded import calibrating
from calib.recorded.options import Options
from calib.recorded.outcome import Outcome
from calib.recorded.poses import PoseRow, Poses
from calib.recorded.table import ends_s
from calib.recorded.tables import Tables
from calib.recorded.units import Sensitivity, sensitivity_of
from calib.signal.instrument import Instrument
from calib.signal.known_filters import corner_apart

BAR_FROM_BYTES = 30_000_000  # smaller files are read too fast for a progress bar


def calibrated(params: dict[str, Any]) -> Outcome:
    """The outcome for these parameters of the command. Raises TableError and click.UsageError."""
    _check_metadata(params)
    given = {name: bool(params[name]) for name in ("reference", "poses", "prior")}
    with as_table_error():
        options_of(params | dict.fromkeys(FILES)).check(**given)  # before any file is read
    options = options_of(params)
    _say_gravity(options)
    sensor, reference = _read(params)
    options, read = _stated(params["poses"], sensor, reference, options, params.get("date_order"))
    with as_table_error(read.line):
        outcome = calibrating.calibrated(sensor, reference, read.poses, options)
    outcome = replace(outcome, reasons=tuple(map(with_dashes, outcome.reasons)))
    if not sensor.components or options.method != 3 or options.plain or outcome.more.get("frame") == "free":
        return outcome
    return replace(outcome, more={**outcome.more, "station": compared(outcome, sensor.components)})


def _say_gravity(options: Options) -> None:
    """Say which uncertainty a gravity has that is no better than a nominal one."""
    if options.gravity is None or options.u_gravity_mps2 is not None or options.plain:
        return
    u_mps2, why = u_of_gravity_mps2(options.gravity)
    if u_mps2 >= U_NOMINAL_GRAVITY_MPS2:
        say(
            f"--gravity {options.gravity:g}: u of gravity is {u_mps2:g} m/s2, because {why}; "
            "give local gravity with more digits, or state --u-gravity-mps2",
            err=True,
        )


def read_files(params: dict[str, Any]) -> Tables:
    """The named files with their poses. Raises TableError and click.UsageError.

    Corner frequencies of AC-coupled instruments are not used.
    """
    return tables_of(params["poses"], *_read(params), options_of(params))


def tables_of(
    poses: Path | None, sensor: SensorFile, reference: ReferenceFile | None, options: Options,
    instrument: Instrument | None = None,
) -> Tables:  # fmt: skip
    """What was read, with the poses of a file, see calib.recorded.calibrating. Raises TableError, click.UsageError."""
    options, read = _stated(poses, sensor, reference, options)
    with as_table_error(read.line):
        return calibrating.tables_of(sensor, reference, read.poses, options, instrument)


def _stated(
    poses: Path | None,
    sensor: SensorFile,
    reference: ReferenceFile | None,
    options: Options,
    date_order: str | None = None,
) -> tuple[Options, PosesFile]:
    """The options and the poses, with what the metadata of a station say. Raises TableError."""
    if sensor.restart and (reference is not None or poses is not None):
        raise TableError(f"{sensor.restart}; a reference or poses need one clock: cut the file there")
    stated = by_metadata(options, sensor.components, reference.components if reference is not None else ())
    stated = _with_filters(stated, sensor, reference)
    if poses is None and reference is not None and reference.components and sensor.components:
        values = pose_of_station(sensor.components, reference.components, stated)
        row = PoseRow(*ends_s(reference.time_s), values)
        return stated, PosesFile.of_metadata(Poses("the metadata", [row]))
    return stated, PosesFile(poses, date_order)


def _with_filters(options: Options, sensor: SensorFile, reference: ReferenceFile | None) -> Options:
    """The options with the filters that drivers state in recordings, where they and the certificate state none."""
    if reference is None or options.method != 3 or options.plain:
        return options
    certificate = options.reference_certificate
    certified = certificate is not None and bool(certificate.filters)
    found = {**by_driver("sensor", sensor.filters), **by_driver("reference", reference.filters)}
    if certified:
        found.pop("reference_filter", None)
    for role in ("sensor", "reference"):
        corner = (f"{role}_corner_hz", f"u_{role}_corner_hz")
        for names in ((f"{role}_filter",), corner):
            if any(getattr(options, name) for name in names):
                found = {name: value for name, value in found.items() if name not in names}
    for line in as_arguments(found):
        say(f"{line}, as its driver states in the recording", err=True)
    return replace(options, **found)


def by_driver(role: str, lines: Sequence[str]) -> dict[str, Any]:
    """The options of a role, "sensor" or "reference", by the filters that its driver states; none that says nothing."""
    filters, (corner_hz, u_corner_hz) = corner_apart(lines)
    found = {f"{role}_filter": filters, f"{role}_corner_hz": corner_hz, f"u_{role}_corner_hz": u_corner_hz}
    return {name: value for name, value in found.items() if value}


def as_arguments(options: Mapping[str, Any]) -> list[str]:
    """Options that `by_driver` gave, as a user writes them."""
    return [
        f"--{name.replace('_', '-')} {value:g}" if isinstance(value, float) else f"--{name.replace('_', '-')} '{value}'"
        for name, stated in options.items()
        for value in (stated if isinstance(stated, tuple) else (stated,))
    ]


def _check_metadata(params: dict[str, Any]) -> None:
    """Check the options of files that describe other files. Raises click.UsageError."""
    if params.get("reference_metadata") and not params["reference"]:
        raise click.UsageError("--reference-metadata needs --reference")
    if params.get("stationxml_out") and not params.get("sensor_metadata"):
        raise click.UsageError("--stationxml-out needs --sensor-metadata")
    if params["rotation"] and params.get("reference_metadata") and params.get("sensor_metadata"):
        raise click.UsageError("the metadata of both instruments state the rotation; remove --rotation")


def _read(params: dict[str, Any]) -> tuple[SensorFile, ReferenceFile | None]:
    paths = [params[name] for name in ("sensor", "reference") if params[name]]
    size = sum(path.stat().st_size for path in paths if path.is_file())
    with _bar("reading", size if size > BAR_FROM_BYTES else 0) as bar:
        described = _description(params, "sensor_metadata")
        sensor = sensor_of(params["sensor"], params.get("columns"), bar, described)
        stated = (params.get("reference_columns"), params.get("sensitivity"))
        described = _description(params, "reference_metadata")
        return sensor, reference_of(params["reference"], *stated, bar, described) if params["reference"] else None


def _description(params: dict[str, Any], metadata: str) -> Description:
    return Description(params.get(metadata), params.get("mapping"), params.get("date_order"))


def sensor_of(
    path: Path, columns: str | None, progress: Progress | None = None, described: Description = NOT_DESCRIBED
) -> SensorFile:
    """Read a sensor's file, and print what was guessed. Raises TableError."""
    table = read_sensor(path, progress, columns, described)
    _say(table.said)
    return table


def reference_of(
    path: Path,
    columns: str | None,
    sensitivity: str | None,
    progress: Progress | None = None,
    described: Description = NOT_DESCRIBED,
) -> ReferenceFile:
    """Read a reference's file, and print what was guessed. Raises TableError and click.BadParameter."""
    stated = _sensitivity(sensitivity) if sensitivity else None
    table = read_reference(path, progress, columns, stated, described)
    _say(table.said)
    return table


def _sensitivity(text: str) -> Sensitivity:
    try:
        return sensitivity_of(text)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--sensitivity") from None


def _say(said: Sequence[str]) -> None:
    for line in said:
        say(line, err=True)


def _bar(label: str, length: int) -> AbstractContextManager[Any]:
    """A progress bar on a terminal, or nothing if `length` is 0. The context gives a function that takes each step."""
    if not length or not sys.stderr.isatty():
        return nullcontext(None)
    return _Bar(click.progressbar(length=length, label=label, file=for_drawing(sys.stderr)))


class _Bar(AbstractContextManager[Any]):
    def __init__(self, bar: Any) -> None:
        self._bar = bar

    def __enter__(self) -> Any:
        return self._bar.__enter__().update

    def __exit__(self, *error: Any) -> None:
        self._bar.__exit__(*error)
