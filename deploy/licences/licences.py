"""The licences of all packages in a directory, in one file: what the Debian package and the container ship.

    .venv/bin/python deploy/licences/licences.py SITE-PACKAGES > copyright

Each package with the licence that its metadata state, the texts that it brings, and what is compiled into it (where the
package has a CycloneDX file that says so). A text that several packages bring stands once. Exit status 1 where a
package has no text, neither of its own nor beside this file; the error names it.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from importlib.metadata import Distribution, distributions
from pathlib import Path

BESIDE = Path(__file__).parent  # texts of packages that bring none: <name>.txt
OURS = "agent/monitor/page/uPlot.LICENSE"  # the one library in fieldcal's own wheel that others wrote
_TEXT = re.compile(r"(^|[/_.])(LICEN[CS]E|COPYING|NOTICE|AUTHORS)[^/]*$", re.IGNORECASE)


def stated(package: Distribution) -> str:
    """The licence by the metadata: an expression, or the older fields."""
    kinds = [
        line.rsplit(" :: ", 1)[-1] for line in package.metadata.get_all("Classifier") or [] if "License ::" in line
    ]
    return package.metadata.get("License-Expression") or ", ".join(kinds) or package.metadata.get("License") or ""


def texts(package: Distribution) -> Iterator[tuple[str, str]]:
    """Name and content of each file with a licence, a notice or authors; without one, the text beside this file."""
    files = sorted(str(file) for file in package.files or [])
    found = [file for file in files if (_TEXT.search(file) and ".dist-info/" in file) or file == OURS]
    for file in found:
        content = package.read_text("../" + file)
        if content is not None:
            yield file, content
    beside = BESIDE / f"{package.name.lower()}.txt"
    if not found and beside.exists():
        yield beside.name, beside.read_text()


def compiled_in(package: Distribution) -> Iterator[str]:
    """Name, version and licence of each library that is compiled into the package."""
    for file in sorted(str(file) for file in package.files or []):
        if ".dist-info/sboms/" in file:
            for part in json.loads(package.read_text("../" + file) or "{}").get("components", []):
                licences = [
                    entry.get("expression") or entry["license"].get("id", "") for entry in part.get("licenses", [])
                ]
                yield f"{part['name']} {part.get('version', '')}: {', '.join(licences) or 'not stated'}"


def licences(site: Path) -> str:
    """The whole file.

    Raises:
        ValueError: a package has no text; names all of them.
    """
    packages = sorted(distributions(path=[str(site)]), key=lambda package: package.name.lower())
    shown: dict[str, str] = {}  # text: where it stands
    parts = []
    without = []
    for package in packages:
        title = f"{package.name} {package.version}"
        lines = ["=" * 78, f"{title}: {stated(package)}", "=" * 78, ""]
        found = list(texts(package))
        if not found:
            without.append(title)
        for name, text in found:
            place = shown.setdefault(text.strip(), f"{title}, {name}")
            lines += [f"--- {name}", "", text.strip() if place == f"{title}, {name}" else f"As of {place}", ""]
        inside = sorted(set(compiled_in(package)))
        if inside:
            lines += ["--- compiled into it", "", *inside, ""]
        parts.append("\n".join(lines))
    if without:
        raise ValueError(f"no text of a licence: {', '.join(without)}; put it into {BESIDE}/<name>.txt")
    return "\n".join(parts)


if __name__ == "__main__":
    try:
        sys.stdout.write(licences(Path(sys.argv[1])))
    except ValueError as error:
        sys.exit(f"licences.py: {error}")
