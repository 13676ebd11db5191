"""From tables and poses to S and Q: makes windows, and chooses the estimator by the options."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from calib.estimate.axes import axis_warnings, sensitivity_reasons
from calib.estimate.nuisances import Priors
from calib.excitation.front_end import Settings
from calib.excitation.window_verdict import Limits
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.paper.method3 import PLAIN, fit, refusal
from calib.recorded.adjusting import adjusted, norm_fitted
from calib.recorded.amplitude_methods import by_amplitudes
from calib.recorded.causes import causes, silent_channels
from calib.recorded.errors import InputError, OptionError
from calib.recorded.options import Coupling, Options
from calib.recorded.outcome import Outcome, nothing_used
from calib.recorded.poses import PoseInterval, Poses, PoseSettings, beside_reference, intervals_of, states_gravity
from calib.recorded.priors import contradictions, instrument_of, priors_of
from calib.recorded.table import ReferenceTable, SensorTable, check_step, ends_s
from calib.recorded.tables import Making, Tables
from calib.recorded.wrong_unit import (
    check_gravity,
    gravity_warnings,
    may_feel_gravity,
    measures_gravity,
    unconfirmed_unit,
)
from calib.signal.instrument import Instrument

CORNERS_ALIKE = (
    "sensor and reference are both AC-coupled and no corner is stated: nothing tells what is the reference's, so S "
    "contains what the reference's corner does; state `reference_corner_hz`, or `reference_coupling` dc"
)
COVERAGE_FACTOR = 2.0  # of plain Method 3, as in the paper: there are thousands of points


def calibrated(sensor: SensorTable, reference: ReferenceTable | None, poses: Poses | None, options: Options) -> Outcome:
    """The outcome for these samples, poses and options, which passed `options.check`. Raises InputError."""
    if reference is not None:
        check_step(sensor)
        check_step(reference)
    outcome = _estimated(sensor, reference, poses, options)
    more = {**outcome.more, "reference_quantity": None if reference is None else reference.quantity}
    outcome = replace(outcome, unit=sensor.unit, more=more)
    silent, feels = [], False
    if reference is not None and reference.channels == 3 and options.rotation is not None:
        silent = silent_channels(sensor, reference, options.rotation)
        feels = options.reference_coupling != "ac"  # its dead channel may be the one along gravity
    if outcome.reasons or (silent and feels):  # what a dead channel does not feel of gravity would be taken for Q
        found = causes(sensor, reference, poses, outcome)
        return replace(outcome, calibration=None, reasons=(*found, *silent, *outcome.reasons))
    told = [*outcome.warnings, *axis_warnings(outcome.sensitivity), *silent]
    if reference is None:
        return replace(outcome, warnings=tuple(told))
    setting = _setting(options, sensor, reference)
    if options.method == 3 and _coupled(instrument_of(options), setting).corners_alike:
        told.append(CORNERS_ALIKE)
    if setting.reference_coupling == "dc":
        told += gravity_warnings(reference)
    gravity_tells = poses is not None and states_gravity(poses) and options.coupling != "ac"
    if not gravity_tells and (reference.channels == 1 or options.reference_coupling is None):
        told += unconfirmed_unit(reference, setting.reference_coupling)
    return replace(outcome, warnings=tuple(told))


def _estimated(sensor: SensorTable, reference: ReferenceTable | None, poses: Poses | None, options: Options) -> Outcome:
    if reference is None and poses is None and not options.plain:
        return norm_fitted(sensor, options)
    if options.method != 3:
        return by_amplitudes(tables_of(sensor, reference, poses, options), options)
    if options.plain:
        return _plain(tables_of(sensor, reference, poses, options), priors_of(options))
    certificate = options.reference_certificate
    if certificate is not None:
        options = replace(
            options,
            u_reference_pct=100.0 * float(np.max(certificate.u_relative)),
            u_reference_transverse_pct=100.0 * certificate.u_transverse,
        )
    tables = tables_of(sensor, reference, poses, options, instrument_of(options))
    return adjusted(tables, priors_of(options), certificate, options.band_hz)


def tables_of(
    sensor: SensorTable, reference: ReferenceTable | None, poses: Poses | None, options: Options,
    instrument: Instrument | None = None,
) -> Tables:  # fmt: skip
    """The tables with their poses, as the options say. Raises InputError.

    `instrument` is from `instrument_of`. With None, corner frequencies of AC-coupled instruments are not used.
    """
    instrument = instrument or Instrument()
    if reference is not None:
        instrument = replace(instrument, quantity=reference.quantity)
        _check_quantity(reference, options.reference_quantity)
    setting = _setting(options, sensor, reference)
    instrument = _coupled(instrument, setting)
    if reference is not None and setting.reference_coupling == "dc":
        check_gravity(reference)
    intervals = _intervals(poses, setting, reference)
    limits = Limits() if options.plain else Limits.of(options.u_offset_mps2, math.radians(options.u_angle_deg))
    more = not options.plain
    settings = Settings(limits, leave_out=more, limit_band=more, bands=more)
    return Tables(sensor, reference, intervals, instrument, Making(settings, align=more))


def _coupled(instrument: Instrument, setting: PoseSettings) -> Instrument:
    """The instrument with the couplings of reference and sensor."""
    ac, sensor_ac = (coupling == "ac" for coupling in (setting.reference_coupling, setting.coupling))
    return replace(instrument, ac_coupled=ac, sensor_ac_coupled=sensor_ac)


def _check_quantity(reference: ReferenceTable, stated: str | None) -> None:
    if stated and reference.quantity != stated:
        raise InputError(
            f"the column holds {reference.quantity}, but `reference_quantity` says {stated}",
            place=reference.place, column=reference.column,
        )  # fmt: skip


def _setting(options: Options, sensor: SensorTable, reference: ReferenceTable | None) -> PoseSettings:
    """The settings that apply to every pose."""
    channels = 0 if reference is None else reference.channels
    return PoseSettings(
        gravity_mps2=options.gravity or STANDARD_GRAVITY_MPS2,
        static_sign=options.static_sign,
        coupling=options.coupling,
        reference_coupling=options.reference_coupling or _usual_coupling(sensor, reference),
        reference_channels=channels,
        rotation=options.rotation,
    )


def _usual_coupling(sensor: SensorTable, reference: ReferenceTable | None) -> Coupling:
    """That of a reference for which nobody states one: DC where it shows gravity, or neither it nor the sensor does."""
    if reference is None or reference.channels != 3 or reference.quantity != "acceleration":
        return "ac"
    return "dc" if measures_gravity(reference) or not may_feel_gravity(sensor, reference) else "ac"


def _intervals(poses: Poses | None, setting: PoseSettings, reference: ReferenceTable | None) -> list[PoseInterval]:
    if setting.rotation is not None and setting.reference_channels != 3:
        raise OptionError("`rotation` is for a tri-axial `reference`, but this one has one axis", "remove `rotation`")
    if poses is not None:
        return intervals_of(poses, setting)
    if reference is None or setting.reference_channels != 3:
        raise OptionError(
            "`poses` is missing", "only a tri-axial `reference`, or rests without a reference, need no poses"
        )
    try:
        pose = beside_reference(setting)
    except ValueError as error:
        raise OptionError(str(error)) from None
    return [PoseInterval(*ends_s(reference.time_s), pose)]


def _plain(tables: Tables, priors: Priors) -> Outcome:
    windows = tables.windows()
    if not any(w.used for w in windows):
        return nothing_used(windows, tables.rate_hz, PLAIN)
    found = fit(windows)
    reasons = (
        *refusal(found, windows),
        *sensitivity_reasons(found.calibration, COVERAGE_FACTOR, stated=priors.parameters is not None),
        *contradictions(found.calibration, priors),
    )
    return Outcome(
        None if reasons else found.calibration,
        reasons,
        windows,
        tables.rate_hz,
        PLAIN,
        coverage_factor=COVERAGE_FACTOR,
        uncertainty_kind="type A, white",
        rank=found.rank,
        residual_sd=found.residual_sd.tolist(),
    )
