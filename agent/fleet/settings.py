"""Settings that a recomputation changes: `fieldcal fleet replay --set channels.*.certificate.sensitivity=0.996`."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from agent.config import Config, recorded_config
from agent.config.channel import Channel
from agent.config.faults import model_faults, path_text

LONGEST = 10_000  # characters of one setting
DEEPEST = 8  # parts of a key; the configuration has four levels
_PART = re.compile(r"[A-Za-z0-9_.-]+|\*")
FORM = "channels.<sensor>.<key>=<value>, or channels.*.<key>=<value> for all, or *=<factor> in place of =<value>"


class SettingError(Exception):
    """A setting cannot be changed so. The message names its key."""


@dataclass(frozen=True, slots=True)
class ChangedSetting:
    """One changed setting. `channel`: the sensor's name, "*" for all. `path`: the keys below the channel.

    `scaled`: `value` multiplies the recorded number instead of replacing the recorded value.
    """

    text: str
    channel: str
    path: tuple[str, ...]
    value: Any
    scaled: bool

    @staticmethod
    def of(text: str) -> ChangedSetting:
        """Read KEY=VALUE or KEY*=FACTOR; the value is written as in TOML. Raises SettingError."""
        key, equals, value_text = text.partition("=")
        scaled = key.endswith("*") and not key.endswith(".*")
        key = key.removesuffix("*").strip() if scaled else key.strip()
        parts = key.split(".")
        if not equals or len(text) > LONGEST or not 3 <= len(parts) <= DEEPEST or parts[0] != "channels":
            raise SettingError(f"{text[:100]!r}: must be {FORM}; only channels decide what is computed")
        if not all(_PART.fullmatch(part) for part in parts):
            raise SettingError(f"{text[:100]!r}: a part of the key is empty or has a character that no key has")
        value = _value(value_text.strip())
        if scaled and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise SettingError(f"{key}: *= needs a number, not {value_text.strip()[:100]!r}")
        setting = ChangedSetting(text, parts[1], tuple(parts[2:]), value, scaled)
        setting._check()
        return setting

    def _check(self) -> None:
        """Refuse what no channel can have, before any recording is read. Raises SettingError."""
        nest: Any = 1.0 if self.scaled else self.value
        for part in reversed(self.path):
            if part.isdecimal():
                return  # an entry of a list: only the recorded configuration tells whether it is there
            nest = {part: nest}
        try:
            Channel.model_validate({"sensor": "sensor"} | nest)
        except ValidationError as error:
            for path, what in model_faults(error, {"sensor": "sensor"} | nest, Channel):
                own = path[: len(self.path)] == self.path or (what.startswith("there is no") and path)
                if own and not (self.scaled and path == self.path and "no such setting" not in what):
                    raise SettingError(f"{path_text(('channels', self.channel, *path))}: {what}") from None


def changed_config(config_json: str, settings: Sequence[ChangedSetting]) -> Config:
    """The recorded configuration with the settings changed. Raises SettingError, or ValueError where it is none."""
    raw = recorded_config(config_json).model_dump(mode="json")
    for setting in settings:
        channels = [c for c in raw["channels"] if setting.channel in ("*", c["sensor"])]
        if not channels:
            there = ", ".join(c["sensor"] for c in raw["channels"])
            raise SettingError(f"channels.{setting.channel}: the recording has no such channel; there is {there}")
        for channel in channels:
            _change(channel, setting)
    try:
        return Config.model_validate(raw)
    except ValidationError as error:
        lines = [f"{path_text(path)}: {what}" for path, what in model_faults(error, raw, Config)]
        raise SettingError("; ".join(lines[:5])) from None


def _change(channel: dict[str, Any], setting: ChangedSetting) -> None:
    key = ".".join(("channels", channel["sensor"], *setting.path))
    held: Any = channel
    for part in setting.path[:-1]:
        held = _inside(held, part, key)
    last: Any = setting.path[-1]
    if isinstance(held, list):
        _inside(held, last, key)
        last = int(last)
    elif not isinstance(held, dict):
        raise SettingError(f"{key}: the recorded configuration has no section there")
    if not setting.scaled:
        held[last] = setting.value
        return
    before = held[last] if isinstance(held, list) else held.get(last)
    if isinstance(before, bool) or not isinstance(before, int | float):
        raise SettingError(f"{key}: *= needs a recorded number, and the recording has {str(before)[:100]!r}")
    held[last] = before * setting.value


def _inside(held: Any, part: str, key: str) -> Any:
    if isinstance(held, dict) and part in held:
        return held[part]
    if isinstance(held, list) and part.isdecimal() and len(part) < 6 and int(part) < len(held):
        return held[int(part)]
    raise SettingError(f"{key}: the recorded configuration has nothing at {part!r}")


def _value(text: str) -> Any:
    """The value as TOML writes it; a word without quotes is text."""
    try:
        found = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return found["value"] if len(found) == 1 else text
