"""The name of the engine: a number that people raise, and a digest of the sources.

The engine is every module that turns recorded events into recorded results: the pipeline, the decoding and encoding of
messages, and all that these two import. Comments, docstrings and empty lines are not part of the digest, nor is the
version of the program: none of them changes a result.
"""

from __future__ import annotations

import ast
import hashlib
import io
import json
import tokenize
from functools import cache
from pathlib import Path
from typing import Any

# Raise this number when results change: when the same events give another S, Q, U or decision than before. The test of
# the golden recordings fails otherwise.
NUMBER = 28
ROOT = Path(__file__).resolve().parents[2]  # of the packages agent, calib and hw
# The modules that an engine's process calls, and one that another module imports by a name that it computes.
BEGIN = ("agent.core.pipeline", "agent.recording.messages", "agent.config.recorded")
BUILT = "built.json"  # beside this file, in an installation that is not editable, and where tests have run
DIGITS = 16  # of the SHA-256 that are the id
_PACKAGES = ("agent", "calib", "hw")


def name() -> str:
    """`<number>-<id>`, as recordings and results carry it."""
    return f"{NUMBER}-{engine_id()}"


@cache
def engine_id() -> str:
    """The first DIGITS hexadecimal digits of the SHA-256 over names and sources of all modules of the engine."""
    return built()[0] or computed()["id"]


def computed() -> dict[str, Any]:
    """The id, and the SHA-256 of each source with its comments, as the file BUILT holds them."""
    sources = {member: path.read_bytes() for member, path in closure()}
    return {"id": digest(sources), "sources": {member: _sha256(source) for member, source in sources.items()}}


@cache
def source_files() -> list[tuple[str, Path]]:
    """`closure` of the engine of this program."""
    return built()[1] or closure()


@cache
def built() -> tuple[str, list[tuple[str, Path]]]:
    """Id and sources as the file BUILT has them; empty where there is no such file, or a source has changed since."""
    path = Path(__file__).with_name(BUILT)
    if not path.is_file():
        return "", []
    held = json.loads(path.read_text())
    files = [(member, ROOT / member) for member in held["sources"]]
    same = all(file.is_file() and _sha256(file.read_bytes()) == held["sources"][member] for member, file in files)
    return (held["id"], files) if same else ("", [])


def digest(sources: dict[str, bytes]) -> str:
    """The id of an engine with these sources, by their names in the archive. Raises SyntaxError, UnicodeDecodeError."""
    total = hashlib.sha256()
    for member, source in sorted(sources.items()):
        total.update(f"{member}\n{_sha256(bare(source).encode())}\n".encode())
    return total.hexdigest()[:DIGITS]


def closure(root: Path = ROOT, begin: tuple[str, ...] = BEGIN) -> list[tuple[str, Path]]:
    """(name in an archive, path) of each module that an engine imports anywhere, and of their packages, by name.

    `root`, `begin`: as ROOT and BEGIN, of the engine of another revision.
    """
    found: dict[str, Path] = {}
    waiting = list(begin)
    while waiting:
        module = waiting.pop()
        path = _path(root, module)
        if path is None or (member := path.relative_to(root).as_posix()) in found:
            continue
        found[member] = path
        waiting += module.rpartition(".")[:1]
        waiting += _imported(
            ast.parse(path.read_bytes()), module if path.stem == "__init__" else module.rpartition(".")[0]
        )
    return sorted(found.items())


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def bare(source: bytes) -> str:
    """A module's source without comments, docstrings, empty lines and its assignment to `__version__`."""
    text = source.decode()
    lines = [line.rstrip("\r\n") for line in io.StringIO(text)]
    for first, last in _docstrings(ast.parse(text)):
        lines[first:last] = [""] * (last - first)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    kept = (line.rstrip() for line in lines)
    return "\n".join(line for line in kept if line and not line.startswith("__version__ = "))


def _docstrings(tree: ast.Module) -> list[tuple[int, int]]:
    """(index of the first line, index behind the last) of each docstring."""
    places = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and node.body:
            first = node.body[0]
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                places.append((first.lineno - 1, first.end_lineno or first.lineno))
    return places


def _imported(tree: ast.Module, package: str) -> list[str]:
    """Names that the imports of a module may mean as modules, those for type checkers left out."""
    names: list[str] = []
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            waiting += node.orelse
            continue
        waiting += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: 1 - node.level or None] if node.level else []
            origin = ".".join([*parts, *([node.module] if node.module else [])])
            names += [origin, *(f"{origin}.{alias.name}" for alias in node.names)]
    return names


def _path(root: Path, module: str) -> Path | None:
    """The file of a module of this program; None for any other name."""
    parts = module.split(".")
    if parts[0] not in _PACKAGES:
        return None
    place = root.joinpath(*parts)
    return next((path for path in (place / "__init__.py", place.with_suffix(".py")) if path.is_file()), None)
