"""What is stated for a certificate and the data tell otherwise is a warning of the certificate."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from agent.certificate.contradictions import contradictions
from agent.certificate.statements import CertificateStatements
from agent.config.reading import load_model
from agent.report.material import Material, gather
from tests.unit.certificates import content, run, stated, uneven
from tests.unit.recorded_bench import EPOCH_NS, record

DATES = "begun = {0}\nended = {1}\nissued = 2030-01-01"


def measured(folder: Path, *times: str) -> Path:
    """A result whose only used window was measured between two times, and one that was refused before them."""
    start_s, stop_s = (datetime.fromisoformat(time).replace(tzinfo=UTC).timestamp() for time in times)
    window = {"start_s": start_s, "stop_s": stop_s, "used": True, "reason": "", "points": 9, "left_out": 0}
    refused = window | {"start_s": start_s - 1e7, "stop_s": start_s - 9e6, "used": False, "reason": "too short"}
    path = folder / "result.json"
    path.write_text(json.dumps(uneven() | {"windows": [refused, window]}))
    return path


@pytest.mark.parametrize(
    ("begun", "ended", "told"),
    [
        ("2026-11-20", "2026-11-21", ""),
        ("2026-11-19", "2026-11-30", ""),
        ("2026-11-21", "2026-11-21", ""),  # where it is UTC+14, it was the 21st at 10:30 UTC of the 20th
        ("2026-11-22", "2026-11-22", "dates.begun is stated as 2026-11-22, but the data are from 2026-11-20 10:30 UTC"),
        ("2026-11-20", "2026-11-20", ""),  # where it is UTC-12, it was still the 20th at 11:30 UTC of the 21st
        ("2026-11-19", "2026-11-19", "dates.ended is stated as 2026-11-19, but the data go on until 2026-11-21 11:30"),
    ],
)
def test_dates(begun: str, ended: str, told: str, tmp_path: Path) -> None:
    result = measured(tmp_path, "2026-11-20 10:30", "2026-11-21 11:30")
    path = stated(tmp_path, dates=DATES.format(begun, ended))
    found = contradictions(load_model(path, CertificateStatements), gather([result], None))
    assert [sentence[: len(told)] for sentence in found] == ([told] if told else [])


def test_times_that_count_from_the_begin_of_a_file_contradict_no_date(tmp_path: Path) -> None:
    result = measured(tmp_path, "1970-01-01 00:00:10", "1970-01-01 00:00:20")
    assert content([result], stated(tmp_path))["result"]["warnings"] == []


@pytest.mark.slow
def test_a_contradiction_is_a_warning_of_every_form(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = measured(tmp_path, "2026-11-20 10:30", "2026-11-21 11:30")
    path = stated(tmp_path, dates=DATES.format("2024-01-02", "2024-01-03"))
    status, told = run(capsys, result, "--stated", path, "-o", tmp_path / "out")
    sentence = "dates.ended is stated as 2024-01-03, but the data go on until 2026-11-21 11:30 UTC"
    assert (status, sentence in told) == (0, True)
    for name in ("certificate.json", "certificate.html", "certificate.xml"):
        assert sentence in (tmp_path / "out" / name).read_text()


@pytest.mark.parametrize(
    ("sensor", "reference", "contradicted"),
    [
        ("a0042", "LW 1234", []), ("", "", []),
        ("A-0043", "", ["instrument.serial_number is stated as A-0042, but the recording names A-0043"]),
        ("", "LW-1235", ["reference.serial_number is stated as LW-1234, but the recording names LW-1235"]),
    ],
)  # fmt: skip
def test_serial_numbers(sensor: str, reference: str, contradicted: list[str], tmp_path: Path) -> None:
    statements = load_model(stated(tmp_path), CertificateStatements)
    given = gather([measured(tmp_path, "2026-11-20 10:30", "2026-11-20 11:30")], None)
    material = Material("imu", given.results, serial_numbers={"instrument": sensor, "reference": reference})
    assert list(contradictions(statements, material)) == contradicted


@pytest.mark.slow
def test_a_recording_tells_its_date_and_its_serial_numbers(tmp_path: Path) -> None:
    record(tmp_path / "data", 41.0)
    day = f"{datetime.fromtimestamp(EPOCH_NS * 1e-9, UTC):%Y-%m-%d}"
    for given in ([tmp_path / "data"], sorted((tmp_path / "data").glob("*.mcap"))):
        material = gather(given, None)
        assert material.serial_numbers == {"instrument": "mems-1", "reference": "reference-1"}
        for ended, said in ((day, 0), ("2001-02-03", 1)):
            path = stated(tmp_path, dates=DATES.format("2001-02-03", ended))
            found = contradictions(load_model(path, CertificateStatements), material)
            assert sum(sentence.startswith("dates.ended is stated as 2001-02-03") for sentence in found) == said
            assert sum("but the recording names" in sentence for sentence in found) == 2
