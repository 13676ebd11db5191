"""What of the site is made from the code is not stale, and each page has its place in the navigation."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import cast

import pytest

from docs import worked_budget
from docs.images import s_q_u
from docs.reference import pages

ROOT = Path(__file__).parents[2]
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    # In a process of its own: click keeps the help option with which a command was called first.
    code = "import json; from docs.reference import pages; print(json.dumps(pages.written()))"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return cast("dict[str, str]", json.loads(run.stdout))


@pytest.mark.thorough
def test_the_reference_is_that_of_the_code(made: dict[str, str]) -> None:
    assert {path.name for path in pages.HERE.glob("*.md")} == set(made)
    stale = [name for name, text in made.items() if (pages.HERE / name).read_text("utf-8") != text]
    assert stale == [], "run `.venv/bin/python -m docs.reference.pages` and commit what it writes"


@pytest.mark.thorough
def test_the_reference_names_what_the_code_has(made: dict[str, str]) -> None:
    assert "| `late_horizon_s` | number | s | `5.0` |" in made["configuration.md"]
    assert "| `reference_frequency_hz` | number | Hz | 0 if nothing moved yet |" in made["messages.md"]
    assert "## fieldcal keys" in made["commands.md"]
    assert "## seedlink" in made["drivers.md"]
    assert "## adjust\n" in made["python.md"]


def test_the_picture_is_that_of_the_code() -> None:
    remedy = "run `.venv/bin/python -m docs.images.s_q_u` and commit what it writes"
    assert s_q_u.DRAWING.read_text("utf-8") == s_q_u.drawing(), remedy


@pytest.mark.thorough
def test_the_budget_is_of_this_version() -> None:
    """Two digits are shown, so that the last one may differ by one on another CPU."""
    shown = worked_budget.PAGE.read_text("utf-8").partition(worked_budget.BEGIN)[2].partition(worked_budget.END)[0]
    made = worked_budget.table(worked_budget.result())
    remedy = "run `.venv/bin/python -m docs.worked_budget` and commit what it writes"
    assert NUMBER.sub("#", shown.strip()) == NUMBER.sub("#", made), remedy
    for old, new in zip(NUMBER.findall(shown), NUMBER.findall(made), strict=True):
        assert float(new) == pytest.approx(float(old), rel=0.1), remedy


def test_every_page_is_in_the_navigation() -> None:
    listed = set(re.findall(r"[\w./-]+\.md\b", (ROOT / "mkdocs.yml").read_text("utf-8")))
    there = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}
    assert listed - {"CONTRIBUTING.md", "CHANGELOG.md"} == there


def test_the_first_page_leads_to_every_page() -> None:
    first = (ROOT / "docs" / "index.md").read_text("utf-8")
    led = set(re.findall(r"\]\(([\w./-]+\.md)[#)]", first))
    there = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}
    assert {page for page in there - led if not page.startswith("decisions/")} == {"index.md"}


def guide() -> list[Path]:
    """The pages of the guide, as the navigation lists them."""
    part = (ROOT / "mkdocs.yml").read_text("utf-8").partition("  - Guide:")[2].partition("\n  - Reference:")[0]
    return [ROOT / "docs" / name for name in re.findall(r": ([\w-]+\.md)$", part, re.MULTILINE)]


def test_the_navigation_has_four_parts() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:\n")[2]
    assert re.findall(r"^  - (\w+):", navigation, re.MULTILINE) == ["Home", "Guide", "Reference", "Evidence", "Inside"]


def test_the_guide_is_short() -> None:
    lines = {page.name: len(page.read_text("utf-8").splitlines()) for page in guide()}
    assert len(lines) >= 10
    assert sum(lines.values()) <= 1500, f"move what is no guide to another part: {lines}"


@pytest.mark.parametrize(
    "page",
    [ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs/reference").glob("*.md"))],
    ids=lambda page: page.name,
)
def test_a_page_begins_with_what_its_reader_can_do_after_it(page: Path) -> None:
    title, empty, first, *_ = page.read_text("utf-8").splitlines()
    assert title.startswith("# ")
    assert empty == ""
    assert first.startswith("After this page you can ")


def test_the_readme_fits_on_a_screen() -> None:
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 60


@pytest.mark.thorough
@pytest.mark.skipif(not (ROOT / ".venv-docs/bin/mkdocs").exists(), reason="`make site` was never run here")
def test_a_warning_is_an_error(tmp_path: Path) -> None:
    for name in ("docs", "CONTRIBUTING.md", "CHANGELOG.md", "mkdocs.yml", "README.md"):
        source = ROOT / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, tmp_path / name)
    (tmp_path / "docs" / "start.md").write_text("# Start\n\n[nowhere](limits.md#no-such-heading)\n")
    done = subprocess.run(
        [ROOT / ".venv-docs/bin/mkdocs", "build", "--strict"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode != 0
    assert "no-such-heading" in done.stdout + done.stderr
