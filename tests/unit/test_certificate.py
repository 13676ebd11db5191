"""`fieldcal certificate` as a user runs it: every form, its numbers, its signatures, and what it refuses."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import msgspec
import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from agent.certificate.making import certificate_of
from agent.certificate.schema import SchemaError, check_schema
from agent.certificate.signing import PURPOSE, signed_json
from agent.certificate.statements import CertificateStatements
from agent.certificate.wording import before_results
from agent.cli.main import run_cli
from agent.config.earlier import DCC, PARAMETER_LIST, SI, read_earlier
from agent.config.reading import load_model
from agent.core.events import CalibrationUpdate
from agent.recording.reading import RecordingReader
from agent.recording.signed_text import SignedText, values_of
from agent.report.material import gather
from agent.report.writing import left_over
from tests.unit.certificates import content, run, stated, uneven
from tests.unit.recorded_bench import record
from tests.unit.test_report import Page
from tests.unit.test_report_numbers import fields


@pytest.fixture(scope="module")
def key(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ed25519PrivateKey]:
    tmp_path = tmp_path_factory.mktemp("key")
    private = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
    path = tmp_path / "key.pem"
    path.write_bytes(private.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    path.chmod(0o600)
    return path, private


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, key: tuple[Path, Ed25519PrivateKey]) -> Path:
    tmp_path = tmp_path_factory.mktemp("made")
    (tmp_path / "result.json").write_text(json.dumps(uneven()))
    (tmp_path / "reference.pdf").write_bytes(b"its certificate")
    told = stated(tmp_path, reference='manufacturer = "P"\nmodel = "M"\nserial_number = "R-9"\n'
                  'certificate_number = "C-1"\ncertificate_issuer = "L"\ncalibrated = 2026-03-01\n'
                  'certificate_file = "reference.pdf"')  # fmt: skip
    out = tmp_path / "out"
    words = ["certificate", tmp_path / "result.json", "--stated", told, "-o", out, "--key", key[0]]
    assert run_cli([str(word) for word in words]) == 0
    return out


@pytest.mark.thorough
def test_the_numbers_survive_json_and_xml(made: Path) -> None:
    told = uneven()
    truth = np.append(np.ravel(told["sensitivity"]), told["offset"])
    for name in ("certificate.json", "certificate.xml"):
        values, covariance = read_earlier(made / name)
        np.testing.assert_allclose(values, truth, rtol=1e-12)
        np.testing.assert_allclose(covariance, told["covariance"], rtol=1e-12)


@pytest.mark.slow
def test_the_dcc_holds_what_the_result_holds(made: Path) -> None:
    """Read by its own names: units in D-SI, U, k, the response, the reference's certificate by its hash."""
    told, root = uneven(), ET.parse(made / "certificate.xml").getroot()
    listed = root.find(f".//{{{DCC}}}quantity[@refType='{PARAMETER_LIST}']/{{{SI}}}realListXMLList")
    assert listed is not None
    texts = {node.tag.rpartition("}")[2]: (node.text or "").split() for node in listed.iter()}
    assert texts["labelXMLList"] == ["Sxx", "Sxy", "Sxz", "Syx", "Syy", "Syz", "Szx", "Szy", "Szz", "Qx", "Qy", "Qz"]
    assert texts["unitXMLList"] == [r"\metre\tothe{-1}\second\tothe{2}"] * 9 + [r"\one"] * 3
    U = told["expanded_uncertainty"]
    expected = np.append(np.ravel(U["sensitivity"]), U["offset"])
    np.testing.assert_allclose(np.array(texts["uncertaintyXMLList"], float), expected, rtol=1e-12)
    np.testing.assert_allclose(np.array(texts["coverageFactorXMLList"], float), U["coverage_factor"], rtol=1e-12)
    named = {
        "".join(q.find(f"{{{DCC}}}name").itertext()).strip(): q  # type: ignore[union-attr]
        for q in root.iter(f"{{{DCC}}}quantity")
    }
    imaginary = named["sensitivity_im Syy"].find(f".//{{{SI}}}valueXMLList")
    assert imaginary is not None
    np.testing.assert_allclose(np.array((imaginary.text or "").split(), float), [1 / 3, 0.42], rtol=1e-12)
    hashed = [node.findtext(f"{{{DCC}}}value") for node in root.iter(f"{{{DCC}}}certificate")]
    assert hashed == [hashlib.sha256(b"its certificate").hexdigest()]
    assert [node.text for node in root.iter(f"{{{DCC}}}conformity")] == ["pass"] * 3


