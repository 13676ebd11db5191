"""Public classes of one name in two files: docs/vocabulary.md has them, each with its reason."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
MOST = 10


def test_each_name_of_two_classes_has_its_reason() -> None:
    files = [path for room in ("agent", "calib", "hw") for path in (ROOT / room).rglob("*.py")]
    texts = [path.read_text("utf-8") for path in files if not path.name.endswith("_pb2.py")]
    names = [name for text in texts for name in re.findall(r"^class (\w+)", text, re.MULTILINE)]
    twice = {name for name, count in Counter(names).items() if count > 1 and not name.startswith("_")}
    text = (ROOT / "docs" / "vocabulary.md").read_text("utf-8")
    section = text.partition("## Names of classes in two files")[2].partition("\n## ")[0]
    stated = re.findall(r"^\| (\w+) \| (?!means)", section, re.MULTILINE)
    assert sorted(stated) == sorted(twice)
    assert len(twice) < MOST
