"""Writes TOML in which each value has a comment: what it is, unit, default and source."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

WIDTH = 100  # characters of a comment's line


@dataclass(frozen=True, slots=True)
class TomlSetting:
    """One value of a configuration. `value` None: the line is a comment, which shows how the setting is written.

    `source`: where the value comes from, such as `default` or `found on the bus`.
    """

    name: str
    value: Any
    says: str
    source: str
    default: Any = None
    unit: str = ""


@dataclass(frozen=True, slots=True)
class TomlTable:
    """A table of TOML with its header, such as `[[channels]]`."""

    header: str
    settings: Sequence[TomlSetting]


def written(title: str, tables: Iterable[TomlTable]) -> str:
    """The text of a file. `title` stands at its top."""
    lines = [*_comment(title)]
    for table in tables:
        lines += ["", table.header]
        for setting in table.settings:
            lines += _lines(setting)
    return "\n".join(lines) + "\n"


def toml_value(value: Any) -> str:
    """A value as TOML writes it: bool, int, float, str, list or tuple, mapping."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(name)} = {toml_value(held)}" for name, held in value.items()) + " }"
    assert isinstance(value, list | tuple), value
    entries = [toml_value(held) for held in value]
    if any(isinstance(held, Mapping) for held in value):
        return "[\n" + "".join(f"  {entry},\n" for entry in entries) + "]"
    return "[" + ", ".join(entries) + "]"


def _lines(setting: TomlSetting) -> Iterator[str]:
    default = "none" if setting.default is None else toml_value(setting.default)
    unit = f" Unit: {setting.unit}." if setting.unit else ""
    says = setting.says.strip().rstrip(".")
    yield from _comment(f"{says[:1].upper()}{says[1:]}.{unit} Default: {default}. Source: {setting.source}.")
    value = "" if setting.value is None else toml_value(setting.value)
    yield f"{_key(setting.name)} = {value}" if value else f"# {_key(setting.name)} ="


def _key(name: str) -> str:
    bare = name.replace("-", "").replace("_", "")
    return name if bare.isascii() and bare.isalnum() else toml_value(name)


def _comment(text: str) -> Iterator[str]:
    for line in textwrap.wrap(text, WIDTH, break_long_words=False, break_on_hyphens=False):
        yield f"# {line}"
