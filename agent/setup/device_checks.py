"""Checks of the devices of a gateway: rights, bus clock, and whether they deliver the samples that they should."""

from __future__ import annotations

import grp
import os
import pwd
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from threading import Thread

from pydantic import ValidationError

from agent.config import Config
from agent.config.devices import Device
from agent.core.events import IN_DRIVER
from agent.setup.buses import bus_clock_khz
from agent.setup.contradictions import place_of
from agent.setup.finding import Finding
from hw.block import BlockFlags
from hw.fifo_options import FifoOptions
from hw.fifo_sensor import FifoSensor
from hw.promises import BlockCheck, as_driver_fault, checked_drops, checked_info
from hw.sensor import AdapterError, DeviceError, Options, Sensor, load_driver, system_clock

RATE_WITHIN = 0.02  # relative; oscillators of MEMS are off by 1 % or less
CPU_SHARE_MAX = 0.5  # of one core, for reading alone
RETURNS_S = 30.0  # s after which a driver that has not returned never will; an opening takes some seconds


def loaded_options(config: Config) -> dict[str, Options]:
    """The options of each device as its driver takes them. The configuration must have passed its check."""
    return {
        device.name: load_driver(device.driver).options_model.model_validate(device.options)
        for device in config.devices
    }


def option_findings(options: Mapping[str, Options]) -> Iterator[Finding]:
    """Which options are not good?"""
    for name, held in options.items():
        for advice in held.advice:
            yield Finding("options", "advice", f"{name}: {advice}")


def sharing_findings(config: Config, options: Mapping[str, Options]) -> Iterator[Finding]:
    """Does a device that must be alone on its bus share it? The device's identity is read where the bus is here."""
    for device in config.devices:
        held = options[device.name]
        if not isinstance(held, FifoOptions) or held.over_spi or not held.must_be_alone:
            continue
        others = [
            name
            for name, other in options.items()
            if isinstance(other, FifoOptions) and other.bus == held.bus and place_of(other) != place_of(held)
        ]
        if not others:
            continue
        sensor = load_driver(device.driver)(device.name, held)
        if not isinstance(sensor, FifoSensor):
            continue
        try:
            identity = sensor.identify()
        except DeviceError:  # `answer_findings` tells it
            identity = "its revision was not read"
        if sensor.must_be_alone:
            says = f"{device.name} shares /dev/i2c-{held.bus} with {' and '.join(others)}: {held.must_be_alone}"
            yield Finding("bus", "advice", f"{says} ({identity})", "give it a bus of its own")


def access_findings(options: Mapping[str, Options]) -> Iterator[Finding]:
    """May this user read and write the devices?"""
    for name, held in options.items():
        if isinstance(held, FifoOptions):
            node = Path(held.node)
        elif isinstance(port := getattr(held, "port", None), str):  # of others it is a number in the network
            node = Path(port)
        else:
            continue
        yield _access(name, node)


def missing_ports(options: Mapping[str, Options]) -> Iterator[Finding]:
    """Which serial ports are not on this machine?"""
    for name, held in options.items():
        if isinstance(port := getattr(held, "port", None), str) and "://" not in port and not Path(port).exists():
            yield _access(name, Path(port))


def _access(name: str, node: Path) -> Finding:
    user = pwd.getpwuid(os.getuid()).pw_name
    try:
        group = grp.getgrgid(node.stat().st_gid).gr_name
    except FileNotFoundError:
        remedy = "connect the device; `fieldcal probe` lists what there is"
        if node.name.startswith("i2c-"):
            remedy = "enable the I2C adapter, and load the kernel module: sudo modprobe i2c-dev"
        elif node.name.startswith("spidev"):
            remedy = "enable the SPI bus (on a Raspberry Pi dtparam=spi=on in config.txt); no kernel driver may hold it"
        return Finding("device", "fault", f"{name}: {node} does not exist", remedy)
    except (OSError, KeyError) as error:
        return Finding("device", "fault", f"{name}: {node}: {error}", "look at its rights with ls -l")
    if not os.access(node, os.R_OK | os.W_OK):
        return Finding(
            "device", "fault", f"{name}: {node}: user {user} may not read and write it",
            f"sudo usermod -aG {group} {user}, then log in anew (or restart the service)",
        )  # fmt: skip
    return Finding("device", "good", f"{name}: {user} may read and write {node}")


def answer_findings(config: Config, options: Mapping[str, Options]) -> Iterator[Finding]:
    """Does each device on an I2C or SPI bus of this machine answer, to transfers as its driver does them?

    Nothing is said of a bus that is not here, and no register is written. A finding of the check `adapter` is one that
    no other device at the address mends.
    """
    for device in config.devices:
        held = options[device.name]
        if not isinstance(held, FifoOptions) or not Path(held.node).exists():
            continue
        try:
            sensor = load_driver(device.driver)(device.name, held)
            if not isinstance(sensor, FifoSensor):
                continue
            identity, used_by = sensor.identify(), sensor.used_by()
        except AdapterError as error:
            yield Finding("adapter", "fault", f"{device.name}: {error}")
        except DeviceError as error:
            remedy = "connect the device, or correct its options; `fieldcal probe` lists what answers"
            yield Finding("device", "fault", f"{device.name}: {error}", remedy)
        except Exception as error:  # a third party's driver may raise anything
            yield _bad_driver(device, as_driver_fault(error))
        else:
            used = f", used by {used_by}" if used_by else ""
            says = f"{device.name}: {identity} answers on {held.node}, one register read a transfer{used}"
            yield Finding("device", "good", says)


