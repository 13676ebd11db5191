"""Writes figures into pages under docs/: each benchmark replaces the part between its two markers."""

from __future__ import annotations

import os
import platform
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"


def machine() -> str:
    """Description of the machine: processor, cores, Python."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), platform.machine())
    return f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}"


def write_part(name: str, text: str) -> None:
    """Put `text` between the markers of `name`, in the page that has them, and print it.

    Raises ValueError if not exactly one page has these markers.
    """
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    pages = [page for page in sorted(DOCS.glob("*.md")) if begin in page.read_text() and end in page.read_text()]
    if len(pages) != 1:
        raise ValueError(f"{len(pages)} pages of {DOCS} have the markers {begin} and {end}")
    head, rest = pages[0].read_text().split(begin, 1)
    tail = rest.split(end, 1)[1]
    pages[0].write_text(f"{head}{begin}\n{text.strip()}\n{end}{tail}")
    print(text)
