"""Priors of the nuisances and of S and Q, from the options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.estimate.nuisances import Priors
from calib.geometry import u_of_gravity_mps2
from calib.model import PARAMETERS, Array, Calibration
from calib.recorded.errors import OptionError
from calib.recorded.options import STATED, Options
from calib.signal.instrument import Instrument
from calib.signal.known_response import KnownResponse, known_response_of

# Without a stated local value, standard gravity is used. Its error is up to 0.3 %: gravity differs by 0.05 m/s2 between
# the poles and the equator.
U_STANDARD_GRAVITY_MPS2 = 0.03
# If a sensitivity differs from its prior by this many standard uncertainties, sensor, axis or reference is not the one
# that was stated. Noise and the errors of priors alone cause this once in 370 times.
CONTRADICTION = 3.0
NOMINAL_TRANSVERSE = 0.03  # of the nominal sensitivity: data sheets of MEMS say 1 to 3 %


def priors_of(options: Options) -> Priors:
    """The options u_..., nominal and prior as priors."""
    parameters, covariance = _prior_calibration(options)
    told = replace(options, u_gravity_mps2=u_gravity_mps2(options))
    stated = {name: convert(getattr(told, option) or 0.0) for name, (option, convert) in STATED.items()}
    return Priors(stated, parameters, covariance).beside_known(known_response(options))


def known_response(options: Options) -> KnownResponse:
    """What is stated of the filters of both instruments; by the reference's certificate, where the options do not."""
    certificate = options.reference_certificate
    of_both = known_response_of(options.sensor_filter, options.reference_filter)
    if options.reference_filter or certificate is None or not certificate.filters:
        return of_both
    return replace(of_both, reference=certificate.filters)


def instrument_of(options: Options) -> Instrument:
    """The reference and the corner frequencies by the options. The quantity is that of the reference's table."""
    return Instrument(
        corner_hz=options.reference_corner_hz,
        u_corner_hz=options.u_reference_corner_hz,
        sensor_corner_hz=options.sensor_corner_hz,
        u_sensor_corner_hz=options.u_sensor_corner_hz,
        known=known_response(options),
    )


def u_gravity_mps2(options: Options) -> float:
    """Standard uncertainty of gravity, m/s2; where it is not stated, by the digits of gravity."""
    if options.u_gravity_mps2 is not None:
        return options.u_gravity_mps2
    return U_STANDARD_GRAVITY_MPS2 if options.gravity is None else u_of_gravity_mps2(options.gravity)[0]


def _prior_calibration(options: Options) -> tuple[Array | None, Array | None]:
    """Prior values (12,) and covariance (12, 12) of S and Q, from `nominal` or `prior`."""
    if options.nominal is not None and options.u_nominal_pct is not None:
        main, u = options.nominal, options.u_nominal_pct / 100.0
        sd = main * np.where(np.eye(3).ravel() > 0, u, NOMINAL_TRANSVERSE)
        return np.append(main * np.eye(3).ravel(), np.zeros(3)), np.diag(np.append(sd**2, np.full(3, np.inf)))
    return (None, None) if options.prior is None else options.prior


def prior_of(values: Array, covariance: Array) -> tuple[Array, Array]:
    """The prior by the S row by row and Q (12,) of an earlier result and their covariance (12, 12).

    What is NaN there is not known: it has an infinite variance in the prior. Raises OptionError.
    """
    values, covariance = np.array(values, dtype=float), np.array(covariance, dtype=float)
    if values.shape != (12,) or covariance.shape != (12, 12):
        raise OptionError(
            "sensitivity must be 3 x 3, offset 3, covariance 12 x 12", "give a whole result", column="prior"
        )
    unknown = ~(np.isfinite(values) & np.isfinite(np.diag(covariance)))
    if unknown[[0, 4, 8]].all() or not values[[0, 4, 8]][~unknown[[0, 4, 8]]].any():
        raise OptionError("it tells no main sensitivity", "give a result that is valid", column="prior")
    covariance[unknown, :], covariance[:, unknown] = 0.0, 0.0
    covariance[unknown, unknown] = np.inf
    known = covariance[np.ix_(~unknown, ~unknown)]
    if not np.all(np.isfinite(known)) or (known.size and np.linalg.eigvalsh(known).min() <= 0.0):
        raise OptionError(
            "the covariance matrix is not positive definite, so it is no covariance", "give another one", column="prior"
        )
    return np.nan_to_num(values), covariance


def contradictions(found: Calibration, priors: Priors) -> list[str]:
    """Reasons for sensitivities that contradict the prior, for methods that do not use one."""
    if priors.parameters is None or priors.covariance is None:
        return []
    u_known = np.sqrt(np.diag(priors.covariance))[:9]
    return _contradicted(PARAMETERS[:9], found.sensitivity.ravel(), found.standard_uncertainty[:9],
                         priors.parameters[:9], u_known)  # fmt: skip


def row_contradictions(found: Calibration, priors: Priors) -> list[str]:
    """The same for a free frame, in which only the lengths of the rows of S can be compared."""
    if priors.parameters is None or priors.covariance is None:
        return []
    main = [0, 4, 8]
    length, known = (np.linalg.norm(S, axis=1) for S in (found.sensitivity, priors.parameters[:9].reshape(3, 3)))
    u_known = np.sqrt(np.diag(priors.covariance))[main]
    names = [f"the length of S's row {axis}" for axis in "xyz"]
    return _contradicted(names, length, found.standard_uncertainty[main], known, u_known)


def _contradicted(names: Sequence[str], values: Array, u: Array, known: Array, u_known: Array) -> list[str]:
    reasons = []
    for k in np.flatnonzero(np.isfinite(values) & np.isfinite(u_known)).tolist():
        away = abs(values[k] - known[k]) / np.hypot(u[k], u_known[k])
        if away > CONTRADICTION:
            reasons.append(
                f"{names[k]} is {values[k]:.4g}, {away:.1f} standard uncertainties from the prior value {known[k]:.4g} "
                f"(u {u_known[k]:.3g}); at most {CONTRADICTION:g} are allowed: check sensor, axes and reference"
            )
    return reasons
