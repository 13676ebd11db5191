"""Reads a TOML file and checks all of it before anything starts. All faults are reported together."""

from __future__ import annotations

import codecs
import re
import tomllib
from pathlib import Path as FilePath
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from agent.config.faults import SHOWN_FAULTS, faults_of, model_faults, path_text
from agent.config.files import read_file
from agent.config.lines import lines_of
from agent.config.names import Told
from agent.config.size import size_faults
from agent.config.syntax import syntax_fault
from agent.config.whole import Config

LARGEST_FILE = 4 << 20  # bytes; a day with one pose each second needs as many
# The sections of a configuration have four levels. tomllib needs quadratic time for a long dotted key: hours for 4 MB.
DEEPEST_KEY = 16
_MARKS = {
    codecs.BOM_UTF8: "a byte order mark (U+FEFF)",
    codecs.BOM_UTF16_LE: "the byte order mark of UTF-16",
    codecs.BOM_UTF16_BE: "the byte order mark of UTF-16",
    b"\x89MCAP": "the mark of an MCAP recording, so it is no configuration (`fieldcal replay` reads recordings)",
}
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+"""
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
        raise config_error(list(model_faults(error, raw, kind)), origin, text) from None


def read_toml(path: FilePath) -> tuple[dict[str, Any], str]:
    """The values of a TOML file, and its text. Raises ConfigError."""
    try:
        text = _text(read_file(path, LARGEST_FILE))
    except OSError as error:
        raise ConfigError([f"{path}: cannot be read: {error.strerror or error}"]) from None
    except ValueError as error:
        raise ConfigError([f"{path}: {error}"]) from None
    if (deep := _LONG_KEY.search(text)) is not None:
        line = text.count("\n", 0, deep.start()) + 1
        raise ConfigError(
            [f"{path}: line {line}: a key has more than {DEEPEST_KEY} parts, shorten it: {deep[0][:40]}..."]
        )
    try:
        raw = tomllib.loads(text)
    except ValueError as error:  # a TOMLDecodeError, or the error for an integer of thousands of digits
        line, what = syntax_fault(text, error)
        raise ConfigError([f"{path}: line {line}: {what}"]) from None
    except RecursionError:
        raise ConfigError([f"{path}: its tables or lists are nested too deep to be read"]) from None
    if too_large := size_faults(raw):
        raise config_error(too_large, str(path), text)
    return raw, text


def _text(data: bytes) -> str:
    """The text of a file in UTF-8. Raises ValueError, which says how to save it."""
    for mark, name in _MARKS.items():
        if data.startswith(mark):
            raise ValueError(f"line 1: the file begins with {name}; save it as UTF-8 without byte order mark (BOM)")
    if (zero := data.find(0)) >= 0:
        line = data.count(b"\n", 0, zero) + 1
        raise ValueError(
            f"line {line}: the file has bytes of 0, as after a power cut, or in UTF-16; write it anew in UTF-8"
        )
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        line, byte = data.count(b"\n", 0, error.start) + 1, data[error.start]
        raise ValueError(f"line {line}: the byte 0x{byte:02X} is not UTF-8; save the file as UTF-8") from None


def parse_config(raw: dict[str, Any], origin: str, text: str = "") -> Config:
    """Check the values of a TOML file. `origin` names the file in the faults. With its `text`, faults name lines too.

    Raises ConfigError with all faults.
    """
    config, faults = faults_of(raw)
    if faults or config is None:
        raise config_error(faults, origin, text)
    return config


def config_error(faults: list[Told], origin: str, text: str) -> ConfigError:
    """The error that tells these faults, each with its line where the text is known."""
    some = faults[:SHOWN_FAULTS]
    lines = lines_of(text, {path for path, _ in some}) if text else {}
    words = []
    for path, what in some:
        place = f"line {lines[path]}: " if text else ""
        words.append(f"{origin}: {place}{f'{path_text(path)}: ' if path else ''}{what}")
    more = len(faults) - SHOWN_FAULTS
    return ConfigError(words + ([f"{origin}: and {more} more faults, not shown"] if more > 0 else []))
