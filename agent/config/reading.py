"""Reads a TOML file and checks all of it before anything starts. All faults are reported together."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path as FilePath
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from agent.config.faults import faults_of, shown, told
from agent.config.files import read_file
from agent.config.lines import lines_of
from agent.config.names import Told
from agent.config.size import size_faults
from agent.config.whole import Config

LARGEST_FILE = 4 << 20  # bytes; a day with one pose each second needs as many
# The sections of a configuration have four levels. tomllib needs quadratic time for a long dotted key: hours for 4 MB.
DEEPEST_KEY = 16
SHOWN_FAULTS = 100
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+"""
_LINE = re.compile(r"\(at line (\d+), column \d+\)")  # as in the messages of tomllib
_LONG_KEY = re.compile(rf"(?<![\w.-]){_PART}(?:\.[ \t]*+{_PART}){{{DEEPEST_KEY}}}")


Model = TypeVar("Model", bound=BaseModel)


class ConfigError(Exception):
    """The faults of a configuration, one line each, with file, line, setting, value and what to do."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults


def load_config(path: FilePath) -> Config:
    """Read and check a TOML file, and the files it names. Raises ConfigError with all faults."""
    raw, text = read_toml(path)
    return parse_config(raw, str(path), text)


def load_model(path: FilePath, kind: type[Model]) -> Model:
    """Read and check a TOML file that holds one model. Raises ConfigError with all faults."""
    raw, text = read_toml(path)
    return check_model(raw, kind, str(path), text)


def check_model(raw: dict[str, Any], kind: type[Model], origin: str, text: str = "") -> Model:
    """Check the values of one model, as `parse_config` does those of a configuration. Raises ConfigError."""
    try:
        return kind.model_validate(raw)
    except ValidationError as error:
        raise _refused(list(told(error, raw)), origin, text) from None


def read_toml(path: FilePath) -> tuple[dict[str, Any], str]:
    """The values of a TOML file, and its text. Raises ConfigError."""
    try:
        text = read_file(path, LARGEST_FILE).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"]) from None
    if (deep := _LONG_KEY.search(text)) is not None:
        line = text.count("\n", 0, deep.start()) + 1
        raise ConfigError(
            [f"{path}: line {line}: a key has more than {DEEPEST_KEY} parts, shorten it: {deep[0][:40]}..."]
        )
    try:
        raw = tomllib.loads(text)
    except ValueError as error:  # a TOMLDecodeError, or the error for an integer of thousands of digits
        found = _LINE.search(str(error))
        place = f"line {found[1]}: " if found else ""
        raise ConfigError([f"{path}: {place}not TOML: {error}"]) from None
    except RecursionError:
        raise ConfigError([f"{path}: its tables or lists are nested too deep to be read"]) from None
    if too_large := size_faults(raw):
        raise _refused(too_large, str(path), text)
    return raw, text


def parse_config(raw: dict[str, Any], origin: str, text: str = "") -> Config:
    """Check the values of a TOML file. `origin` names the file in the faults. With its `text`, faults name lines too.

    Raises ConfigError with all faults.
    """
    config, faults = faults_of(raw)
    if faults or config is None:
        raise _refused(faults, origin, text)
    return config


def _refused(faults: list[Told], origin: str, text: str) -> ConfigError:
    some = faults[:SHOWN_FAULTS]
    lines = lines_of(text, {path for path, _ in some}) if text else {}
    words = []
    for path, what in some:
        place = f"line {lines[path]}: " if text else ""
        words.append(f"{origin}: {place}{f'{shown(path)}: ' if path else ''}{what}")
    more = len(faults) - SHOWN_FAULTS
    return ConfigError(words + ([f"{origin}: and {more} more faults, not shown"] if more > 0 else []))
