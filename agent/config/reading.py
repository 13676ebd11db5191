"""A TOML file read and checked wholly before anything starts, every fault named at once."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from agent.config.sinks import Tls
from agent.config.tls import tls_faults
from agent.config.whole import Config
from hw.sensor import DeviceError, load_driver

LARGEST_FILE = 4 << 20  # bytes; a day of a pose each second has as many
# Sections of ours go four deep. The parser takes quadratic time for a long dotted key: hours for 4 MB of it.
DEEPEST_KEY = 16
LONGEST_LIST = 86_400  # a pose each second of a day; each fault in a list costs 2 kB and 25 us
SHOWN_FAULTS = 100
SHOWN_CHARACTERS = 100  # of a value or a path in a fault
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+"""
_LONG_KEY = re.compile(rf"(?<![\w.-]){_PART}(?:\.[ \t]*+{_PART}){{{DEEPEST_KEY},}}+")


class ConfigError(Exception):
    """The faults of a configuration, one line each, every one with file, path and value."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults


def load_config(path: Path) -> Config:
    """Read and check a TOML file. Raises ConfigError with all faults."""
    try:
        with open(path, "rb") as file:
            text = file.read(LARGEST_FILE + 1).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"]) from None
    if len(text) > LARGEST_FILE:
        raise ConfigError([f"{path}: more than {LARGEST_FILE} bytes, no configuration"])
    if (deep := _LONG_KEY.search(text)) is not None:
        line = text.count("\n", 0, deep.start()) + 1
        raise ConfigError([f"{path}: line {line}: a key of more than {DEEPEST_KEY} parts: {deep[0][:40]}..."])
    try:
        raw = tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError is one, and so is an integer of thousands of digits
        raise ConfigError([f"{path}: not TOML: {error}"]) from None
    except RecursionError:
        raise ConfigError([f"{path}: not TOML of ours: nested too deep"]) from None
    if longest := [f"{path}: {line}" for line in _long_lists(raw, "")]:
        raise ConfigError(longest)
    return parse_config(raw, str(path))


def parse_config(raw: dict[str, Any], origin: str) -> Config:
    """Check what a TOML file held; `origin` names it in the faults."""
    faults: list[str] = []
    config = None
    try:
        config = Config.model_validate(raw)
    except ValidationError as error:
        faults += [f"{origin}: {line}" for line in _fault_lines(error)]
    devices = raw.get("devices")
    for i, device in enumerate(devices if isinstance(devices, list) else []):
        if isinstance(device, dict):
            faults += [f"{origin}: devices.{i}.{line}" for line in _driver_faults(device)]
    faults += [f"{origin}: zenoh.tls.{line}" for line in _tls_faults(raw.get("zenoh"))]
    if faults or config is None:
        more = len(faults) - SHOWN_FAULTS
        raise ConfigError(faults[:SHOWN_FAULTS] + ([f"{origin}: and {more} faults more"] if more > 0 else []))
    return config


def _long_lists(value: Any, path: str) -> Iterator[str]:
    if isinstance(value, list) and len(value) > LONGEST_LIST:
        yield f"{_short(path)}: a list of {len(value)}, more than {LONGEST_LIST}"
    elif isinstance(value, (dict, list)):
        for name, item in value.items() if isinstance(value, dict) else enumerate(value):
            if isinstance(item, (dict, list)):
                yield from _long_lists(item, f"{path}.{name}" if path else str(name))


def _driver_faults(device: dict[str, Any]) -> list[str]:
    driver, options = device.get("driver"), device.get("options", {})
    if not isinstance(driver, str) or not isinstance(options, dict):
        return []  # the section's own check names it
    try:
        load_driver(driver).options_model.model_validate(options)
    except DeviceError as error:
        return [f"driver: {error}"]
    except ValidationError as error:
        return [f"options.{line}" for line in _fault_lines(error)]
    return []


def _tls_faults(zenoh: Any) -> list[str]:
    tls = zenoh.get("tls") if isinstance(zenoh, dict) else None
    try:
        files = Tls.model_validate(tls).files
    except ValidationError:
        return []  # the section's own check names it, if it is there at all
    return tls_faults(files)


def _fault_lines(error: ValidationError) -> list[str]:
    lines, faults = [], error.errors()
    places = [fault["loc"] for fault in faults]
    for fault in faults:
        # A list that is too short only because what is in it was refused is no fault of its own.
        if fault["type"] == "too_short" and any(
            len(p) > len(fault["loc"]) and p[: len(fault["loc"])] == fault["loc"] for p in places
        ):
            continue
        path = ".".join(str(part) for part in fault["loc"])
        value = fault.get("input")
        # A whole section as "the offending value" would bury the message.
        whole = isinstance(value, (dict, BaseModel, list, tuple)) or fault["type"] == "missing"
        shown = "" if whole else f", not {_shown(value)}"
        message = fault["msg"].removeprefix("Value error, ")
        lines.append(f"{_short(path)}: {message}{shown}" if path else message)
    return lines


def _shown(value: Any) -> str:
    if isinstance(value, int) and value.bit_length() > 64:
        return f"a number of {value.bit_length()} bits"  # Python refuses to write one of thousands of digits
    return _short(repr(value))


def _short(text: str) -> str:
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[:SHOWN_CHARACTERS]}..."
