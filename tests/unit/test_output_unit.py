"""The unit of the sensor's output goes from the file through result, table, report and certificate."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.certificate.content import ResultCertificate
from agent.certificate.dcc import dcc
from agent.certificate.making import as_object, certificate_of
from agent.certificate.signing import CertificateSigner
from agent.certificate.statements import CertificateStatements
from agent.certificate.wording import before_results, parameters
from agent.cli.main import run_cli
from agent.config.earlier import read_earlier
from agent.config.reading import load_model
from agent.report.material import gather
from agent.report.page import page
from agent.report.writing import left_over
from calib.recorded.notebook import calibrate
from tests.unit.certificates import STATED
from tests.unit.test_notebook import OPTIONS, POSES, REFERENCE, SENSOR, as_csv

G_MPS2 = 9.80665  # by definition of the unit
MAIN = (1.02, 0.99, 1.01)  # of S in tests.unit.test_notebook, for an output in m/s2
Q_MPS2 = (0.3, -0.1, 0.2)


def files(folder: Path, heads: tuple[str, ...], scale: float = 1.0, reference: dict[str, Any] = REFERENCE) -> list[str]:
    """The recording of tests.unit.test_notebook with these names of columns, its indications times `scale`."""
    time_s, *values = SENSOR.values()
    columns = dict(zip(("time_s", *heads), (time_s, *(scale * v for v in values)), strict=True))
    poses = {name: [row[name] for row in POSES] for name in POSES[0]}
    given = {"sensor": columns, "reference": reference, "poses": poses}
    return [f"--{name}={as_csv(folder / f'{name}.csv', held)}" for name, held in given.items()]


def calibrated(folder: Path, *arguments: str) -> tuple[Path, dict[str, Any]]:
    to = folder / "result.json"
    options = [f"--{name.replace('_', '-')}={value}" for name, value in OPTIONS.items()]
    assert run_cli(["calibrate", *arguments, *options, f"--json={to}"]) == 0
    return to, json.loads(to.read_text())


def report(result: Path) -> str:
    """The words of the report, without its figures."""
    return words(page(gather([result], None), [], []))


def certificate(folder: Path, result: Path, **changes: str) -> ResultCertificate:
    """The certificate with the example's statements, in which `changes` replace lines by their entry."""
    material = gather([result], None)
    stated = load_model(statements(folder, **changes), CertificateStatements)
    return certificate_of(material, stated, folder, left_over(material))


def statements(folder: Path, **changes: str) -> Path:
    text = re.sub(r"\[decision\](.|\n)*", "", STATED.read_text())
    for old, new in changes.items():
        text = re.sub(rf"{old} = .*\n", new, text)
    (folder / "certificate.toml").write_text(text)
    return folder / "certificate.toml"


def rows(found: ResultCertificate) -> dict[str, str]:
    """Value, U and unit of each parameter, as the certificate shows them."""
    return {name: f"{value} {unit}" for name, value, unit, *_ in parameters(found)}


def first(told: dict[str, Any], factor: float) -> str:
    """S xx with its U in another unit."""
    return "{:.4f} ± {:.4f}".format(
        *(factor * part["sensitivity"][0][0] for part in (told, told["expanded_uncertainty"]))
    )


def reference_of(found: ResultCertificate) -> str:
    return next(text for section in before_results(found, "") for name, text in section.rows if name == "reference")


def words(html: str) -> str:
    """The text of a page, with blanks in the place of its marks."""
    return " ".join(re.sub(r"<[^>]*>", " ", html).split())


@pytest.mark.two_cases
@pytest.mark.parametrize(
    ("heads", "stated", "unit"),
    [
        (("X [mV]", "Y [mV]", "Z [mV]"), "", "mV"),
        (("x_counts", "y_counts", "z_counts"), "", "count"),
        (("Acc X (m/s²)", "Acc Y (m/s²)", "Acc Z (m/s²)"), "", "m/s2"),
        (("p", "q", "r"), "--columns=time=time_s,x=p:V,y=q:V,z=r:V", "V"),
        (("vx", "vy", "vz"), "", None),
        (("X [mV]", "Y", "Z [mV]"), "", None),
        (("X [EU]", "Y [EU]", "Z [EU]"), "", None),
    ],
)
def test_the_result_has_the_unit_that_all_three_columns_have(
    tmp_path: Path, heads: tuple[str, ...], stated: str, unit: str | None
) -> None:
    given = [*files(tmp_path, heads), *([stated] if stated else [])]
    assert calibrated(tmp_path, *given)[1]["unit"] == unit


