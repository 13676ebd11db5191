"""`fieldcal probe`: devices that answer on this machine's I2C buses, SPI buses and serial ports; their self-tests."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import click
from pydantic import ValidationError

from agent.terminal.text import say
from hw.fifo_options import FifoOptions
from hw.fifo_sensor import FifoSensor
from hw.i2c import I2CDevice
from hw.self_test import SelfTestReport
from hw.sensor import ConfigurationError, DeviceError, DeviceLost, IdentityError, driver_names, load_driver
from hw.serial_ports import serial_ports
from hw.spi import SPI_BUS

MICRO = 1e6


@dataclass(frozen=True, slots=True)
class ProbedAddress:
    """Answer at an address.

    `drivers` are those that recognise the device (several if the part does not tell which of them it is); `note` is
    what the other drivers, the adapter or the kernel report; `used_by` is the process that has the device open;
    `warning`: why the device must be alone on its bus, where it is not.
    """

    address: int
    drivers: list[str] = field(default_factory=list)
    identity: str = ""
    note: str = ""
    used_by: str = ""
    warning: str = ""
    self_test: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class ProbedBus:
    """The bus /dev/i2c-N; `fault` tells why it cannot be probed."""

    number: int
    fault: str
    answers: list[ProbedAddress]


@dataclass(frozen=True, slots=True)
class Selected:
    """What one chip select of SPI has: `bus` as in the options of a driver; `note` tells why nothing is known."""

    bus: str
    driver: str = ""
    identity: str = ""
    note: str = ""
    used_by: str = ""
    self_test: dict[str, Any] | None = None


def bus_name(value: str | int) -> str | int:
    """N of /dev/i2c-N, or spiB.C of /dev/spidevB.C. Raises click.BadParameter."""
    text = str(value)
    if not text.isdecimal() and not re.fullmatch(SPI_BUS, text):
        raise click.BadParameter(f"{text!r} is neither N of /dev/i2c-N nor spiB.C of /dev/spidevB.C, as spi0.0")
    return int(text) if text.isdecimal() else text


@click.command()
@click.option("--bus", "buses", type=bus_name, multiple=True, metavar="BUS", help="Only /dev/i2c-BUS, or spiB.C.")
@click.option("--driver", metavar="NAME", help="Ask as this driver does. Only with it is a device on SPI asked.")
@click.option(
    "--self-test", is_flag=True, help="Run the self-test of each device. It resets the device: stop the agent first."
)
@click.option("--json", "json_to", type=click.Choice(["-"]), help="One JSON object on standard output.")
def probe(buses: tuple[str | int, ...], driver: str | None, self_test: bool, json_to: str | None) -> int:
    """Probe the buses and serial ports of this machine. Reads only identity registers, unless --self-test is given.

    SPI has no addresses, and what reads from one part may write to another. So a device on SPI is asked only where both
    --bus and --driver name it, as in --bus spi0.0 --driver adxl355.

    Exit status 3 if a self-test failed, 1 if a named bus cannot be probed.
    """
    drivers = i2c_drivers()
    if driver is not None and driver not in drivers:
        raise click.BadParameter(f"{driver!r} is none of {', '.join(drivers)}", param_hint="--driver")
    asked = {driver: drivers[driver]} if driver else drivers
    found = [on_bus(bus, asked, self_test) for bus in buses or i2c_buses() if isinstance(bus, int)]
    on_select = asked if buses else drivers
    selected = [on_spi(bus, on_select, self_test) for bus in buses or spi_buses() if isinstance(bus, str)]
    ports = [] if buses else serial_ports()
    if json_to:
        told = {"i2c": [asdict(bus) for bus in found], "spi": [asdict(one) for one in selected], "serial": ports}
        click.echo(json.dumps(told))
    else:
        _print(found, selected, ports, named=bool(buses))
    return _status(found, selected, named=bool(buses))


def _status(buses: Sequence[ProbedBus], selected: Sequence[Selected], *, named: bool) -> int:
    """The exit status; `named`: these buses were asked for by their names."""
    if named and (any(bus.fault for bus in buses) or not all(one.identity for one in selected)):
        return 1
    results = [answer.self_test for bus in buses for answer in bus.answers] + [one.self_test for one in selected]
    return 3 if any(result and result["faults"] for result in results) else 0


def i2c_buses() -> list[int]:
    """Numbers N of the I2C adapters /dev/i2c-N of this machine."""
    nodes = (path.name.removeprefix("i2c-") for path in Path("/dev").glob("i2c-*"))
    return sorted(int(number) for number in nodes if number.isdigit())


def spi_buses() -> list[str]:
    """Chip selects spiB.C of this machine that have a node /dev/spidevB.C."""
    return sorted(path.name.replace("spidev", "spi") for path in Path("/dev").glob("spidev*.*"))


def i2c_drivers() -> dict[str, type[FifoSensor]]:
    """Drivers that can identify a device at an address, by name."""
    found = {}
    for name in driver_names():
        try:
            driver = load_driver(name)
        except ConfigurationError:
            continue  # `fieldcal sensors` reports the reason
        if isinstance(driver, type) and issubclass(driver, FifoSensor):
            found[name] = driver
    return found


def on_bus(number: int, drivers: dict[str, type[FifoSensor]], self_test: bool) -> ProbedBus:
    """Probe the addresses that the drivers know, in ascending order of the addresses."""
    adapter = I2CDevice("adapter", number, 0, time.sleep)
    try:
        adapter.open()
    except DeviceError as error:
        return ProbedBus(number, str(error), [])
    finally:
        adapter.close()
    by_address: dict[int, dict[str, type[FifoSensor]]] = {}
    for name, driver in drivers.items():
        for address in get_args(driver.options_model.model_fields["address"].annotation):
            by_address.setdefault(address, {})[name] = driver
    tried = [_at(number, address, by_address[address], self_test) for address in sorted(by_address)]
    answers = [answer for answer in tried if answer is not None]
    if len(answers) == 1:
        answers = [replace(answers[0], warning="")]
    return ProbedBus(number, "", answers)


def _at(bus: int, address: int, drivers: dict[str, type[FifoSensor]], self_test: bool) -> ProbedAddress | None:
    known: dict[str, FifoSensor] = {}
    identities: list[str] = []
    notes: list[str] = []
    for name, driver in drivers.items():
        sensor = driver(name, driver.options_model.model_validate({"bus": bus, "address": address}))
        try:
            identities.append(sensor.identify())
            known[name] = sensor
        except IdentityError as error:
            notes.append(str(error))
        except ConfigurationError as error:
            return ProbedAddress(address, note=str(error))
        except DeviceLost:
            return None
    if not known:
        return ProbedAddress(address, note="; ".join(notes))
    sensor = next(iter(known.values()))
    result = self_test_result(sensor) if self_test else None
    told = {"used_by": sensor.used_by(), "warning": sensor.must_be_alone}
    return ProbedAddress(address, list(known), " or ".join(identities), **told, self_test=result)


def on_spi(bus: str, drivers: dict[str, type[FifoSensor]], self_test: bool) -> Selected:
    """Ask the device on a chip select as the only one of `drivers` does; with several, do not ask."""
    if len(drivers) > 1:
        known = " or ".join(name for name, driver in drivers.items() if _over_spi(driver))
        return Selected(bus, note=f"not asked, since this could write to another part; name its driver: --bus {bus} "
                        f"--driver {known}")  # fmt: skip
    ((name, driver),) = drivers.items()
    try:
        sensor = driver(name, driver.options_model.model_validate({"bus": bus}))
        identity = sensor.identify()
    except ValidationError as error:
        return Selected(bus, name, note=str(error.errors()[0]["msg"]).removeprefix("Value error, "))
    except DeviceError as error:
        return Selected(bus, name, note=str(error))
    used_by = sensor.used_by()
    return Selected(bus, name, identity, used_by=used_by, self_test=self_test_result(sensor) if self_test else None)


def _over_spi(driver: type[FifoSensor]) -> bool:
    model = driver.options_model
    return issubclass(model, FifoOptions) and model.spi is not None


def self_test_result(sensor: FifoSensor) -> dict[str, Any]:
    """Result of the self-test, for JSON and for the printed lines."""
    try:
        sensor.open()
        return as_object(sensor.self_test())
    except DeviceError as error:
        return {"faults": [str(error)]}
    finally:
        sensor.close()


def as_object(report: SelfTestReport) -> dict[str, Any]:
    """Values of a self-test by axis, in g."""
    return {
        "change_g": report.change_g,
        "low_g": report.test.low_g,
        "high_g": report.test.high_g,
        "noise_g": report.noise_g,
        "data_sheet_noise_g": report.test.noise_g,
        "source": report.test.source,
        "faults": report.faults,
    }


def _print_bus(bus: ProbedBus) -> None:
    if bus.fault:
        say(bus.fault)
        return
    say(f"/dev/i2c-{bus.number}: " + ("" if bus.answers else "no device that a driver recognises"))
    for answer in bus.answers:
        say(f"  0x{answer.address:02X}  {answer.identity or answer.note}")
        if answer.drivers:
            used_by = f", used by {answer.used_by}" if answer.used_by else ""
            say(f"        driver {' or '.join(answer.drivers)}, one register read a transfer as here{used_by}")
        if answer.warning:
            say(f"        warning: other devices answer on this bus; {answer.warning}")
        for line in _self_test_lines(answer.self_test):
            say(f"        {line}")


def _print(buses: list[ProbedBus], selected: list[Selected], ports: list[dict[str, str]], *, named: bool) -> None:
    if not buses and not named:
        say("no I2C bus (no /dev/i2c-N): enable the adapter and load the kernel module i2c-dev")
    for bus in buses:
        _print_bus(bus)
    for one in selected:
        used_by = f", used by {one.used_by}" if one.used_by else ""
        say(f"{one.bus}: {f'{one.identity}, driver {one.driver}{used_by}' if one.identity else one.note}")
        for line in _self_test_lines(one.self_test):
            say(f"        {line}")
    for port in ports:
        known = [text for text in (port["description"], port["serial_number"]) if text not in ("", "n/a")]
        say(f"{port['port']}: serial port, {', '.join(known) or 'of which the system knows nothing more'}")
    if ports:
        say("a port is not opened here; `fieldcal init --sensor-port PORT` listens to it")


def _self_test_lines(result: dict[str, Any] | None) -> Iterator[str]:
    if result is None:
        return
    if "change_g" in result:
        figures = (result[key] for key in ("change_g", "low_g", "high_g", "noise_g", "data_sheet_noise_g"))
        for axis, change, low, high, noise, stated in zip("xyz", *figures, strict=True):
            yield (
                f"{axis}: changes by {change:.3f} g ({low:.3g} to {high:.3g}), "
                f"noise {MICRO * noise:.0f} ug rms (data sheet {MICRO * stated:.0f})"
            )
        yield f"limits: {result['source']}"
    yield "self-test failed: " + "; ".join(result["faults"]) if result["faults"] else "self-test passed"
