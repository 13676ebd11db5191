"""What `fieldcal calibrate` makes of its options: files to windows, windows to an outcome."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import click
import numpy as np

from agent.calibrate.adjusting import adjusted, norm_fitted
from agent.calibrate.amplitude_methods import by_amplitudes
from agent.calibrate.corners import has_corner, uncoupled
from agent.calibrate.frontend import FrontEnd, Options
from agent.calibrate.outcome import Outcome, nothing_used
from agent.calibrate.poses import PoseInterval, Setting, beside_reference, read_poses
from agent.calibrate.priors import contradictions, priors_of
from agent.calibrate.tables import ReferenceTable, TableError, read_reference, read_sensor
from calib.estimate.nuisances import Priors
from calib.estimate.verdict import dead_reasons
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.paper.method3 import PLAIN, fit, refusal

BAR_FROM_BYTES = 30_000_000  # shorter files are read before a bar could be of use
COVERAGE_FACTOR = 2.0  # of plain Method 3: thousands of points, as the paper has it


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
