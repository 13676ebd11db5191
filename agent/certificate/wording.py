"""The content of a certificate as headings and rows of text, the same for PDF and HTML."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from agent import __version__
from agent.calibrate.origin import SourceFile
from agent.certificate.content import COVERAGE_PROBABILITY, EQUATION, ResultCertificate
from agent.report.tables import number
from agent.report.units import offset_unit, position_name, sensitivity_unit
from calib.model import PARAMETERS
from calib.output_unit import ACCELERATION
from calib.rounding import plus_minus

Rows = Sequence[tuple[str, str]]
MOST_FILES = 6
HEADS = ("", "value ± U", "unit", "U in %", "k", "degrees of freedom")


@dataclass(frozen=True, slots=True)
class CertificateSection:
    """A heading with its rows of name and text."""

    heading: str
    rows: Rows


def before_results(c: ResultCertificate, signature: str) -> Iterator[CertificateSection]:
    """All that stands before the results."""
    s = c.stated
    if c.result.warnings:
        yield CertificateSection("Warnings", [("warning", warning) for warning in c.result.warnings])
    role = f", {s.operator.role}" if s.operator.role else ""
    yield CertificateSection("Certificate", [
        ("number", c.number),
        ("issued by", f"{s.organisation.name}, {s.organisation.address}"),
        ("responsible", f"{s.operator.name}{role}"),
        ("customer", f"{s.customer.name}, {s.customer.address}"),
        ("place", s.place.description),
        ("dates", _dates(c)),
        ("statement", c.statement),
        ("signature", signature),
    ])  # fmt: skip
    i, r = s.instrument, s.reference
    yield CertificateSection("Sensor and reference", [
        ("sensor", f"{i.name}: {i.manufacturer} {i.model}, serial number {i.serial_number}"),
        *([("identity", str(c.result.fields["identity"]))] if c.result.fields.get("identity") else []),
        ("reference", f"{r.name}: {r.manufacturer} {r.model}, serial number {r.serial_number}"),
        ("traceability", f"certificate {r.certificate_number} of {r.certificate_issuer}, {r.calibrated}"),
        ("its file", _file(c.reference_file) if c.reference_file else "not given"),
        *([("its error", "all results of this reference share it; certificate.json has the derivatives by it")]
          if c.result.fields.get("shared_errors") else []),
    ])  # fmt: skip
    yield CertificateSection("Method and conditions", list(_conditions(c)))


def after_results(c: ResultCertificate) -> Iterator[CertificateSection]:
    """What the results mean, and where they come from."""
    rows = [
        ("U", f"expanded uncertainty with the stated k: a coverage probability of {100 * COVERAGE_PROBABILITY:.2f} %"),
        ("%", "of the main sensitivity of the same row"),
        ("validity", "the results are those of the named sensor on the stated dates"),
        ("copies", "only of the whole certificate, unless the issuing organisation agrees"),
    ]
    if not c.result.determined.all():
        names = [name for name, known in zip(PARAMETERS, c.result.determined, strict=True) if not known]
        rows.append(("not determined", f"by the data: {', '.join(names)}; a value is what was known before"))
    yield CertificateSection("How to read the results", rows)
    decision = c.stated.decision
    if decision is not None:
        U = "deviation and U together are" if decision.rule == "guard band" else "the deviation is"
        unit = sensitivity_unit(c.result.unit)
        limit = f"at most {decision.limit_pct:g} % of {decision.nominal:g}{'' if unit == '1' else f' {unit}'}"
        yield CertificateSection("Conformity", [("decision rule", f"{decision.rule}: {U} {limit}"), *[
            (v.parameter, f"deviation {v.deviation_pct:+.2f} %, U {v.expanded_uncertainty_pct:.2f} %: "
                          f"{'conforms' if v.conforms else 'does not conform'}")
            for v in c.verdicts
        ]])  # fmt: skip
    engine = c.result.fields.get("engine")
    yield CertificateSection("Origin", [
        *[("made from", _file(file)) for file in c.files[:MOST_FILES]],
        *([("and", f"{len(c.files) - MOST_FILES} more files, see certificate.json")] if len(c.files) > MOST_FILES
          else []),
        *[("remark", remark) for remark in c.stated.remarks],
        *([("engine", f"{engine}: the code that made the result")] if engine else []),
        ("program", f"fieldcal {__version__}; certificate.json and certificate.xml have all digits and the covariance"),
    ])  # fmt: skip


def parameters(c: ResultCertificate) -> list[tuple[str, ...]]:
    """A row for each parameter, under HEADS."""
    result = c.result.in_display_units
    units = [sensitivity_unit(result.unit)] * 9 + [offset_unit(result.unit)] * 3
    return [
        (
            f"{name[0]} {name[1:]}",
            plus_minus(float(result.values[k]), float(result.expanded_uncertainty[k])).replace("-", "−")
            + ("" if result.determined[k] or not np.isfinite(result.values[k]) else " *"),
            units[k],
            number(c.relative_pct[k], 2),
            number(result.coverage_factor[k], 3),
            number(result.degrees_of_freedom[k], 3),
        )
        for k, name in enumerate(PARAMETERS)
    ]


def _dates(c: ResultCertificate) -> str:
    d = c.stated.dates
    received = f"received {d.received}, " if d.received else ""
    return f"{received}calibrated {d.begun} to {d.ended}, issued {d.issued}"


def _conditions(c: ResultCertificate) -> Iterator[tuple[str, str]]:
    yield "method", c.method
    yield "equation", f"{EQUATION}; V indication, a acceleration, S sensitivity, Q offset"
    t = c.temperature_degc
    yield "temperature", f"{t[0]:g} to {t[1]:g} °C" if t else "not recorded"
    band, at = c.result.frequencies.valid_band_hz, c.result.frequencies.reference_frequency_hz
    if band is not None and at is not None:
        low, high = band
        yield "frequencies", f"S at {at:.3g} Hz; right within U/3 from {low:.3g} to {high:.3g} Hz"
    elif at == 0.0:
        yield "frequencies", "S at 0 Hz, as rests tell it"
    elif c.frequency_hz:
        yield "frequencies", f"mean frequency of the motion {c.frequency_hz[0]:.3g} to {c.frequency_hz[1]:.3g} Hz"
    if c.levels_mps2:
        low, high = c.levels_mps2
        yield "levels", f"motion of {low:.3g} to {high:.3g} {ACCELERATION} (rms) in {_used(c)} windows"
    if c.positions:
        shown = [position_name(p) for p in c.positions[:8]]
        yield "positions", "; ".join(shown) + (f"; {len(c.positions)} in all" if len(c.positions) > 8 else "")
    if c.stated.conditions.other:
        yield "other", c.stated.conditions.other


def _used(c: ResultCertificate) -> int:
    return sum(window.used for window in c.result.windows)


def _file(file: SourceFile) -> str:
    return f"{file.path}, SHA-256 {file.sha256}"
