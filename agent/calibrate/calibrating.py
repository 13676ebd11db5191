"""Carries out `fieldcal calibrate`: reads the files, makes windows, and chooses the estimator by the options."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from agent.calibrate.adjusting import adjusted, norm_fitted
from agent.calibrate.amplitude_methods import by_amplitudes
from agent.calibrate.files import Files, Options
from agent.calibrate.outcome import Outcome, nothing_used
from agent.calibrate.poses import PoseInterval, Setting, beside_reference, read_poses
from agent.calibrate.priors import contradictions, instrument_of, priors_of
from agent.calibrate.reference_certificate import read_reference_certificate
from agent.calibrate.station import compared, coupling_of, frame_of, pose_of_station
from agent.calibrate.tables import ReferenceTable, SensorTable, read_reference, read_sensor
from agent.calibrate.wrong_unit import check_gravity
from agent.reading.formats import NOT_DESCRIBED, Description
from agent.reading.source import Progress, TableError
from agent.reading.units import Sensitivity, sensitivity_of
from agent.terminal.text import for_drawing, say
from calib.estimate.nuisances import Priors
from calib.estimate.verdict import dead_reasons
from calib.excitation.front_end import Settings
from calib.excitation.window_verdict import Limits
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.paper.method3 import PLAIN, fit, refusal
from calib.signal.instrument import Instrument

BAR_FROM_BYTES = 30_000_000  # smaller files are read too fast for a progress bar
COVERAGE_FACTOR = 2.0  # of plain Method 3, as in the paper: there are thousands of points


def calibrated(options: dict[str, Any]) -> Outcome:
    """The outcome for these options. Raises TableError and click.UsageError."""
    _check(options)
    if not options["reference"] and not options["poses"] and not options["plain"]:
        described = _description(options, "sensor_metadata")
        return norm_fitted(sensor_of(options["sensor"], options.get("columns"), None, described), options)
    if options["method"] != "3":
        return by_amplitudes(read_files(options), options)
    if options["plain"]:
        return _plain(read_files(options), priors_of(options))
    stated = options.get("reference_certificate")
    certificate = None if stated is None else read_reference_certificate(stated)
    if certificate is not None:
        options = options | {"u_reference_pct": 100.0 * float(np.max(certificate.u_relative))}
    files = read_files(options, instrument_of(options))
    outcome = adjusted(files, priors_of(options), certificate)
    if not files.components:
        return outcome
    return replace(outcome, more={**outcome.more, "station": compared(outcome, files.components)})


def read_files(options: dict[str, Any], instrument: Instrument | None = None) -> Files:
    """Read the named files: tables, clocks and poses. Raises TableError.

    `instrument` is from `instrument_of`. With None, corner frequencies of AC-coupled instruments are not used.
    """
    paths = [options[name] for name in ("sensor", "reference") if options[name]]
    size = sum(path.stat().st_size for path in paths if path.is_file())
    with _bar("reading", size if size > BAR_FROM_BYTES else 0) as bar:
        described = _description(options, "sensor_metadata")
        sensor = sensor_of(options["sensor"], options.get("columns"), bar, described)
        stated = (options.get("reference_columns"), options.get("sensitivity"))
        described = _description(options, "reference_metadata")
        reference = reference_of(options["reference"], *stated, bar, described) if options["reference"] else None
    return files_of(options, sensor, reference, instrument)


def files_of(
    options: dict[str, Any], sensor: SensorTable, reference: ReferenceTable | None, instrument: Instrument | None = None
) -> Files:
    """What was read, with its poses and as the options say. Raises TableError and click.UsageError."""
    instrument = instrument or Instrument()
    if reference is not None:
        instrument = replace(instrument, quantity=reference.quantity)
        _check_quantity(reference, instrument, options["reference_quantity"])
    setting = setting_of(options, sensor, reference)
    instrument = replace(instrument, ac_coupled="ac" in (setting.coupling, setting.reference_coupling))
    if reference is not None and setting.reference_coupling == "dc":
        check_gravity(reference)
    poses = _poses(options, setting, sensor, reference)
    plain = options["plain"]
    limits = Limits.of(options["u_offset_mps2"], math.radians(options["u_angle_deg"]))
    settings = Settings(Limits() if plain else limits, leave_out=not plain, limit_band=not plain, bands=not plain)
    return Files(sensor, reference, poses, instrument, Options(settings, align=not plain))


def _description(options: dict[str, Any], metadata: str) -> Description:
    return Description(options.get(metadata), options.get("mapping"))


def sensor_of(
    path: Path, columns: str | None, progress: Progress | None = None, described: Description = NOT_DESCRIBED
) -> SensorTable:
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
) -> ReferenceTable:
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


def _check_quantity(reference: ReferenceTable, instrument: Instrument, stated: str | None) -> None:
    if stated and reference.quantity != stated:
        raise TableError(
            f"{reference.path}, {reference.column} holds {reference.quantity}, but --reference-quantity says {stated}"
        )
    if instrument.derivatives and instrument.has_corner:
        raise TableError(
            f"{reference.path}: a {reference.quantity} reference takes no corner "
            "frequency; leave out the corner options"
        )


def setting_of(options: dict[str, Any], sensor: SensorTable, reference: ReferenceTable | None) -> Setting:
    """The settings that apply to every pose. What the metadata of a station say of coupling and rotation counts."""
    channels = 0 if reference is None else reference.x.shape[1]
    told = None if reference is None else coupling_of(reference.components)
    rotation = _rotation(options["rotation"])
    if rotation is None and reference is not None and reference.components and channels == 3 and sensor.components:
        rotation = frame_of(sensor.components)
    return Setting(
        gravity_mps2=options["gravity_mps2"] or STANDARD_GRAVITY_MPS2,
        static_sign=int(options["static_sign"]),
        coupling=coupling_of(sensor.components) or options["coupling"],
        reference_coupling=options["reference_coupling"] or told or ("dc" if channels == 3 else "ac"),
        reference_channels=channels,
        rotation=rotation,
    )


def _poses(
    options: dict[str, Any], setting: Setting, sensor: SensorTable, reference: ReferenceTable | None
) -> list[PoseInterval]:
    if options["rotation"] and setting.reference_channels != 3:
        raise click.UsageError(
            "--rotation is for a tri-axial --reference, but this one has one axis; remove --rotation"
        )
    if options["poses"]:
        return read_poses(options["poses"], setting)
    if reference is not None and reference.components and sensor.components:
        pose = pose_of_station(sensor.components, reference.components, setting)
        return [PoseInterval(float(reference.time_s[0]), float(reference.time_s[-1]), pose)]
    if reference is None or setting.reference_channels != 3:
        raise click.UsageError(
            "--poses is missing; only a tri-axial --reference, or rests without a reference, need no poses"
        )
    try:
        pose = beside_reference(setting)
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    return [PoseInterval(float(reference.time_s[0]), float(reference.time_s[-1]), pose)]


def _check(options: dict[str, Any]) -> None:
    """Check options that need or exclude each other, which click cannot do. Raises click.UsageError."""
    if (options["nominal"] is None) != (options["u_nominal_pct"] is None):
        raise click.UsageError("--nominal and --u-nominal-pct must be given together")
    if options["nominal"] is not None and options["prior"]:
        raise click.UsageError("give --nominal or --prior, not both")
    if options["rotation"] and not options["reference"]:
        raise click.UsageError("--rotation needs a tri-axial --reference")
    if options.get("reference_metadata") and not options["reference"]:
        raise click.UsageError("--reference-metadata needs --reference")
    if options.get("stationxml_out") and not options.get("sensor_metadata"):
        raise click.UsageError("--stationxml-out needs --sensor-metadata")
    if options["rotation"] and options.get("reference_metadata") and options.get("sensor_metadata"):
        raise click.UsageError("the metadata of both instruments state the rotation; remove --rotation")
    if options["method"] != "3" and not (options["reference"] and options["poses"]):
        raise click.UsageError(f"--method {options['method']} needs --reference and --poses")


def _rotation(text: str | None) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    if text is None:
        return None
    try:
        return np.array([float(part) for part in text.split(",")]).reshape(3, 3)
    except ValueError:
        raise click.BadParameter(f"{text!r} must be nine numbers r11,r12,...,r33", param_hint="--rotation") from None


def _plain(files: Files, priors: Priors) -> Outcome:
    windows = files.windows()
    if not any(w.used for w in windows):
        return nothing_used(windows, files.rate_hz, PLAIN)
    found = fit(windows)
    reasons = (
        *refusal(found, windows),
        *dead_reasons(found.calibration.sensitivity),
        *contradictions(found.calibration, priors),
    )
    return Outcome(
        None if reasons else found.calibration,
        reasons,
        windows,
        files.rate_hz,
        PLAIN,
        coverage_factor=COVERAGE_FACTOR,
        uncertainty_kind="type A, white",
        rank=found.rank,
        residual_sd=found.residual_sd.tolist(),
    )


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