@pytest.mark.slow
def test_the_order_of_elements_is_that_of_the_schema(made: Path) -> None:
    """The sequences of DCC 3.2.1, as its schema states them; a validator refuses any other order."""
    root = ET.parse(made / "certificate.xml").getroot()
    sequences = {
        "digitalCalibrationCertificate": "administrativeData measurementResults comment document",
        "coreData": "countryCodeISO3166_1 usedLangCodeISO639_1 mandatoryLangCodeISO639_1 uniqueIdentifier "
        "identifications receiptDate beginPerformanceDate endPerformanceDate performanceLocation issueDate",
        "item": "name equipmentClass description installedSoftwares manufacturer model identifications",
        "measuringEquipment": "name equipmentClass description certificate manufacturer model identifications",
        "measurementResult": "name description usedMethods usedSoftware measuringEquipments influenceConditions "
        "results measurementMetaData",
        "identification": "issuer value name",
        "statement": "name description norm reference declaration valid date conformity",
        "contact": "name eMail phone location", "customer": "name eMail phone location",
        "respPerson": "person description role mainSigner",
        "realListXMLList": "labelXMLList valueXMLList unitXMLList expandedUncXMLList ellipsoidalRegionXMLList",
        "expandedUncXMLList": "uncertaintyXMLList coverageFactorXMLList coverageProbabilityXMLList",
        "ellipsoidalRegionXMLList": "covarianceMatrix coverageFactor coverageProbability",
    }  # fmt: skip
    assert root.get("schemaVersion") == "3.2.1"
    seen = set()
    for node in root.iter():
        name = node.tag.rpartition("}")[2]
        if name in sequences:
            seen.add(name)
            order = [sequences[name].split().index(child.tag.rpartition("}")[2]) for child in node]
            assert order == sorted(order), name
    assert seen == set(sequences)


@pytest.mark.slow
def test_every_signature_is_over_the_stated_bytes(made: Path, key: tuple[Path, Ed25519PrivateKey]) -> None:
    public = key[1].public_key()
    body, signature = signed_json((made / "certificate.json").read_bytes())
    number = json.loads(body)["number"]
    assert signature is not None
    check(signature, public, number, {"certificate": body})
    xml = (made / "certificate.xml").read_bytes()
    element = re.search(rb"<dcc:comment.*</dcc:comment>", xml, re.DOTALL)
    assert element is not None
    inside = ET.fromstring(xml).find(f"{{{DCC}}}comment/*")
    assert inside is not None
    check(SignedText.read((inside.text or "").encode()), public, number, {"xml": xml.replace(element[0], b"")})
    files = {name: (made / name).read_bytes() for name in
             ("certificate.pdf", "certificate.html", "certificate.xml", "certificate.json")}  # fmt: skip
    check(SignedText.read((made / "certificate.sig").read_bytes()), public, number, files)


def check(signature: SignedText, public: Any, number: str, parts: dict[str, bytes]) -> None:
    assert signature.fault(public) == ""
    told = values_of(signature.text, PURPOSE, ["number", *parts])
    assert told == [number, *(hashlib.sha256(part).hexdigest() for part in parts.values())]


@pytest.mark.slow
def test_the_page_loads_nothing_and_states_the_clauses(made: Path) -> None:
    seen = Page(made / "certificate.html")
    pictures = [link for link in seen.links if link.startswith("data:image/svg+xml;base64,")]
    assert seen.links == pictures
    assert len(pictures) == 2
    assert not re.search(r"<script|style=|@import|url\(", seen.source)
    policy = re.search(r'content="(default-src [^"]*)"', seen.source)
    style = re.search(r"<style>(.*)</style>", seen.source, re.DOTALL)
    assert policy is not None
    assert style is not None
    digest = base64.b64encode(hashlib.sha256(style[1].encode()).digest()).decode()
    assert policy[1].startswith(f"default-src 'none'; style-src 'sha256-{digest}'; img-src data:;")
    for words in ("field calibration", "not accredited", "Structures Laboratory", "Bridge Operator", "A-0042", "R-9",
                  "C-1 of L", "V(t) = S a(t − lag) + Q", "18 to 21.5 °C", "S at 2.7 Hz", "95.45 %", "guard band",
                  ": conforms", "2026-11-20", hashlib.sha256(b"its certificate").hexdigest()):  # fmt: skip
        assert words in seen.text, words


