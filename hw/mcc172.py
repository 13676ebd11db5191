"""Driver `mcc172`: an analog sensor on an MCC 172 (24 bit, IEPE, on the header of a Raspberry Pi), through daqhats.

Names and meanings as in daqhats 1.4.1 (daqhats/mcc172.py, hats.py): it returns volts unless counts are requested, the
range is +-5 V, the rate is 51.2 kHz divided by 1 to 256, a scan stops when its buffer overflows. The board's filter
delays by 39 samples (a_in_clock, trigger_config), which is a part of the reference's lag. The inputs are AC-coupled:
-3 dB at 0.78 Hz, and at most -0.1 dB at 5.2 Hz (ES MCC 172 rev. 2.1), as a filter of first order has it (-0.097 dB). No
tolerance is printed; 10 % is that of usual capacitors.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator

from hw.block import DeviceInfo
from hw.buffered_sensor import BUFFER_S, BufferedSensor, Indications
from hw.sensor import ConfigurationError, DeviceLost, IdentityError, Options
from hw.vendor_library import vendor_library

BASE_RATE_HZ, DIVIDERS = 51_200.0, range(1, 257)
RATE_TOLERANCE = 1e-3
FILTER_SAMPLES = 39  # by which the board's filter delays
CORNER_HZ, U_CORNER_PCT = 0.78, 10
SYNC_POLL_S, SYNC_POLLS = 0.01, 200  # the converters need 128 periods to synchronise: 0.64 s at the slowest rate
MV_PER_V = 1e3
UNSCALED = 1000.0  # mV per unit: the library then returns volts
INVALID_BOARD = "Invalid board type"


class Mcc172Options(Options):
    """Options of `mcc172`."""

    address: int = Field(0, ge=0, le=7, description="address of the board, as set by its jumpers")
    channel: Literal[0, 1] = Field(0, description="input of the board")
    rate_hz: float = Field(
        3200.0, gt=0, description="51200 divided by a whole number from 1 to 256, e.g. 1600, 3200, 6400"
    )
    iepe: bool = Field(True, description="supply the sensor with constant current (IEPE); false for a voltage source")
    serial_number: str = Field("", description="of the sensor, as on its label")

    @field_validator("rate_hz")
    @classmethod
    def _check_rate(cls, value: float) -> float:
        divider = round(BASE_RATE_HZ / value)
        if divider not in DIVIDERS or abs(BASE_RATE_HZ / divider - value) > RATE_TOLERANCE * value:
            near = BASE_RATE_HZ / min(max(divider, 1), 256)
            raise ValueError(f"{value:g} Hz is not 51200 Hz divided by 1 to 256; the nearest rate is {near:g} Hz")
        return BASE_RATE_HZ / divider

    def check_installed(self) -> None:
        """Raises ConfigurationError, with what to install, where the vendor's library is not there."""
        _library()

    @property
    def axis_count(self) -> int:
        """That of the channel."""
        return 1

    @property
    def tells_sensitivity(self) -> bool:
        """It tells mV; the sensitivity is that of the sensor behind it."""
        return False

    @property
    def known_filters(self) -> tuple[str, ...]:
        """The board's coupling, and the delay of its filter. Of the sensor behind the board nothing is known."""
        coupling = f"highpass corner_hz={CORNER_HZ:g} u_corner_pct={U_CORNER_PCT:g}"
        return coupling, f"delay delay_s={FILTER_SAMPLES / self.rate_hz:.6g}"


class Mcc172(BufferedSensor):
    """One channel in mV, with the calibration of the board applied.

    The sensitivity of the sensor is applied elsewhere.
    """

    options_model: ClassVar[type[Options]] = Mcc172Options

    _board: Any = None

    def _where(self) -> str:
        return f"MCC 172/address {self._options.address}"

    def _start(self) -> DeviceInfo:
        options = self._options
        library = _library()
        try:
            self._board = library.mcc172(options.address)
            settings = self._configure(library)
            self._scan()
        except library.HatError as error:
            raise (IdentityError if INVALID_BOARD in str(error) else DeviceLost)(f"{self._where()}: {error}") from error
        except Exception as error:
            if type(error) is not Exception:  # daqhats raises a plain Exception only if its C library is missing
                raise
            raise ConfigurationError(f"driver mcc172: {error}") from error
        return DeviceInfo(
            driver="mcc172",
            kind="MCC 172",
            serial_number=options.serial_number,
            unit="mV",
            axes=1,
            nominal_rate_hz=options.rate_hz,
            settings=settings,
            filters=options.known_filters,
        )

    def _configure(self, library: Any) -> dict[str, str]:
        """Write the settings of input and clock and read them back."""
        board, options = self._board, self._options
        board.iepe_config_write(options.channel, int(options.iepe))
        board.a_in_sensitivity_write(options.channel, UNSCALED)
        board.a_in_clock_config_write(library.SourceType.LOCAL, options.rate_hz)
        for _ in range(SYNC_POLLS):
            clock = board.a_in_clock_config_read()
            if clock.synchronized:
                break
            self._sleep(SYNC_POLL_S)
        else:
            raise DeviceLost(f"{self._where()}: the converters did not synchronise within {SYNC_POLL_S * SYNC_POLLS} s")
        found = {
            "iepe": (board.iepe_config_read(options.channel), int(options.iepe)),
            "mV per unit": (board.a_in_sensitivity_read(options.channel), UNSCALED),
            "rate_hz": (round(clock.sample_rate_per_channel, 3), round(options.rate_hz, 3)),
        }
        wrong = [f"{name} is {is_:g}, not {wanted:g}" for name, (is_, wanted) in found.items() if is_ != wanted]
        if wrong:
            raise ConfigurationError(f"{self._where()} does not hold its settings: {', '.join(wrong)}")
        return {name: f"{is_:g}" for name, (is_, _) in found.items()} | {
            "channel": str(options.channel),
            "board": board.serial(),
            "board calibrated": board.calibration_date(),
            "firmware": board.firmware_version().version,
        }

    def _scan(self) -> None:
        library, options = _library(), self._options
        kept = round(BUFFER_S * options.rate_hz)
        self._board.a_in_scan_start(1 << options.channel, kept, library.OptionFlags.CONTINUOUS)

    def _ends(self, info: DeviceInfo) -> tuple[float, float]:  # noqa: ARG002 - the same for every board
        known = self._board.info()
        return MV_PER_V * known.AI_MIN_VOLTAGE, MV_PER_V * known.AI_MAX_VOLTAGE

    def _stop(self) -> None:
        board, self._board = self._board, None
        if board is not None:
            _end_scan(board)

    def _take(self) -> tuple[Indications, bool]:
        board = self._board
        try:
            read = board.a_in_scan_read_numpy(-1, 0)
            overrun = read.hardware_overrun or read.buffer_overrun
            if overrun:
                _end_scan(board)
                self._scan()
            elif not read.running:
                raise DeviceLost(f"{self._where()}: the scan stopped")
        except _library().HatError as error:
            raise DeviceLost(f"{self._where()}: {error}") from error
        return MV_PER_V * np.asarray(read.data, np.float64)[:, None], overrun


def _end_scan(board: Any) -> None:
    try:
        board.a_in_scan_stop()
        board.a_in_scan_cleanup()
    except _library().HatError:
        pass  # there was no scan


def _library() -> Any:
    return vendor_library("daqhats", "mcc172", "mcc", "MCC's library libdaqhats")
