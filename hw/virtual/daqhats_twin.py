"""Replaces the library daqhats, with one MCC 172 connected, as daqhats 1.4.1 documents it."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

SYNC_READS = 3  # number of clock reads before the converters are synchronised

Info = namedtuple("Info", ["AI_MIN_VOLTAGE", "AI_MAX_VOLTAGE"])
Clock = namedtuple("Clock", ["clock_source", "sample_rate_per_channel", "synchronized"])
Version = namedtuple("Version", ["version"])
ScanRead = namedtuple("ScanRead", ["running", "hardware_overrun", "buffer_overrun", "triggered", "timeout", "data"])


class HatError(Exception):
    """Like the error of the library."""

    def __init__(self, address: int, value: str) -> None:
        super().__init__(value)
        self.address = address
        self.value = value

    def __str__(self) -> str:
        return f"Addr {self.address}: {self.value}"


class SourceType(IntEnum):
    """Clock source."""

    LOCAL = 0


class OptionFlags(IntEnum):
    """Options of a scan."""

    DEFAULT = 0x0000
    CONTINUOUS = 0x0010


class DaqhatsTwin:
    """Replaces the module. `source(first, n)` returns (n,) volts; `samples_due()` the number of samples that exist now.

    A scan whose buffer overflows stops and the next read reports the overrun, like with the board.
    """

    HatError, SourceType, OptionFlags = HatError, SourceType, OptionFlags

    def __init__(self, source: Callable[[int, int], NDArray[np.float64]], samples_due: Callable[[], int]) -> None:
        self.source = source
        self.samples_due = samples_due
        self.present = {0: "MCC 172"}  # kind of board by address
        self.stuck: dict[str, Any] = {}  # fault: value that is read back instead of the written one, by setting
        self.hardware_overrun = False  # fault: the next read reports an overrun
        self.next = 0

    def mcc172(self, address: int = 0) -> Board:
        """Open the board."""
        kind = self.present.get(address)
        if kind is None:
            raise HatError(address, "Board not responding.")
        if kind != "MCC 172":
            raise HatError(address, "Invalid board type.")
        return Board(self, address)


class Board:
    """Replaces the object that `mcc172(address)` returns."""

    def __init__(self, twin: DaqhatsTwin, address: int) -> None:
        self._twin = twin
        self._address = address
        self._iepe = [0, 0]
        self._mv_per_unit = [1000.0, 1000.0]
        self._rate_hz = 51_200.0
        self._reads = 0
        self._capacity = 0

    def info(self) -> Info:
        """Lowest and highest voltage."""
        return Info(-5.0, 5.0 - 10.0 / 16_777_216)

    def serial(self) -> str:
        """Serial number of the board."""
        return "01ABCDEF"

    def calibration_date(self) -> str:
        """Calibration date of the board."""
        return "2026-02-03"

    def firmware_version(self) -> Version:
        """Firmware version of the board."""
        return Version("1.03")

    def iepe_config_write(self, channel: int, mode: int) -> None:
        """Switch the IEPE current on or off."""
        self._iepe[channel] = mode

    def iepe_config_read(self, channel: int) -> int:
        """Whether the IEPE current is on."""
        return int(self._twin.stuck.get("iepe", self._iepe[channel]))

    def a_in_sensitivity_write(self, channel: int, value: float) -> None:
        """Set mV per unit."""
        self._mv_per_unit[channel] = value

    def a_in_sensitivity_read(self, channel: int) -> float:
        """Return mV per unit."""
        return self._mv_per_unit[channel]

    def a_in_clock_config_write(self, clock_source: SourceType, sample_rate_per_channel: float) -> None:
        """Set the nearest possible rate."""
        assert clock_source == SourceType.LOCAL
        divider = int(51_200.0 / sample_rate_per_channel + 0.5)
        self._rate_hz = 51_200.0 / min(max(divider, 1), 256)
        self._reads = 0

    def a_in_clock_config_read(self) -> Clock:
        """Clock source, rate, and whether the converters are synchronised."""
        self._reads += 1
        synchronized = self._reads >= self._twin.stuck.get("sync", SYNC_READS)
        return Clock(SourceType.LOCAL, self._rate_hz, synchronized)

    def a_in_scan_start(self, channel_mask: int, samples_per_channel: int, options: int) -> None:
        """Start to keep samples."""
        if self._capacity:
            raise HatError(self._address, "A scan is already active.")
        assert channel_mask in (1, 2)
        assert options == OptionFlags.CONTINUOUS
        least = 1_000 if self._rate_hz <= 1_024 else 10_000 if self._rate_hz <= 10_240 else 100_000
        self._capacity = max(least, samples_per_channel)
        self._twin.next = self._twin.samples_due()

    def a_in_scan_read_numpy(self, samples_per_channel: int, timeout: float) -> ScanRead:
        """All samples that exist and were not read yet."""
        assert (samples_per_channel, timeout) == (-1, 0)
        twin = self._twin
        if self._address not in twin.present:
            raise HatError(self._address, "Incorrect response -7.")
        if not self._capacity:
            raise HatError(self._address, "Scan not active.")
        first, due = twin.next, twin.samples_due()
        kept = min(due - first, self._capacity)
        over = due - first > kept
        twin.next = first + kept
        hardware, twin.hardware_overrun = twin.hardware_overrun, False
        return ScanRead(not (over or hardware), hardware, over, True, False, twin.source(first, kept))

    def a_in_scan_stop(self) -> None:
        """Stop the scan."""

    def a_in_scan_cleanup(self) -> None:
        """Release the buffer."""
        self._capacity = 0
