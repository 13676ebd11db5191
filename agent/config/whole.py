"""The whole configuration: all its sections, and the checks between them."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from agent.config.channel import Channel
from agent.config.commands import Commands
from agent.config.devices import Device, Gateway
from agent.config.names import name_faults
from agent.config.section import Section
from agent.config.sinks import Mqtt, Recording, Results, Zenoh
from agent.config.supervision import Supervision


class Config(Section):
    """The whole configuration."""

    gateway: Gateway = Gateway()
    # A gateway reads a few devices. Each has a thread, and a thousand would be a typing error.
    devices: Annotated[tuple[Device, ...], Field(min_length=1, max_length=100)]
    channels: Annotated[tuple[Channel, ...], Field(min_length=1, max_length=100)]
    recording: Recording = Recording()
    results: Results = Results()
    zenoh: Zenoh = Zenoh()
    mqtt: Mqtt = Mqtt()
    commands: Commands = Commands()
    supervision: Supervision = Supervision()

    @model_validator(mode="after")
    def _names(self) -> Config:
        for path, what in name_faults(self.model_dump()):
            raise ValueError(f"{'.'.join(map(str, path))}: {what}")
        return self
