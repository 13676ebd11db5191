"""`fieldcal report` as a user runs it: on results, recordings and a data directory, sound and broken ones."""

from __future__ import annotations

import json
import re
import shutil
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.report.material import Material, gather
from agent.report.page import page
from agent.report.result import parse
from agent.report.writing import as_object, left_over
from hw.virtual.bench import Truth
from tests.unit.recorded_bench import record
from tests.unit.test_report_numbers import fields, moving

SECONDS = 41.0  # three positions of the bench
VOID = {"meta", "img", "br", "use", "path", "image", "rect", "circle", "line"}


class Page(HTMLParser):
    """What a browser would make of the page: ids, what it would load, and text. Fails on tags that do not close."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.links: list[str] = []
        self.text = ""
        self._open: list[str] = []
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self._open.append(tag)
        for name, value in attrs:
            if name == "id" and value:
                self.ids.append(value)
            if name in ("href", "src", "xlink:href") and value:
                self.links.append(value)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self._open.pop()

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Truth]:
    directory = tmp_path_factory.mktemp("report") / "data"
    return directory, record(directory, SECONDS)


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str]:
    status = run_cli(["report", *map(str, arguments)])
    return status, capsys.readouterr().err


def numbers(*inputs: Path) -> dict[str, Any]:
    """What report.json would hold, without drawing."""
    material = gather(inputs, None)
    held: dict[str, Any] = json.loads(msgspec.json.encode(as_object(material, left_over(material), [])))
    return held


def write(path: Path, **changes: Any) -> Path:
    path.write_text(json.dumps(fields(**changes)))
    return path


def check_figures(output: Path, *names: str) -> None:
    """These figures and no others, each in three formats."""
    assert {p.name for p in (output / "figures").iterdir()} == {
        f"{n}.{e}" for n in names for e in ("svg", "png", "pdf")
    }
    for name in names:
        assert (output / "figures" / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        assert (output / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def check_alone(seen: Page) -> None:
    """Nothing is loaded, and every reference finds its one target."""
    assert all(link.startswith("#") for link in seen.links)
    assert {link[1:] for link in seen.links} <= set(seen.ids)
    assert set(re.findall(r"url\(#([^)]*)\)", seen.source)) <= set(seen.ids)
    assert not re.search(r"@import|url\((?!#)", seen.source)
    assert not re.search(r"https?://(?!www\.w3\.org/)", seen.source)  # names of XML, never loaded
    figures = re.findall(r"<svg .*?</svg>", seen.source, re.DOTALL)
    ids = [set(re.findall(r'\bid="([^"]*)"', svg)) for svg in figures]
    assert sum(map(len, ids)) == len(set().union(*ids))


@pytest.mark.thorough
def test_a_data_directory(recorded: tuple[Path, Truth], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    directory, truth = recorded
    assert run(capsys, directory, "-o", tmp_path / "out") == (0, "")
    names = "rows", "main", "transverse", "budget", "response", "indications", "residuals", "windows"
    check_figures(tmp_path / "out", *names)
    seen = Page(tmp_path / "out" / "report.html")
    check_alone(seen)
    for words in (
        "of all kept windows, solved anew; its u is 1.000",
        "Calibration of mems", "VALID", "Method 3 (recursive adjustment)",
        "count/(m/s²)", "fieldcal-000001.mcap", "θ 35°",
        "combined", "SHA-256", "mems-1", "Covariance", "beside a reference accelerometer",
    ):  # fmt: skip
        assert words in seen.text, words
    held = json.loads((tmp_path / "out" / "report.json").read_text())
    S = np.array(held["results"][0]["sensitivity"])
    np.testing.assert_allclose(S, truth.sensitivity, atol=5e-3 * truth.sensitivity.max())  # the clamp's angles
    assert f"{S[0, 0]:.7g}" in seen.text
    assert len(held["residuals"]) == 3
    # What is left is noise, and what the clamp's angles are off by, which S and Q do not take up.
    sd = np.array(held["results"][0]["residual_sd"])
    for left in held["residuals"]:
        assert np.all((np.array(left["rms"]) > 0.95 * sd) & (np.array(left["rms"]) < 3.0 * sd))
    assert [len(f["sha256"]) for f in held["files"]] == [64]


@pytest.mark.thorough
def test_a_recording_gives_the_same_calibration_and_a_torn_one_what_it_has(
    recorded: tuple[Path, Truth], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = recorded[0] / "fieldcal-000001.mcap"
    whole, directory = numbers(source), numbers(recorded[0])
    # Only a data directory has the state from which the budget follows.
    of_state = [directory["results"][0].pop(name) for name in ("budget", "degrees_of_freedom")]
    assert all(of_state)
    assert [whole["results"][0].pop(name) for name in ("budget", "degrees_of_freedom")] == [{}, None]
    assert whole["results"] == directory["results"]
    assert whole["residuals"] == directory["residuals"]
    assert len(whole["residuals"]) == 3
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(source.read_bytes()[:-3000])
    status, said = run(capsys, torn, "-o", tmp_path / "torn")
    assert status == 0
    assert said.startswith(f"fieldcal report: {torn}: the recording ends early, at ")
    assert said.count("\n") == 1
    assert "ends early" in Page(tmp_path / "torn" / "report.html").text


@pytest.mark.thorough
def test_a_recording_without_a_calibration_says_why_and_is_status_3(
    recorded: tuple[Path, Truth], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = (recorded[0] / "fieldcal-000001.mcap").read_bytes()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(source[: len(source) // 2])
    status, said = run(capsys, torn, "-o", tmp_path / "out")
    assert status == 3
    assert "refused: not in force yet, parameters not determined: Sxx" in said
    seen = Page(tmp_path / "out" / "report.html")
    assert "REFUSED" in seen.text
    assert "not in force yet" in seen.text
    check_figures(tmp_path / "out", "windows")


@pytest.mark.thorough
def test_methods_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    diagonal = [[10.1, None, None], [None, 9.8, None], [None, None, 10.3]]
    flags = {"sensitivity": np.eye(3, dtype=bool).tolist(), "offset": [False] * 3}
    paths = [
        write(tmp_path / "one.json", method="1", statistics={"Sxx": [{"n": 6, "s_rel_pct": 0.0234}], "rel_S_pct": 1.0}),
        write(tmp_path / "two.json", method="2", sensitivity=diagonal, offset=None, determined=flags),
        write(tmp_path / "three.json", method="3 (adjustment)", budget={"type A": [0.01] * 12}),
    ]
    assert run(capsys, *paths, "-o", tmp_path / "out", "--unit", "mV") == (0, "")
    check_figures(tmp_path / "out", "rows-1", "rows-2", "rows-3", "main", "transverse", "budget-3")
    seen = Page(tmp_path / "out" / "report.html")
    check_alone(seen)
    assert seen.text.count("not determined") == 9
    assert "mV/(m/s²)" in seen.text
    assert re.search(r"<td>Sxx</td><td>1</td><td>6</td><td>0.0234</td>", seen.source)
    assert "9.800 ±\N{NO-BREAK SPACE}0.020" in seen.text
    assert [r["output_unit"] for r in json.loads((tmp_path / "out" / "report.json").read_text())["results"]] == [
        "mV"
    ] * 3


def test_two_results_of_one_method_are_told_apart_by_their_files(tmp_path: Path) -> None:
    paths = [write(tmp_path / f"{name}.json", method="1") for name in ("before", "after")]
    assert [r.label for r in gather(paths, None).results] == ["Method 1, before", "Method 1, after"]


def test_a_refused_result_shows_its_reasons(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nothing = {"sensitivity": None, "offset": None}
    path = write(
        tmp_path / "r.json", **nothing, determined=nothing, covariance=None, status="refused",
        reasons=["rank 3 of 4: <two> alphas"], budget={"type A": [0.1] * 12},
    )  # fmt: skip
    status, said = run(capsys, path, "-o", tmp_path / "out")
    assert (status, said) == (3, "refused: rank 3 of 4: <two> alphas\n")
    seen = Page(tmp_path / "out" / "report.html")
    assert "REFUSED" in seen.text
    assert "rank 3 of 4: <two> alphas" in seen.text
    assert not list((tmp_path / "out" / "figures").iterdir())


@pytest.mark.slow
def test_a_result_of_files_is_shown_with_their_samples_as_long_as_they_are_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "session"
    assert run_cli(["simulate", "--preset", "plain", "--csv", str(folder), "--duration", "41"]) == 0
    names = [part for n in ("sensor", "reference", "poses") for part in (f"--{n}", str(folder / f"{n}.csv"))]
    capsys.readouterr()
    assert run_cli(["calibrate", "--plain", *names, "--json", "-"]) == 0
    (folder / "result.json").write_text(capsys.readouterr().out)
    held = numbers(folder / "result.json")
    sd = np.array(held["results"][0]["residual_sd"])
    # Pooled over windows, the rms of the residuals is the residual SD of the fit.
    pooled = np.sqrt(np.mean([np.square(r["rms"]) for r in held["residuals"]], axis=0))
    np.testing.assert_allclose(pooled, sd, rtol=0.01)
    assert len(held["files"]) == 4
    shutil.move(folder, tmp_path / "moved")  # they are found beside the result
    assert numbers(tmp_path / "moved" / "result.json")["residuals"] == held["residuals"]
    with (tmp_path / "moved" / "poses.csv").open("a") as file:
        file.write("\n")
    held = numbers(tmp_path / "moved" / "result.json")
    assert held["residuals"] == []
    assert len(held["notices"]) == 1
    assert "poses.csv has changed since the calibration" in held["notices"][0]


@pytest.mark.thorough
def test_the_same_input_gives_the_same_bytes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "r.json", method="1")
    for name in ("a", "b"):
        assert run(capsys, path, "-o", tmp_path / name)[0] == 0
    for file in [p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*")]:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


def bad_inputs(recorded: Path, folder: Path) -> dict[str, tuple[list[str | Path], str]]:
    (folder / "broken.json").write_text('{"sensitivity": [')
    (folder / "list.json").write_text("[1]")
    (folder / "other.json").write_text('{"a": 1}')
    (folder / "empty").mkdir()
    (folder / "empty.mcap").write_bytes(b"")
    source = bytearray((recorded / "fieldcal-000001.mcap").read_bytes())
    source[len(source) // 2] ^= 1
    (folder / "damaged.mcap").write_bytes(source)
    good = write(folder / "good.json", output_unit="mV")
    wrong = write(folder / "wrong.json", sensitivity=[[1, 2], [3, 4]])
    return {
        "missing": ([folder / "no.json"], "no.json: No such file or directory"),
        "missing recording": ([folder / "no.mcap"], "no.mcap: No such file or directory"),
        "no JSON": ([folder / "broken.json"], "broken.json: the file is not a JSON object with a calibration: "),
        "list": ([folder / "list.json"], "list.json: the file is not a JSON object with a calibration: "),
        "other object": ([folder / "other.json"], "other.json: the file is not a calibration result"),
        "wrong field": ([wrong], "wrong.json: field sensitivity: must be 3 x 3 numbers"),
        "no store": ([folder / "empty"], "state.sqlite: there is no such file"),
        "empty recording": ([folder / "empty.mcap"], "empty.mcap: "),
        "damaged recording": ([folder / "damaged.mcap"], "damaged.mcap: the recording is damaged at "),
        "mixture": ([good, recorded], "the inputs are of several kinds"),
        "sensor": ([recorded, "--sensor", "other"], "there is no sensor 'other'; the sensors are: mems"),
        "unit": ([good, "--unit", "count"], "--unit count: the indications are in mV; leave --unit out"),
    }


CASES = (
    "missing", "missing recording", "no JSON", "list", "other object", "wrong field", "no store", "empty recording",
    "damaged recording", "mixture", "sensor", "unit",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_one_line_and_status_2(
    recorded: tuple[Path, Truth], tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    arguments, words = bad_inputs(recorded[0], tmp_path)[case]
    status, said = run(capsys, *arguments, "-o", tmp_path / "out")
    assert status == 2
    assert words in said
    assert said.startswith("fieldcal report: ")
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_output_that_cannot_be_written_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    status, said = run(capsys, write(tmp_path / "r.json"), "-o", tmp_path / "file" / "out")
    assert status == 2
    assert said == f"fieldcal report: {tmp_path / 'file' / 'out' / 'figures'}: Not a directory\n"


def test_without_matplotlib_the_extra_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    status, said = run(capsys, write(tmp_path / "r.json"), "-o", tmp_path / "out")
    assert status == 1
    assert said == "fieldcal report: the figures need matplotlib; install it with: fieldcal extras --install report\n"


def test_what_stands_in_the_data_cannot_break_the_page(tmp_path: Path) -> None:
    evil = '</td></svg><script>alert("x")</script>'
    window = {"start_s": 0, "stop_s": 1, "used": False, "reason": evil, "points": 1, "position": evil}
    hostile = parse(fields(method=evil, output_unit=evil, identity=evil, nuisances={evil: {"value": 1.0, "unit": evil}},
                           statistics={evil: evil}, windows=[window], reasons=[evil]), evil)  # fmt: skip
    material = Material(evil, [hostile], facts={evil: evil}, notices=[evil])
    path = tmp_path / "page.html"
    path.write_text(page(material, [], []), encoding="utf-8")
    assert "<script" not in Page(path).source


def test_a_window_that_the_result_does_not_cover_has_no_residuals() -> None:
    """Method 2 knows no transverse sensitivities, and all axes move."""
    diagonal = [[10.1, None, None], [None, 9.8, None], [None, None, 10.3]]
    known, partly = parse(fields(), "a"), parse(fields(sensitivity=diagonal, offset=None), "b")
    traces = {"30 deg": moving(0.0)}
    assert len(left_over(Material("", [known], traces=traces))) == 1
    assert left_over(Material("", [partly], traces=traces)) == []
