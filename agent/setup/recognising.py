"""Sensors on serial ports that answer when they are asked who they are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import ValidationError

from hw.sensor import ConfigurationError, DeviceLost, driver_names, load_driver
from hw.serial_sensor import AskedSensor


@dataclass(frozen=True, slots=True)
class Recognised:
    """The driver of a sensor that answered, and options that follow from the answer."""

    driver: str
    options: Mapping[str, Any]


def recognised(port: str, baud_rate: int | None = None) -> Recognised | None:
    """Ask at a port, with the commands of each driver that has any; None where no sensor answers.

    Without `baud_rate` all baud rates of a driver are tried, its default first. The sensor then sends nothing.
    """
    for name, driver in _asking():
        known = driver.options_model.model_fields["baud_rate"]
        rates = dict.fromkeys([known.default, *reversed(get_args(known.annotation))])
        for rate in rates if baud_rate is None else [baud_rate]:
            try:
                options = driver.options_model.model_validate({"port": port, "baud_rate": rate})
                return Recognised(name, {"baud_rate": rate} | driver("asked", options).identify())
            except DeviceLost:
                return None
            except (ValidationError, ConfigurationError):
                continue  # this driver or this baud rate is not that of the sensor
    return None


def _asking() -> Iterator[tuple[str, type[AskedSensor]]]:
    for name in driver_names():
        try:
            driver = load_driver(name)
        except ConfigurationError:
            continue  # `fieldcal sensors` reports the reason
        if isinstance(driver, type) and issubclass(driver, AskedSensor):
            yield name, driver
