"""The devices of a new configuration: their drivers, and every option of them with its source."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import ValidationError

from agent.setup.asking import Asking, Stated
from agent.setup.buses import bus_clock_khz
from agent.setup.drivers import describe, unit_of
from agent.setup.listening import Heard, hear
from agent.setup.toml import Setting, Table
from hw.fifo_options import FifoOptions
from hw.sensor import ConfigurationError, load_driver
from hw.units import STANDARD_GRAVITY_MPS2

Role = Literal["sensor", "reference"]
TEXT_LINES = "serial-csv"
HEARD_OPTIONS = ("axes", "sequence", "rate_hz")  # what lines of text tell
BAUD_RATE = 115200  # default of all serial drivers
# A sensor at rest indicates gravity. m/s2 and g are recognised by this length of the mean.
GRAVITY_MPS2 = (8.0, 12.0)
GRAVITY_G = (0.8, 1.2)


@dataclass(frozen=True, slots=True)
class Found:
    """A device that the probe found: its driver, options that follow from its place, and a text for people."""

    driver: str
    options: Mapping[str, Any]
    label: str


@dataclass(slots=True)
class Chosen:
    """The device of one role: its driver and its options, each with its source. `hint` helps where one is missing."""

    role: Role
    driver: Stated[str]
    options: dict[str, Stated[Any]] = field(default_factory=dict)
    hint: str = ""

    def state(self, name: str, value: Any, source: str) -> None:
        """State an option, unless the user has stated it."""
        self.options.setdefault(name, Stated(value, source))

    def value(self, name: str) -> Any:
        """Value of an option; None where it is not stated."""
        stated = self.options.get(name)
        return None if stated is None else stated.value


def listen(devices: list[Chosen], faults: list[str]) -> None:
    """Listen to the devices that write lines of text, as far as their options are not all stated."""
    waiting = [
        device
        for device in devices
        if device.driver.value == TEXT_LINES
        and device.value("port")
        and not all(name in device.options for name in HEARD_OPTIONS)
    ]
    ports = {str(device.value("port")): int(device.value("baud_rate") or BAUD_RATE) for device in waiting}
    heard = hear(ports) if ports else {}
    for device in waiting:
        told = heard[str(device.value("port"))]
        if isinstance(told, str):
            faults.append(
                f"{device.role}: port {device.value('port')}: {told}; connect the device, or state its lines with "
                f"--{device.role}-option for each of rate_hz, axes, sequence (and baud_rate)"
            )
            for name in HEARD_OPTIONS:  # the fault is told once
                device.state(name, {"axes": 3, "sequence": False, "rate_hz": 1.0}[name], "missing")
        else:
            _state_heard(device, told, faults)


def _state_heard(device: Chosen, heard: Heard, faults: list[str]) -> None:
    device.state("axes", heard.axes, "counted on the port")
    device.state("sequence", heard.sequence, "seen on the port")
    device.state("rate_hz", heard.nominal_hz, f"counted on the port: {heard.counted_hz:.4g} Hz")
    if "unit" in device.options or heard.axes != 3:
        return
    length = sum(value**2 for value in heard.mean) ** 0.5
    if heard.whole:
        device.state("unit", "count", "all indications on the port are whole numbers")
    elif GRAVITY_MPS2[0] <= length <= GRAVITY_MPS2[1]:
        device.state("unit", "m/s2", f"the mean on the port has the length {length:.3g}, as gravity has")
    elif GRAVITY_G[0] <= length <= GRAVITY_G[1]:
        device.state("unit", "g", f"the mean on the port has the length {length:.3g}, as gravity has in g")
    else:
        faults.append(
            f"{device.role}: the mean on the port has the length {length:.4g}, so its unit is neither m/s2 nor g; "
            f"state --{device.role}-option unit=... (count or mV), or let the device send m/s2"
        )
    device.hint = (
        f"; the mean on the port has the length {length:.5g}, which at rest is gravity: about "
        f"{length / STANDARD_GRAVITY_MPS2:.4g} per m/s2"
    )


def complete(device: Chosen, asking: Asking) -> None:
    """State every option of the driver: those that the user and the probe left out from the driver's defaults."""
    try:
        model = load_driver(device.driver.value).options_model
    except ConfigurationError as error:
        asking.faults.append(f"--{device.role}: {error}")
        return
    schema = model.model_json_schema()
    if issubclass(model, FifoOptions):
        _fit_bus(device, model)
    for name, option in schema.get("properties", {}).items():
        if name not in device.options and name in schema.get("required", []):
            unit = unit_of(name)
            says = option.get("description", name) + (f", {unit}" if unit else "")
            asked = asking.value(f"--{device.role}-option {name}=VALUE", None, f"{device.role}: {says}")
            device.options[name] = Stated(asked.value, asked.source)
        device.state(name, option.get("default"), "default")


def _fit_bus(device: Chosen, model: type[FifoOptions]) -> None:
    """State the clock of the bus as the system tells it, and the highest usual rate that fits it."""
    clock_khz = bus_clock_khz(int(device.value("bus") or 1))
    if clock_khz is not None:
        device.state("bus_khz", clock_khz, "the device tree of this machine")
    if "rate_hz" in device.options:
        return
    default = model.model_fields["rate_hz"].default
    stated = {name: held.value for name, held in device.options.items()}
    for rate in sorted((rate for rate in model.rates_hz if rate <= default), reverse=True):
        try:
            model.model_validate(stated | {"rate_hz": rate})
        except ValidationError:
            continue
        source = "default" if rate == default else f"the highest rate that the bus of {clock_khz:g} kHz carries"
        device.state("rate_hz", rate, source)
        return


def tables_of(device: Chosen) -> Iterator[Table]:
    """The tables of a device."""
    yield Table(
        "[[devices]]",
        [
            Setting("name", device.role, "name of this device in results and messages", "role of the device"),
            Setting("driver", device.driver.value, "driver; `fieldcal sensors` lists all", device.driver.source),
        ],
    )
    schema = describe(device.driver.value).options
    properties, required = schema.get("properties", {}), schema.get("required", [])
    settings = []
    for name, stated in device.options.items():
        option = properties.get(name, {})
        says = str(option.get("description", name.replace("_", " ")))
        default = None if name in required else option.get("default")
        settings.append(Setting(name, stated.value, says, stated.source, default, unit_of(name)))
    yield Table("[devices.options]", settings)
