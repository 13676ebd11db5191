"""The devices of a new configuration: their drivers, and every option of them with its source."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import click
from pydantic import ValidationError

from agent.setup.asking import Interview, SourcedValue
from agent.setup.buses import bus_clock_khz
from agent.setup.datagrams import hear_shake
from agent.setup.drivers import describe, unit_of
from agent.setup.listening import PortLines, hear
from agent.setup.recognising import recognised
from agent.setup.toml import TomlSetting, TomlTable
from hw.fifo_options import FifoOptions, foreign_options
from hw.line_columns import IGNORED, Column, columns_of
from hw.sensor import ConfigurationError, load_driver
from hw.serial_stream import SerialCsvOptions
from hw.shake_udp import ShakeUdpOptions
from hw.units import STANDARD_GRAVITY_MPS2

Role = Literal["sensor", "reference"]
TEXT_LINES = "serial-csv"
SHAKE = "shake-udp"
BAUD_RATE = 115200  # default of all serial drivers
# A sensor at rest indicates gravity. m/s2 and g are recognised by this length of the mean.
GRAVITY_MPS2 = (8.0, 12.0)
GRAVITY_G = (0.8, 1.2)


@dataclass(frozen=True, slots=True)
class ProbedDevice:
    """A device that the probe found: its driver, options that follow from its place, and a text for people."""

    driver: str
    options: Mapping[str, Any]
    label: str


@dataclass(slots=True)
class ChosenDevice:
    """The device of one role: its driver and its options, each with its source. `hint` helps where one is missing."""

    role: Role
    driver: SourcedValue[str]
    options: dict[str, SourcedValue[Any]] = field(default_factory=dict)
    hint: str = ""

    def state(self, name: str, value: Any, source: str) -> None:
        """State an option, unless the user has stated it."""
        self.options.setdefault(name, SourcedValue(value, source))

    def value(self, name: str) -> Any:
        """Value of an option; None where it is not stated."""
        stated = self.options.get(name)
        return None if stated is None else stated.value


def listen(devices: list[ChosenDevice], asking: Interview) -> None:
    """Listen to the devices that write lines of text or send datagrams, as far as their options are not all stated."""
    for device in devices:
        if device.driver.value == SHAKE and "channels" not in device.options:
            _hear_shake(device, asking)
    waiting = [device for device in devices if _sends_lines(device) and not _is_stated(device)]
    ports = {str(device.value("port")): int(device.value("baud_rate") or BAUD_RATE) for device in waiting}
    heard = hear(ports) if ports else {}
    for device in waiting:
        told = heard[str(device.value("port"))]
        if isinstance(told, str):
            if _ask(device):
                continue
            asking.faults.append(
                f"{device.role}: port {device.value('port')}: {told}; connect the device, or state its lines with "
                f"--{device.role}-option for each of rate_hz, axes, sequence or columns (and baud_rate), or its driver "
                f"with --{device.role} if it sends no lines"
            )
            device.state("rate_hz", 1.0, "missing")  # the fault is told once
        else:
            device.state("rate_hz", told.nominal_hz, f"counted on the port: {told.counted_hz:.4g} Hz")
            if columns := _columns(device, told, asking):
                _state_unit(device, columns, told, asking.faults)


def _sends_lines(device: ChosenDevice) -> bool:
    return device.driver.value == TEXT_LINES and bool(device.value("port"))


def _is_stated(device: ChosenDevice) -> bool:
    """Whether columns and rate of the lines are stated, as the columns are from now on where the options tell them."""
    if columns := _stated_columns(device):
        _state_columns(device, columns, f"option --{device.role}-option")
    return bool(columns) and "rate_hz" in device.options


def _ask(device: ChosenDevice) -> bool:
    """Ask the device at a port without lines of text who it is; whether it answered. Its driver is then known."""
    if device.driver.source.startswith("option"):
        return False
    found = recognised(str(device.value("port")), device.value("baud_rate"))
    if found is not None:
        device.driver = SourcedValue(found.driver, "the device answered on the port")
        for name, value in found.options.items():
            device.state(name, value, "the device answered on the port")
    return found is not None


def _hear_shake(device: ChosenDevice, asking: Interview) -> None:
    """State the channels and the rate of the Raspberry Shake that sends to this computer."""
    option = f"--{device.role}-option"
    stated = {name: held.value for name, held in device.options.items()}
    try:
        told = hear_shake(ShakeUdpOptions.model_validate(stated | {"channels": ["EHZ"]}))  # any; it is not used
    except ValidationError as error:
        told = f"{option} {error.errors()[0]['loc'][0]}: {error.errors()[0]['msg']}"
    if isinstance(told, str):
        asking.faults.append(f"{device.role}: {told}")
        device.state("channels", [], "missing")  # the fault is told once
        return
    device.state("rate_hz", told.nominal_hz, f"counted on the port: {told.counted_hz:.4g} Hz")
    held = SourcedValue(told.channels, "heard on the port")
    if not held.value:
        question = (
            f"{device.role}: one channel, or three for x, y, z, with commas; those that came: {', '.join(told.came)}"
        )
        held = asking.value(f"{option} channels=[...]", None, question, kind=_texts)
    device.state("channels", list(held.value or ()), held.source)


def _stated_columns(device: ChosenDevice) -> tuple[Column, ...]:
    """The columns as the user states them: by `columns`, or by axes and sequence; () where they are not stated."""
    stated = {name: held.value for name in ("columns", "axes", "sequence") if (held := device.options.get(name))}
    if "columns" not in stated and len(stated) < 2:
        return ()
    try:
        return SerialCsvOptions.model_validate({"port": "stated", "rate_hz": 1.0} | stated).line
    except ValidationError:
        return ()  # the check of the whole configuration names the fault


def _columns(device: ChosenDevice, heard: PortLines, asking: Interview) -> tuple[Column, ...]:
    """State the columns of the lines as heard, or as answered, unless the user has stated them; () where they are not
    known or contradict what the user has stated."""
    option, count = f"--{device.role}-option columns=[...]", len(heard.means)
    held = SourcedValue(_stated_columns(device) or heard.columns, "seen on the port")
    if "columns" in device.options and not _stated_columns(device):
        return ()
    if not held.value:
        question = (
            f"{device.role}: what the {count} columns of its lines are, as in {heard.example}, in their order with "
            f"commas; names: {' '.join(get_args(Column))} ({IGNORED} is not read)"
        )
        held = asking.value(option, None, question, kind=_names)
    columns: tuple[Column, ...] = held.value or ()
    if not columns:
        return ()
    if device.role == "sensor" and _axes(columns) == 1:
        asking.faults.append(
            f"sensor: its lines have one axis, as {heard.example}, and a sensor needs three; a device with one axis "
            "can be the reference (--reference-port)"
        )
        return ()
    expected = {"axes": _axes(columns), "sequence": "seq" in columns}
    wrong = [f"{name} = {device.value(name)}" for name in expected if device.value(name) not in (None, expected[name])]
    if wrong or len(columns) != count:
        stated = wrong or [f"{len(columns)} columns"]
        asking.faults.append(
            f"{device.role}: {' and '.join(stated)} do not fit its lines of {count} columns, as {heard.example}; "
            f"state {option} with {count} of {' '.join(get_args(Column))} ({IGNORED} is not read)"
        )
        return ()
    _state_columns(device, columns, held.source)
    return columns


def _axes(columns: Sequence[Column]) -> int:
    return sum(name in ("x", "y", "z", "a") for name in columns)


def _state_columns(device: ChosenDevice, columns: tuple[Column, ...], source: str) -> None:
    """State axes and sequence, and the columns too where these two do not tell all."""
    axes, sequence = _axes(columns), "seq" in columns
    device.state("axes", axes, source)
    device.state("sequence", sequence, source)
    if columns != columns_of(axes, sequence):
        device.state("columns", list(columns), source)


def _texts(answer: str) -> tuple[str, ...]:
    """Texts between commas."""
    return tuple(text.strip() for text in answer.split(","))


def _names(answer: str) -> tuple[str, ...]:
    """Names between commas. Raises click.BadParameter."""
    names = _texts(answer)
    if wrong := [name for name in names if name not in get_args(Column)]:
        raise click.BadParameter(f"{wrong[0]!r} is none of {' '.join(get_args(Column))}")
    return names


def _state_unit(device: ChosenDevice, columns: tuple[Column, ...], heard: PortLines, faults: list[str]) -> None:
    axes = [at for at, name in enumerate(columns) if name in ("x", "y", "z")]
    if "unit" in device.options or not axes:
        return
    length = sum(heard.means[at] ** 2 for at in axes) ** 0.5
    if all(heard.whole[at] for at in axes):
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


def complete(device: ChosenDevice, asking: Interview) -> None:
    """State every option of the driver: those that the user and the probe left out from the driver's defaults."""
    try:
        model = load_driver(device.driver.value).options_model
    except ConfigurationError as error:
        asking.faults.append(f"--{device.role}: {error}")
        return
    schema = model.model_json_schema()
    options = schema.get("properties", {})
    if issubclass(model, FifoOptions):
        device.state("bus", model.model_fields["bus"].default, "default")
        _fit_bus(device, model)
        foreign = foreign_options(device.value("bus"))
        options = {name: option for name, option in options.items() if name not in foreign}
    for name, option in options.items():
        if name not in device.options and name in schema.get("required", []):
            unit = unit_of(name)
            says = option.get("description", name) + (f", {unit}" if unit else "")
            kind = _texts if option.get("items", {}).get("type") == "string" else None
            asked = asking.value(f"--{device.role}-option {name}=VALUE", None, f"{device.role}: {says}", kind=kind)
            device.options[name] = SourcedValue(asked.value, asked.source)
        device.state(name, option.get("default"), "default")


