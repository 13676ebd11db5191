"""A TOML file read and checked wholly before anything starts, every fault named at once."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from agent.config.whole import Config
from hw.sensor import DeviceError, load_driver

LARGEST_FILE = 4 << 20  # bytes; a day of a pose each second has as many


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
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError([f"{path}: not TOML: {error}"]) from None
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
    if faults or config is None:
        raise ConfigError(faults)
    return config


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
        shown = "" if whole else f", not {value!r}"
        message = fault["msg"].removeprefix("Value error, ")
        lines.append(f"{path}: {message}{shown}" if path else message)
    return lines
