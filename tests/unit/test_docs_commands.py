"""Every command, option, make target and setting that README and docs name exists.

Commands in fences of the kind `sh` are run by tests/scenarios/test_documented_commands.py, and the examples of some
pages by tests of their own. The others (on devices, networks and files that a test does not have) are compared here
with the program, without running them.
"""

from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
from pydantic import BaseModel

from agent.cli.main import fieldcal
from agent.config.whole import Config
from docs.reference.pages import _models
from hw.sensor import load_driver

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
IN_LINE = re.compile(r"`((?:fieldcal|make) [^`\n]+)`")
SIGNED_TEXT = re.compile(r"fieldcal \w+, version \d")  # first lines of signed texts, docs/audit.md


def lines(page: Path) -> list[str]:
    """Command lines of a page: in fences, indented, and within sentences."""
    text = page.read_text("utf-8").replace("\\\n", " ")
    found = [line for kind, block in FENCE.findall(text) if kind in ("sh", "text", "") for line in block.splitlines()]
    rest = FENCE.sub("", text)
    found += [line for line in rest.splitlines() if line.startswith("    ")] + IN_LINE.findall(rest)
    commands = [re.sub(r"^\s*(sudo )?(\.venv/bin/)?", "", line).split("  #")[0].split(" && ")[0] for line in found]
    return [line for line in commands if re.match(r"(fieldcal|make) [a-z]", line) and not SIGNED_TEXT.match(line)]


def unknown(words: list[str]) -> Iterator[str]:
    """Words of a `fieldcal` command line that the program does not have."""
    command: click.Command = fieldcal
    context = click.Context(command)
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        name = words.pop(0)
        if name not in command.list_commands(context):
            yield name
            return
        found = command.get_command(context, name)
        assert found is not None
        command, context = found, click.Context(found, parent=context)
    known = {
        option for parameter in command.get_params(context) for option in (*parameter.opts, *parameter.secondary_opts)
    }
    yield from (word for word in words if re.match(r"--?[a-z]", word) and word.partition("=")[0] not in known)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_options_exist(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    wrong = []
    for line in lines(page):
        try:
            program, *words = shlex.split(line)
        except ValueError:
            continue  # an apostrophe in a sentence
        words = [word.strip("[](),;.") for word in words if word not in ("...", "COMMAND", "VERB")]
        if program == "make":
            wrong += [line] if words[0] not in targets else []
        else:
            wrong += [f"{line}: {word}" for word in unknown(words)]
    assert wrong == []


def strangers(model: type[BaseModel], table: dict[str, Any], path: str) -> Iterator[str]:
    """Keys of a table that its section does not have."""
    for key, value in table.items():
        if key not in model.model_fields:
            yield f"{path}{key}"
            continue
        inner = _models(model.model_fields[key].annotation)
        for entry in value if isinstance(value, list) else [value]:
            if isinstance(entry, dict) and inner:
                among = [list(strangers(one, entry, f"{path}{key}.")) for one in inner]
                yield from min(among, key=len)
            if key == "devices" and isinstance(entry, dict) and "driver" in entry:
                options = load_driver(entry["driver"]).options_model.model_fields
                yield from (f"{path}{key}.options.{name}" for name in entry.get("options", {}) if name not in options)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_settings_exist(page: Path) -> None:
    wrong = []
    for kind, block in FENCE.findall(page.read_text("utf-8")):
        # A fragment of a channel begins with one of its tables; TOML then needs the channel before it.
        text = "[[channels]]\n" + block if kind == "toml" and re.match(r"\[channels\.", block) else block
        table = tomllib.loads(text) if kind == "toml" else {}
        # Other files in TOML: package, certificate, and the links of a site (docs/site.md).
        if set(table) & set(Config.model_fields) and "links" not in table:
            wrong += list(strangers(Config, table, ""))
    assert wrong == []


def test_what_does_not_exist_is_found() -> None:
    assert list(unknown(["calibrate", "--sensr", "x"])) == ["--sensr"]
    assert list(unknown(["recalibrate"])) == ["recalibrate"]
    assert list(unknown(["keys", "ad"])) == ["ad"]
    assert list(strangers(Config, {"zenoh": {"conect": []}, "gatewey": {}}, "")) == ["zenoh.conect", "gatewey"]
    device = {"devices": [{"name": "a", "driver": "mqtt", "options": {"tpic": "x"}}]}
    assert list(strangers(Config, device, "")) == ["devices.options.tpic"]
