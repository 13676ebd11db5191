"""Hooks of mkdocs: pages outside docs/ belong to the site, and links to other files of the repository lead to copies.

The pages stay readable in the repository: there their links lead to the files themselves.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
OUTSIDE = ("CONTRIBUTING.md", "CHANGELOG.md")
LINK = re.compile(r"(\]\()([^)#\s]+)(#[^)\s]*)?(\))")
SOURCE = "source"  # folder of the site that holds copies of other files, as text


def on_files(files: Any, config: Any) -> Any:
    """Add the pages and the files that pages link to."""
    for name in OUTSIDE:
        files.append(File.generated(config, name, content=(ROOT / name).read_text("utf-8")))
    for page in [file for file in files if file.src_uri.endswith(".md")]:
        for _, link, _, _ in LINK.findall(page.content_string):
            path = _path(page.src_uri, link)
            if path is not None and path.is_file() and _is_source(path):
                name = _copy(path)
                if name not in files.src_uris:
                    files.append(File.generated(config, name, content=path.read_text("utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links lead to the pages and copies of the site; a link to a folder becomes its name."""

    def changed(found: re.Match[str]) -> str:
        begin, link, anchor, end = found.groups(default="")
        path = _path(page.file.src_uri, link)
        if path is None or not path.exists():
            return found[0]
        if path == ROOT / "README.md":
            target = "index.md"
        elif path.name in OUTSIDE and path.parent == ROOT:
            target = path.name
        elif path.is_dir():
            target = "index.md" if path != ROOT / "docs" / "decisions" else f"decisions/{_first(path)}"
        elif _is_source(path):
            target = _copy(path)
        else:
            target = path.relative_to(ROOT / "docs").as_posix()
        return begin + posixpath.relpath(target, posixpath.dirname(page.file.src_uri) or ".") + anchor + end

    return LINK.sub(changed, markdown)


def _path(page: str, link: str) -> Path | None:
    """The file of the repository to which a link of a page leads; None where it leads out of the repository."""
    if "://" in link or link.startswith(("mailto:", "/")):
        return None
    base = ROOT if page in OUTSIDE else (ROOT / "docs" / page).parent
    path = (base / link).resolve()
    return path if path.is_relative_to(ROOT) else None


def _is_source(path: Path) -> bool:
    """Whether it is neither a page nor a picture of docs/."""
    return not path.is_relative_to(ROOT / "docs") and path.name not in (*OUTSIDE, "README.md")


def _copy(path: Path) -> str:
    return f"{SOURCE}/{path.relative_to(ROOT).as_posix()}.txt"


def _first(folder: Path) -> str:
    return min(path.name for path in folder.glob("*.md"))
