"""What every driver is: the protocol, the tree of errors, and the registry of drivers (built in and entry points)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Any, ClassVar, Protocol, runtime_checkable

from pydantic import BaseModel, ConfigDict

from hw.block import DeviceInfo, SampleBlock

ENTRY_POINT_GROUP = "fieldcal.sensors"


class DeviceError(Exception):
    """Anything a device or its port does wrong. The message names port, address and value."""


class ConfigurationError(DeviceError):
    """The settings cannot work with this device: retrying does not help until somebody changes something."""


class IdentityError(ConfigurationError):
    """Something answers, but it is not the device that was named."""


class DeviceLost(DeviceError):  # noqa: N818 - the state has this name in events and texts
    """The device or its port is gone; the reader closes it and tries again with back-off."""


class Options(BaseModel):
    """Base of every driver's options: unknown keys are refused, values are not changed after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@runtime_checkable
class Sensor(Protocol):
    """A device that yields sample blocks. All methods are called from one reader thread.

    Drivers are built as `Driver(name, options, clock=...)` and do no I/O before `open`.
    """

    options_model: ClassVar[type[Options]]

    def open(self) -> DeviceInfo:
        """Identify, reset, configure, read back. Raises ConfigurationError, IdentityError or DeviceLost."""

    def read_block(self) -> SampleBlock | None:
        """The next block (about 0.5 s of bursts); None when nothing came within about 0.5 s. Raises DeviceLost."""

    def close(self) -> None:
        """Release the port; never raises, may be called twice, a closed sensor can be opened again."""


class DriverFactory(Protocol):
    """What a registry entry must be: a Sensor class."""

    options_model: ClassVar[type[Options]]

    def __call__(self, name: str, options: Any, *, clock: Callable[[], tuple[int, int]] = ...) -> Sensor: ...


BUILT_IN: Mapping[str, str] = {
    "adxl355": "hw.adxl355:Adxl355",
    "serial-csv": "hw.serial_stream:SerialCsv",
}
