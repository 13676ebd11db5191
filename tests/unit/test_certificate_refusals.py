"""`fieldcal certificate`: what it refuses, each in one line that names the place; and the decision rule."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from agent.config.earlier import DCC, EarlierError, read_earlier
from tests.unit.certificates import BANDS, content, run, stated
from tests.unit.test_report_numbers import fields


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('<!DOCTYPE x [<!ENTITY a "aaaa">]><x>&a;</x>', "document type"),
        ('<!DOCTYPE x SYSTEM "file:///etc/passwd"><x/>', "document type"),
        ("<x/>", "no digital calibration certificate"),
        (f'<d:digitalCalibrationCertificate xmlns:d="{DCC}"/>', "--nominal"),
        ("<x", "broken"),
        ("<a:x/>", "broken: unbound prefix"),
        ('{"certificate": []}', "neither a result"),
    ],
)
def test_what_is_no_certificate_is_refused(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "prior"
    for encoding in ("utf-8", "utf-16") if text.startswith("<!") else ("utf-8",):
        path.write_text(text, encoding=encoding)
        with pytest.raises(EarlierError, match=words if encoding == "utf-8" else "prior: "):
            read_earlier(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("section", "lines", "words"),
    [
        ("operator", "", "operator: is missing; add it"),
        ("operator", 'name = " A"', "operator.name: must be one line of visible characters"),
        ("place", 'description = "x"\nkind = "moon"', "place.kind"),
        ("dates", "begun = 2026-02-01\nended = 2026-01-01\nissued = 2026-03-01", "dates.ended: 2026-01-01 is before"),
        ("dates", 'begun = "soon"\nended = 2026-01-01\nissued = 2026-03-01', "dates.begun: must be a date"),
        ("customer", 'name = "x"\ncity = "y"\ncountry = "Italy"', "customer.country: must be the two capital letters"),
        ("conditions", "temperature_low_degc = 3", "must be given together"),
        ("seal", "x = 1", "seal: there is no such setting"),
        ("instrument", 'manufacturer = "a"\nmodel = "b"\nserial_number = "c"', "instrument.output_unit: is missing"),
        ("instrument", 'manufacturer = "a"\nmodel = "b"\nserial_number = "c"\noutput_unit = "furlong"',
         "output unit 'furlong': a DCC cannot say it"),
    ],
)  # fmt: skip
def test_a_fault_of_the_statements_is_named(
    section: str, lines: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "result.json").write_text(json.dumps(fields()))
    path = stated(tmp_path, **{section: lines})
    tomllib.loads(path.read_text())
    status, told = run(capsys, tmp_path / "result.json", "--stated", path, "-o", tmp_path / "out")
    assert status == 2
    assert len(told.splitlines()) == 1
    assert str(path) in told
    assert words in told
    assert not (tmp_path / "out").exists()


def test_a_refused_result_has_no_certificate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "result.json").write_text(json.dumps(fields(status="refused", reasons=["too little motion"])))
    status = run(capsys, tmp_path / "result.json", "--stated", stated(tmp_path), "-o", tmp_path / "out")
    assert status == (3, "refused: too little motion\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"valid_band_hz": ["x", 1]}, "valid_band_hz"),
        ({"reference_frequency_hz": "x"}, "reference_frequency_hz"),
        ({"response": [{"low_hz": 1.0}]}, "response"),
        ({"response": [BANDS[0] | {"sensitivity_re": [1.0]}]}, "response"),
        ({"covariance": None}, "covariance: the result has none"),
        ({"expanded_uncertainty": {"coverage_factor": None}}, "expanded_uncertainty, covariance"),
    ],
)
def test_a_fault_of_the_result_is_named(
    changes: dict[str, Any], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "result.json").write_text(json.dumps(fields(**changes)))
    status, told = run(capsys, tmp_path / "result.json", "--stated", stated(tmp_path), "-o", tmp_path / "out")
    assert status == 2
    assert told.startswith(f"fieldcal certificate: {tmp_path / 'result.json'}: ")
    assert len(told.splitlines()) == 1
    assert words in told


def test_the_decision_rule_takes_u_into_account(tmp_path: Path) -> None:
    """S_xx is 1.0 % from 10 with U 0.2 %: a limit of 1.1 % is kept without U, and not kept with it."""
    S = [[10.1, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 10.0]]
    (tmp_path / "result.json").write_text(json.dumps(fields(sensitivity=S)))
    found = {}
    for rule in ("simple acceptance", "guard band"):
        path = stated(tmp_path, decision=f'nominal = 10.0\nlimit_pct = 1.1\nrule = "{rule}"')
        told = content([tmp_path / "result.json"], path)
        found[rule] = [entry["conforms"] for entry in told["conformity"]]
    assert found == {"simple acceptance": [True, True, True], "guard band": [False, True, True]}


def test_gravity_alone_names_no_instrument_as_the_reference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rest = {"start_s": 0.0, "stop_s": 30.0, "used": True, "reason": "", "points": 3000, "kind": "rest"}
    path = tmp_path / "result.json"
    path.write_text(json.dumps(fields(reference_quantity=None, windows=[rest])))
    status, said = run(capsys, path, "--stated", stated(tmp_path), "-o", tmp_path / "out")
    assert status == 2
    assert "reference.name: is missing; gravity was the only excitation" in said
    told = tmp_path / "certificate.toml"
    told.write_text(told.read_text().replace("[reference]", '[reference]\nname = "local gravity"'))
    assert content([path], told)["stated"]["reference"]["name"] == "local gravity"
