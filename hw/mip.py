"""Driver `mip`: MicroStrain's inertial sensors (3DM-GX, CV, CX, GV, GQ) that speak MIP on a serial or USB port."""

from __future__ import annotations

import contextlib
import struct
from dataclasses import replace
from typing import Any, Literal, Self

import numpy as np
import serial
from pydantic import Field, model_validator

from hw import mip_packets as mip
from hw.block import LARGEST, BlockFlags, DeviceInfo
from hw.cutting import Break, Cutter, follow
from hw.frame_stream import Decoded, FrameStream
from hw.frames import Found, Layout
from hw.sensor import ConfigurationError, DeviceLost, IdentityError
from hw.serial_sensor import BITS_A_BYTE, LONGEST_GAP_S, LOST, AskedSensor, SerialOptions
from hw.units import STANDARD_GRAVITY_MPS2, asked_of_certificate, nominal_sensitivity

PACKET_BYTES = mip.HEADER + mip.FIELD_BYTES[mip.ACCELERATION] + mip.FIELD_BYTES[mip.GPS_TIME] + mip.CHECKSUM
IDLE_ATTEMPTS = 3
ANSWER_TIMEOUT_S = 0.25
ANSWER_WAIT_S = 0.02
ANSWER_ATTEMPTS = 10
LAYOUT = Layout(mip.SYNC, PACKET_BYTES, "fletcher16")


