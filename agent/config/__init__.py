"""The configuration: one TOML file, checked wholly before anything starts, every fault named at once."""

from agent.config.channel import Channel
from agent.config.commands import CommandKey, Commands
from agent.config.devices import Device, Gateway
from agent.config.pose import PoseInterval
from agent.config.reading import ConfigError, load_config, parse_config
from agent.config.recorded import recorded_config
from agent.config.sinks import Recording, Results, Tls, Zenoh
from agent.config.supervision import Metrics, Supervision
from agent.config.whole import Config

__all__ = [
    "Channel", "CommandKey", "Commands", "Config", "ConfigError", "Device", "Gateway", "Metrics", "PoseInterval",
    "Recording", "Results", "Supervision", "Tls", "Zenoh",
    "load_config", "parse_config", "recorded_config",
]  # fmt: skip
