"""Statements of a certificate without an editor: options, questions, and the certificate at the end of a session."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from agent.cli.leading import calibrate_options, make_result
from agent.cli.main import run_cli
from tests.scenarios.processes import answered
from tests.unit.certificates import STATED, run, uneven

pytest.importorskip("matplotlib", reason="the certificate needs the extra `report`")


def entries() -> dict[str, str]:
    """The example's statements, by entry."""
    return {
        f"{section}.{name}": str(value)
        for section, held in tomllib.loads(STATED.read_text()).items()
        for name, value in held.items()
    }


@pytest.fixture
def result(tmp_path: Path) -> Path:
    path = tmp_path / "result.json"
    path.write_text(json.dumps(uneven()))
    return path


def told(path: Path) -> object:
    return json.loads((path / "certificate.json").read_text())["certificate"]


@pytest.mark.thorough
def test_options_state_what_a_file_states(capsys: pytest.CaptureFixture[str], tmp_path: Path, result: Path) -> None:
    stated = [word for name, value in entries().items() for word in ("--state", f"{name}={value}")]
    assert run(capsys, result, *stated, "-o", tmp_path / "options") == (0, "")
    assert run(capsys, result, "--stated", STATED, "-o", tmp_path / "file") == (0, "")
    assert told(tmp_path / "options") == told(tmp_path / "file")
    kept = tmp_path / "options" / "certificate.toml"
    assert not (tmp_path / "file" / "certificate.toml").exists()
    assert run(capsys, result, "--stated", kept, "-o", tmp_path / "again") == (0, "")
    assert told(tmp_path / "again") == told(tmp_path / "file")


@pytest.mark.thorough
def test_an_option_replaces_what_the_file_states(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, result: Path
) -> None:
    out = tmp_path / "out"
    assert run(capsys, result, "--stated", STATED, "--state", "customer.name=Tower Operator", "-o", out) == (0, "")
    text = (out / "certificate.html").read_text()
    assert "Tower Operator" in text
    assert "Bridge Operator" not in text


@pytest.mark.thorough
def test_the_file_of_the_statements_is_not_written_over(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, result: Path
) -> None:
    mine = tmp_path / "certificate.toml"
    mine.write_text(STATED.read_text())
    assert run(capsys, result, "--stated", mine, "--state", "customer.city=Roma", "-o", tmp_path) == (0, "")
    assert mine.read_text() == STATED.read_text()


def test_what_is_missing_is_named_with_its_option(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, result: Path
) -> None:
    status, said = run(capsys, result, "--state", "organisation.name=L", "-o", tmp_path / "out")
    assert status == 2
    lines = said.splitlines()
    one = "fieldcal certificate: --state organisation.city=... is missing: organisation.city (docs/certificate.md)"
    assert one in lines
    assert all("... is missing" in line for line in lines)
    assert len(lines) == 19, "all but the name of the organisation and what has a default"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("customer.name", "write ENTRY=VALUE, as in customer.city=Pescara"),
        ("title.name=x", "title.name: title is no section"),
        ("customer.country=Italy", "--state: customer.country: must be the two capital letters of ISO 3166-1"),
        ("customer.colour=red", "--state: customer.colour: there is no such setting"),
        ("dates.ended=2026-11-01", "--state: dates.ended: 2026-11-01 is before begun"),
        ('remarks=["one", "two", 3]', "--state: remarks.2: "),
    ],
)
def test_a_wrong_entry_is_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, result: Path, entry: str, words: str
) -> None:
    all_others = {"title": "T"} | entries()
    stated = [word for name, value in all_others.items() for word in ("--state", f"{name}={value}")]
    status, said = run(capsys, result, *stated, "--state", entry, "-o", tmp_path / "out")
    assert (status, said.count("\n"), words in said) == (2, 1, True), said


@pytest.mark.thorough
def test_questions_are_asked_on_a_terminal(tmp_path: Path, result: Path) -> None:
    stated = [f"--state={name}={value}" for name, value in entries().items() if not name.startswith("customer")]
    answered("certificate", result, *stated, "-o", tmp_path / "out", typed="Tower Operator\nPescara\nIT\n")
    assert tomllib.loads((tmp_path / "out" / "certificate.toml").read_text())["customer"]["name"] == "Tower Operator"


@pytest.mark.thorough
def test_a_led_session_ends_with_the_certificate(tmp_path: Path) -> None:
    assert run_cli(["simulate", "--preset", "plain", "--csv", str(tmp_path)]) == 0
    options = calibrate_options([f"--{name}={tmp_path / name}.csv" for name in ("sensor", "reference", "poses")])
    options["json_to"] = str(tmp_path / "result.json")
    assert make_result(options, tmp_path, STATED) == 0
    assert (tmp_path / "certificate" / "certificate.pdf").exists()


def test_without_statements_the_file_is_named_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = tmp_path / "result.json"
    result.write_text(json.dumps(uneven()))
    status, said = run(capsys, result, "-o", tmp_path / "out")
    first, second, *_ = said.splitlines()
    assert status == 2
    assert first.startswith("fieldcal certificate: --stated certificate.toml is missing: ")
    assert "examples/certificate.toml" in first
    assert "--state organisation.name=... is missing" in second
