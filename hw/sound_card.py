"""Driver `sound-card`: a digital accelerometer that is a USB sound card (Digiducer 333D01 and similar)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hw.block import DeviceInfo
from hw.buffered_sensor import BufferedSensor
from hw.sensor import DeviceLost, Options
from hw.vendor_library import vendor_library

FULL_SCALE = 2**23  # counts; the device sends 24 bits
CHANNELS = 2
# Name of a card: model, format, serial number, sensitivity of each channel, calibration date (The Modal Shop, MAN-0343;
# the same digits are in their Python example). Format 1: counts per m/s2, five digits. Formats 2 and 3: counts per
# volt, seven digits, divided by 1 and 20.
_ACCELERATION = re.compile(r"(333D\w\w|633A\w\w|SDC0\w\w).1(\w{6})(\d{5})(\d{5})(\d{6})")
_VOLTAGE = re.compile(r"(485B\w\w|SDC0\w\w).([23])(\w{6})(\d{7})(\d{7})(\d{6})")


class SoundCardOptions(Options):
    """Options of `sound-card`."""

    device: str = Field("333D", min_length=1, description="part of the name of the sound card")
    channel: Literal[1, 2] = Field(1, description="1 is A, 2 is B; A is the more sensitive one in a 333D01")
    rate_hz: float = Field(
        8000.0, description="one of 8000, 11025, 16000, 22050, 32000, 44100, 48000", gt=0, le=192_000
    )

    @property
    def axis_count(self) -> int:
        """That of the channel."""
        return 1

    def check_installed(self) -> None:
        """Raises ConfigurationError, with what to install, where the vendor's library is not there."""
        _library()


@dataclass(frozen=True, slots=True)
class Plate:
    """Data of a card that are encoded in its name. `counts_per_mps2` is None for a card that measures a voltage."""

    model: str
    serial_number: str
    counts_per_mps2: float | None
    calibrated: str  # yymmdd


def read_plate(name: str, channel: int) -> Plate | None:
    """Decode the name of a sound card; None if the name has another form."""
    if found := _ACCELERATION.search(name):
        model, serial, *sensitivities, date = found.groups()
        return Plate(model, serial, float(sensitivities[channel - 1]), date)
    if found := _VOLTAGE.search(name):
        return Plate(found[1], found[3], None, found[6])
    return None


class SoundCard(BufferedSensor):
    """Uses blocking reads: callbacks need writable and executable memory, which a hardened service may not have."""

    options_model: ClassVar[type[Options]] = SoundCardOptions

    _stream: Any = None

    def _where(self) -> str:
        return f"sound card/input {self._options.device!r}"

    def _start(self) -> DeviceInfo:
        options = self._options
        library = _library()
        try:
            cards = [card for card in library.query_devices() if card["max_input_channels"] >= options.channel]
            index = next((card["index"] for card in cards if options.device in card["name"]), None)
            if index is None:
                known = ", ".join(repr(card["name"]) for card in cards) or "none"
                raise DeviceLost(f"no sound card/input with {options.device!r} in its name; available: {known}")
            name = library.query_devices(index)["name"]
            self._stream = library.InputStream(
                device=index, channels=CHANNELS, samplerate=options.rate_hz, dtype="int32", blocksize=0
            )
            self._stream.start()
        except library.PortAudioError as error:
            raise DeviceLost(f"{self._where()} at {options.rate_hz:g} Hz: {error}") from error
        plate = read_plate(name, options.channel) or Plate("sound card", "", None, "")
        counts = plate.counts_per_mps2
        return DeviceInfo(
            driver="sound-card",
            kind=plate.model,
            serial_number=plate.serial_number,
            unit="count",
            axes=1,
            nominal_rate_hz=options.rate_hz,
            range_mps2=FULL_SCALE / counts if counts else None,
            nominal_sensitivity=counts,
            settings={"name": name, "channel": str(options.channel), "calibrated": plate.calibrated},
        )

    def _ends(self, info: DeviceInfo) -> tuple[float, float]:  # noqa: ARG002 - the range is the same for every card
        return -FULL_SCALE, FULL_SCALE - 1

    def _stop(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close(ignore_errors=True)

    def _take(self) -> tuple[NDArray[np.int32], bool]:
        try:
            frames, overflowed = self._stream.read(self._stream.read_available)
        except _library().PortAudioError as error:
            raise DeviceLost(f"{self._where()}: {error}") from error
        return frames[:, self._options.channel - 1, None] >> 8, bool(overflowed)


def _library() -> Any:
    return vendor_library("sounddevice", "sound-card", "sound", "PortAudio")
