"""Which filters a run will divide out, by device, and who states them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from agent.config import Config
from agent.config.knowledge import Certificate, Prior
from calib.signal.known_filters import corner_apart
from hw.sensor import load_driver

ESTIMATED = "its response is estimated with S"
PARTS = ("delay ", "highpass ", "corner_hz=")  # lines that say nothing of the size at the upper end of the motion


@dataclass(frozen=True, slots=True)
class StatedFilters:
    """The lines that state the filters of a device in a channel, and who states them; "" where nobody does."""

    sensor: str  # of the channel
    device: str
    lines: tuple[str, ...]
    stated_by: str

    @property
    def line(self) -> str:
        """One line for people."""
        if not self.stated_by:
            return f"filters of {self.device}: none stated; {ESTIMATED}"
        rest = f"; the rest of {ESTIMATED}" if all(line.startswith(PARTS) for line in self.lines) else ""
        return f"filters of {self.device}, stated by {self.stated_by}: {'; '.join(self.lines)}{rest}"


def stated_filters(config: Config) -> Iterator[StatedFilters]:
    """Of the sensor and the references of each channel. What a driver tells only of an open device is not among it."""
    drivers = {device.name: device for device in config.devices}

    def of(sensor: str, name: str, section: Prior | Certificate, place: str) -> StatedFilters:
        driver = drivers[name].driver
        known = load_driver(driver).options_model.model_validate(drivers[name].options).known_filters
        own = _lines(section)
        filters, _ = corner_apart(known)
        used = section.with_filters(known)
        of_driver = [
            line for line in known
            if (used.filters != section.filters if line in filters else used.corner_hz != section.corner_hz)
        ]  # fmt: skip
        by = [who for who, lines in ((place, own), (f"the driver {driver}", of_driver)) if lines]
        return StatedFilters(sensor, name, (*own, *of_driver), " and ".join(by))

    for channel in config.channels:
        yield of(channel.sensor, channel.sensor, channel.prior, "prior")
        for beside in channel.by_reference:
            if beside.reference is not None:
                yield of(channel.sensor, beside.reference, beside.certificate, "the certificate")


def _lines(section: Prior | Certificate) -> tuple[str, ...]:
    """What the section itself states."""
    has_table = isinstance(section, Certificate) and section.response is not None
    corner = f"corner_hz={section.corner_hz:g} u_corner_hz={section.u_corner_hz:g}"
    return (
        *section.filters,
        *(["the table of its certificate"] if has_table else []),
        *([corner] if section.corner_hz or section.u_corner_hz else []),
    )
