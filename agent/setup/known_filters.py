"""Which filters a run will divide out, by device, and who states them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from agent.config import Config
from hw.sensor import load_driver


@dataclass(frozen=True, slots=True)
class StatedFilters:
    """The lines that state the filters of a device in a channel, and who states them; "" where nobody does."""

    sensor: str  # of the channel
    device: str
    lines: tuple[str, ...]
    stated_by: str

    @property
    def told(self) -> str:
        """One line for people."""
        if not self.stated_by:
            return f"filters of {self.device}: none stated; its response is estimated with S"
        return f"filters of {self.device}, stated by {self.stated_by}: {'; '.join(self.lines)}"


def stated_filters(config: Config) -> Iterator[StatedFilters]:
    """Of the sensor and the references of each channel. What a driver tells only of an open device is not among it."""
    drivers = {device.name: device for device in config.devices}

    def of(sensor: str, name: str, lines: tuple[str, ...], section: str, more: tuple[str, ...] = ()) -> StatedFilters:
        device = drivers[name]
        known = load_driver(device.driver).options_model.model_validate(device.options).known_filters
        if lines or more:
            return StatedFilters(sensor, name, (*lines, *more), section)
        return StatedFilters(sensor, name, known, f"the driver {device.driver}" if known else "")

    for channel in config.channels:
        yield of(channel.sensor, channel.sensor, channel.prior.filters, "prior.filters")
        for beside in channel.by_reference:
            if beside.reference is not None:
                certificate = beside.certificate
                table = () if certificate.response is None else ("the table of its certificate",)
                yield of(channel.sensor, beside.reference, certificate.filters, "the certificate", table)
