"""Driver `serial-binary`: a device that sends one sample per frame; the configuration describes the frame."""

from __future__ import annotations

import math
import re
from typing import Self, cast

import numpy as np
import serial
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from hw.block import LARGEST, BlockFlags, DeviceInfo
from hw.cutting import Break, Cutter, follow
from hw.frame_stream import Decoded, FrameStream
from hw.frames import WIDTH, ByteOrder, ChecksumName, Found, Layout, NumberType, numbers
from hw.sensor import DeviceLost
from hw.serial_sensor import BITS_A_BYTE, LONGEST_GAP_S, Filters, SerialOptions, SerialSensor
from hw.unchecked_frames import UncheckedFrames
from hw.units import Unit, asked_of_certificate, nominal_sensitivity, tells_sensitivity

UNDECIDED_S = 5.0  # frames of this time must tell which place in the stream is theirs


class Number(BaseModel):
    """A number in a frame."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    at: int = Field(ge=0, description="position of its first byte in the frame, counted from 0")
    type: NumberType

    @property
    def end(self) -> int:
        """Position after the last byte of the number."""
        return self.at + WIDTH[self.type]


class Thermometer(Number):
    """The device's temperature: degC = zero_degc + number / counts_per_degc."""

    counts_per_degc: float = Field(1.0, description="counts per degree; negative if the counts fall with temperature")
    zero_degc: float = Field(0.0, description="degC at 0 counts")


class SerialBinaryOptions(SerialOptions):
    """Options of `serial-binary`."""

    rate_hz: float = Field(gt=0, le=100_000, allow_inf_nan=False, description="nominal rate of the samples")
    start: str = Field(description='first bytes of every frame, hexadecimal, e.g. "aa55"')
    end: str = Field("", description='last bytes of every frame, after the checksum, hexadecimal, e.g. "0d"')
    length: int = Field(ge=3, le=256, description="bytes of a frame, from the first of start to the last of end")
    byte_order: ByteOrder = Field("little", description="of all numbers")
    indications: tuple[Number, ...] = Field(description="x, y, z, or a single one: [{at = 4, type = 'i16'}, ...]")
    sequence: Number | None = Field(None, description="a sample counter; without it lost frames are not noticed")
    temperature: Thermometer | None = Field(None, description="temperature of the device")
    checksum: ChecksumName = Field("none", description="kind of checksum, in the last bytes before end")
    checksum_from: int = Field(0, ge=0, description="first byte that the checksum covers")
    checksum_order: ByteOrder = Field(
        "little", description="byte order of a checksum of two bytes, and of the words that sum16 adds"
    )
    unit: Unit = Field("count", description="of the indications")
    full_scale: float | None = Field(None, gt=0, description="indications of this size or more are saturated")
    serial_number: str = Field("", description="of the device, as on its label")
    filters: Filters = ()

    @field_validator("start", "end")
    @classmethod
    def _is_bytes(cls, value: str, info: ValidationInfo) -> str:
        least = 1 if info.field_name == "start" else 0
        if not re.fullmatch(f"([0-9a-fA-F]{{2}}){{{least},8}}", value):
            raise ValueError(f"{least} to 8 bytes of two hexadecimal digits each, as in aa55")
        return value

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.temperature is not None and self.temperature.counts_per_degc == 0:
            raise ValueError("temperature.counts_per_degc: 0 counts per degree is not possible")
        if len(self.indications) not in (1, 3):
            raise ValueError(f"indications: 1 or 3 numbers are needed, not {len(self.indications)}")
        covered = self.layout.body
        if covered < max(len(self.layout.start), self.checksum_from + 1):
            raise ValueError(f"length: {self.length} bytes are too few for start, checksum and end")
        if self.checksum == "sum16" and (covered - self.checksum_from) % 2:
            raise ValueError(
                f"checksum: sum16 adds words of two bytes, but bytes {self.checksum_from} to {covered - 1} are an odd "
                "number of bytes; correct checksum_from or length"
            )
        for number in (*self.indications, self.sequence, self.temperature):
            if number is not None and number.end > covered:
                raise ValueError(
                    f"the {number.type} at {number.at} ends at byte {number.end}; "
                    f"in a frame of {self.length} bytes numbers must end at {covered} or before"
                )
        if self.sequence is not None and self.sequence.type not in ("u8", "u16", "u32"):
            raise ValueError(f"sequence: type must be u8, u16 or u32, not {self.sequence.type}")
        bits_hz = BITS_A_BYTE * self.length * self.rate_hz
        if bits_hz > self.baud_rate:
            raise ValueError(
                f"port too slow: {self.rate_hz:g} frames/s of {self.length} bytes, {BITS_A_BYTE} bits each, are "
                f"{bits_hz:g} bit/s; baud_rate is only {self.baud_rate}"
            )
        return self

    @property
    def axis_count(self) -> int:
        """One for each number of a frame."""
        return len(self.indications)

    @property
    def known_filters(self) -> tuple[str, ...]:
        """As the user states them."""
        return self.filters

    @property
    def tells_sensitivity(self) -> bool:
        """Whether it indicates m/s2 or g: nothing else is known of such a device."""
        return tells_sensitivity(self.unit)

    @property
    def asked_of_certificate(self) -> str:
        """A reference that indicates g has not the sensitivity 1."""
        return asked_of_certificate(self.unit)

    @property
    def layout(self) -> Layout:
        """Layout for `hw.frames.find`."""
        start, end = bytes.fromhex(self.start), bytes.fromhex(self.end)
        return Layout(start, self.length, self.checksum, self.checksum_from, self.checksum_order, end)

    @property
    def advice(self) -> tuple[str, ...]:
        """One byte does not tell where a frame begins: it may also occur inside the frame."""
        if self.checksum != "none" or self.end or self.sequence is not None or len(self.layout.start) > 1:
            return ()
        return (
            f"start is the single byte {self.start}, and nothing else tells where a frame begins; state checksum, end "
            "or sequence, or a start of two bytes (a later release will refuse these options)",
        )


