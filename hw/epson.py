"""Driver `epson`: Epson's accelerometers M-A352, M-A552AR and vibration sensors M-A342, M-A542VR on a UART."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any, Literal, Self

import numpy as np
import serial
from numpy.typing import NDArray
from pydantic import Field, model_validator

from hw import epson_frames as epson
from hw.block import BlockFlags, DeviceInfo
from hw.cutting import Break, Cutter, follow
from hw.frame_stream import Decoded, FrameStream
from hw.frames import Found
from hw.sensor import ConfigurationError, DeviceLost, IdentityError
from hw.serial_sensor import BITS_A_BYTE, LONGEST_GAP_S, LOST, AskedSensor, SerialOptions
from hw.unchecked_frames import UncheckedFrames
from hw.units import STANDARD_GRAVITY_MPS2, asked_of_certificate, nominal_sensitivity

COMMAND_WAIT_S = 0.001  # the data sheet asks for 0.66 ms at 115200 baud
STOP_WAIT_S = 0.2  # Epson's own code waits this long for the last sample
STOP_ATTEMPTS = 5
ANSWER_TIMEOUT_S = 0.1
READY_S = 1.2  # after power-on; the data sheet has 0.9 s
SETTING_S = 0.3  # for another filter 4 ms, for another output of an M-A342 0.12 s
POLL_S = 0.02


class EpsonOptions(SerialOptions):
    """Options of `epson`."""

    baud_rate: Literal[115200, 230400, 460800, 921600] = Field(
        460800, description="as set in the device, which is 460800 at the factory; 921600: M-A342 alone"
    )
    unit: Literal["g", "m/s"] = Field(
        "g", description="g: acceleration (M-A352, M-A552AR); m/s: velocity (M-A342, M-A542VR)"
    )
    rate_hz: float = Field(
        200.0, description=f"1000, 500, 200, 100 or 50; of velocities {epson.VELOCITY_HZ:g}, and no other"
    )
    filter: str | None = Field(
        None,
        description="of accelerations: taps and corner in Hz, as k512_fc60; the default has 512 taps and the highest "
        "corner that the rate allows",
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.unit == "m/s":
            if self.rate_hz != epson.VELOCITY_HZ or self.filter is not None:
                raise ValueError(f"unit m/s: velocities come at {epson.VELOCITY_HZ:g} Hz, without a choice of filter")
        elif self.rate_hz not in epson.RATE_CODES:
            known = ", ".join(f"{rate:g}" for rate in epson.RATE_CODES)
            raise ValueError(f"rate_hz: {self.rate_hz:g} Hz is not a rate of this device; use one of {known}")
        elif self.filter is not None and self.filter not in self.valid_filters:
            raise ValueError(
                f"filter: {self.filter!r} does not go with {self.rate_hz:g} Hz; use one of "
                f"{', '.join(self.valid_filters)}"
            )
        frame_bytes = self.output.layout.length
        bits_hz = BITS_A_BYTE * frame_bytes * self.rate_hz
        if bits_hz > self.baud_rate:
            raise ValueError(
                f"port too slow: {self.rate_hz:g} frames/s of {frame_bytes} bytes, {BITS_A_BYTE} bits each, are "
                f"{bits_hz:g} bit/s; baud_rate is only {self.baud_rate}"
            )
        return self

    @property
    def output(self) -> epson.Output:
        """What the device sends."""
        return epson.VELOCITY if self.unit == "m/s" else epson.ACCELERATION

    @property
    def valid_filters(self) -> list[str]:
        """Filters that go with the rate."""
        return [name for name, slowest_hz in epson.SLOWEST_HZ.items() if slowest_hz <= self.rate_hz]

    @property
    def used_filter(self) -> str:
        """The filter of accelerations; "" of velocities."""
        return self.filter or epson.USUAL_FILTERS.get(self.rate_hz, "")

    @property
    def quantity(self) -> str:
        """As the unit says."""
        return "velocity" if self.unit == "m/s" else "acceleration"

    @property
    def known_filters(self) -> tuple[str, ...]:
        """The delay of the filter. The data sheet draws its response and tells no number; of velocities it is not
        known."""
        return () if self.unit == "m/s" else (f"delay delay_s={epson.filter_delay_s(self.used_filter):g}",)

    @property
    def tells_sensitivity(self) -> bool:
        """Whether it measures an acceleration."""
        return self.unit == "g"

    @property
    def asked_of_certificate(self) -> str:
        """A reference that indicates g has not the sensitivity 1."""
        return asked_of_certificate(self.unit)


class EpsonStream(FrameStream):
    """One sample a frame; the sample counter tells how many are missing.

    `failed`: the device told an error (EA). Samples from there on are discarded. After a pause of this program in which
    the counter may have wrapped around, missing samples cannot be counted: RESTART.
    """

    def __init__(self, cutter: Cutter, options: EpsonOptions) -> None:
        self._output = options.output
        self._rate_hz = options.rate_hz
        super().__init__(cutter, options.output.layout)

    def begin(self) -> None:
        """Start after a port was opened."""
        super().begin()
        self._last: int | None = None
        self._step = round(epson.COUNTS_HZ / self._rate_hz) if self._output is epson.ACCELERATION else 0
        self._unchecked = UncheckedFrames(self._layout, self._count)
        self._arrival_ns: int | None = None
        self._paused = False
        self.failed = False

    def feed(self, data: bytes, arrival_ns: int, utc_ns: int) -> None:
        """Add one burst (`data`) and its arrival time, ns."""
        before_ns, self._arrival_ns = self._arrival_ns, arrival_ns
        self._paused |= before_ns is not None and arrival_ns - before_ns > LONGEST_GAP_S * 1e9
        super().feed(data, arrival_ns, utc_ns)

    def _count(self, frames: NDArray[np.uint8]) -> NDArray[np.uint16]:
        return epson.counts(frames, self._output)

    def _find(self, data: bytes) -> Found:
        return super()._find(data) if self._output is epson.ACCELERATION else self._unchecked.find(data)

    def _decode(self, found: Found) -> Decoded:
        frames = found.frames
        accelerations = self._output is epson.ACCELERATION
        if accelerations and (wrong := epson.faulty(frames)).any():
            self.failed, frames = True, frames[: int(wrong.argmax())]
        raw_degc = epson.temperature(frames[-1]) if accelerations and len(frames) else (None, None)
        indications = epson.indications(frames, self._output)
        return Decoded(indications, np.arange(len(frames)), self._breaks(self._count(frames)), *raw_degc)

    def _breaks(self, counts: NDArray[np.uint16]) -> list[Break]:
        if not len(counts):
            return []
        before = int(counts[0]) if self._last is None else self._last
        rises = np.asarray(np.diff(counts.astype(np.int64), prepend=before), np.int64) % 65536
        if not self._step and len(rises) > 1:
            values, n = np.unique(rises[1:], return_counts=True)
            self._step = int(values[n.argmax()])
        steps, others = np.divmod(rises, max(1, self._step))
        steps[others > 0] = 0  # no whole number of samples: the counter began anew
        if self._last is None:
            steps[0] = 1
        self._last = int(counts[-1])
        paused, self._paused = self._paused, False
        breaks = follow(steps, LONGEST_GAP_S * self._rate_hz)
        return [Break(point.at, BlockFlags.RESTART) for point in breaks] if paused else breaks


class Epson(AskedSensor):
    """Sets rate, filter and the contents of frames, and reads them back; then the device sends by itself.

    User offsets are set to zero, and the limits at which values end to 15 g. Nothing is saved in the device: after a
    loss of power it has its saved settings until this driver opens it again. While it sends, its registers cannot be
    read.
    """

    options_model = EpsonOptions
    _stream: EpsonStream

    def _stop(self) -> None:
        if self._port is not None:
            with contextlib.suppress(*LOST):
                self._write(self._port, *epson.MODE, high=epson.STOP)
        super()._stop()

    def _build_stream(self, name: str) -> EpsonStream:
        output = self._options.output
        limits = -output.highest / output.scale, output.highest / output.scale
        return EpsonStream(Cutter(name, self._options.rate_hz, *limits), self._options)

    def _recognise(self, port: serial.Serial) -> dict[str, Any]:
        port.timeout = ANSWER_TIMEOUT_S
        product = self._product(port)
        if product.startswith(epson.VELOCITY.products):
            return {"unit": "m/s", "rate_hz": epson.VELOCITY_HZ}
        return {"unit": "g"}

    def _set_up(self, port: serial.Serial) -> DeviceInfo:
        options, output = self._options, self._options.output
        timeout, port.timeout = port.timeout, ANSWER_TIMEOUT_S
        product = self._product(port)
        if not product.startswith(output.products):
            raise IdentityError(
                f"{self._where()}: M-{product} does not send {options.unit}; correct unit, or connect an "
                f"M-{' or M-'.join(output.products)}"
            )
        if (found := self._read(port, epson.DIAGNOSIS)) & epson.HARDWARE_ERRORS:
            raise ConfigurationError(f"{self._where()}: M-{product} reports a hardware error (DIAG_STAT 0x{found:04X})")
        read = self._settle(port, epson.settings(output, options.rate_hz, options.used_filter))
        number = epson.text([self._read(port, register) for register in epson.SERIAL_NUMBER])
        version = self._read(port, epson.VERSION)
        self._write(port, *epson.MODE, high=epson.START)
        port.timeout = timeout
        return self._info(
            "epson",
            {epson.NAMES[register]: f"0x{value:04X}" for register, value in read.items()}
            | {"VERSION": f"{version:04X}"},
            kind=f"M-{product}",
            serial_number=number,
            unit=options.unit,
            axes=3,
            range_mps2=epson.RANGE_G * STANDARD_GRAVITY_MPS2 if options.unit == "g" else None,
            nominal_sensitivity=nominal_sensitivity(options.unit),
            filter_settings=(epson.NAMES[epson.SAMPLING], epson.NAMES[epson.FILTER]),
        )

    def _finish(self) -> None:
        super()._finish()
        if self._stream.failed and self._loss is None:
            raise DeviceLost(f"{self._where()}: the sensor reports an error (flag EA)")

    def _product(self, port: serial.Serial) -> str:
        """Stop the device and read its product ID. Raises IdentityError."""
        heard = b""
        for _ in range(STOP_ATTEMPTS):
            port.write(epson.END)  # ends what another program may have begun
            self._write(port, *epson.MODE, high=epson.STOP)
            self._sleep(STOP_WAIT_S)
            heard = port.read(port.in_waiting)
            with contextlib.suppress(IdentityError):
                if self._read(port, epson.IDENTITY) == epson.IDENTITY_VALUE:
                    break
        else:
            said = f"{len(heard)} bytes without an answer" if heard else "nothing"
            raise IdentityError(
                f"{self._where()}: no Epson sensor at {port.baudrate} baud (received: {said}); check baud_rate"
            )
        self._until_clear(port, epson.GLOBAL, epson.NOT_READY, READY_S)
        return epson.text([self._read(port, register) for register in epson.PRODUCT])

    def _settle(self, port: serial.Serial, wanted: Mapping[tuple[int, int], int]) -> dict[tuple[int, int], int]:
        """Write the settings and return them as read back. Raises ConfigurationError where one does not hold."""
        for register, value in wanted.items():
            self._write(port, *register, low=value & 0xFF, high=value >> 8 if register != epson.UART else None)
        self._until_clear(port, epson.SIGNAL, epson.OUTPUT_BUSY, SETTING_S)
        if epson.FILTER in wanted:
            self._until_clear(port, epson.FILTER, epson.FILTER_BUSY, SETTING_S)
        read = {register: self._read(port, register) for register in wanted}
        read[epson.UART] &= 0xFF
        wrong = [
            f"{epson.NAMES[register]} is 0x{read[register]:04X}, not 0x{value:04X}"
            for register, value in wanted.items()
            if read[register] != value
        ]
        if wrong:
            raise ConfigurationError(f"{self._where()}: the sensor does not hold its settings: {', '.join(wrong)}")
        return read

    def _until_clear(self, port: serial.Serial, register: tuple[int, int], busy: int, longest_s: float) -> None:
        """Wait until no bit of `busy` is set."""
        for _ in range(round(longest_s / POLL_S)):
            if not self._read(port, register) & busy:
                return
            self._sleep(POLL_S)
        raise ConfigurationError(f"{self._where()}: the sensor is not ready {longest_s:g} s after a command")

    def _write(
        self, port: serial.Serial, window: int, address: int, low: int | None = None, high: int | None = None
    ) -> None:
        commands = [epson.write(epson.WINDOW_AT, window)]
        commands += [epson.write(address + i, value) for i, value in enumerate((low, high)) if value is not None]
        for command in commands:
            port.write(command)
            self._sleep(COMMAND_WAIT_S)

    def _read(self, port: serial.Serial, register: tuple[int, int]) -> int:
        """The value of a register. Raises IdentityError where the device does not answer."""
        window, address = register
        self._write(port, window, address)
        port.reset_input_buffer()
        port.write(epson.ask(address))
        self._sleep(COMMAND_WAIT_S)
        found = epson.answer(port.read(4), address)
        if found is None:
            raise IdentityError(f"{self._where()}: the sensor does not answer for register 0x{address:02X}")
        return found
