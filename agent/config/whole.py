"""The whole configuration: all sections, and what must agree between them."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from agent.config.channel import Channel
from agent.config.devices import Device, Gateway
from agent.config.section import Section
from agent.config.sinks import Recording, Results, Zenoh


class Config(Section):
    """All of it."""

    gateway: Gateway = Gateway()
    devices: Annotated[tuple[Device, ...], Field(min_length=1)]
    channels: Annotated[tuple[Channel, ...], Field(min_length=1)]
    recording: Recording = Recording()
    results: Results = Results()
    zenoh: Zenoh = Zenoh()

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
        return self
