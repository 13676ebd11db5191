"""The certificate as a digital calibration certificate (DCC 3.2.1 of PTB) with quantities in D-SI 2.1.

No schema is read: the order of the elements is that of the schema. docs/certificate-content.md says how to validate.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from xml.etree import ElementTree as ET

import numpy as np

from agent import __version__
from agent.calibrate.origin import SourceFile
from agent.certificate.content import COVERAGE_PROBABILITY, EQUATION, CertificateError, ResultCertificate
from agent.certificate.signing import CertificateSigner
from agent.certificate.statements import NOT_IN_XML, Contact, Item, Reference
from agent.config.earlier import COVARIANCE, DCC, PARAMETER_LIST, SI
from agent.report.units import output_unit
from agent.terminal.text import one_line
from calib.model import PARAMETERS, Array
from calib.output_unit import G_IN

VERSION = "3.2.1"
LANGUAGE = "en"
OWN = "https://fieldcal.invalid/certificate"  # namespace of the signature; .invalid is reserved, nothing is there
PER_MPS2 = r"\metre\tothe{-1}\second\tothe{2}"
UNITS = {
    "m/s²": r"\metre\second\tothe{-2}", "V": r"\volt", "mV": r"\milli\volt", "uV": r"\micro\volt", "µV": r"\micro\volt",
    "count": r"\one", "A": r"\ampere", "mA": r"\milli\ampere", "C": r"\coulomb", "pC": r"\pico\coulomb",
    "mm/s²": r"\milli\metre\second\tothe{-2}", "cm/s²": r"\centi\metre\second\tothe{-2}",
    "m/s": r"\metre\second\tothe{-1}", "cm/s": r"\centi\metre\second\tothe{-1}",
    "mm/s": r"\milli\metre\second\tothe{-1}", "m": r"\metre", "mm": r"\milli\metre", "µm": r"\micro\metre",
    **dict.fromkeys(G_IN, r"\one"),  # D-SI has no g: the indication is a number, and a statement says what of
}  # fmt: skip
_CLOSING = b"</dcc:digitalCalibrationCertificate>"


def dcc(c: ResultCertificate, signer: CertificateSigner) -> bytes:
    """The XML. Its signature is over the bytes of the file without the element dcc:comment. Raises CertificateError."""
    for prefix, space in (("dcc", DCC), ("si", SI)):
        ET.register_namespace(prefix, space)
    root = ET.Element(_dcc("digitalCalibrationCertificate"), schemaVersion=VERSION)
    _administrative(_add(root, "administrativeData"), c)
    _measurement(_add(root, "measurementResults"), c)
    ET.indent(root)
    body: bytes = ET.tostring(root, encoding="UTF-8", xml_declaration=True)
    signed = signer.sign({"xml": body})
    if signed is None:
        return body
    told = ET.Element(_dcc("comment"))
    ET.SubElement(told, f"{{{OWN}}}signature").text = signed.decode()
    comment: bytes = ET.tostring(told, encoding="UTF-8", xml_declaration=False)
    return body.removesuffix(_CLOSING) + comment + _CLOSING


def _administrative(data: ET.Element, c: ResultCertificate) -> None:
    s = c.stated
    software = _add(_add(data, "dccSoftware"), "software")
    _texts(software, "name", "fieldcal")
    _add(software, "release", __version__)
    core = _add(data, "coreData")
    _add(core, "countryCodeISO3166_1", s.organisation.country)
    _add(core, "usedLangCodeISO639_1", LANGUAGE)
    _add(core, "mandatoryLangCodeISO639_1", LANGUAGE)
    _add(core, "uniqueIdentifier", c.number)
    if s.dates.received:
        _add(core, "receiptDate", s.dates.received)
    _add(core, "beginPerformanceDate", s.dates.begun)
    _add(core, "endPerformanceDate", s.dates.ended)
    _add(core, "performanceLocation", s.place.kind)
    _add(core, "issueDate", s.dates.issued)
    item = _add(_add(data, "items"), "item")
    _instrument(item, s.instrument, None)
    laboratory = _add(data, "calibrationLaboratory")
    _contact(_add(laboratory, "contact"), s.organisation)
    person = _add(_add(data, "respPersons"), "respPerson")
    _texts(_add(person, "person"), "name", s.operator.name)
    if s.operator.role:
        _add(person, "role", s.operator.role)
    _add(person, "mainSigner", "true")
    _contact(_add(data, "customer"), s.customer)
    statements = _add(data, "statements")
    for name, text in (("title", s.title), ("accreditation", c.statement), ("place", s.place.description),
                       *(("warning", warning) for warning in c.result.warnings), *_output_in_g(c.result.unit),
                       *(("remark", remark) for remark in s.remarks)):  # fmt: skip
        statement = _add(statements, "statement")
        _texts(statement, "name", name)
        _texts(statement, "declaration", text)
    _conformity(statements, c)


def _output_in_g(unit: str) -> list[tuple[str, str]]:
    """What the numbers of an output in g are, which D-SI cannot say."""
    one_g = G_IN.get(output_unit(unit))
    if one_g is None:
        return []
    told = f"the indications V and the offsets Q are numbers in {output_unit(unit)}: {one_g:g} is 9.80665 m/s²"
    return [("output unit", told)]


def _conformity(statements: ET.Element, c: ResultCertificate) -> None:
    decision = c.stated.decision
    for verdict in c.verdicts:
        assert decision is not None
        statement = _add(statements, "statement")
        _texts(statement, "name", f"conformity of {verdict.parameter}")
        words = f"decision rule: {decision.rule}; limit {decision.limit_pct!r} % of {decision.nominal!r}"
        _texts(statement, "declaration", words)
        _add(statement, "conformity", "pass" if verdict.conforms else "fail")


def _measurement(results: ET.Element, c: ResultCertificate) -> None:
    measured = _add(results, "measurementResult")
    _texts(measured, "name", "S and Q")
    method = _add(_add(measured, "usedMethods"), "usedMethod", refType="basic_calibrationMethod")
    _texts(method, "name", c.method)
    _texts(method, "description", EQUATION)
    r = c.stated.reference
    equipment = _add(_add(measured, "measuringEquipments"), "measuringEquipment", refType="basic_referenceStandard")
    named = f"{r.certificate_number} of {r.certificate_issuer}, {r.calibrated}"
    _instrument(equipment, r, c.reference_file, named)
    _conditions(measured, c)
    listed = _add(measured, "results")
    known = np.flatnonzero(np.isfinite(c.result.values) & np.isfinite(c.result.expanded_uncertainty))
    _parameters(_result(listed, "Parameters with expanded uncertainties", PARAMETER_LIST), c, known)
    _covariance(_result(listed, "Parameters with their covariance", COVARIANCE), c, known)
    _response(listed, c)


def _conditions(measured: ET.Element, c: ResultCertificate) -> None:
    kinds: list[tuple[str, str, Iterable[float] | None]] = [
        ("temperature", r"\degreecelsius", c.temperature_degc),
        ("band in which S holds", r"\hertz", c.result.frequencies.valid_band_hz),
        ("frequency at which S holds", r"\hertz", _list_of_one(c.result.frequencies.reference_frequency_hz)),
        ("mean frequency of the motion", r"\hertz", c.frequency_hz or None),
        ("level of the motion, rms", UNITS["m/s²"], c.levels_mps2),
    ]
    there = [(name, unit, list(values)) for name, unit, values in kinds if values is not None]
    if not there and not c.positions:
        return
    conditions = _add(measured, "influenceConditions")
    for name, unit, values in there:
        data = _condition(conditions, name)
        _list(_quantity(data, name), values, [unit] * len(values))
    if c.positions:
        _texts(_condition(conditions, "positions"), "text", "; ".join(c.positions))


def _condition(conditions: ET.Element, name: str) -> ET.Element:
    condition = _add(conditions, "influenceCondition")
    _texts(condition, "name", name)
    return _add(condition, "data")


def _list_of_one(value: float | None) -> list[float] | None:
    return None if value is None else [value]


def _parameters(data: ET.Element, c: ResultCertificate, known: np.ndarray[tuple[int, ...], np.dtype[np.intp]]) -> None:
    result = c.result
    units = [_unit(result.unit, k) for k in known]
    listed = _list(
        _quantity(data, "S and Q", PARAMETER_LIST), result.values[known], units, [PARAMETERS[k] for k in known]
    )
    U = _si(listed, "expandedUncXMLList")
    _si(U, "uncertaintyXMLList", _numbers(result.expanded_uncertainty[known]))
    _si(U, "coverageFactorXMLList", _numbers(result.coverage_factor[known]))
    _si(U, "coverageProbabilityXMLList", _numbers([COVERAGE_PROBABILITY] * len(known)))
    freedom = [k for k in known if math.isfinite(result.degrees_of_freedom[k])]
    if freedom:
        values = result.degrees_of_freedom[freedom]
        quantity = _quantity(data, "effective degrees of freedom")
        _list(quantity, values, [r"\one"] * len(freedom), [PARAMETERS[k] for k in freedom])
    percent = [k for k in known if math.isfinite(c.relative_pct[k])]
    quantity = _quantity(data, "expanded uncertainty relative to the main sensitivity of the row")
    _list(quantity, c.relative_pct[percent], [r"\percent"] * len(percent), [PARAMETERS[k] for k in percent])


def _covariance(data: ET.Element, c: ResultCertificate, known: np.ndarray[tuple[int, ...], np.dtype[np.intp]]) -> None:
    """The covariance of the parameters whose covariances are all known."""
    result = c.result
    held = [k for k in known if np.isfinite(result.covariance[k][known]).all()]
    units = [_unit(result.unit, k) for k in held]
    quantity = _quantity(data, "S and Q", COVARIANCE)
    listed = _list(quantity, result.values[held], units, [PARAMETERS[k] for k in held])
    region = _si(listed, "ellipsoidalRegionXMLList")
    matrix = _si(region, "covarianceMatrix")
    for k, unit in zip(held, units, strict=True):
        column = _si(matrix, "column")
        for i, other in zip(held, units, strict=True):
            entry = _si(column, "covariance")
            _si(entry, "value", repr(float(result.covariance[i, k])))
            _si(entry, "unit", other + unit)
    _si(region, "coverageFactor", repr(float(result.coverage_factor[held].max())))
    _si(region, "coverageProbability", repr(COVERAGE_PROBABILITY))


def _response(listed: ET.Element, c: ResultCertificate) -> None:
    """The complex sensitivity in third octaves: for each element of S a list of real and of imaginary parts, and u."""
    bands = c.result.frequencies.bands
    if not bands:
        return
    data = _result(listed, "Response over frequency", "fieldcal_response")
    for name in ("low_hz", "high_hz"):
        _list(_quantity(data, name), [getattr(band, name) for band in bands], [r"\hertz"] * len(bands))
    for name in ("sensitivity_re", "sensitivity_im", "standard_uncertainty"):
        values = np.array([getattr(band, name) for band in bands], dtype=float).reshape(len(bands), 9)
        for k in range(9):
            if np.isfinite(values[:, k]).all():
                unit = [_unit(c.result.unit, k)] * len(bands)
                _list(_quantity(data, f"{name} {PARAMETERS[k]}"), values[:, k], unit)


def _instrument(
    on: ET.Element, instrument: Item | Reference, certificate: SourceFile | None, certificate_name: str = ""
) -> None:
    _texts(on, "name", instrument.name)
    if certificate is not None:
        held = _add(on, "certificate")
        _texts(held, "referral", certificate_name)
        _add(held, "referralID", certificate.path)
        _add(held, "procedure", "SHA-256")
        _add(held, "value", certificate.sha256)
    elif certificate_name:
        _texts(on, "description", f"certificate {certificate_name}")
    _texts(_add(on, "manufacturer"), "name", instrument.manufacturer)
    _add(on, "model", instrument.model)
    identification = _add(_add(on, "identifications"), "identification")
    _add(identification, "issuer", "manufacturer")
    _add(identification, "value", instrument.serial_number)
    _texts(identification, "name", "serial number")


def _contact(on: ET.Element, contact: Contact) -> None:
    _texts(on, "name", contact.name)
    if contact.email:
        _add(on, "eMail", contact.email)
    place = _add(on, "location")
    for name, text in (("city", contact.city), ("countryCode", contact.country), ("postCode", contact.post_code),
                       ("street", contact.street)):  # fmt: skip
        if text:
            _add(place, name, text)


def _unit(told: str, k: int) -> str:
    """The unit of parameter `k` in D-SI. Raises CertificateError."""
    unit = output_unit(told)
    if unit not in UNITS:
        raise CertificateError(
            f"output unit {told!r}: a DCC cannot say it; instrument.output_unit must be one of {', '.join(UNITS)}, "
            "or make the result in one of these"
        )
    if k >= 9:
        return UNITS[unit]
    if unit == "m/s²":
        return r"\one"
    return PER_MPS2 if UNITS[unit] == r"\one" else UNITS[unit] + PER_MPS2


def _result(listed: ET.Element, name: str, kind: str) -> ET.Element:
    result = _add(listed, "result", refType=kind)
    _texts(result, "name", name)
    return _add(result, "data")


def _quantity(on: ET.Element, name: str, kind: str = "") -> ET.Element:
    quantity = _add(on, "quantity", **({"refType": kind} if kind else {}))
    _texts(quantity, "name", name)
    return quantity


def _list(
    quantity: ET.Element, values: Iterable[float] | Array, units: list[str], labels: Sequence[str] = ()
) -> ET.Element:
    listed = _si(quantity, "realListXMLList")
    if labels:
        _si(listed, "labelXMLList", " ".join(labels))
    _si(listed, "valueXMLList", _numbers(values))
    _si(listed, "unitXMLList", " ".join(units))
    return listed


def _numbers(values: Iterable[float] | Array) -> str:
    return " ".join(repr(float(value)) for value in values)


def _texts(on: ET.Element, tag: str, text: str) -> None:
    _add(_add(on, tag), "content", text, lang=LANGUAGE)


def _add(on: ET.Element, tag: str, text: str | None = None, **attributes: str) -> ET.Element:
    child = ET.SubElement(on, _dcc(tag), attributes)
    child.text = None if text is None else NOT_IN_XML.sub("?", one_line(text))
    return child


def _si(on: ET.Element, tag: str, text: str | None = None) -> ET.Element:
    child = ET.SubElement(on, f"{{{SI}}}{tag}")
    child.text = text
    return child


def _dcc(tag: str) -> str:
    return f"{{{DCC}}}{tag}"
