"""Replaces the library uldaq, with one board connected, as uldaq 1.2.3 documents it."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from enum import IntEnum
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray


class ULError(IntEnum):
    """Some error codes of the library."""

    DEV_NOT_CONNECTED = 7
    OVERRUN = 18
    BAD_RATE = 22


class ULException(Exception):  # noqa: N818 - the library's name
    """Like the error of the library."""

    def __init__(self, error_code: ULError) -> None:
        super().__init__(error_code)
        self.error_code = error_code

    def __str__(self) -> str:
        return f"{self.error_code!s}: {self.error_code.name}"


class InterfaceType(IntEnum):
    """Connection of a board."""

    ANY = 7


class AiInputMode(IntEnum):
    """Mode of an input."""

    DIFFERENTIAL = 1
    SINGLE_ENDED = 2


class Range(IntEnum):
    """Range of an input."""

    BIP10VOLTS = 5
    BIP5VOLTS = 6
    BIP2VOLTS = 9
    BIP1VOLTS = 11


class ScanOption(IntEnum):
    """Options of a scan."""

    CONTINUOUS = 8


class AInScanFlag(IntEnum):
    """Flags of a scan."""

    DEFAULT = 0


class ScanStatus(IntEnum):
    """Status of a scan."""

    IDLE = 0
    RUNNING = 1


class IepeMode(IntEnum):
    """IEPE mode of an input."""

    DISABLED = 1
    ENABLED = 2


class CouplingMode(IntEnum):
    """Coupling of an input."""

    DC = 1
    AC = 2


class UldaqTwin:
    """Replaces the module. `source(first, n)` returns (n, axes) volts; `samples_due()` how many samples exist now."""

    ULError, ULException, InterfaceType, AiInputMode, Range = ULError, ULException, InterfaceType, AiInputMode, Range
    ScanOption, AInScanFlag, ScanStatus, IepeMode = ScanOption, AInScanFlag, ScanStatus, IepeMode
    CouplingMode = CouplingMode

    def __init__(self, source: Callable[[int, int], NDArray[np.float64]], samples_due: Callable[[], int]) -> None:
        self.source = source
        self.samples_due = samples_due
        self.plugged = True
        self.iepe = True  # whether the board has an IEPE current
        self.ranges = [Range.BIP10VOLTS, Range.BIP1VOLTS]
        self.rate_error = 0.0
        self.fault: ULError | None = None  # fault: the next status request fails with it
        self.ended = False  # fault: the scan stops by itself

    def get_daq_device_inventory(self, interface_type: int) -> list[Any]:
        """Connected boards."""
        assert interface_type == InterfaceType.ANY
        return [SimpleNamespace(product_name="USB-1808X", unique_id="01F2A3B4")] if self.plugged else []

    def DaqDevice(self, descriptor: Any) -> Device:  # noqa: N802, ARG002 - the library's name; there is one board
        """Make the object of the board."""
        return Device(self)

    def create_float_buffer(self, number_of_channels: int, samples_per_channel: int) -> Any:
        """Make a ring buffer."""
        return (ctypes.c_double * (number_of_channels * samples_per_channel))()


class Device:
    """A board, its analog inputs and their configuration."""

    def __init__(self, twin: UldaqTwin) -> None:
        self._twin = twin
        self._ring: Any = None
        self._modes: dict[tuple[str, int], Any] = {}
        self._begun = self._written = 0

    def connect(self) -> None:
        """Connect to the board."""
        self._check()

    def disconnect(self) -> None:
        """Disconnect from the board."""
        self._check()

    def release(self) -> None:
        """Release the board."""

    def get_ai_device(self) -> Device:
        """The analog inputs."""
        return self

    def get_info(self) -> Device:
        """Properties of the analog inputs."""
        return self

    def get_config(self) -> Device:
        """Configuration of the analog inputs."""
        return self

    def get_num_chans_by_mode(self, input_mode: AiInputMode) -> int:
        """Number of inputs."""
        return 8 if input_mode == AiInputMode.DIFFERENTIAL else 16

    def get_ranges(self, input_mode: AiInputMode) -> list[Range]:  # noqa: ARG002 - the same in both modes
        """Ranges that the board has."""
        return self._twin.ranges

    def supports_iepe(self) -> bool:
        """Whether the board has an IEPE current."""
        return self._twin.iepe

    def set_chan_iepe_mode(self, channel: int, mode: IepeMode) -> None:
        """Switch the IEPE current on or off."""
        self._modes["iepe", channel] = mode

    def get_chan_iepe_mode(self, channel: int) -> IepeMode:
        """Whether the IEPE current is on."""
        return IepeMode(self._modes["iepe", channel])

    def set_chan_coupling_mode(self, channel: int, mode: CouplingMode) -> None:
        """Set AC or DC coupling."""
        self._modes["coupling", channel] = mode

    def get_chan_coupling_mode(self, channel: int) -> CouplingMode:
        """Return AC or DC coupling."""
        return CouplingMode(self._modes["coupling", channel])

    def a_in_scan(
        self, low_channel: int, high_channel: int, input_mode: AiInputMode, analog_range: Range,
        samples_per_channel: int, rate: float, options: ScanOption, flags: AInScanFlag, data: Any,
    ) -> float:  # fmt: skip
        """Fill the ring buffer `data` continuously; returns the actual rate, Hz."""
        self._check()
        assert len(data) == samples_per_channel * (high_channel - low_channel + 1)
        assert (options, flags) == (ScanOption.CONTINUOUS, AInScanFlag.DEFAULT)
        assert (AiInputMode(input_mode), Range(analog_range)) is not None
        if rate > 50_000:
            raise ULException(ULError.BAD_RATE)
        self._ring = np.ctypeslib.as_array(data).reshape(samples_per_channel, -1)
        self._begun = self._twin.samples_due()
        self._written = 0
        return rate * (1 + self._twin.rate_error)

    def get_scan_status(self) -> tuple[ScanStatus, Any]:
        """Whether the scan runs, and how many scans were written into the ring buffer."""
        self._check()
        if self._twin.fault is not None:
            fault, self._twin.fault = self._twin.fault, None
            raise ULException(fault)
        self._write()
        status = ScanStatus.IDLE if self._ring is None or self._twin.ended else ScanStatus.RUNNING
        return status, SimpleNamespace(current_scan_count=self._written)

    def scan_stop(self) -> None:
        """Stop the scan."""
        self._check()
        self._ring = None

    def _write(self) -> None:
        if self._ring is None:
            return
        kept, count = len(self._ring), self._twin.samples_due() - self._begun
        first = max(self._written, count - kept)
        scans = np.arange(first, count)
        self._ring[scans % kept] = self._twin.source(self._begun + first, len(scans))
        self._written = count

    def _check(self) -> None:
        if not self._twin.plugged:
            raise ULException(ULError.DEV_NOT_CONNECTED)
