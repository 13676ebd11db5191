"""The sources that draw the pictures of running programs, and which of them have changed since the pictures were made.

`make pictures` makes the pictures and ends with `.venv/bin/python -m docs.images.inputs`, which writes a digest of each
source into inputs.json. `tests/unit/test_docs_pictures.py` fails where a source has changed since. Who has changed one
and sees by its picture that nothing else is drawn runs the second command alone. Comments and empty lines do not count.
What the engine computes is no source: another digit makes no picture stale.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path

IMAGES = Path(__file__).parent
ROOT = IMAGES.parents[1]
DIGESTS = IMAGES / "inputs.json"
PAGE = "agent/monitor/page"
# Of pictures by the beginning of their names: sources, and modules of the page that draw them together with all that
# these import.
SOURCES: dict[str, tuple[str, ...]] = {
    "run": (
        "docs/images/run_svg.py",
        *(f"agent/terminal/{name}.py" for name in ("screen", "wording", "watch", "state", "text")),
    ),
    "fleet": (
        "tests/scenarios/fleet_page.py", "agent/fleet/simulated_sensor.py", "agent/fleet/simulated_channel.py",
        "agent/monitor/fleet.py", "agent/monitor/trends.py", "agent/monitor/onset.py", f"{PAGE}/index.html",
        f"{PAGE}/page.css", f"{PAGE}/fleet.js", f"{PAGE}/sensor.js",
    ),
    "bench": ("tests/scenarios/bench_page.py", f"{PAGE}/page.css", f"{PAGE}/bench.js"),
    "report": (
        "tests/scenarios/report_pictures.py", "agent/report/page.css",
        *(f"agent/report/{name}.py" for name in ("page", "tables", "figures", "diagrams", "timelines", "style")),
    ),
}  # fmt: skip
IMPORTED = re.compile(r"""^import .* from "\./([\w-]+\.js)";$""", re.MULTILINE)
COMMENTS = {
    ".py": re.compile(r"^\s*#.*$", re.MULTILINE), ".js": re.compile(r"^\s*//.*$", re.MULTILINE),
    ".css": re.compile(r"/\*.*?\*/", re.DOTALL), ".html": re.compile(r"<!--.*?-->", re.DOTALL),
}  # fmt: skip


def digest(text: str, kind: str) -> str:
    """Of a source without comments of their own lines and empty lines. `kind`: the end of its name."""
    lines = (line.rstrip() for line in COMMENTS[kind].sub("", text).splitlines())
    return hashlib.sha256("\n".join(line for line in lines if line).encode()).hexdigest()[:16]


def sources(beginning: str) -> Iterator[Path]:
    """The sources of pictures, each once."""
    known, waiting = set(), [ROOT / name for name in SOURCES[beginning]]
    while waiting:
        path = waiting.pop(0)
        if path not in known:
            known.add(path)
            yield path
            waiting += [path.parent / name for name in IMPORTED.findall(path.read_text("utf-8"))]


def digests() -> dict[str, dict[str, str]]:
    """The digest of each source, by the beginning of the names of its pictures."""
    return {
        beginning: {str(p.relative_to(ROOT)): digest(p.read_text("utf-8"), p.suffix) for p in sources(beginning)}
        for beginning in SOURCES
    }


if __name__ == "__main__":
    DIGESTS.write_text(json.dumps(digests(), indent=1) + "\n")
