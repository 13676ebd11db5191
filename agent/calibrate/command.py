"""`fieldcal calibrate`: S and Q from files."""

from __future__ import annotations

import math
import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from agent.calibrate.adjusting import adjusted, norm_fitted
from agent.calibrate.amplitude_methods import by_amplitudes
from agent.calibrate.corners import has_corner, uncoupled
from agent.calibrate.frontend import FrontEnd, Options
from agent.calibrate.origin import origin
from agent.calibrate.outcome import Outcome, as_json, nothing_used, print_outcome
from agent.calibrate.poses import PoseInterval, Setting, beside_reference, read_poses
from agent.calibrate.priors import contradictions, priors_of
from agent.calibrate.tables import ReferenceTable, TableError, read_reference, read_sensor
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.method3 import PLAIN, fit, refusal
from calib.nuisances import Priors
from calib.verdict import dead_reasons

BAR_FROM_BYTES = 30_000_000  # shorter files are read before a bar could be of use
COVERAGE_FACTOR = 2.0  # of plain Method 3: thousands of points, as the paper has it

_FILE = click.Path(path_type=Path, dir_okay=False)


class _Finite(click.FloatRange):
    """A range of numbers; nan and inf, which click lets through, are none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


_U = _Finite(0)


@click.command()
@click.option("--sensor", type=_FILE, required=True, help="time_s,vx,vy,vz[,temperature_degc]")
@click.option("--reference", type=_FILE, help="time_s,a or time_s,v or time_s,ax,ay,az; SI units.")
@click.option("--poses", type=_FILE, help="start_s,stop_s and theta_deg,alpha_deg | dx,dy,dz | axis | gx,gy,gz")
@click.option("--method", type=click.Choice(["1", "2", "3"]), default="3", show_default=True, help="Of the paper.")
@click.option("--reference-quantity", type=click.Choice(["acceleration", "velocity"]), help="By default as the header.")
@click.option("--reference-coupling", type=click.Choice(["dc", "ac"]), help="Default: ac for one axis, dc for three.")
@click.option("--coupling", type=click.Choice(["dc", "ac"]), default="dc", show_default=True, help="Of the sensor.")
@click.option("--u-angle-deg", type=_U, default=0.2, show_default=True, help="u of alpha or direction, by position.")
@click.option("--u-theta-deg", type=_U, default=0.2, show_default=True, help="u of theta, common to all positions.")
@click.option("--u-alpha-common-deg", type=_U, default=0.1, show_default=True, help="u of alpha, common.")
@click.option("--u-theta-position-deg", type=_U, default=0.0, show_default=True, help="u of theta, by position.")
@click.option("--u-offset-mps2", type=_U, default=0.05, show_default=True, help="u of the offset between windows.")
@click.option("--u-offset-position-mps2", type=_U, default=0.0, show_default=True, help="u of the offset, by position.")
@click.option("--u-reference-pct", type=_U, default=0.1, show_default=True, help="u of the reference's sensitivity.")
@click.option(
    "--u-transverse-motion-pct",
    type=_U,
    default=1.0,
    show_default=True,
    help="u of motion across a uniaxial reference.",
)
@click.option("--reference-corner-hz", type=_U, default=0.0, show_default=True, help="Of an AC-coupled reference.")
@click.option("--u-reference-corner-hz", type=_U, default=0.0, show_default=True, help="Its standard uncertainty.")
@click.option("--sensor-corner-hz", type=_U, default=0.0, show_default=True, help="Of an AC-coupled sensor.")
@click.option("--u-sensor-corner-hz", type=_U, default=0.0, show_default=True, help="Its standard uncertainty.")
@click.option("--u-tilt-deg", type=_U, default=0.0, show_default=True, help="u of the mount's tilt.")
@click.option("--rotation", metavar="R11,...,R33", help="Of a tri-axial reference: a = R a_ref.")
@click.option("--u-rotation-deg", type=_U, default=0.2, show_default=True, help="u of the rotation, about each axis.")
@click.option("--gravity", "gravity_mps2", type=_Finite(9.7, 9.9), help="Local gravity in m/s2.")
@click.option("--u-gravity-mps2", type=_U, help="u of gravity: 0.03, or 0 with --gravity.")
@click.option(
    "--static-sign", type=click.Choice(["+1", "-1"]), default="+1", show_default=True, help="+1: Eqs. (9)-(11)."
)
@click.option("--nominal", type=_Finite(min=0, min_open=True), help="Nominal sensitivity, output unit per m/s2.")
@click.option("--u-nominal-pct", type=_Finite(0, min_open=True), help="Its standard uncertainty.")
@click.option("--prior", type=_FILE, help="A result of this command (JSON): what was known before.")
@click.option("--plain", is_flag=True, help="Method 3 exactly as printed, no nuisances.")
@click.option("--json", "json_to", type=click.Choice(["-"]), help="One JSON object on standard output.")
def calibrate(**options: Any) -> int:
    """Calibrate from files: sensor.csv, reference.csv, poses.csv.

    Exit status 0 if accepted, 2 on bad input, 3 if the data are refused; the reasons are printed.
    """
    try:
        outcome = calibrated(options)
    except TableError as error:
        click.echo(f"fieldcal calibrate: {error}", err=True)
        return 2
    if options["json_to"]:
        click.echo(as_json(replace(outcome, more={**outcome.more, **origin(options)})))
    else:
        print_outcome(outcome)
    for reason in outcome.reasons:
        click.echo(f"refused: {reason}", err=True)
    return 3 if outcome.reasons else 0


def calibrated(options: dict[str, Any]) -> Outcome:
    """What the files say. Raises TableError, click.UsageError."""
    _check(options)
    if not options["reference"] and not options["poses"] and not options["plain"]:
        return norm_fitted(read_sensor(options["sensor"]), options)
    if options["method"] != "3":
        return by_amplitudes(read_files(options), options)
    if options["plain"]:
        return _plain(read_files(options), priors_of(options))
    priors = priors_of(options)
    return adjusted(read_files(options, priors), priors)


def read_files(options: dict[str, Any], priors: Priors | None = None) -> FrontEnd:
    """Tables, clocks and poses of the files named; corners undone as `priors` state them. Raises TableError."""
    paths = [options[name] for name in ("sensor", "reference") if options[name]]
    size = sum(path.stat().st_size for path in paths if path.is_file())
    with _bar("reading", size if size > BAR_FROM_BYTES else 0) as bar:
        sensor = read_sensor(options["sensor"], bar)
        reference = read_reference(options["reference"], bar) if options["reference"] else None
    stated = options["reference_quantity"]
    if reference is not None and stated and reference.velocity != (stated == "velocity"):
        column = "v" if reference.velocity else "a"
        raise TableError(f"{reference.path}, line 1: column {column} is no {stated}")
    poses = _poses(options, setting_of(options, reference), reference)
    if priors is not None and reference is not None and has_corner(priors):
        sensor, reference, poses = uncoupled(sensor, reference, poses, priors)
    return FrontEnd(sensor, reference, poses, Options(leave_out=not options["plain"], align=not options["plain"]))


def setting_of(options: dict[str, Any], reference: ReferenceTable | None) -> Setting:
    """What holds in every pose."""
    channels = 0 if reference is None else reference.x.shape[1]
    return Setting(
        gravity_mps2=options["gravity_mps2"] or STANDARD_GRAVITY_MPS2,
        static_sign=int(options["static_sign"]),
        coupling=options["coupling"],
        reference_coupling=options["reference_coupling"] or ("dc" if channels == 3 else "ac"),
        reference_channels=channels,
        rotation=_rotation(options["rotation"]),
    )


def _poses(options: dict[str, Any], setting: Setting, reference: ReferenceTable | None) -> list[PoseInterval]:
    if options["rotation"] and setting.reference_channels != 3:
        raise click.UsageError("--rotation turns a tri-axial --reference, this one has one axis")
    if options["poses"]:
        return read_poses(options["poses"], setting)
    if reference is None or setting.reference_channels != 3:
        raise click.UsageError("--poses is needed")
    try:
        pose = beside_reference(setting)
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    return [PoseInterval(float(reference.time_s[0]), float(reference.time_s[-1]), pose)]


def _check(options: dict[str, Any]) -> None:
    """What click cannot see: options that need or exclude each other."""
    if (options["nominal"] is None) != (options["u_nominal_pct"] is None):
        raise click.UsageError("--nominal and --u-nominal-pct go together")
    if options["nominal"] is not None and options["prior"]:
        raise click.UsageError("give one of --nominal and --prior")
    if options["rotation"] and not options["reference"]:
        raise click.UsageError("--rotation turns a tri-axial --reference")
    if options["method"] != "3" and not (options["reference"] and options["poses"]):
        raise click.UsageError(f"--method {options['method']} needs --reference and --poses")


def _rotation(text: str | None) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    if text is None:
        return None
    try:
        return np.array([float(part) for part in text.split(",")]).reshape(3, 3)
    except ValueError:
        raise click.BadParameter(f"{text!r} is not nine numbers r11,r12,...,r33", param_hint="--rotation") from None


def _plain(front: FrontEnd, priors: Priors) -> Outcome:
    windows = front.windows()
    if not any(w.used for w in windows):
        return nothing_used(windows, front.sensor_clock.rate_hz, PLAIN)
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
        front.sensor_clock.rate_hz,
        PLAIN,
        coverage_factor=COVERAGE_FACTOR,
        uncertainty_kind="type A, white",
        rank=found.rank,
        residual_sd=found.residual_sd.tolist(),
    )


def _bar(label: str, length: int) -> AbstractContextManager[Any]:
    """A progress bar on a terminal; without a length nothing. What it yields is called with steps."""
    if not length or not sys.stderr.isatty():
        return nullcontext(None)
    return _Bar(click.progressbar(length=length, label=label, file=sys.stderr))


class _Bar(AbstractContextManager[Any]):
    def __init__(self, bar: Any) -> None:
        self._bar = bar

    def __enter__(self) -> Any:
        return self._bar.__enter__().update

    def __exit__(self, *error: Any) -> None:
        self._bar.__exit__(*error)
