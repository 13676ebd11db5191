"""Common part of all drivers whose samples wait in the buffer of a library."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags, DeviceInfo
from hw.cutting import Cutter, Stretch
from hw.polling import PollingSensor

BUFFER_S = 1.0  # length of the buffer that a driver asks its library for: fifty polls
# Of a device with IEPE of which nobody knows the corner: data sheets have 0.1 Hz (iba ibaM-4AI-IEPE), 0.78 Hz (MCC 172)
# and 1 Hz; seldom more, such as 3 Hz (ADLINK PCI-9527).
UNKNOWN_COUPLING = "highpass corner_hz=0.6 u_corner_pct=50"
OVERFLOW = "input overflow"

Indications = NDArray[np.int32] | NDArray[np.float64]
Read = tuple[int, int, Indications]
"""Arrival (CLOCK_MONOTONIC) and UTC, both in ns, and the samples."""


class BufferedSensor(PollingSensor):
    """Reads all waiting samples at each poll. Their arrival is the time just before the read.

    If the buffer overflows, it is not known where among the waiting samples the lost ones were. All waiting samples are
    then discarded and the next block carries RESTART and OVERRUN. A subclass finds, starts and reads its device.
    """

    def __init__(self, name: str, options: Any, **timing: Any) -> None:
        super().__init__(name, options, **timing)
        self._cutter = Cutter(name, np.nan)  # the rate is known after `open`
        self._reads: list[Read] = []

    @abstractmethod
    def _take(self) -> tuple[Indications, bool]:
        """Return the waiting samples (n, axes), and whether samples were lost since the last call.

        After a loss the measurement must run again when this method returns. Raises DeviceLost.
        """

    def _ends(self, info: DeviceInfo) -> tuple[float, float]:  # noqa: ARG002 - not every device needs it
        """Lowest and highest indication of the range, in the unit of the indications."""
        return -np.inf, np.inf

    def _temperature(self) -> tuple[int | None, float | None]:
        """Raw value and degC at the end of a block; None where the device has no thermometer."""
        return None, None

    def open(self) -> DeviceInfo:
        """Find the device, set it up and start it. Raises DeviceLost, ConfigurationError or IdentityError."""
        info = super().open()
        self._cutter.nominal_rate_hz = info.nominal_rate_hz
        self._cutter.lowest, self._cutter.highest = self._ends(info)
        self._cutter.flag(BlockFlags.RESTART)
        return info

    def _poll_once(self) -> bool:
        now_ns, utc_ns = self._clock()
        samples, overflowed = self._take()
        if overflowed:
            self._dropped["samples", OVERFLOW] += len(samples)
            self._finish()
            self._cutter.flag(BlockFlags.RESTART | BlockFlags.OVERRUN)
            self._extend()
        elif len(samples):
            self._reads.append((now_ns, utc_ns, samples))
        return True

    def _finish(self) -> None:
        reads, self._reads = self._reads, []
        if not reads:
            return
        arrivals_ns, utc_ns, samples = zip(*reads, strict=True)
        count = np.cumsum([len(part) for part in samples])
        indications = np.ascontiguousarray(np.concatenate(samples))
        stretch = Stretch(indications, np.array(arrivals_ns), count, utc_ns[-1], *self._temperature())
        self._ready.extend(self._cutter.cut(stretch))
