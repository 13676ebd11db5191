"""Where a certificate comes from, as a graph (W3C PROV-JSON): reference, windows, result, certificate, each by hash."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any

import msgspec

from agent import __version__
from agent.certificate.content import ResultCertificate

PREFIX = {"fieldcal": "https://fieldcal.invalid/", "sha256": "urn:hash:sha256:"}  # .invalid: nothing is there
CALIBRATION, SOFTWARE = "fieldcal:calibration", "fieldcal:program"


def graph(c: ResultCertificate, result: dict[str, Any]) -> dict[str, Any]:
    """The PROV-JSON. `result` is that of certificate.json; its entity is named by the SHA-256 of its JSON.

    A file or window is named by its SHA-256 too. The names of instruments are their serial numbers.
    """
    s, r = c.stated, c.stated.reference
    sensor = f"fieldcal:instrument/{s.instrument.manufacturer}/{s.instrument.model}/{s.instrument.serial_number}"
    reference = f"fieldcal:instrument/{r.manufacturer}/{r.model}/{r.serial_number}"
    issued = f"fieldcal:certificate/{r.certificate_issuer}/{r.certificate_number}"
    own = f"fieldcal:certificate/{s.organisation.name}/{c.number}"
    found = _digest(result)
    entity: dict[str, dict[str, Any]] = {
        sensor: _about("sensor", s.instrument.serial_number),
        reference: _about("reference", r.serial_number),
        issued: _about("certificate", r.certificate_number) | ({"fieldcal:sha256": c.reference_file.sha256}
                                                              if c.reference_file else {}),
        found: _about("result", c.result.label),
        own: _about("certificate", c.number),
    }  # fmt: skip
    files = {f"sha256:{file.sha256}": _about("file", file.path) for file in c.files}
    windows = {
        _digest(msgspec.structs.asdict(w)): _about("window", w.position) | {"start_s": w.start_s, "stop_s": w.stop_s}
        for w in c.result.windows
        if w.used
    }
    made_of = [(window, file) for window in windows for file in files]
    derived = [
        (reference, issued),
        (found, reference),
        *made_of,
        *((found, source) for source in windows or files),
        (own, found),
    ]
    organisation, operator = f"fieldcal:organisation/{s.organisation.name}", f"fieldcal:person/{s.operator.name}"
    return {
        "prefix": PREFIX,
        "entity": entity | files | windows,
        "activity": {CALIBRATION: {"prov:startTime": s.dates.begun, "prov:endTime": s.dates.ended,
                                   "fieldcal:method": c.method}},
        "agent": {organisation: {"prov:type": "prov:Organization"}, operator: {"prov:type": "prov:Person"},
                  SOFTWARE: {"prov:type": "prov:SoftwareAgent", "prov:label": f"fieldcal {__version__}"}},
        "used": _relations("u", "prov:activity", "prov:entity",
                           ((CALIBRATION, name) for name in (sensor, reference, *windows))),
        "wasGeneratedBy": _relations("g", "prov:entity", "prov:activity", [(found, CALIBRATION)]),
        "wasDerivedFrom": _relations("d", "prov:generatedEntity", "prov:usedEntity", derived),
        "wasAssociatedWith": _relations("a", "prov:activity", "prov:agent",
                                        [(CALIBRATION, operator), (CALIBRATION, SOFTWARE)]),
        "wasAttributedTo": _relations("t", "prov:entity", "prov:agent", [(own, organisation)]),
    }  # fmt: skip


def _about(kind: str, label: str) -> dict[str, Any]:
    return {"prov:type": f"fieldcal:{kind}", "prov:label": label}


def _relations(letter: str, first: str, second: str, pairs: Iterable[tuple[str, str]]) -> dict[str, dict[str, str]]:
    return {f"_:{letter}{k}": {first: a, second: b} for k, (a, b) in enumerate(pairs, start=1)}


def _digest(value: Any) -> str:
    """The name of something by the SHA-256 of its JSON, without blanks, members in their order."""
    return f"sha256:{hashlib.sha256(msgspec.json.encode(value)).hexdigest()}"
