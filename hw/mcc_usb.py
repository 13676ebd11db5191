"""Driver `mcc-usb`: analog sensors on a USB or Ethernet board of MCC, through uldaq (MCC's library for Linux).

Names and meanings as in uldaq 1.2.3 (ai_device.py, ul_structs.py, ul_enums.py): a continuous scan writes into a ring
buffer, and the transfer status counts the scans written so far. This count is the only sign of an overrun. The library
tells neither the delay of a board nor its filters, nor the corner of its AC coupling: they stand in the board's manual.
"""

from __future__ import annotations

import contextlib
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hw.block import DeviceInfo
from hw.buffered_sensor import BUFFER_S, UNKNOWN_COUPLING, BufferedSensor, Indications
from hw.sensor import ConfigurationError, DeviceLost, Options
from hw.vendor_library import vendor_library

MV_PER_V = 1e3
RATE_TOLERANCE = 0.01  # relative; a board uses the nearest rate its clock can make, a larger difference is refused
OVERRUNS = ("OVERRUN", "ADC_OVERRUN", "PACER_OVERRUN", "NET_BUFFER_OVERRUN")
LOST = ("DEV_NOT_FOUND", "DEV_NOT_CONNECTED", "DEAD_DEV", "DEV_UNAVAILABLE", "NO_CONNECTION_ESTABLISHED", "TIMEDOUT")


class MccUsbOptions(Options):
    """Options of `mcc-usb`."""

    device: str = Field(
        "", description="part of the board's product name or unique id; empty if there is only one board"
    )
    first_channel: int = Field(0, ge=0, description="first input")
    axes: Literal[1, 3] = Field(
        1, description="1: first_channel only; 3: first_channel and the next two inputs as x, y, z"
    )
    differential: bool = Field(True, description="else single-ended")
    range_v: Literal[1, 2, 5, 10] = Field(10, description="range, plus and minus; the board must have it")
    rate_hz: float = Field(1000.0, gt=0, le=100_000, description="scans a second")
    iepe: bool = Field(
        False, description="supply the sensors with constant current (IEPE), AC-coupled; the board must be able to"
    )
    serial_number: str = Field("", description="of the sensor, as on its label")

    def check_installed(self) -> None:
        """Raises ConfigurationError, with what to install, where the vendor's library is not there."""
        _library()

    @property
    def axis_count(self) -> int:
        """As stated."""
        return self.axes

    @property
    def tells_sensitivity(self) -> bool:
        """It tells mV; the sensitivity is that of the sensor behind it."""
        return False

    @property
    def known_filters(self) -> tuple[str, ...]:
        """With IEPE the AC coupling, whose corner is not known; of delay and filters nothing is known."""
        return (UNKNOWN_COUPLING,) if self.iepe else ()


