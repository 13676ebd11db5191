"""The protocol that every driver implements, the errors, and the registry of drivers (built in and entry points)."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, ClassVar, Protocol, cast, runtime_checkable

from pydantic import BaseModel, ConfigDict

from hw.block import DeviceInfo, Drop, SampleBlock

ENTRY_POINT_GROUP = "fieldcal.sensors"
# Golden ratio: each poll is later by this part of a sample period, so that polls and samples never beat
GOLDEN = (5**0.5 - 1) / 2

Clock = Callable[[], tuple[int, int]]
"""Returns (CLOCK_MONOTONIC, UTC), both in ns, read directly one after the other."""


class DeviceError(Exception):
    """A fault of a device or its port. The message names port, address and value."""


class ConfigurationError(DeviceError):
    """The settings cannot work with this device.

    A retry does not help until the configuration or the machine is changed.
    """


class AdapterError(ConfigurationError):
    """The adapter of the bus refuses a kind of transfer that this driver needs."""


class IdentityError(ConfigurationError):
    """A device answers, but it is not the configured one."""


class DeviceLost(DeviceError):  # noqa: N818 - the state has this name in events and texts
    """The device or its port is gone. The reader closes it and tries again with increasing delay."""


class Options(BaseModel):
    """Base class of every driver's options: unknown keys are refused, values do not change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def check_installed(self) -> None:
        """Raises ConfigurationError, with what to install, where a library that the driver needs is not there."""

    @property
    def axis_count(self) -> int:
        """How many axes the opened device has, 1 or 3."""
        return 3

    @property
    def tells_sensitivity(self) -> bool:
        """Whether the opened device may tell its sensitivity: by its data sheet, or since it indicates m/s2 or g."""
        return True

    @property
    def tests_itself(self) -> bool:
        """Whether the driver is a SelfTestingSensor (hw.self_test)."""
        return False

    @property
    def asked_of_certificate(self) -> str:
        """What the certificate's sensitivity must state where this device is a reference; "" where 1 may be right."""
        return ""

    @property
    def quantity(self) -> str:
        """What the device measures, "acceleration", "velocity" or "displacement"; "" where the driver does not know."""
        return ""

    @property
    def advice(self) -> tuple[str, ...]:
        """What is not good about these options, each with its remedy. The device works with them all the same."""
        return ()

    @property
    def known_filters(self) -> tuple[str, ...]:
        """The filters of the device as these options set it, as in DeviceInfo; empty where they are not known."""
        return ()


@runtime_checkable
class Sensor(Protocol):
    """A device that returns sample blocks. All methods are called from one reader thread.

    Drivers are built as `Driver(name, options, clock=..., sleep=...)` and do no I/O before `open`. They wait only in
    `sleep` (seconds) or in a read that ends when data arrive, so that a simulated clock can drive them faster than real
    time. The first block after `open` carries RESTART. The sample index continues over `close` and `open` and never
    repeats.
    """

    options_model: ClassVar[type[Options]]

    def open(self) -> DeviceInfo:
        """Identify the device, reset it, write the settings, read them back.

        Raises ConfigurationError, IdentityError or DeviceLost.
        """

    def read_block(self) -> SampleBlock | None:
        """The next block (about 0.5 s of bursts, never empty); None if no sample came in that time.

        Raises DeviceLost, after all samples that were read before the loss have been returned.
        """

    def take_drops(self) -> list[Drop]:
        """Data that could not be used since the last call, one entry per reason; usually empty. Never raises."""

    def close(self) -> None:
        """Release the port. Never raises, may be called twice; a closed sensor can be opened again."""


class DriverFactory(Protocol):
    """What a registry entry must be: a class that implements Sensor."""

    options_model: ClassVar[type[Options]]

    def __call__(
        self, name: str, options: Any, *, clock: Clock = ..., sleep: Callable[[float], None] = ...
    ) -> Sensor: ...


BUILT_IN: Mapping[str, str] = {
    "adxl345": "hw.adxl345:Adxl345",
    "adxl355": "hw.adxl355:Adxl355",
    "adxl357": "hw.adxl355:Adxl357",
    "adxl359": "hw.adxl355:Adxl359",
    "epson": "hw.epson:Epson",
    "icm20948": "hw.icm20948:Icm20948",
    "icm42688": "hw.icm42688:Icm42688",
    "iio": "hw.iio:Iio",
    "lis3dh": "hw.lis3dh:Lis3dh",
    "lsm6dso": "hw.lsm6dso:Lsm6dso",
    "mcc-usb": "hw.mcc_usb:MccUsb",
    "mcc172": "hw.mcc172:Mcc172",
    "mip": "hw.mip:Mip",
    "mqtt": "hw.mqtt:Mqtt",
    "mpu6050": "hw.mpu6050:Mpu6050",
    "ni": "hw.ni_daqmx:Ni",
    "seedlink": "hw.seedlink:Seedlink",
    "serial-binary": "hw.serial_binary:SerialBinary",
    "serial-csv": "hw.serial_stream:SerialCsv",
    "shake-udp": "hw.shake_udp:ShakeUdp",
    "sound-card": "hw.sound_card:SoundCard",
    "virtual": "hw.virtual.device:Virtual",
    "witmotion": "hw.witmotion:WitMotion",
}


def driver_names() -> list[str]:
    """Names of all drivers, built in and installed as plug-ins, sorted. Imports no driver."""
    return sorted({*BUILT_IN, *(entry.name for entry in entry_points(group=ENTRY_POINT_GROUP))})


def load_driver(name: str) -> DriverFactory:
    """Import the driver of this name. A plug-in cannot replace a built-in driver.

    Raises ConfigurationError if no driver has this name, or if a plug-in cannot be imported or is not a sensor class.
    """
    if name in BUILT_IN:
        entry = EntryPoint(name, BUILT_IN[name], ENTRY_POINT_GROUP)
    else:
        found = list(entry_points(group=ENTRY_POINT_GROUP, name=name))
        if not found:
            raise ConfigurationError(_unknown(name))
        entry = found[0]
    try:
        driver = entry.load()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a plug-in may raise anything while it is imported, also SystemExit
        raise ConfigurationError(f"driver {name!r} ({entry.value}) cannot be loaded: {error!r}") from error
    model = getattr(driver, "options_model", None)
    if not (callable(driver) and isinstance(model, type) and issubclass(model, Options)):
        raise ConfigurationError(f"driver {name!r} ({entry.value}) is not a sensor class with an options_model")
    return cast(DriverFactory, driver)


def _unknown(name: str) -> str:
    import difflib

    names = driver_names()
    near = difflib.get_close_matches(name.lower(), names, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return f"no driver {name!r}: {hint}available drivers: {', '.join(names)}"


def system_clock() -> tuple[int, int]:
    """CLOCK_MONOTONIC and UTC of this machine, ns."""
    return time.monotonic_ns(), time.time_ns()


@functools.cache
def boot_id() -> str:
    """Identifier of this boot from the kernel; CLOCK_MONOTONIC counts from this boot."""
    return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
