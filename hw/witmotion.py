"""Driver `witmotion`: WitMotion inertial sensors (WT901, JY901 and similar) on a serial port."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
import serial
from pydantic import Field, model_validator

from hw import witmotion_frames as wit
from hw.block import BlockFlags, DeviceInfo
from hw.cutting import Break, Cutter, follow
from hw.frame_stream import Decoded, FrameStream
from hw.frames import Found, find
from hw.sensor import ConfigurationError, DeviceLost, IdentityError
from hw.serial_sensor import BITS_A_BYTE, LONGEST_GAP_S, SerialOptions, SerialSensor

FRAMES_A_SAMPLE = 2  # time and acceleration
STANDARD_GRAVITY_MPS2 = 9.80665
COMMAND_WAIT_S = 0.02  # WitMotion's own code waits this long between commands
ANSWER_WAIT_S = 0.05
ANSWER_ATTEMPTS = 5
ANSWER_TIMEOUT_S = 0.1


class WitMotionOptions(SerialOptions):
    """Options of `witmotion`."""

    rate_hz: float = Field(100.0, description=f"one of {', '.join(f'{rate:g}' for rate in wit.RATE_CODES)}")
    baud_rate: Literal[9600, 115200, 230400, 921600] = Field(
        115200, description="as set in the device; factory setting: 9600"
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.rate_hz not in wit.RATE_CODES:
            known = ", ".join(f"{rate:g}" for rate in wit.RATE_CODES)
            raise ValueError(f"rate_hz: {self.rate_hz:g} Hz is not a rate of this device; use one of {known}")
        frame_bytes = FRAMES_A_SAMPLE * wit.LAYOUT.length
        bits_hz = BITS_A_BYTE * frame_bytes * self.rate_hz
        if bits_hz > self.baud_rate:
            raise ValueError(
                f"port too slow: {self.rate_hz:g} samples/s of {frame_bytes} bytes, {BITS_A_BYTE} bits each, are "
                f"{bits_hz:g} bit/s; baud_rate is only {self.baud_rate}"
            )
        return self


class WitStream(FrameStream):
    """A sample is a time frame followed by an acceleration frame; the times tell how many samples are missing.

    An acceleration frame that does not follow a time frame is no sample. `restarted`: the device's clock started again.
    The samples after that are discarded, because the device has lost its settings, too.
    """

    def __init__(self, cutter: Cutter, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        super().__init__(cutter, wit.LAYOUT)

    def begin(self) -> None:
        """Start after a port was opened."""
        super().begin()
        self._time_frame: np.ndarray | None = None
        self._last_ms: int | None = None
        self.restarted = False

    def _decode(self, found: Found) -> Decoded:
        waiting = 0 if self._time_frame is None else 1
        frames = found.frames if self._time_frame is None else np.vstack([self._time_frame, found.frames])
        kind = frames[:, 1]
        together = ~found.slipped[1 - waiting : len(found.start)]  # else frames may be missing between the two
        frame = np.flatnonzero((kind[1:] == wit.ACCELERATION) & (kind[:-1] == wit.TIME) & together) + 1
        self._time_frame = frames[-1:] if len(frames) and kind[-1] == wit.TIME else None
        times_ms = wit.milliseconds(frames[frame - 1])
        breaks = self._breaks(times_ms)
        if self.restarted:
            frame, breaks = frame[:0], []
        elif breaks and breaks[-1].flags & BlockFlags.RESTART:
            self.restarted = True
            frame, breaks = frame[: breaks[-1].at], breaks[:-1]
        samples = frames[frame]
        raw_degc = wit.temperature(samples[-1]) if len(samples) else (None, None)
        return Decoded(wit.counts(samples), frame - waiting, breaks, *raw_degc)

    def _breaks(self, times_ms: np.ndarray) -> list[Break]:
        if not len(times_ms):
            return []
        first = times_ms[:1] - round(1e3 / self._rate_hz) if self._last_ms is None else [self._last_ms]
        self._last_ms = int(times_ms[-1])
        breaks = follow(wit.steps(np.concatenate([first, times_ms]), self._rate_hz), LONGEST_GAP_S * self._rate_hz)
        restart = next((i for i, point in enumerate(breaks) if point.flags & BlockFlags.RESTART), len(breaks))
        return breaks[: restart + 1]


class WitMotion(SerialSensor):
    """Sets rate, filter, output content and zero offsets, and reads them back.

    Nothing is saved in the device. After a loss of power it has its saved settings until this driver opens it again.
    """

    options_model = WitMotionOptions
    _stream: WitStream

    def _build_stream(self, name: str) -> WitStream:
        return WitStream(Cutter(name, self._options.rate_hz, *wit.LIMITS), self._options.rate_hz)

    def _set_up(self, port: serial.Serial) -> DeviceInfo:
        timeout, port.timeout = port.timeout, ANSWER_TIMEOUT_S
        wanted = wit.settings(self._options.rate_hz)
        for command in (wit.write(wit.KEY, wit.UNLOCK), *(wit.write(*setting) for setting in wanted.items())):
            port.write(command)
            self._sleep(COMMAND_WAIT_S)
        found = self._registers(port, wit.OUTPUT) | self._registers(port, wit.OFFSET_Y)
        found |= self._registers(port, wit.BANDWIDTH)
        wrong = [
            f"{wit.NAMES[register]} is 0x{found[register]:04X}, not 0x{value:04X}"
            for register, value in wanted.items()
            if found[register] != value
        ]
        if wrong:
            raise ConfigurationError(f"port {port.port}: WitMotion does not hold its settings: {', '.join(wrong)}")
        settings = {wit.NAMES[register]: f"0x{found[register]:04X}" for register in wanted}
        (version, *_) = self._registers(port, wit.VERSION).values()
        number = self._registers(port, wit.NUMBER) | self._registers(port, wit.NUMBER + 2)
        port.timeout = timeout
        return self._info(
            "witmotion",
            settings | {"VERSION": f"0x{version:04X}"},
            kind="WitMotion",
            serial_number=_text(number),
            unit="count",
            axes=3,
            range_mps2=16 * STANDARD_GRAVITY_MPS2,
            nominal_sensitivity=wit.COUNTS_PER_G / STANDARD_GRAVITY_MPS2,
        )

    def _finish(self) -> None:
        super()._finish()
        if self._stream.restarted and self._loss is None:
            raise DeviceLost(f"{self._where()}: the clock of the WitMotion jumped (did it lose power?)")

    def _registers(self, port: serial.Serial, first: int) -> dict[int, int]:
        """Read the four registers from `first` on, by number. Frames that the device sends on its own are skipped."""
        port.reset_input_buffer()
        port.write(wit.ask(first))
        heard = b""
        for _ in range(ANSWER_ATTEMPTS):
            self._sleep(ANSWER_WAIT_S)
            heard += port.read(max(1, port.in_waiting))
            for frame in find(heard, wit.LAYOUT).frames:
                if frame[1] == wit.REGISTERS:
                    return dict(enumerate(wit.words(frame), first))
        said = "nothing" if not heard else f"{len(heard)} bytes without an answer"
        raise IdentityError(
            f"port {port.port}: no WitMotion at {port.baudrate} baud (received: {said}); check baud_rate"
        )


def _text(registers: dict[int, int]) -> str:
    """Decode two characters per register; "" if they are not letters and digits."""
    text = b"".join(value.to_bytes(2, "little") for value in registers.values()).rstrip(b"\0 \xff")
    return text.decode("ascii") if text.isalnum() else ""