@pytest.mark.slow
def test_the_unit_is_in_table_report_and_certificate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result, told = calibrated(tmp_path, *files(tmp_path, ("X [mV]", "Y [mV]", "Z [mV]")))
    assert "  S in mV per m/s², Q in mV, U with k = 2" in capsys.readouterr().out
    assert "S in mV/(m/s²), Q in mV. After ±" in report(result)
    found = certificate(tmp_path, result, output_unit="")
    assert rows(found)["S xx"] == f"{first(told, 1.0)} mV/(m/s²)"
    assert rows(found)["Q x"].endswith(" mV")
    assert as_object(found)["result"]["output_unit"] == "mV"
    assert r"\milli\volt\metre\tothe{-1}" in dcc(found, CertificateSigner(None, "")).decode()


@pytest.mark.slow
def test_a_unit_that_contradicts_the_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result, _ = calibrated(tmp_path, *files(tmp_path, ("X [mV]", "Y [mV]", "Z [mV]")))
    stated = statements(tmp_path)
    assert run_cli(["certificate", str(result), "--stated", str(stated), "-o", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"fieldcal certificate: {stated}: instrument.output_unit: 'count', but the indications in {result} are in "
        "'mV'; write 'mV', or leave the line out"
    )
    assert not (tmp_path / "out").exists()
    assert certificate(tmp_path, result, output_unit='output_unit = "mv"\n').result.unit == "mV"  # the same
    assert run_cli(["report", str(result), "--unit", "count", "-o", str(tmp_path / "report")]) == 2
    assert "--unit count: the indications are in mV; leave --unit out" in capsys.readouterr().err


def numbers(text: str, row: str, count: int) -> list[tuple[float, float]]:
    """Value and U in a row of a table of text."""
    line = next(line for line in text.splitlines() if line.split()[:1] == [row])
    found = re.findall(r"(-?[\d.]+) ± ([\d.]+)", line)
    assert len(found) == count
    return [(float(value), float(U)) for value, U in found]


@pytest.mark.one_case
@pytest.mark.parametrize(("unit", "one_g"), [("g", 1.0), ("mg", 1e3)])
def test_an_output_in_g_is_shown_in_g_per_g_and_mg(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], unit: str, one_g: float
) -> None:
    heads = (f"X [{unit}]", f"Y [{unit}]", f"Z [{unit}]")
    result, told = calibrated(tmp_path, *files(tmp_path, heads, one_g / G_MPS2))
    printed = capsys.readouterr().out
    assert "S in g/g, Q in mg, U" in printed
    for i, axis in enumerate("xyz"):
        row = numbers(printed, axis, 4)
        (S, U_S), (Q, U_Q) = row[i], row[3]
        assert abs(S - MAIN[i]) < U_S < 0.02
        assert abs(Q - Q_MPS2[i] * 1e3 / G_MPS2) < U_Q < 20.0
    # The object has the file's unit, of which S is for 1 m/s2.
    np.testing.assert_allclose(np.diag(told["sensitivity"]), np.array(MAIN) * one_g / G_MPS2, rtol=0.01)
    assert "S in g/g, Q in mg. After ±" in report(result)
    found = certificate(tmp_path, result, output_unit="")
    assert rows(found)["S xx"] == f"{first(told, G_MPS2 / one_g)} g/g"
    assert re.fullmatch(r"\d\d\.\d ± \d\.\d mg", rows(found)["Q x"])
    xml = dcc(found, CertificateSigner(None, ""))
    assert f"numbers in {unit}: {one_g:g} is 9.80665 m/s²" in xml.decode()
    (tmp_path / "earlier.xml").write_bytes(xml)
    np.testing.assert_array_equal(read_earlier(tmp_path / "earlier.xml")[0][:9], np.ravel(told["sensitivity"]))