class MccUsb(BufferedSensor):
    """In mV, with the calibration of the board applied. The sensitivity of the sensor is applied elsewhere."""

    options_model: ClassVar[type[Options]] = MccUsbOptions

    _device: Any = None
    _ai: Any = None
    _ring: Any = None
    _read = 0

    def _where(self) -> str:
        return f"MCC board/device {self._options.device!r}"

    def _start(self) -> DeviceInfo:
        options = self._options
        library = _library()
        try:
            descriptor = self._find(library)
            self._device = library.DaqDevice(descriptor)
            self._device.connect()
            self._ai = self._device.get_ai_device()
            self._configure(library)
            rate_hz = self._scan()
        except library.ULException as error:
            lost = error.error_code.name in LOST
            raise (DeviceLost if lost else ConfigurationError)(f"{self._where()}: {error}") from error
        if abs(rate_hz - options.rate_hz) > RATE_TOLERANCE * options.rate_hz:
            raise ConfigurationError(
                f"{self._where()}: rate_hz {options.rate_hz:g} is not available, the nearest rate is {rate_hz:g} Hz"
            )
        return DeviceInfo(
            driver="mcc-usb",
            kind=descriptor.product_name,
            serial_number=options.serial_number,
            unit="mV",
            axes=options.axes,
            nominal_rate_hz=rate_hz,
            settings={
                "board": descriptor.unique_id,
                "first_channel": str(options.first_channel),
                "differential": str(options.differential),
                "range_v": str(options.range_v),
                "iepe": str(options.iepe),
            },
            filters=options.known_filters,
        )

    def _find(self, library: Any) -> Any:
        boards = library.get_daq_device_inventory(library.InterfaceType.ANY)
        wanted = self._options.device
        found = [board for board in boards if wanted in board.product_name or wanted in board.unique_id]
        if len(found) != 1:
            known = ", ".join(f"{board.product_name} {board.unique_id}" for board in boards) or "none"
            raise DeviceLost(
                f"{self._where()}: {len(found)} boards have this in their name, one is needed; connected: {known}"
            )
        return found[0]

    def _configure(self, library: Any) -> None:
        """Check that the board can do what the options ask for; switch the sensors' current on or off."""
        info, options = self._ai.get_info(), self._options
        channels = range(options.first_channel, options.first_channel + options.axes)
        there = info.get_num_chans_by_mode(self._mode(library))
        if channels.stop > there:
            raise ConfigurationError(
                f"{self._where()}: there is no input {channels.stop - 1}; in this mode the board has "
                f"{there} inputs, counted from 0"
            )
        known = [found.name for found in info.get_ranges(self._mode(library))]
        if self._range(library).name not in known:
            raise ConfigurationError(
                f"{self._where()}: the board has no range_v {options.range_v}; it has {', '.join(known)}"
            )
        if not info.supports_iepe():
            if options.iepe:
                raise ConfigurationError(f"{self._where()}: iepe = true, but the board has no IEPE current")
            return
        config = self._ai.get_config()
        mode = library.IepeMode.ENABLED if options.iepe else library.IepeMode.DISABLED
        coupling = library.CouplingMode.AC if options.iepe else library.CouplingMode.DC
        for channel in channels:
            config.set_chan_iepe_mode(channel, mode)
            config.set_chan_coupling_mode(channel, coupling)
            if (config.get_chan_iepe_mode(channel), config.get_chan_coupling_mode(channel)) != (mode, coupling):
                raise ConfigurationError(
                    f"{self._where()}: input {channel} does not accept {mode.name}, {coupling.name}"
                )

    def _mode(self, library: Any) -> Any:
        return library.AiInputMode.DIFFERENTIAL if self._options.differential else library.AiInputMode.SINGLE_ENDED

    def _range(self, library: Any) -> Any:
        return library.Range[f"BIP{self._options.range_v}VOLTS"]

    def _scan(self) -> float:
        """Start the scan; returns the actual rate, Hz."""
        library, options = _library(), self._options
        length = 2 * round(BUFFER_S * options.rate_hz)
        self._ring = library.create_float_buffer(options.axes, length)
        self._read = 0
        last = options.first_channel + options.axes - 1
        rate_hz = self._ai.a_in_scan(
            options.first_channel, last, self._mode(library), self._range(library), length, options.rate_hz,
            library.ScanOption.CONTINUOUS, library.AInScanFlag.DEFAULT, self._ring,
        )  # fmt: skip
        return float(rate_hz)

    def _ends(self, info: DeviceInfo) -> tuple[float, float]:  # noqa: ARG002 - the range is the one that was set
        full_mv = MV_PER_V * self._options.range_v
        return -full_mv, full_mv * (1 - 2.0**-15)  # one step of 16 bit, the coarsest converter, below full scale

    def _stop(self) -> None:
        device, self._device, self._ai = self._device, None, None
        if device is None:
            return
        with contextlib.suppress(_library().ULException):
            device.get_ai_device().scan_stop()
        with contextlib.suppress(_library().ULException):
            device.disconnect()
        with contextlib.suppress(_library().ULException):
            device.release()

    def _take(self) -> tuple[Indications, bool]:
        library = _library()
        try:
            status, transfer = self._ai.get_scan_status()
            first, self._read = self._read, transfer.current_scan_count
            samples = self._copied(first, self._read)
            _, after = self._ai.get_scan_status()
            overrun = after.current_scan_count - first > self._capacity
        except library.ULException as error:
            if error.error_code.name not in OVERRUNS:
                raise DeviceLost(f"{self._where()}: {error}") from error
            samples, overrun, status = np.empty((0, self._options.axes)), True, None
        if overrun:
            self._again(library)
        elif status == library.ScanStatus.IDLE:
            raise DeviceLost(f"{self._where()}: the scan stopped")
        return MV_PER_V * samples, overrun

    @property
    def _capacity(self) -> int:
        """Scans that may wait: half the ring, because the library may be writing into the other half."""
        return int(len(self._ring) // self._options.axes // 2)

    def _copied(self, first: int, stop: int) -> NDArray[np.float64]:
        """Copy scans first .. stop - 1; only the newest ones if there are more than `_capacity`."""
        ring = np.ctypeslib.as_array(self._ring).reshape(-1, self._options.axes)
        return np.asarray(ring[np.arange(max(first, stop - self._capacity), stop) % len(ring)])

    def _again(self, library: Any) -> None:
        try:
            self._ai.scan_stop()
            self._scan()
        except library.ULException as error:
            raise DeviceLost(f"{self._where()}: {error}") from error


def _library() -> Any:
    return vendor_library("uldaq", "mcc-usb", "mcc", "MCC's library libuldaq")