@pytest.mark.thorough
def test_the_pdf_has_two_pages_and_is_the_same_each_time(
    made: Path, key: tuple[Path, Ed25519PrivateKey], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len(re.findall(rb"/Type /Page\b", (made / "certificate.pdf").read_bytes())) == 2
    told, out = made.with_name("certificate.toml"), tmp_path / "again"
    assert run(capsys, made.with_name("result.json"), "--stated", told, "-o", out, "--key", key[0]) == (0, "")
    for path in made.iterdir():
        assert (out / path.name).read_bytes() == path.read_bytes(), path.name


@pytest.mark.thorough
def test_texts_from_outside_are_shown_and_do_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hostile = '<script>alert(1)</script> & $x$ "q" ]]>'
    told = fields(identity=f"{hostile}\x1b[2J\ufffe", method="3 (adjustment)")
    (tmp_path / "result.json").write_text(json.dumps(told))
    customer = f"name = '''{hostile}'''\ncity = 'C'\ncountry = 'DE'"
    out = tmp_path / "out"
    assert run(capsys, tmp_path / "result.json", "--stated", stated(tmp_path, customer=customer), "-o", out) == (0, "")
    seen = Page(out / "certificate.html")
    assert hostile in seen.text
    assert "<script" not in seen.source
    assert "\x1b" not in seen.source
    assert hostile in "".join(ET.parse(out / "certificate.xml").getroot().itertext())
    assert json.loads((out / "certificate.json").read_text())["signature"] is None
    assert not (out / "certificate.sig").exists()


@pytest.mark.thorough
def test_a_data_directory_and_a_recording(tmp_path: Path) -> None:
    record(tmp_path / "data", 41.0)
    told = stated(tmp_path, decision="")
    told.write_text(told.read_text().replace('output_unit = "count"\n', ""))
    recordings = sorted((tmp_path / "data").glob("*.mcap"))
    found = [content(given, told) for given in ([tmp_path / "data"], recordings)]
    assert found[0]["result"]["sensitivity"] == found[1]["result"]["sensitivity"]
    assert found[0]["result"]["output_unit"] == "count"
    conditions = found[0]["conditions"]
    # Lines of one size from 1 to 8 Hz: the root mean square of their frequencies. Their peaks are at 5 m/s2.
    np.testing.assert_allclose(conditions["motion_frequency_hz"], np.sqrt((8**3 - 1) / 21), rtol=0.05)
    assert 1.0 < conditions["levels_mps2"][0] <= conditions["levels_mps2"][1] < 5.0
    assert found[0]["made_from"][0]["sha256"] == hashlib.sha256(recordings[0].read_bytes()).hexdigest()
    steps = (step for path in recordings for step in RecordingReader(path).steps())
    update = [r for step in steps for r in step.results if isinstance(r, CalibrationUpdate)][-1]
    for one in found:
        assert one["conditions"]["reference_frequency_hz"] == update.reference_frequency_hz > 1.0
        assert one["conditions"]["valid_band_hz"] == update.valid_band_hz
        assert one["result"]["response"] == [msgspec.structs.asdict(band) for band in update.response]
    assert len(update.response) == 3


def test_the_graph_leads_from_the_certificate_to_the_files_and_the_reference(tmp_path: Path) -> None:
    """Every name that a relation uses is there, and each file is named by its hash."""
    windows = [{"start_s": k, "stop_s": k + 1.0, "used": k != 1, "reason": "", "points": 9, "position": f"p{k}"}
               for k in range(3)]  # fmt: skip
    path = tmp_path / "result.json"
    path.write_text(json.dumps(fields(windows=windows)))
    held = content([path], stated(tmp_path))
    assert held["conditions"]["positions"] == ["p0", "p2"]  # of the windows that were used
    assert held["conditions"]["temperature_degc"] == [18.0, 21.5]  # as stated
    graph = held["provenance"]
    names = {*graph["entity"], *graph["activity"], *graph["agent"]}
    relations = [r for kind in graph if kind.startswith(("was", "used")) for r in graph[kind].values()]
    assert {name for relation in relations for name in relation.values()} == names
    assert all(name.partition(":")[0] in graph["prefix"] for name in names)
    sources: dict[str, set[str]] = {}
    for relation in graph["wasDerivedFrom"].values():
        sources.setdefault(relation["prov:generatedEntity"], set()).add(relation["prov:usedEntity"])
    [result] = sources[f"fieldcal:certificate/Structures Laboratory/{held['number']}"]
    canonical = msgspec.json.encode(held["result"])
    assert result == f"sha256:{hashlib.sha256(canonical).hexdigest()}"
    reference = "fieldcal:instrument/PCB/393B12/LW-1234"
    assert len(sources[result]) == 3
    file = f"sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}"
    assert {source for window in sources[result] - {reference} for source in sources[window]} == {file}
    assert sources[reference] == {"fieldcal:certificate/Accredited Laboratory/2026-0815"}


@pytest.mark.thorough
def test_what_is_not_known_is_left_out(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """S_xy and Q are null: the DCC has the other eight parameters with their covariance, and so has the prior."""
    told = uneven()
    told["sensitivity"][0][1], told["offset"], told["degrees_of_freedom"] = None, None, None
    for place in (1, 9, 10, 11):
        told["covariance"][place] = [None] * 12
        for row in told["covariance"]:
            row[place] = None
    (tmp_path / "result.json").write_text(json.dumps(told))
    out = tmp_path / "out"
    assert run(capsys, tmp_path / "result.json", "--stated", stated(tmp_path), "-o", out) == (0, "")
    values, covariance = read_earlier(out / "certificate.xml")
    known = [0, 2, 3, 4, 5, 6, 7, 8]
    assert np.flatnonzero(np.isfinite(values)).tolist() == known
    whole = read_earlier(made / "certificate.xml")[1]
    np.testing.assert_array_equal(covariance[np.ix_(known, known)], whole[np.ix_(known, known)])
    assert np.isnan(covariance[1]).all()


SCHEMA = """<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" targetNamespace="https://ptb.de/dcc"
 elementFormDefault="qualified"><xs:import namespace="https://ptb.de/si" schemaLocation="https://ptb.de/si/SI.xsd"/>
 <xs:element name="digitalCalibrationCertificate"><xs:complexType><xs:sequence>
 <xs:any processContents="skip" minOccurs="{count}" maxOccurs="{count}"/></xs:sequence>
 <xs:attribute name="schemaVersion" use="required"/></xs:complexType></xs:element></xs:schema>"""


@pytest.mark.slow
@pytest.mark.parametrize(("count", "words"), [(2, ""), (3, "the DCC is not valid: /"), (None, "SI_Format.xsd must be")])
def test_the_dcc_is_checked_against_a_schema_that_the_user_has(
    count: int | None, words: str, made: Path, tmp_path: Path
) -> None:
    """A schema that wants two parts, as DCC has them, accepts it; one that wants three does not. Nothing is fetched."""
    pytest.importorskip("xmlschema", reason="the extra dcc is not installed")
    (tmp_path / "dcc.xsd").write_text(SCHEMA.format(count=count or 2))
    if count is not None:
        namespace = "http://www.w3.org/2001/XMLSchema"
        (tmp_path / "SI_Format.xsd").write_text(
            f'<s:schema xmlns:s="{namespace}" targetNamespace="https://ptb.de/si"/>'
        )
    xml = re.sub(rb"<dcc:comment.*</dcc:comment>", b"", (made / "certificate.xml").read_bytes(), flags=re.DOTALL)
    if not words:
        check_schema(xml, tmp_path / "dcc.xsd")
        return
    with pytest.raises(SchemaError, match=words):
        check_schema(xml, tmp_path / "dcc.xsd")


@pytest.mark.skipif("FIELDCAL_DCC_XSD" not in os.environ, reason="FIELDCAL_DCC_XSD does not name dcc.xsd of PTB")
@pytest.mark.parametrize("source", ["files", "recording"])
def test_the_dcc_is_valid_by_the_schema_of_ptb(source: str, made: Path, tmp_path: Path) -> None:
    """dcc.xsd 3.2.1 with SI_Format.xsd 2.1.0 beside it; PTB's files are not part of this repository."""
    pytest.importorskip("xmlschema", reason="the extra dcc is not installed")
    out, schema = made, Path(os.environ["FIELDCAL_DCC_XSD"])
    if source == "recording":
        record(tmp_path / "data", 41.0)
        told, out = stated(tmp_path), tmp_path / "out"
        told.write_text(told.read_text().replace('output_unit = "count"\n', ""))
        words = ["certificate", tmp_path / "data", "--stated", told, "-o", out, "--xsd", schema]
        assert run_cli([str(word) for word in words]) == 0
    check_schema((out / "certificate.xml").read_bytes(), schema)
    broken = (out / "certificate.xml").read_bytes().replace(b"dcc:uniqueIdentifier", b"dcc:identifier")
    with pytest.raises(SchemaError, match="identifier"):
        check_schema(broken, schema)


def test_s_that_rests_alone_tell_holds_at_0_hz(tmp_path: Path) -> None:
    """Not at the mean frequency of the motion, which took no part."""
    path = tmp_path / "result.json"
    path.write_text(json.dumps(fields(reference_frequency_hz=0.0, valid_band_hz=None, response=None)))
    material, told = gather([path], None), stated(tmp_path)
    made = certificate_of(material, load_model(told, CertificateStatements), told.parent, left_over(material))
    held = replace(made, frequency_hz=(7.8, 7.8))
    rows = [row for section in before_results(held, "") for row in section.rows]
    assert ("frequencies", "S at 0 Hz, as rests tell it") in rows