@pytest.mark.thorough
def test_a_reference_of_velocity_is_a_vibrometer(tmp_path: Path) -> None:
    t, a = REFERENCE["time_s"], REFERENCE["a"]
    velocity = {"time_s": t, "v": np.concatenate([[0.0], np.cumsum(0.5 * (a[1:] + a[:-1]) * np.diff(t))])}
    result, told = calibrated(tmp_path, *files(tmp_path, ("X [mV]", "Y [mV]", "Z [mV]"), reference=velocity))
    assert told["reference_quantity"] == "velocity"
    assert "beside a reference vibrometer (velocity)" in report(result)
    found = certificate(tmp_path, result, output_unit="")
    assert reference_of(found) == "reference vibrometer (velocity): PCB 393B12, serial number LW-1234"
    xml = dcc(found, CertificateSigner(None, "")).decode()
    assert "reference vibrometer (velocity)" in xml
    assert "reference accelerometer" not in xml
    named = certificate(tmp_path, result, output_unit="", manufacturer='name = "laser"\nmanufacturer = "Polytec"\n')
    assert reference_of(named).startswith("laser: Polytec ")


@pytest.mark.slow
def test_a_reference_of_acceleration_is_an_accelerometer(tmp_path: Path) -> None:
    result, _ = calibrated(tmp_path, *files(tmp_path, ("X [mV]", "Y [mV]", "Z [mV]")))
    assert reference_of(certificate(tmp_path, result, output_unit="")).startswith("reference accelerometer: PCB ")


@pytest.mark.thorough
def test_a_warning_is_told_once_wherever_the_result_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All outputs of the sensor have the wrong sign: S is valid, and negative."""
    given = files(tmp_path, ("X [mV]", "Y [mV]", "Z [mV]"), -1.0)
    result, told = calibrated(tmp_path, *given)
    warnings = told["warnings"]
    assert [line.split(" (")[0].split(",")[0] for line in warnings] == ["det S is negative", "Sxx = -1.02"]
    printed = capsys.readouterr()
    assert printed.out.count("WARNING: det S is negative") == 1
    assert printed.out.index("WARNING: det S is negative") < printed.out.index("S in mV per m/s²")
    assert "det S" not in printed.err
    options = [f"--{name.replace('_', '-')}={value}" for name, value in OPTIONS.items()]
    assert run_cli(["calibrate", *given, *options, "--json=-"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["warnings"] == warnings
    assert printed.err.count("WARNING: det S is negative") == 1
    shown = report(result)
    assert shown.count("det S is negative") == 1
    assert shown.index("Warning det S is negative") < shown.index("S in mV/(m/s²)")
    found = certificate(tmp_path, result, output_unit="")
    first = next(before_results(found, ""))
    assert (first.heading, list(first.rows)) == ("Warnings", [("warning", warning) for warning in warnings])
    assert as_object(found)["result"]["warnings"] == warnings
    assert dcc(found, CertificateSigner(None, "")).decode().count("det S is negative") == 1
    inverted = calibrate({n: v if n == "time_s" else -v for n, v in SENSOR.items()}, REFERENCE, POSES, **OPTIONS)
    html = inverted._repr_html_()
    assert html.count("Warning: det S is negative") == 1
    assert html.index("det S is negative") < html.index("<table")


@pytest.mark.slow
def test_a_nominal_gravity_has_the_uncertainty_of_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What gravity contributes to U of the offset is in proportion to its u, stated or by its digits."""
    given = ["calibrate", *files(tmp_path, ("X [mV]", "Y [mV]", "Z [mV]")), "--u-angle-deg=0.1", "--json=-"]
    line = (
        "--gravity 9.81: u of gravity is 0.01 m/s2, because it has at most 2 decimals, as a nominal value has; give "
        "local gravity with more digits, or state --u-gravity-mps2"
    )
    of_gravity = []
    for options in (["--gravity=9.81"], ["--gravity=9.81", "--u-gravity-mps2=0.002"], ["--gravity=9.8103"]):
        assert run_cli([*given, *options]) == 0
        printed = capsys.readouterr()
        of_gravity.append(json.loads(printed.out)["budget"]["gravity"]["Qz"])
        assert printed.err.splitlines().count(line) == (options == ["--gravity=9.81"])
        assert printed.err.count("u of gravity") == (options == ["--gravity=9.81"])
    rounded_mps2 = 0.5e-4 / 3**0.5  # half of the last digit, rectangular
    np.testing.assert_allclose(
        np.array(of_gravity) / of_gravity[1], np.array([0.01, 0.002, rounded_mps2]) / 0.002, rtol=0.02
    )
