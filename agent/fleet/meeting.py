"""One meeting of a sensor with a reference: its files become windows, and the windows a link of the site."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.calibrate.calibrating import reference_of, sensor_of, tables_of
from agent.calibrate.stated import options_of
from agent.calibrate.tables import ReferenceFile
from agent.config.earlier import EarlierError, read_earlier
from agent.fleet.site_file import DeviceSection
from agent.reading.source import TableError
from calib.estimate.nuisances import Applied, Priors
from calib.model import Array, Window, own_channels
from calib.recorded.adjusting import adjusted, over_frequency
from calib.recorded.options import Options
from calib.recorded.priors import NOMINAL_TRANSVERSE, instrument_of, priors_of
from calib.recorded.tables import Tables
from calib.signal.response import FLAT, Response
from calib.site_adjustment.device import SiteDevice
from calib.site_adjustment.link import Link, link

WORST_CONDITION = 1e3  # of S: a dead output makes it infinite
ROUNDING = 1e-9  # of the largest eigenvalue of a covariance


@dataclass(frozen=True, slots=True, eq=False)
class Meeting:
    """What came of one meeting: a link, or the reasons why there is none, or why a part of it was left out.

    `used` windows of `windows`; `channels` of the reference; `u_gravity_mps2` as stated for the link.
    """

    sensor: str
    reference: str
    found: Link | None
    reasons: tuple[str, ...]
    windows: int
    used: int
    channels: int
    u_gravity_mps2: float


def stated_calibration(section: DeviceSection, directory: Path) -> tuple[Array, Array] | None:
    """Mean (12,) and covariance (12, 12) of S and Q by a certificate or a nominal sensitivity; None without one.

    Raises TableError.
    """
    if section.certificate is not None:
        path = directory / section.certificate
        try:
            mean, covariance = read_earlier(path)
        except EarlierError as error:
            raise TableError(str(error)) from None
        if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
            raise TableError(f"{path}: not all parameters and covariances are known; they are needed of a reference")
        if np.linalg.cond(mean[:9].reshape(3, 3)) > WORST_CONDITION:
            raise TableError(f"{path}, sensitivity: the matrix cannot be inverted, so it does not give accelerations")
        values = np.linalg.eigvalsh(covariance)
        if values[0] < -ROUNDING * values[-1] or not np.allclose(covariance, covariance.T):
            raise TableError(f"{path}, covariance: the matrix is not symmetric and positive, so it is no covariance")
        return mean, covariance
    if section.nominal is not None and section.u_nominal_pct is not None:
        u = section.nominal * np.where(np.eye(3).ravel() > 0, section.u_nominal_pct / 100.0, NOMINAL_TRANSVERSE)
        mean = np.append(section.nominal * np.eye(3).ravel(), np.zeros(3))
        return mean, np.diag(np.append(u**2, np.full(3, np.inf)))
    return None


def read(params: dict[str, Any], options: Options, known: tuple[Array, Array] | None) -> Tables:
    """The files of a meeting, by the parameters of `fieldcal calibrate`. Raises TableError.

    `known` is of a reference whose file holds its own indications.
    """
    sensor = sensor_of(params["sensor"], params["columns"])
    reference = None
    if params["reference"] and known is None:
        reference = reference_of(params["reference"], params["reference_columns"], params["sensitivity"])
    elif params["reference"] and known is not None:
        table, (mean, _) = sensor_of(params["reference"], params["reference_columns"]), known
        a = (table.v[:] - mean[9:]) @ np.linalg.inv(mean[:9].reshape(3, 3)).T
        reference = ReferenceFile(table.name, table.time_s, a, "acceleration", "by its own S and Q", said=table.said)
    return tables_of(params["poses"], sensor, reference, options, instrument_of(options))


def meeting(sensor: str, reference: str, stretches: Sequence[Tables], priors: Priors) -> Meeting:
    """Calibrate the sensor beside the reference alone; what is not refused becomes a link.

    `stretches`: tables of one mounting, one or several. A stretch that is refused is left out.
    """
    used: list[Window] = []
    reasons: list[str] = []
    seen, lag_s = 0, 0.0
    for tables in stretches:
        priors = tables.beside(priors)
    for tables in stretches:
        outcome = adjusted(tables, priors)
        seen += len(outcome.windows)
        reasons += outcome.reasons
        if not outcome.reasons:
            used += [w for w in outcome.windows if w.used]
            lag_s = outcome.lag_s or 0.0
    channels = max((own_channels(w.sums.reference_channels) for w in used), default=0)
    told = seen, len(used), channels, priors.gravity_mps2
    if not used:
        return Meeting(sensor, reference, None, tuple(reasons), *told)
    taken = next((Response(w.response) for w in used if w.response), FLAT)
    applied = Applied(lag_s, priors.reference_corner_at_hz, priors.sensor_corner_at_hz, taken)
    found = link(sensor, reference, used, over_frequency(priors, used, lag_s), applied)
    return Meeting(sensor, reference, found, tuple(reasons), *told)


def meeting_of(sensor: str, reference: str, params: dict[str, Any], known: tuple[Array, Array] | None) -> Meeting:
    """A meeting by its files and options. Raises TableError."""
    options = options_of(params)
    found = meeting(sensor, reference, [read(params, options, known)], priors_of(options))
    if known is None or found.found is None or found.found.rotation is not None:
        return found
    reason = (
        f"{reference} states S and Q of all its axes, which needs a reference that measures gravity itself, in one "
        "rotation to the sensor; state u_sensitivity_pct and a file in SI units"
    )
    return replace(found, found=None, reasons=(reason,))


def device(name: str, section: DeviceSection, directory: Path, meetings: list[Meeting]) -> SiteDevice:
    """What is known of a device before any link. Raises TableError."""
    known = stated_calibration(section, directory)
    if known is not None:
        return SiteDevice.with_covariance(name, *known)
    if section.u_sensitivity_pct is not None:
        channels = max((m.channels for m in meetings if m.reference == name), default=3)
        return SiteDevice.reference(name, section.u_sensitivity_pct / 100.0, channels)
    first = next((m.found for m in meetings if m.found is not None and m.sensor == name), None)
    mean = np.append(np.eye(3).ravel(), np.zeros(3)) if first is None else first.mean
    return SiteDevice.with_covariance(name, mean, np.diag(np.full(12, np.inf)))