def bus_findings(options: Mapping[str, Options], sysfs: Path = Path("/sys")) -> Iterator[Finding]:
    """Is each I2C bus as fast as the configuration says, and fast enough for the rate? (On SPI the driver sets it.)"""
    for name, held in options.items():
        if not isinstance(held, FifoOptions) or isinstance(held.bus, str):
            continue
        clock_khz = bus_clock_khz(held.bus, sysfs)
        if clock_khz is None:
            says = f"{name}: the system does not tell the clock of /dev/i2c-{held.bus}; bus_khz states {held.bus_khz:g}"
            yield Finding("bus", "good", says)
            continue
        remedy = (
            "make the bus faster (on a Raspberry Pi dtparam=i2c_arm_baudrate=400000 in config.txt), or lower rate_hz; "
            f"state bus_khz = {clock_khz:g}, so that `fieldcal check` counts with it"
        )
        try:
            type(held).model_validate(held.model_dump(exclude_unset=True) | {"bus_khz": clock_khz})
        except ValidationError as error:
            says = f"{name}: /dev/i2c-{held.bus} runs at {clock_khz:g} kHz: {error.errors()[0]['msg']}"
            yield Finding("bus", "fault", says.replace("Value error, ", ""), remedy)
            continue
        if clock_khz < held.bus_khz:
            says = f"{name}: /dev/i2c-{held.bus} runs at {clock_khz:g} kHz, bus_khz states {held.bus_khz:g}"
            yield Finding("bus", "advice", says, remedy)
        else:
            yield Finding("bus", "good", f"{name}: /dev/i2c-{held.bus} runs at {clock_khz:g} kHz")


def measured_findings(config: Config, options: Mapping[str, Options], duration_s: float) -> list[Finding]:
    """Read all devices together for some seconds, as the agent does, and compare with their nominal rates."""
    began_s, cpu_s = time.monotonic(), time.process_time()
    found: dict[str, Finding] = {}

    def measure(device: Device) -> None:
        found[device.name] = _measured(device, options[device.name], duration_s)

    threads = [Thread(target=measure, args=[device], daemon=True) for device in config.devices]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, began_s + duration_s + RETURNS_S - time.monotonic()))
    share = (time.process_time() - cpu_s) / (time.monotonic() - began_s)
    findings = [found.get(device.name) or _bad_driver(device, "it does not return") for device in config.devices]
    if share > CPU_SHARE_MAX:
        remedy = "lower rate_hz, or use a faster computer: the estimation needs time too"
        findings.append(Finding("throughput", "advice", f"reading alone needs {share:.0%} of one core", remedy))
    return findings


def rate_finding(device: str, rate_hz: float, nominal_hz: float, losses: str = "") -> Finding:
    """The rate that was measured, compared with the nominal one. `losses`: what was lost meanwhile."""
    says = f"{device}: {rate_hz:.4g} samples a second, nominal {nominal_hz:g}" + (f"; {losses}" if losses else "")
    if losses or not abs(rate_hz - nominal_hz) <= RATE_WITHIN * nominal_hz:
        remedy = "correct rate_hz, make the port or bus faster (baud_rate, bus clock), or stop other programs here"
        return Finding("throughput", "fault", says, remedy)
    return Finding("throughput", "good", says)


def _measured(device: Device, options: Options, duration_s: float) -> Finding:
    try:
        sensor = load_driver(device.driver)(device.name, options)
        try:
            return _read_for(device.name, sensor, duration_s)
        finally:
            sensor.close()
    except DeviceError as error:
        return Finding("throughput", "fault", f"{device.name}: {error}", "connect the device, or correct its options")
    except BaseException as error:  # a third party's driver may raise anything
        return _bad_driver(device, as_driver_fault(error))


def _bad_driver(device: Device, fault: str) -> Finding:
    remedy = "use another version of the driver, and tell its author of the fault"
    return Finding("throughput", "fault", f"{device.name}: {IN_DRIVER} {device.driver!r}: {fault}", remedy)


def _read_for(name: str, sensor: Sensor, duration_s: float) -> Finding:
    samples, overruns, first_ns, last_ns = 0, 0, 0, 0
    opened = system_clock()
    info = checked_info(sensor.open())
    check = BlockCheck(name, info, opened)
    end_s = time.monotonic() + duration_s
    while time.monotonic() < end_s:
        read = sensor.read_block()
        if read is None:
            continue
        block = check.taken(read)
        overruns += bool(block.flags & BlockFlags.OVERRUN)
        last_ns = block.t_monotonic_ns
        if first_ns:  # counting begins after the first block
            samples += block.n
        first_ns = first_ns or last_ns
    lost = [f"{overruns} overruns"] if overruns else []
    lost += [f"{drop.count} {drop.unit}: {drop.reason}" for drop in checked_drops(sensor.take_drops())]
    if last_ns == first_ns:
        remedy = "check its power, its cable and its options"
        return Finding(
            "throughput", "fault", f"{name}: {'; '.join([f'no samples in {duration_s:g} s', *lost])}", remedy
        )
    return rate_finding(name, samples / ((last_ns - first_ns) * 1e-9), info.nominal_rate_hz, "; ".join(lost))
