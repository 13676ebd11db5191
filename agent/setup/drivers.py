"""What each driver says of itself: description, options with units and defaults."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

from hw.sensor import BUILT_IN, ConfigurationError, DriverFactory, load_driver

# unit by the ending of the option's name
UNITS = {
    "_hz": "Hz",
    "_khz": "kHz",
    "_mhz": "MHz",
    "_s": "s",
    "_g": "g",
    "_mps2": "m/s2",
    "_degc": "degC",
    "baud_rate": "bit/s",
}


@dataclass(frozen=True, slots=True)
class Driver:
    """One driver. `options` is the JSON schema of its options; `fault` tells why the driver cannot be loaded."""

    name: str
    built_in: bool
    description: str
    options: dict[str, Any]
    fault: str = ""


def describe(name: str) -> Driver:
    """Description of a driver. If the driver cannot be loaded, the description holds the reason."""
    try:
        factory = load_driver(name)
    except ConfigurationError as error:
        return Driver(name, name in BUILT_IN, "", {}, str(error))
    return Driver(name, name in BUILT_IN, _first_line(factory), factory.options_model.model_json_schema())


def _first_line(factory: DriverFactory) -> str:
    """First line of the module's docstring without the prefix "Driver `x`: "."""
    module = sys.modules[getattr(factory, "__module__", "")]
    line = (module.__doc__ or "").strip().partition("\n")[0]
    return line.partition(": ")[2] or line


def unit_of(option: str) -> str:
    """Unit of an option, from its name; "" if the name has none."""
    return next((unit for end, unit in UNITS.items() if option.endswith(end)), "")
