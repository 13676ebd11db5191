"""README, CONTRIBUTING and docs: the files and links that they name exist, and what is made from code is not stale."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from docs.images import import_graph

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAMED = re.compile(r"`((?:agent|calib|hw|tests|docs|examples|benchmarks|deploy)/[\w./-]*)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
CITED = re.compile(r"(?<![\w/.-])(?:docs/)?[\w-]+\.md\b")
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """As GitHub makes them of headings."""
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in HEADING.findall(text)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_files_exist(page: Path) -> None:
    named = NAMED.findall(page.read_text("utf-8"))
    assert [name for name in named if not (ROOT / name).exists()] == []


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    for link in LINK.findall(page.read_text("utf-8")):
        path, _, anchor = link.partition("#")
        if "://" in path:
            continue
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert broken == []


@pytest.mark.thorough
def test_comments_cite_pages_that_exist() -> None:
    pages = {page.name for page in PAGES} | {str(page.relative_to(ROOT)) for page in PAGES}
    missing = []
    for room in ("agent", "calib", "hw", "tests", "benchmarks", "examples", "docs"):
        for path in sorted((ROOT / room).rglob("*.py")):
            cited = CITED.findall(path.read_text("utf-8"))
            missing += [f"{path.relative_to(ROOT)}: {name}" for name in cited if name not in pages]
    assert missing == []


def test_import_graph_is_that_of_the_code() -> None:
    imports = import_graph.imports_of_rooms()
    remedy = "run `.venv/bin/python -m docs.images.import_graph` and commit what it writes"
    assert len(imports) > 15
    assert import_graph.DRAWING.read_text("utf-8") == import_graph.drawing(imports), remedy
    assert import_graph.table(imports) in import_graph.PAGE.read_text("utf-8"), remedy


def test_the_page_names_every_room() -> None:
    text = import_graph.PAGE.read_text("utf-8")
    for room in import_graph.imports_of_rooms():
        path = room.replace(".", "/")
        assert f"`{path}/`" in text or f"`{path}.py`" in text, room
