"""Functions with more than six parameters: docs/architecture.md has them, each with its reason."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RULE = ("--select=PLR0913", "--config=lint.pylint.max-args=6", "--ignore-noqa", "--output-format=json")


@pytest.mark.slow
def test_each_function_with_more_than_six_parameters_has_its_reason() -> None:
    command = [sys.executable, "-m", "ruff", "check", "--no-cache", *RULE, "agent", "calib", "hw", "deploy"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    there: set[tuple[str, str]] = set()
    for fault in json.loads(run.stdout):
        path = Path(fault["filename"])
        name, of_click = _function(path, fault["location"]["row"])
        if not of_click:
            there.add((path.relative_to(ROOT).as_posix(), name))
    assert ("hw/virtual/uldaq_twin.py", "a_in_scan") in there
    assert there == _stated()


def _function(path: Path, line: int) -> tuple[str, bool]:
    """The name of the function there, and whether it is a command, whose parameters are its options."""
    tree = ast.parse(path.read_text("utf-8"))
    (function,) = (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.lineno == line)
    decorators = [ast.unparse(decorator) for decorator in function.decorator_list]
    return function.name, any(re.match(r"\w+\.command\(", decorator) for decorator in decorators)


def _stated() -> set[tuple[str, str]]:
    """(file, function) of each line of the table. A line with several files has as many functions."""
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    table = text.partition("| more than six parameters |")[2].partition("\n\n")[0]
    stated: set[tuple[str, str]] = set()
    for row in table.splitlines()[2:]:
        functions, files = (re.findall("`([^`]+)`", cell) for cell in row.split("|")[1:3])
        names = [name.rpartition(".")[2] for name in functions]
        if len(files) == 1:
            files *= len(names)
        stated |= set(zip(files, names, strict=True))
    return stated