def _fit_bus(device: ChosenDevice, model: type[FifoOptions]) -> None:
    """State the clock of the bus as the system tells it, and the highest usual rate that fits it without advice."""
    bus = device.value("bus")
    clock_khz = None if isinstance(bus, str) else bus_clock_khz(bus)
    if clock_khz is not None:
        device.state("bus_khz", clock_khz, "the device tree of this machine")
    if "rate_hz" in device.options:
        return
    default = model.model_fields["rate_hz"].default
    stated = {name: held.value for name, held in device.options.items()}
    for rate in sorted((rate for rate in model.rates_hz if rate <= default), reverse=True):
        try:
            fitting = model.model_validate(stated | {"rate_hz": rate})
        except ValidationError:
            continue
        if fitting.advice:
            continue
        source = "default" if rate == default else "the highest rate for this bus"
        device.state("rate_hz", rate, source)
        return


def tables_of(device: ChosenDevice) -> Iterator[TomlTable]:
    """The tables of a device."""
    yield TomlTable(
        "[[devices]]",
        [
            TomlSetting("name", device.role, "name of this device in results and messages", "role of the device"),
            TomlSetting("driver", device.driver.value, "driver; `fieldcal sensors` lists all", device.driver.source),
        ],
    )
    schema = describe(device.driver.value).options
    properties, required = schema.get("properties", {}), schema.get("required", [])
    settings = []
    for name, stated in device.options.items():
        option = properties.get(name, {})
        says = str(option.get("description", name.replace("_", " ")))
        default = None if name in required else option.get("default")
        settings.append(TomlSetting(name, stated.value, says, stated.source, default, unit_of(name)))
    yield TomlTable("[devices.options]", settings)
