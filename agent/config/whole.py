"""The whole configuration: all sections, and what must agree between them."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from agent.config.channel import Channel
from agent.config.commands import Commands
from agent.config.devices import Device, Gateway
from agent.config.section import Section
from agent.config.sinks import Recording, Results, Zenoh
from agent.config.supervision import Supervision


class Config(Section):
    """All of it."""

    gateway: Gateway = Gateway()
    # A gateway reads a handful; a thousand threads are a typing error.
    devices: Annotated[tuple[Device, ...], Field(min_length=1, max_length=100)]
    channels: Annotated[tuple[Channel, ...], Field(min_length=1, max_length=100)]
    recording: Recording = Recording()
    results: Results = Results()
    zenoh: Zenoh = Zenoh()
    commands: Commands = Commands()
    supervision: Supervision = Supervision()

    @model_validator(mode="after")
    def _names(self) -> Config:
        names = [d.name for d in self.devices]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"devices: the name {name!r} is used more than once")
        sensors = [c.sensor for c in self.channels]
        for i, channel in enumerate(self.channels):
            for role, device in (("sensor", channel.sensor), ("reference", channel.reference)):
                if device is not None and device not in names:
                    known = ", ".join(names)
                    raise ValueError(f"channels.{i}.{role}: no device is called {device!r}; there are {known}")
            if channel.reference == channel.sensor:
                raise ValueError(f"channels.{i}: a sensor cannot be its own reference")
            if sensors.count(channel.sensor) > 1:
                raise ValueError(f"channels.{i}.sensor: {channel.sensor!r} has more than one channel")
        for i, key in enumerate(self.commands.keys):
            for sensor in key.sensors:
                if sensor != "*" and sensor not in sensors:
                    raise ValueError(f"commands.keys.{i}.sensors: {sensor!r} has no channel")
        return self
