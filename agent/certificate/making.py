"""Makes the content of a certificate, and its JSON object, from a result and from what was stated."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from agent import __version__
from agent.calibrate.origin import SourceFile, source_file
from agent.certificate.content import (
    COVERAGE_PROBABILITY,
    EQUATION,
    MAIN,
    CertificateError,
    ConformityVerdict,
    ResultCertificate,
)
from agent.certificate.contradictions import contradictions
from agent.certificate.provenance import graph
from agent.certificate.statements import CertificateStatements, DecisionRule
from agent.core.events import CalibrationUpdate
from agent.report.material import Material, MaterialError
from agent.report.result import CalibrationResult, plain
from agent.report.trace import Residuals
from agent.report.units import reference_name
from calib.model import PARAMETERS, Array
from calib.recorded.units import unit_name

FORMAT = 1  # of certificate.json


def certificate_of(
    material: Material, stated: CertificateStatements, beside: Path, seen: Iterable[Residuals]
) -> ResultCertificate:
    """The certificate of the first result. `beside`: directory of certificate.toml. What the data tell otherwise than
    what is stated is among its warnings. Raises CertificateError and MaterialError."""
    result = material.results[0]
    source = material.files[0].path if material.files else "the input"
    result = replace(result, unit=_unit(result.unit, stated.instrument.output_unit, source))
    warnings = (*result.warnings, *contradictions(stated, material))
    result = replace(result, fields={**result.fields, "warnings": list(warnings)})
    stated = _with_reference_name(stated, result)
    residuals, levels = tuple(seen), _levels(material)
    known = np.isfinite(result.values) & np.isfinite(result.expanded_uncertainty)
    if not any(np.isfinite(result.covariance[k][known]).all() for k in np.flatnonzero(known)):
        raise MaterialError(
            f"{source}: expanded_uncertainty, covariance: the result has none; make it again with `fieldcal calibrate`"
        )
    found = ResultCertificate(
        stated=stated, number=stated.number, sensor=material.sensor, result=result,
        reference_file=_reference_file(stated.reference.certificate_file, beside), files=tuple(material.files),
        temperature_degc=_temperature(stated, material.history), frequency_hz=_frequencies(residuals),
        levels_mps2=(min(levels), max(levels)) if levels else None,
        positions=tuple(dict.fromkeys(w.position for w in result.windows if w.used and w.position)),
        relative_pct=_relative(result), verdicts=_verdicts(result.in_display_units, stated.decision),
        history=tuple(material.history), seen=residuals,
    )  # fmt: skip
    if found.number:
        return found
    digest = hashlib.sha256(msgspec.json.encode(as_object(found))).hexdigest()
    return replace(found, number=f"FC-{stated.dates.issued}-{digest[:12]}")


def as_object(certificate: ResultCertificate) -> dict[str, Any]:
    """The member `certificate` of certificate.json."""
    c, result = certificate, certificate.result
    told = result.fields
    measured = plain(
        {name: told.get(name) for name in
         ("sensitivity", "offset", "standard_uncertainty", "expanded_uncertainty", "covariance", "determined",
          "response", "budget", "warnings", "reference_quantity", "lag_s", "frame", "method", "uncertainty_kind",
          "identity", "shared_errors")}
        | {"parameters": PARAMETERS, "output_unit": result.unit, "degrees_of_freedom": result.degrees_of_freedom,
           "coverage_probability": COVERAGE_PROBABILITY, "expanded_uncertainty_pct": c.relative_pct}
    )  # fmt: skip
    return {
        "format": FORMAT,
        "number": c.number,
        "statement": c.statement,
        "stated": c.stated.model_dump(mode="json"),
        "sensor": c.sensor,
        "reference_certificate": None if c.reference_file is None else msgspec.structs.asdict(c.reference_file),
        "method": {"name": c.method, "equation": EQUATION},
        "conditions": plain(
            {
                "temperature_degc": c.temperature_degc,
                "reference_frequency_hz": c.result.frequencies.reference_frequency_hz,
                "valid_band_hz": c.result.frequencies.valid_band_hz,
                "motion_frequency_hz": c.frequency_hz,
                "levels_mps2": c.levels_mps2,
                "positions": c.positions,
                "windows": sum(w.used for w in result.windows),
            }
        ),
        "result": measured,
        "conformity": plain([{
            "parameter": v.parameter, "deviation_pct": v.deviation_pct,
            "expanded_uncertainty_pct": v.expanded_uncertainty_pct, "limit_pct": v.limit_pct, "conforms": v.conforms,
        } for v in c.verdicts]),
        "made_from": [msgspec.structs.asdict(file) for file in c.files],
        "made_by": {"fieldcal": __version__, "calibrated_with": told.get("version"), "engine": told.get("engine")},
        "provenance": graph(c, measured),
    }  # fmt: skip


def _unit(told: str, stated: str, source: str) -> str:
    """The output unit: of the result, or as it is stated. Raises CertificateError where the two contradict."""
    named = unit_name(stated) or stated
    if told and stated and (unit_name(told) or told) != named:
        raise CertificateError(
            f"instrument.output_unit: {stated!r}, but the indications in {source} are in {told!r}; "
            f"write {told!r}, or leave the line out"
        )
    if not told and not stated:
        raise CertificateError(
            "instrument.output_unit: is missing, and the result does not state it; add it, for example mV or count"
        )
    return told or named


def _with_reference_name(stated: CertificateStatements, result: CalibrationResult) -> CertificateStatements:
    """The statements with a name of the reference, by what it gives, where none is stated.

    Raises CertificateError where gravity was the only excitation: then no instrument was used.
    """
    quantity, used = result.fields.get("reference_quantity"), [w for w in result.windows if w.used]
    if not stated.reference.name and quantity is None and used and all(w.kind == "rest" for w in used):
        raise CertificateError(
            "reference.name: is missing; gravity was the only excitation, so the reference is no instrument: state "
            "name = 'local gravity', and in the other entries where its value comes from (docs/certificate.md)"
        )
    named = stated.reference.name or reference_name(quantity)
    return stated.model_copy(update={"reference": stated.reference.model_copy(update={"name": named})})


def _reference_file(name: str, beside: Path) -> SourceFile | None:
    if not name:
        return None
    path = beside / name
    try:
        return replace_path(source_file(path), name)
    except OSError as error:
        raise CertificateError(f"reference.certificate_file: {path}: {error.strerror or error}") from None


def replace_path(file: SourceFile, name: str) -> SourceFile:
    """The same file under the name that was stated for it."""
    return SourceFile(name, file.size_bytes, file.sha256)


def _temperature(stated: CertificateStatements, history: list[CalibrationUpdate]) -> tuple[float, float] | None:
    low, high = stated.conditions.temperature_low_degc, stated.conditions.temperature_high_degc
    if low is not None and high is not None:
        return low, high
    newest = history[-1] if history else None
    if newest is None or not np.isfinite([newest.temperature_low_degc, newest.temperature_high_degc]).all():
        return None
    return newest.temperature_low_degc, newest.temperature_high_degc


def _frequencies(seen: tuple[Residuals, ...]) -> tuple[float, ...]:
    """Least and largest mean frequency of the motion in the windows that can be shown point by point."""
    found = [r.frequency_hz for r in seen if r.frequency_hz is not None]
    return (min(found), max(found)) if found else ()


def _levels(material: Material) -> list[float]:
    """Root mean square of the reference's motion in each used window, as far as it is known."""
    windows = material.results[0].fields.get("windows")
    entries = [w for w in windows if isinstance(w, dict) and w.get("used")] if isinstance(windows, list) else []
    numbers = [entry.get("numbers") for entry in entries]
    told = [n.get("reference_rms_mps2") for n in numbers if isinstance(n, dict)]
    moved = [trace.reference for trace in material.traces.values() if trace.reference.size]
    rms = [float(np.sqrt(np.mean(np.var(reference, axis=0)))) for reference in moved]
    return [float(level) for level in told if isinstance(level, int | float)] or rms


def _relative(result: CalibrationResult) -> Array:
    main = np.repeat(np.abs(result.values[MAIN]), 3)
    return np.append(100.0 * result.expanded_uncertainty[:9] / main, np.full(3, np.nan))


def _verdicts(shown: CalibrationResult, decision: DecisionRule | None) -> tuple[ConformityVerdict, ...]:
    if decision is None:
        return ()
    found = []
    for k in MAIN:
        value, expanded = shown.values[k], shown.expanded_uncertainty[k]
        deviation, U = 100.0 * (value / decision.nominal - 1.0), 100.0 * expanded / decision.nominal
        guard = U if decision.rule == "guard band" else 0.0
        conforms = bool(abs(deviation) + guard <= decision.limit_pct)  # NaN, for what is not known, does not conform
        found.append(ConformityVerdict(PARAMETERS[k], float(deviation), float(U), decision.limit_pct, conforms))
    return tuple(found)
