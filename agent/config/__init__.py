"""The configuration: one TOML file, checked wholly before anything starts, every fault named at once."""

from agent.config.channel import Channel, PoseInterval
from agent.config.devices import Device, Gateway
from agent.config.reading import ConfigError, load_config, parse_config
from agent.config.sinks import Recording, Results, Zenoh
from agent.config.whole import Config

__all__ = [
    "Channel", "Config", "ConfigError", "Device", "Gateway", "PoseInterval", "Recording", "Results", "Zenoh",
    "load_config", "parse_config",
]  # fmt: skip
