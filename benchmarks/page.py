"""Writes figures into pages under docs/: each benchmark replaces the part between its two markers."""

from __future__ import annotations

import os
import platform
from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "docs" / "performance.md"


def machine() -> str:
    """Description of the machine: processor, cores, Python."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), platform.machine())
    return f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}"


def write_part(name: str, text: str, at: Path = PAGE) -> None:
    """Put `text` between the markers of `name`, and print it.

    Raises ValueError if the page does not have these markers.
    """
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    page = at.read_text()
    if begin not in page or end not in page:
        raise ValueError(f"{at} does not have the markers {begin} and {end}")
    head, rest = page.split(begin, 1)
    tail = rest.split(end, 1)[1]
    at.write_text(f"{head}{begin}\n{text.strip()}\n{end}{tail}")
    print(text)