class BinaryStream(FrameStream):
    """One sample per frame.

    With a sequence number, missing frames are a GAP. Without one, bytes outside a frame may have been any number of
    frames: RESTART. A frame with a number that is not finite, or beyond LARGEST, is not a sample.
    """

    def __init__(self, cutter: Cutter, options: SerialBinaryOptions) -> None:
        self._options = options
        super().__init__(cutter, options.layout)

    def begin(self) -> None:
        """Start after a port was opened."""
        super().begin()
        self._last: int | None = None
        self._unchecked = UncheckedFrames(self._layout, self._sequence if self._options.sequence else None)

    @property
    def undecided(self) -> str:
        """What the frames of UNDECIDED_S did not tell; "" where they told it, or were not that many."""
        search = self._unchecked
        if search.places < 2 or search.undecided < UNDECIDED_S * self._options.rate_hz:
            return ""
        return (
            f"{search.places} bytes of each {self._layout.length} may be the start of a frame ({self._options.start}), "
            f"in {search.undecided} frames one after the other; state checksum, end or sequence"
        )

    def _find(self, data: bytes) -> Found:
        return self._unchecked.find(data) if self._layout.checksum == "none" else super()._find(data)

    def _sequence(self, frames: NDArray[np.uint8]) -> NDArray[np.unsignedinteger]:
        kind = self._options.sequence
        assert kind is not None
        return cast(NDArray[np.unsignedinteger], numbers(frames, kind.at, kind.type, self._options.byte_order))

    def _decode(self, found: Found) -> Decoded:
        options = self._options
        columns = [numbers(found.frames, n.at, n.type, options.byte_order) for n in options.indications]
        counted = all(n.type not in ("f32", "u32") for n in options.indications)
        with np.errstate(invalid="ignore"):  # the four bytes of an f32 may hold any bits
            values = np.column_stack(columns).astype(np.int32 if counted else np.float64)
        sound = (np.abs(values) <= LARGEST).all(axis=1)
        samples = found.frames[sound]
        return Decoded(
            np.ascontiguousarray(values[sound]),
            np.flatnonzero(sound),
            self._unseen(found, sound) if options.sequence is None else self._follow(samples, options.sequence),
            *self._temperature(samples),
        )

    def _unseen(self, found: Found, sound: NDArray[np.bool_]) -> list[Break]:
        """Breaks where there are bytes or frames between two samples that are not samples."""
        broken = found.slipped[:-1].copy()
        broken[1:] |= ~sound[:-1]
        return [Break(at, BlockFlags.RESTART) for at in np.flatnonzero(broken[sound]).tolist()]

    def _follow(self, frames: NDArray[np.uint8], kind: Number) -> list[Break]:
        """Breaks where the sequence number, which wraps around, does not increase by one."""
        if not len(frames):
            return []
        sequence = self._sequence(frames).astype(np.int64)
        before = sequence[0] - 1 if self._last is None else self._last
        self._last = int(sequence[-1])
        steps = np.diff(sequence, prepend=before) % 256 ** WIDTH[kind.type]
        return follow(steps, LONGEST_GAP_S * self._options.rate_hz)

    def _temperature(self, frames: NDArray[np.uint8]) -> tuple[int | None, float | None]:
        """Raw value and degC in the last frame; None without one."""
        kind = self._options.temperature
        if kind is None or not len(frames):
            return None, None
        value = float(numbers(frames[-1:], kind.at, kind.type, self._options.byte_order)[0])
        degc = kind.zero_degc + value / kind.counts_per_degc
        if not math.isfinite(degc):
            return None, None
        return None if kind.type == "f32" else int(value), degc


class SerialBinary(SerialSensor):
    """Finds frames by their first and last bytes, their checksum and their sequence; other bytes are counted and
    skipped."""

    options_model = SerialBinaryOptions
    _stream: BinaryStream

    def _build_stream(self, name: str) -> BinaryStream:
        limit = self._options.full_scale or math.inf
        return BinaryStream(Cutter(name, self._options.rate_hz, -limit, limit), self._options)

    def _set_up(self, port: serial.Serial) -> DeviceInfo:  # noqa: ARG002 - such a device has no settings
        options = self._options
        return self._info(
            "serial-binary",
            {"start": options.start, "length": str(options.length), "checksum": options.checksum}
            | ({"end": options.end} if options.end else {}),
            kind="serial-binary",
            serial_number=options.serial_number,
            unit=options.unit,
            nominal_sensitivity=nominal_sensitivity(options.unit),
            axes=len(options.indications),
        )

    def _finish(self) -> None:
        super()._finish()
        if self._loss is None and (undecided := self._stream.undecided):
            raise DeviceLost(f"{self._where()}: {undecided}")
