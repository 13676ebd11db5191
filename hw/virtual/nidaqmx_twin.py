"""Replaces the library nidaqmx, with one device connected, as nidaqmx 1.7.0 documents it."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

NO_LONGER_AVAILABLE, INVALID_DEVICE_ID, NO_SUCH_CHANNEL, BAD_VALUE = -200279, -200220, -200170, -200077


class DaqNotFoundError(Exception):
    """Like the error of the library."""


class DaqError(Exception):
    """Like the error of the library, whose message has several lines."""

    def __init__(self, message: str, error_code: int) -> None:
        super().__init__(f"{message}\n\nStatus Code: {error_code}")
        self.error_code = error_code


class AcquisitionType(Enum):
    """Whether a task samples a fixed number of times or continuously."""

    FINITE = 10178
    CONTINUOUS = 10123


class Coupling(Enum):
    """Coupling of an input."""

    AC = 10045
    DC = 10050


class ExcitationSource(Enum):
    """Source of the supply current of a sensor."""

    INTERNAL = 10200
    NONE = 10230


class ExcitationVoltageOrCurrent(Enum):
    """Whether a sensor is supplied with a voltage or a current."""

    USE_VOLTAGE = 10322
    USE_CURRENT = 10134


class NidaqmxTwin:
    """Replaces the modules. `source(first, n)` returns (n, channels) volts; `samples_due()` how many samples exist.

    If the buffer overruns, the next read reports it and the task must be started again, like with the library.
    """

    DaqError = DaqError

    def __init__(self, source: Callable[[int, int], NDArray[np.float64]], samples_due: Callable[[], int]) -> None:
        self.source = source
        self.samples_due = samples_due
        self.plugged = True
        self.installed = True  # whether NI-DAQmx itself is installed
        self.rate_error = 0.0
        self.kind = "NI 9234"
        self.task: Task | None = None  # the newest task
        self.modules: dict[str, Any] = {
            "nidaqmx": self,
            "nidaqmx.constants": SimpleNamespace(
                AcquisitionType=AcquisitionType,
                Coupling=Coupling,
                ExcitationSource=ExcitationSource,
                ExcitationVoltageOrCurrent=ExcitationVoltageOrCurrent,
            ),
            "nidaqmx.errors": SimpleNamespace(DaqNotFoundError=DaqNotFoundError),
            "nidaqmx.stream_readers": SimpleNamespace(AnalogMultiChannelReader=Reader),
            "nidaqmx.system": SimpleNamespace(Device=self.device),
        }

    def Task(self) -> Task:  # noqa: N802 - the library's name
        """Make a task."""
        if not self.installed:
            raise DaqNotFoundError("Could not find an installation of NI-DAQmx.")
        self.task = Task(self)
        return self.task

    def device(self, name: str) -> Any:  # noqa: ARG002 - there is only one device
        """Properties of a device."""
        return SimpleNamespace(product_type=self.kind, serial_num=0x1A2B3C)

    def check(self) -> None:
        """Raise DaqError if the device is not connected."""
        if not self.plugged:
            raise DaqError("Device identifier is invalid.", INVALID_DEVICE_ID)


class Task:
    """A task. It is also its own collection of channels, timing and stream, which are separate in the library."""

    def __init__(self, twin: NidaqmxTwin) -> None:
        self.twin = twin
        self.ai_channels = self.timing = self.in_stream = self
        self.inputs: list[Any] = []
        self.samp_clk_rate = 0.0
        self.running = False
        self.closed = False
        self.next = 0

    def add_ai_voltage_chan(self, physical_channel: str, *, min_val: float, max_val: float) -> Any:
        """Add an input; its range is the smallest one that includes `min_val` and `max_val`."""
        self.twin.check()
        if not physical_channel.startswith("cDAQ1Mod1/ai"):
            raise DaqError("Physical channel specified does not exist.", NO_SUCH_CHANNEL)
        assert -min_val == max_val
        self.inputs.append(SimpleNamespace(name=physical_channel, ai_rng_high=5.0 if max_val <= 5.0 else 10.0))
        return self.inputs[-1]

    def cfg_samp_clk_timing(self, rate: float, *, sample_mode: AcquisitionType, samps_per_chan: int) -> None:
        """Set rate and size of the buffer."""
        assert sample_mode is AcquisitionType.CONTINUOUS
        if rate > 51_200:
            raise DaqError("Requested value is not a supported value for this property.", BAD_VALUE)
        self.samp_clk_rate = rate * (1 + self.twin.rate_error)
        self.capacity = max(samps_per_chan, 10_000)  # the library's minimum for a rate of 100 to 10 000 Hz

    def start(self) -> None:
        """Start to keep samples."""
        self.twin.check()
        assert not self.running
        self.running = True
        self.next = self.twin.samples_due()

    def stop(self) -> None:
        """Stop sampling."""
        self.twin.check()
        self.running = False

    def close(self) -> None:
        """Delete the task."""
        self.closed = True

    @property
    def avail_samp_per_chan(self) -> int:
        """Number of samples per channel that can be read."""
        self.twin.check()
        return min(self.twin.samples_due() - self.next, self.capacity) if self.running else 0


class Reader:
    """`stream_readers.AnalogMultiChannelReader`."""

    def __init__(self, task_in_stream: Task) -> None:
        self._task = task_in_stream

    def read_many_sample(
        self, data: NDArray[np.float64], number_of_samples_per_channel: int, timeout: float
    ) -> int:  # fmt: skip
        """Fill `data` (channels, n)."""
        task = self._task
        task.twin.check()
        assert timeout == 0
        assert data.shape == (len(task.inputs), number_of_samples_per_channel)
        if task.twin.samples_due() - task.next > task.capacity:
            raise DaqError("The application is not able to keep up with the hardware.", NO_LONGER_AVAILABLE)
        data[:] = task.twin.source(task.next, number_of_samples_per_channel).T
        task.next += number_of_samples_per_channel
        return number_of_samples_per_channel