class MipOptions(SerialOptions):
    """Options of `mip`."""

    baud_rate: Literal[9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600] = Field(
        115200, description="as set in the device, which is 115200 at the factory"
    )
    unit: Literal["g"] = Field("g", description="of the indications")
    rate_hz: float = Field(
        100.0, gt=0, le=4000, description="the base rate of the device, which opening tells, or a whole part of it"
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        bits_hz = BITS_A_BYTE * PACKET_BYTES * self.rate_hz
        if bits_hz > self.baud_rate:
            raise ValueError(
                f"port too slow: {self.rate_hz:g} packets/s of {PACKET_BYTES} bytes, {BITS_A_BYTE} bits each, are "
                f"{bits_hz:g} bit/s; baud_rate is only {self.baud_rate}"
            )
        return self

    @property
    def quantity(self) -> str:
        """It indicates accelerations."""
        return "acceleration"

    @property
    def asked_of_certificate(self) -> str:
        """A reference that indicates g has not the sensitivity 1."""
        return asked_of_certificate(self.unit)


class MipStream(FrameStream):
    """A sample is a packet with an acceleration and a time; the times tell how many samples are missing.

    Other packets and fields are skipped. `clock` is the field with the time, as the device has it. `restarted`: the
    time jumped. The samples after that are discarded, because the device may have lost its settings.
    """

    clock = mip.GPS_TIME

    def __init__(self, cutter: Cutter, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        super().__init__(cutter, LAYOUT)

    def begin(self) -> None:
        """Start after a port was opened."""
        super().begin()
        self._last_s: float | None = None
        self.restarted = False

    def _find(self, data: bytes) -> Found:
        return mip.find(data)

    def _decode(self, found: Found) -> Decoded:
        rows, times_s, which = mip.samples(mip.packets(found), self.clock)
        sound = (np.abs(rows) <= LARGEST).all(axis=1) & np.isfinite(times_s)
        rows, times_s, which = rows[sound], times_s[sound], which[sound]
        breaks = self._breaks(times_s)
        if self.restarted:
            rows, which, breaks = rows[:0], which[:0], []
        elif breaks and breaks[-1].flags & BlockFlags.RESTART:
            self.restarted = True
            rows, which, breaks = rows[: breaks[-1].at], which[: breaks[-1].at], breaks[:-1]
        return Decoded(rows, which, breaks)

    def _breaks(self, times_s: np.ndarray) -> list[Break]:
        """Breaks up to the first RESTART."""
        if not len(times_s):
            return []
        before_s = times_s[0] - 1 / self._rate_hz if self._last_s is None else self._last_s
        self._last_s = float(times_s[-1])
        rises_s = np.diff(times_s, prepend=before_s)
        if self.clock == mip.GPS_TIME:
            rises_s %= mip.WEEK_S
        breaks = follow(np.round(rises_s * self._rate_hz), LONGEST_GAP_S * self._rate_hz)
        restart = next((i for i, point in enumerate(breaks) if point.flags & BlockFlags.RESTART), len(breaks))
        return breaks[: restart + 1]


class Mip(AskedSensor):
    """Sets rate and contents of the packets, and reads them back; other streams are turned off.

    The user's bias of the accelerations and the rotation to the frame of a vehicle are set to nothing, and the low-pass
    filter to half the rate. Nothing is saved in the device. What it sends it has corrected with its own calibration.
    """

    options_model = MipOptions
    _stream: MipStream

    def _stop(self) -> None:
        if self._port is not None:
            with contextlib.suppress(*LOST):
                self._port.write(mip.packet(mip.BASE, (mip.IDLE, b"")))
        super()._stop()

    def _build_stream(self, name: str) -> MipStream:
        self._cutter = Cutter(name, self._options.rate_hz)
        return MipStream(self._cutter, self._options.rate_hz)

    def _recognise(self, port: serial.Serial) -> dict[str, Any]:
        port.timeout = ANSWER_TIMEOUT_S
        self._idle(port)
        return {}

    def _set_up(self, port: serial.Serial) -> DeviceInfo:
        timeout, port.timeout = port.timeout, ANSWER_TIMEOUT_S
        self._idle(port)
        told = self._ask(port, mip.BASE, mip.DEVICE_INFO, least=82)
        model, _, number, _, options = (mip.text(told[at : at + 16]) for at in range(2, 82, 16))
        known = self._descriptors(port)
        self._stream.clock = self._clock_field(known)
        generation = mip.generation(known)
        decimation = self._set_format(port, generation)
        corner_hz = self._set_filter(port, generation) if (mip.SENSOR_COMMANDS, generation.low_pass) in known else None
        for command in (mip.ACCELERATION_BIAS, mip.TO_VEHICLE):
            if (mip.SENSOR_COMMANDS, command) in known:
                self._ask(port, mip.SENSOR_COMMANDS, command, bytes([mip.WRITE]) + bytes(12))
        range_g = self._range_g(port) if (mip.SENSOR_COMMANDS, mip.RANGES) in known else None
        self._cutter.highest = np.inf if range_g is None else range_g
        self._cutter.lowest = -self._cutter.highest
        self._stream_on(port, generation, {data_set for data_set, _ in known if data_set >= mip.SENSOR_DATA})
        port.timeout = timeout
        settings = {"firmware": str(int.from_bytes(told[:2], "big")), "options": options, "decimation": str(decimation)}
        settings |= {} if corner_hz is None else {"low-pass": f"{corner_hz:g} Hz"}
        settings |= {} if range_g is None else {"range": f"{range_g:g} g"}
        info = self._info(
            "mip",
            settings,
            kind=model,
            serial_number=number,
            unit=self._options.unit,
            axes=3,
            range_mps2=None if range_g is None else range_g * STANDARD_GRAVITY_MPS2,
            nominal_sensitivity=nominal_sensitivity(self._options.unit),
            filter_settings=tuple({"decimation", "low-pass"} & settings.keys()),
        )
        return info if corner_hz is None else replace(info, filters=(generation.filter_line(corner_hz),))

    def _finish(self) -> None:
        super()._finish()
        if self._stream.restarted and self._loss is None:
            raise DeviceLost(f"{self._where()}: the clock of the sensor jumped (did it lose power?)")

    def _idle(self, port: serial.Serial) -> None:
        """Stop all streams. Raises IdentityError where nothing answers as a MIP device does."""
        heard = b""
        for _ in range(IDLE_ATTEMPTS):
            answer, heard = self._exchange(port, mip.BASE, mip.IDLE)
            if answer is not None:
                return
        said = f"{len(heard)} bytes without an answer" if heard else "nothing"
        raise IdentityError(
            f"{self._where()}: no MIP device at {port.baudrate} baud (received: {said}); check baud_rate"
        )

    def _ask(self, port: serial.Serial, descriptor_set: int, command: int, data: bytes = b"", least: int = 0) -> bytes:
        """The answer to a command, of at least `least` bytes. Raises ConfigurationError, IdentityError."""
        answer, _ = self._exchange(port, descriptor_set, command, data)
        if answer is None:
            raise IdentityError(f"{self._where()}: no answer to command 0x{descriptor_set:02X},0x{command:02X}")
        code, told = answer
        if code or len(told) < least:
            why = mip.REFUSALS.get(code, f"answers {code}") if code else f"answers with {len(told)} bytes"
            raise ConfigurationError(
                f"{self._where()}: command 0x{descriptor_set:02X},0x{command:02X}: the sensor {why}"
            )
        return told

    def _exchange(
        self, port: serial.Serial, descriptor_set: int, command: int, data: bytes = b""
    ) -> tuple[tuple[int, bytes] | None, bytes]:
        """The code and data that answer a command, None where none came in time; and all bytes that came."""
        port.reset_input_buffer()
        port.write(mip.packet(descriptor_set, (command, data)))
        heard = b""
        for _ in range(ANSWER_ATTEMPTS):
            self._sleep(ANSWER_WAIT_S)
            came = port.read(max(1, port.in_waiting))
            heard += came
            answer = mip.answer(heard, descriptor_set, command)
            if answer is not None or not came:
                return answer, heard
        return None, heard

    def _descriptors(self, port: serial.Serial) -> set[tuple[int, int]]:
        """The descriptors that the device knows: commands and data."""
        told = self._ask(port, mip.BASE, mip.DESCRIPTORS)
        known = mip.descriptors(told)
        if (mip.BASE, mip.MORE_DESCRIPTORS) in known:
            known |= mip.descriptors(self._ask(port, mip.BASE, mip.MORE_DESCRIPTORS))
        if (mip.SENSOR_DATA, mip.ACCELERATION) not in known:
            raise IdentityError(f"{self._where()}: this MIP device has no scaled acceleration")
        return known

    def _clock_field(self, known: set[tuple[int, int]]) -> int:
        """The time that never jumps, where the device has it; else the GPS time, which runs without GPS too."""
        for field in (mip.REFERENCE_TIME, mip.GPS_TIME):
            if (mip.SENSOR_DATA, field) in known:
                return field
        raise IdentityError(f"{self._where()}: this MIP device stamps no times (fields 0x12, 0xD5)")

    def _set_format(self, port: serial.Serial, generation: mip.Generation) -> int:
        """Set the contents of the packets and their rate. Returns the decimation."""
        rate_hz: float = self._options.rate_hz
        told = self._ask(port, mip.SENSOR_COMMANDS, generation.base_rate, generation.which, least=2)
        base_hz = int.from_bytes(told[-2:], "big")
        decimation = round(base_hz / rate_hz)
        if decimation * rate_hz != base_hz:
            near = sorted({base_hz // max(1, decimation + i) for i in (0, 1)} | {base_hz})
            raise ConfigurationError(
                f"{self._where()}: rate_hz: {rate_hz:g} is no whole part of the base rate, {base_hz} Hz; use for "
                f"example {', '.join(f'{rate:g}' for rate in near if base_hz % rate == 0)}"
            )
        wanted = struct.pack(">BBHBH", 2, self._stream.clock, decimation, mip.ACCELERATION, decimation)
        format_of = generation.which
        self._ask(port, mip.SENSOR_COMMANDS, generation.format, bytes([mip.WRITE]) + format_of + wanted)
        held = self._ask(port, mip.SENSOR_COMMANDS, generation.format, bytes([mip.READ]) + format_of)
        if held != format_of + wanted:
            raise ConfigurationError(
                f"{self._where()}: the sensor does not hold its message format: {held.hex()}, not "
                f"{(format_of + wanted).hex()}"
            )
        return decimation

    def _set_filter(self, port: serial.Serial, generation: mip.Generation) -> float:
        """Let the low-pass filter follow the rate. Returns its corner, Hz."""
        which = generation.which + bytes([mip.ACCELERATION])
        on = bytes([True, False]) + bytes(generation.frequency_bytes)
        self._ask(port, mip.SENSOR_COMMANDS, generation.low_pass, bytes([mip.WRITE]) + which + on)
        told = self._ask(
            port, mip.SENSOR_COMMANDS, generation.low_pass, bytes([mip.READ]) + which, least=len(which) + 2
        )
        if told[len(which) : len(which) + 2] != on[:2]:
            raise ConfigurationError(f"{self._where()}: the sensor does not hold its low-pass filter: {told.hex()}")
        return float(self._options.rate_hz) / 2

    def _range_g(self, port: serial.Serial) -> float:
        """The range of the accelerometer as it is set, g."""
        told = self._ask(port, mip.SENSOR_COMMANDS, mip.RANGE, bytes([mip.READ, mip.ACCELEROMETER]), least=2)
        ranges = self._ask(port, mip.SENSOR_COMMANDS, mip.RANGES, bytes([mip.ACCELEROMETER]), least=2)
        found = mip.ranges_g(ranges).get(told[1])
        if found is None:
            raise ConfigurationError(f"{self._where()}: the sensor does not tell the range of its setting {told[1]}")
        return found

    def _stream_on(self, port: serial.Serial, generation: mip.Generation, data_sets: set[int]) -> None:
        """Turn off the other streams, turn on this one, and let the device send."""
        for data_set in [*sorted(data_sets - {mip.SENSOR_DATA}), mip.SENSOR_DATA]:
            number, on = generation.stream(data_set), data_set == mip.SENSOR_DATA
            if number is not None:
                self._ask(port, mip.SENSOR_COMMANDS, mip.STREAM, bytes([mip.WRITE, number, on]))
        self._ask(port, mip.BASE, mip.RESUME)
