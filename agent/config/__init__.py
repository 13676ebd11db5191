"""The configuration: one TOML file, checked wholly before anything starts, every fault named at once.

Each name is imported when it is first used: who only opens a file with `agent.config.files` does not load pydantic and
the sections, which takes 0.15 s.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agent.config.channel import Channel
    from agent.config.commands import CommandKey, Commands
    from agent.config.devices import Device, Gateway
    from agent.config.pose import PoseInterval
    from agent.config.reading import ConfigError, load_config, parse_config
    from agent.config.recorded import recorded_config
    from agent.config.sinks import Mqtt, Recording, Results, Tls, Zenoh
    from agent.config.supervision import Metrics, Supervision
    from agent.config.whole import Config

__all__ = [
    "Channel", "CommandKey", "Commands", "Config", "ConfigError", "Device", "Gateway", "Metrics", "Mqtt",
    "PoseInterval", "Recording", "Results", "Supervision", "Tls", "Zenoh",
    "load_config", "parse_config", "recorded_config",
]  # fmt: skip

_PLACES = {
    "channel": ("Channel",),
    "commands": ("CommandKey", "Commands"),
    "devices": ("Device", "Gateway"),
    "pose": ("PoseInterval",),
    "reading": ("ConfigError", "load_config", "parse_config"),
    "recorded": ("recorded_config",),
    "sinks": ("Mqtt", "Recording", "Results", "Tls", "Zenoh"),
    "supervision": ("Metrics", "Supervision"),
    "whole": ("Config",),
}
_PLACE = {name: module for module, names in _PLACES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _PLACE:
        raise AttributeError(f"module 'agent.config' has no attribute {name!r}")
    value = getattr(import_module(f"agent.config.{_PLACE[name]}"), name)
    globals()[name] = value
    return value
