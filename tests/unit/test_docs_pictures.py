"""No picture of the documentation is stale: each is drawn by a command, from sources that have not changed since."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from docs.images import inputs

ROOT = Path(__file__).parents[2]
OF_TESTS = {"import_graph.svg", "s_q_u.svg"}  # drawn again by test_docs.py and test_docs_site.py
USED = re.compile(r"images/([\w-]+\.(?:png|svg))")


def test_the_sources_of_the_pictures_have_not_changed_since_they_were_made() -> None:
    made, now = json.loads(inputs.DIGESTS.read_text("utf-8")), inputs.digests()
    stale = {
        beginning: sorted(name for name in made.get(beginning, {}).keys() | found.keys()
                          if made.get(beginning, {}).get(name) != found.get(name))
        for beginning, found in now.items()
    }  # fmt: skip
    assert {beginning: names for beginning, names in stale.items() if names} == {}, (
        "the sources of these pictures have changed: run `make pictures` and look at the pictures, or, where the "
        "change is not seen in them, `.venv/bin/python -m docs.images.inputs`; commit what it writes"
    )


def test_every_picture_is_used_and_made_by_a_command() -> None:
    there = {path.name for path in inputs.IMAGES.iterdir() if path.suffix in (".png", ".svg")}
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    assert {name for page in pages for name in USED.findall(page.read_text("utf-8"))} == there
    made = {name for name in there if name.partition(".")[0].partition("-")[0] in inputs.SOURCES}
    assert there - made == OF_TESTS


@pytest.mark.parametrize(
    ("kind", "before", "after", "same"),
    [
        (".js", "// one\nconst a = 1;\n", "const a = 1;\n\n// other\n", True),
        (".js", 'const a = "// x";', 'const a = "// y";', False),
        (".css", ".a { left: 0; } /* one */\n", ".a { left: 0; }\n/* other */\n", True),
        (".css", ".a { left: 0; }", ".a { left: 1px; }", False),
        (".py", "    # one\na = 1\n", "a = 1\n", True),
        (".py", "if a:\n    b = 1\n    c = 1\n", "if a:\n    b = 1\nc = 1\n", False),
    ],
)
def test_what_is_a_change_of_a_source(kind: str, before: str, after: str, *, same: bool) -> None:
    assert (inputs.digest(before, kind) == inputs.digest(after, kind)) is same


def test_modules_that_the_page_imports_are_sources() -> None:
    names = {path.name for path in inputs.sources("fleet")}
    assert {"fleet.js", "words.js", "parts.js", "format.js", "common.js", "plots.js"} <= names
    assert not {"bench.js", "plan.js", "live.js"} & names
