"""Driver `ni`: analog sensors on a device of National Instruments, through nidaqmx and NI-DAQmx.

Names, error codes and meanings as in nidaqmx 1.7.0 (task/, stream_readers/, constants.py, error_codes.py). AC coupling
is a filter of one pole (NI-DAQmx Device Considerations, "Input Coupling"); its corner, and the delay of a delta-sigma
converter, which the library does not take out, stand in the documentation of each device (NI cDAQ-9178 user manual,
"Analog Input"). The driver does not know them, nor which devices have a filter against aliases.
"""

from __future__ import annotations

import contextlib
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, field_validator

from hw.block import DeviceInfo
from hw.buffered_sensor import BUFFER_S, UNKNOWN_COUPLING, BufferedSensor, Indications
from hw.sensor import ConfigurationError, DeviceLost, Options
from hw.vendor_library import vendor_library

MV_PER_V = 1e3
RATE_TOLERANCE = 0.01  # relative; a device uses the nearest rate its clock can make, a larger difference is refused
# Samples were lost: buffer overwritten or full, on-board FIFO overrun (three codes).
OVERRUNS = (-200279, -200222, -200361, -200010, -209829)
AC_ONLY = ("9233", "449")  # parts of the names of devices that are always AC-coupled (NI-DAQmx Device Considerations)
# Device unknown, not accessible or removed, transfer aborted, no device or resource of this name.
LOST = (-200220, -201003, -200045, -50405, -88705, -88708)


class NiOptions(Options):
    """Options of `ni`."""

    channels: tuple[str, ...] = Field(description='physical channels, one or three for x, y, z: ["cDAQ1Mod1/ai0"]')
    rate_hz: float = Field(2048.0, gt=0, le=200_000, description="samples a second")
    range_v: float = Field(5.0, gt=0, le=100, description="largest voltage expected, plus and minus")
    iepe_ma: float | None = Field(
        None, gt=0, le=20, description="supply current of the sensors in mA (IEPE), AC-coupled"
    )
    serial_number: str = Field("", description="of the sensor, as on its label")

    @field_validator("channels")
    @classmethod
    def _check_axes(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if len(value) not in (1, 3):
            raise ValueError(f"1 or 3 channels are needed, not {len(value)}")
        if not all(channel.partition("/")[2] for channel in value):
            raise ValueError(f"each channel must be device/input, as in cDAQ1Mod1/ai0, not {', '.join(value)}")
        return value

    def check_installed(self) -> None:
        """Raises ConfigurationError, with what to install, where the vendor's library is not there."""
        _library()

    @property
    def axis_count(self) -> int:
        """One for each channel."""
        return len(self.channels)

    @property
    def tells_sensitivity(self) -> bool:
        """It tells mV; the sensitivity is that of the sensor behind it."""
        return False

    @property
    def known_filters(self) -> tuple[str, ...]:
        """With IEPE the AC coupling, whose corner is not known; of delay and filters nothing is known."""
        return () if self.iepe_ma is None else (UNKNOWN_COUPLING,)


class Ni(BufferedSensor):
    """In mV, with the calibration of the device applied. The sensitivity of the sensor is applied elsewhere."""

    options_model: ClassVar[type[Options]] = NiOptions

    _task: Any = None
    _reader: Any = None

    def _where(self) -> str:
        return f"NI channels {', '.join(self._options.channels)}"

    def _start(self) -> DeviceInfo:
        options = self._options
        library = _library()
        try:
            self._task = library.Task()
            inputs = [self._input(channel) for channel in options.channels]
            self._full_mv = MV_PER_V * min(found.ai_rng_high for found in inputs)
            self._task.timing.cfg_samp_clk_timing(
                options.rate_hz,
                sample_mode=_library("constants").AcquisitionType.CONTINUOUS,
                samps_per_chan=round(BUFFER_S * options.rate_hz),
            )
            self._reader = _library("stream_readers").AnalogMultiChannelReader(self._task.in_stream)
            self._task.start()
            rate_hz = float(self._task.timing.samp_clk_rate)
            device = _library("system").Device(options.channels[0].partition("/")[0])
            kind, board = device.product_type, f"{device.serial_num:X}"
        except library.DaqError as error:
            lost = error.error_code in LOST
            raise (DeviceLost if lost else ConfigurationError)(f"{self._where()}: {_line(error)}") from error
        except _library("errors").DaqNotFoundError as error:
            raise ConfigurationError(f"driver ni needs NI-DAQmx, which is not installed: {_line(error)}") from error
        if abs(rate_hz - options.rate_hz) > RATE_TOLERANCE * options.rate_hz:
            raise ConfigurationError(
                f"{self._where()}: rate_hz {options.rate_hz:g} is not available, the nearest rate is {rate_hz:g} Hz"
            )
        return DeviceInfo(
            driver="ni",
            kind=kind,
            serial_number=options.serial_number,
            unit="mV",
            axes=len(options.channels),  # type: ignore[arg-type] # 1 or 3
            nominal_rate_hz=rate_hz,
            settings={
                "board": board,
                "channels": ", ".join(options.channels),
                "range_mv": f"{self._full_mv:g}",
                "iepe_ma": str(options.iepe_ma),
            },
            filters=(UNKNOWN_COUPLING,) if any(part in kind for part in AC_ONLY) else options.known_filters,
        )

    def _input(self, channel: str) -> Any:
        """Add a channel, and the supply current for its sensor if `iepe_ma` is set."""
        options, constants = self._options, _library("constants")
        added = self._task.ai_channels.add_ai_voltage_chan(channel, min_val=-options.range_v, max_val=options.range_v)
        if options.iepe_ma is not None:
            added.ai_coupling = constants.Coupling.AC
            added.ai_excit_src = constants.ExcitationSource.INTERNAL
            added.ai_excit_voltage_or_current = constants.ExcitationVoltageOrCurrent.USE_CURRENT
            added.ai_excit_val = options.iepe_ma * 1e-3
        return added

    def _ends(self, info: DeviceInfo) -> tuple[float, float]:  # noqa: ARG002 - read when the channels were set up
        # One step of 16 bit, the coarsest converter, below full scale
        return -self._full_mv, self._full_mv * (1 - 2.0**-15)

    def _stop(self) -> None:
        task, self._task, self._reader = self._task, None, None
        if task is not None:
            with contextlib.suppress(_library().DaqError):
                task.close()

    def _take(self) -> tuple[Indications, bool]:
        axes = len(self._options.channels)
        try:
            n = int(self._task.in_stream.avail_samp_per_chan)
            volts = np.empty((axes, n))
            if n:
                self._reader.read_many_sample(volts, number_of_samples_per_channel=n, timeout=0.0)
        except _library().DaqError as error:
            if error.error_code not in OVERRUNS:
                raise DeviceLost(f"{self._where()}: {_line(error)}") from error
            self._again()
            return np.empty((0, axes)), True
        return MV_PER_V * volts.T, False

    def _again(self) -> None:
        with contextlib.suppress(_library().DaqError):  # stop() may report the same error once more
            self._task.stop()
        try:
            self._task.start()
        except _library().DaqError as error:
            raise DeviceLost(f"{self._where()}: {_line(error)}") from error


def _line(error: Exception) -> str:
    """The error's message on one line; NI-DAQmx writes several lines with empty lines between them."""
    return " ".join(str(error).split())


def _library(part: str = "") -> Any:
    name = f"nidaqmx.{part}" if part else "nidaqmx"
    return vendor_library(name, "ni", "ni", "NI-DAQmx")
