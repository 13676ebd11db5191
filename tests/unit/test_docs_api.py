"""docs/api.md: its examples run and print what the page says, and it documents every parameter of every name."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import io
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import calib

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "api.md").read_text("utf-8")
EXAMPLE = re.compile(r"^```python\n(.*?)^```\n(?:```text\n(.*?)^```\n)?", re.MULTILINE | re.DOTALL)
OBJECTS = [name for name in calib.__all__ if name != "PARAMETERS"]


@pytest.mark.thorough
def test_examples_print_what_the_page_says() -> None:
    examples = EXAMPLE.findall(PAGE)
    assert len(examples) > 6
    assert sum(bool(printed) for _, printed in examples) > 5
    notebook: dict[str, Any] = {}
    for code, expected in examples:
        output = io.StringIO()
        with contextlib.redirect_stdout(output):
            exec(compile(code, "docs/api.md", "exec"), notebook)
        assert output.getvalue() == expected, code


@pytest.mark.parametrize("name", OBJECTS)
def test_every_parameter_is_documented(name: str) -> None:
    section = re.search(rf"^### `{name}`\n(.*?)(?=^##|\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert section is not None, f"docs/api.md has no section for {name}"
    documented = re.findall(r"^\| `(\w+)`", section[1], re.MULTILINE)
    thing = getattr(calib, name)
    if name == "Priors":  # its numbers are those of the table of unknowns, which has an order of its own
        assert sorted(documented) == sorted(
            [*calib.Priors.table, "parameters", "covariance", "response_model", "corner_unknown"]
        )
    elif dataclasses.is_dataclass(thing):
        assert documented == [field.name for field in dataclasses.fields(thing)]
    else:
        assert documented == list(inspect.signature(thing).parameters)


def test_the_reference_shows_defaults_as_they_are() -> None:
    """A name loses the modules before it there, a number nothing."""
    shown = (ROOT / "docs" / "reference" / "python.md").read_text("utf-8")
    defaults = {name: p.default for name, p in inspect.signature(calib.calibrate).parameters.items()}
    numbers = {name: value for name, value in defaults.items() if isinstance(value, float)}
    assert len(numbers) > 10
    assert [f"{name}={value!r}" for name, value in numbers.items() if f"{name}={value!r}," not in shown] == []


def test_every_name_is_there_and_the_page_has_no_others() -> None:
    assert all(getattr(calib, name) is not None for name in calib.__all__)
    assert set(calib.__all__) <= set(dir(calib))
    assert sorted(re.findall(r"^### `(\w+)`", PAGE, re.MULTILINE)) == sorted(OBJECTS)
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = calib.no_such_name


def test_importing_calib_loads_no_numpy() -> None:
    code = "import sys, calib; print('numpy' in sys.modules, 'scipy' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False", "False"]


@pytest.mark.parametrize("package", ["agent", "calib", "hw"])
def test_types_are_offered(package: str) -> None:
    """PEP 561: with py.typed in the package a user's type checker reads its annotations."""
    assert (ROOT / package / "py.typed").is_file()
