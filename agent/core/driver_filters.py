"""The filters of a channel's devices: those that the configuration states, else those that their drivers state."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from agent.config import Channel
from agent.config.filters import FiltersError, filters_of

Lines = tuple[str, ...]


class DriverFilters:
    """`channel`: that of the configuration, `configured`, with the filters of the drivers where it states none.

    `by_device`: what the drivers of opened devices state. Of a device that has not been opened yet, it is what its
    driver stated in the run before.
    """

    def __init__(self, configured: Channel) -> None:
        self.configured = configured
        self.channel = configured
        self.by_device: dict[str, Lines] = {}

    def hear(self, device: str, info: Mapping[str, Any]) -> str:
        """A device was opened. Returns why its driver's statement is not used; "" where it is, or where there is none.

        Recordings of earlier versions have no statement.
        """
        stated, fault = Lines(), ""
        try:
            stated = filters_of(info.get("filters", ()))
        except FiltersError as error:
            fault = f"what the driver of {device} states of its filters is not used: {error}"
        self.take({**self.by_device, device: stated})
        return fault

    def take(self, by_device: Mapping[str, Lines]) -> None:
        """These are stated, by device."""
        self.by_device = dict(by_device)
        stated = self.configured.with_filters_of(self.by_device) if any(self.by_device.values()) else self.configured
        if not alike(stated, self.channel):
            self.channel = stated

    def snapshot(self) -> dict[str, list[str]]:
        """State for `load`."""
        return {device: list(lines) for device, lines in self.by_device.items()}

    def load(self, state: Mapping[str, Iterable[str]]) -> None:
        """Take the state that `snapshot` gave."""
        self.take({device: tuple(lines) for device, lines in state.items()})


def alike(one: Channel, other: Channel) -> bool:
    """Whether the same filters and corners are stated of the sensor and of each reference."""
    return [_stated(beside) for beside in one.by_reference] == [_stated(beside) for beside in other.by_reference]


def _stated(beside: Channel) -> tuple[object, ...]:
    of = beside.instrument
    return of.known, of.corner_hz, of.u_corner_hz, of.sensor_corner_hz, of.u_sensor_corner_hz
