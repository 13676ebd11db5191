"""`calibrate`: from arrays or DataFrames to S and Q in one call, as files are calibrated."""

from __future__ import annotations

import difflib
import inspect
import warnings
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from calib.model import Array
from calib.recorded.arrays import poses_of, reference_table, sensor_table
from calib.recorded.calibrating import calibrated
from calib.recorded.errors import OptionError
from calib.recorded.options import Options
from calib.recorded.outcome import Outcome
from calib.recorded.priors import prior_of

NAMES = [f.name for f in fields(Options)]


def calibrate(sensor: Any, reference: Any = None, poses: Any = None, **options: Any) -> Outcome:
    """S and Q from recorded samples, with the uncertainty and the reasons for a refusal.

    sensor: times in s and indications in the output unit: a DataFrame, a dict of columns or a structured array with the
    columns time_s, vx, vy, vz; an array (n, 4); or a pair of times (n,) and values (n, 3). Columns with other names and
    units, as "X [mV]", are chosen and converted as those of a CSV are; a warning says what was guessed.
    reference: the same with the columns time_s and a (m/s2), v (m/s), d (m), or ax, ay, az (m/s2). None: only rests.
    poses: a DataFrame, or a list with a dict for each pose: start_s, stop_s and theta_deg, alpha_deg | dx, dy, dz |
    axis | gx, gy, gz. None beside a tri-axial reference, and for rests in positions that nobody knows.
    options: the fields of calib.recorded.options.Options, with their defaults (docs/api.md lists them).

    Data that are refused are no exception: the result then has the status "refused" and its reasons. Raises InputError,
    a ValueError, for samples, poses and options that cannot be used.
    """
    stated = _options(options)
    stated.check(reference=reference is not None, poses=poses is not None, prior=stated.prior is not None)
    read = sensor_table(sensor)
    beside = None if reference is None else reference_table(reference, stated.reference_quantity)
    for line in (*read.said, *(beside.said if beside else ())):
        warnings.warn(line, stacklevel=2)
    return calibrated(read, beside, None if poses is None else poses_of(poses), stated)


def _signature() -> inspect.Signature:
    """With each option by its name and default, for help and for completion in a notebook."""
    given = [p for p in inspect.signature(calibrate).parameters.values() if p.kind is not p.VAR_KEYWORD]
    by_name = [inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, default=f.default) for f in fields(Options)]
    return inspect.Signature([*given, *by_name], return_annotation=Outcome)


calibrate.__signature__ = _signature()  # type: ignore[attr-defined]


def _options(told: Mapping[str, Any]) -> Options:
    for name in told:
        if name not in NAMES:
            near = difflib.get_close_matches(name, NAMES, n=1)
            raise TypeError(f"calibrate() has no option {name!r}" + (f"; is {near[0]!r} meant?" if near else ""))
    given: dict[str, Any] = dict(told)
    for name, convert in (("rotation", _rotation), ("prior", _prior)):
        if given.get(name) is not None:
            given[name] = convert(given[name])
    return Options(**given)


def _rotation(given: Any) -> Array:
    try:
        return np.array(given, dtype=float).reshape(3, 3)
    except (TypeError, ValueError):
        remedy = "give 3 x 3 numbers, a = R a_ref"
        raise OptionError(f"{given!r} cannot be used", remedy, column="rotation", value=given) from None


def _prior(given: Any) -> tuple[Array, Array]:
    """The prior from a result, a Calibration, or the object that `json.loads` makes of a result; with what a result
    knows of combinations of elements of S."""
    names = ("sensitivity", "offset", "covariance")
    members = given if isinstance(given, Mapping) else getattr(given, "more", {})
    given = members.get("joint") or given
    try:
        told = [given[name] if isinstance(given, Mapping) else getattr(given, name) for name in names]
        S, Q, covariance = (np.array(each, dtype=float) for each in told)
    except (AttributeError, KeyError, TypeError, ValueError):
        remedy = "give a result of `calibrate`, a Calibration, or a dict with sensitivity, offset and covariance"
        raise OptionError(f"{type(given).__name__} cannot be used", remedy, column="prior", value=given) from None
    return prior_of(np.append(S.ravel(), Q), covariance)
