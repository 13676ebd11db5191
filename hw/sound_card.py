"""Driver `sound-card`: a digital accelerometer that is a USB sound card (Digiducer 333D01 and alike)."""

from __future__ import annotations

import importlib
import re
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hw.block import BlockFlags, DeviceInfo, Drop, SampleBlock
from hw.cutting import Cutter, Stretch
from hw.sensor import Clock, ConfigurationError, DeviceLost, Options, system_clock

BLOCK_S, POLL_S = 0.5, 0.02
GOLDEN = (5**0.5 - 1) / 2
FULL_SCALE = 2**23  # counts; the interface hands on 24 bits
CHANNELS = 2
# Model, format, serial number, a sensitivity a channel, calibration date: The Modal Shop, MAN-0343; the same digits in
# their Python example. Format 1: counts per m/s2, five digits; 2 and 3: counts per volt, seven digits, by 1 and 20.
_ACCELERATION = re.compile(r"(333D\w\w|633A\w\w|SDC0\w\w).1(\w{6})(\d{5})(\d{5})(\d{6})")
_VOLTAGE = re.compile(r"(485B\w\w|SDC0\w\w).([23])(\w{6})(\d{7})(\d{7})(\d{6})")

Read = tuple[int, int, NDArray[np.int32]]
"""Arrival and UTC in ns, and the samples."""


class SoundCardOptions(Options):
    """Options of `sound-card`."""

    device: str = Field("333D", min_length=1, description="part of the sound card's name")
    channel: Literal[1, 2] = Field(1, description="A or B; of a 333D01 the first is the sensitive one")
    rate_hz: float = Field(
        8000.0, description="one of 8000, 11025, 16000, 22050, 32000, 44100, 48000", gt=0, le=192_000
    )


@dataclass(frozen=True, slots=True)
class Plate:
    """What a card says of itself by its name. `counts_per_mps2` is None for one that measures a voltage."""

    model: str
    serial_number: str
    counts_per_mps2: float | None
    calibrated: str  # yymmdd


def read_plate(name: str, channel: int) -> Plate | None:
    """The plate in a sound card's name; None if it has none."""
    if found := _ACCELERATION.search(name):
        model, serial, *sensitivities, date = found.groups()
        return Plate(model, serial, float(sensitivities[channel - 1]), date)
    if found := _VOLTAGE.search(name):
        return Plate(found[1], found[3], None, found[6])
    return None


class SoundCard:
    """Blocking reads (callbacks need memory that is written and executed, which a hardened service is denied).

    What an input overflow lost lies somewhere in what was waiting: all of that is thrown away, and the next sample
    starts anew.
    """

    options_model: ClassVar[type[Options]] = SoundCardOptions

    def __init__(
        self,
        name: str,
        options: SoundCardOptions,
        *,
        clock: Clock = system_clock,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options
        self._clock = clock
        self._sleep = sleep
        self._cutter = Cutter(name, options.rate_hz, -FULL_SCALE, FULL_SCALE - 1)
        self._stream: Any = None
        self._ready: deque[SampleBlock] = deque()
        self._loss: DeviceLost | None = None
        self._dropped = 0
        self._phase = 0.0

    def open(self) -> DeviceInfo:
        """Find the card and start it. Raises DeviceLost, or ConfigurationError (library, rate)."""
        self.close()
        options = self._options
        library = _library()
        try:
            cards = [card for card in library.query_devices() if card["max_input_channels"] >= options.channel]
            index = next((card["index"] for card in cards if options.device in card["name"]), None)
            if index is None:
                known = ", ".join(repr(card["name"]) for card in cards) or "none"
                raise DeviceLost(f"no sound card/input with {options.device!r} in its name; there are {known}")
            name = library.query_devices(index)["name"]
            self._stream = library.InputStream(
                device=index, channels=CHANNELS, samplerate=options.rate_hz, dtype="int32", blocksize=0
            )
            self._stream.start()
        except library.PortAudioError as error:
            self.close()
            raise DeviceLost(f"sound card/input {options.device!r} at {options.rate_hz:g} Hz: {error}") from error
        self._loss = None
        self._cutter.flag(BlockFlags.RESTART)
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

    def close(self) -> None:
        """Stop the stream."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close(ignore_errors=True)

    def take_drops(self) -> list[Drop]:
        """What waited when the input overflowed."""
        dropped, self._dropped = self._dropped, 0
        return [Drop(dropped, "samples", "input overflow")] if dropped else []

    def read_block(self) -> SampleBlock | None:
        """The next block, or None. Raises DeviceLost."""
        if not self._ready and self._loss is None:
            if self._stream is None:
                raise DeviceLost(f"sound card/input {self._options.device!r} is not open")
            self._gather()
        if self._ready:
            return self._ready.popleft()
        if self._loss is not None:
            raise self._loss
        return None

    def _gather(self) -> None:
        """Read for BLOCK_S; a loss, of samples or of the card, ends it earlier."""
        library = _library()
        reads: list[Read] = []
        end_ns = self._clock()[0] + round(BLOCK_S * 1e9)
        try:
            while self._clock()[0] < end_ns and not self._ready:
                self._phase = (self._phase + GOLDEN) % 1.0
                self._sleep(POLL_S + self._phase / self._options.rate_hz)
                now_ns, utc_ns = self._clock()
                frames, overflowed = self._stream.read(self._stream.read_available)
                if overflowed:
                    self._dropped += len(frames)
                    self._finish(reads)
                    self._cutter.flag(BlockFlags.RESTART | BlockFlags.OVERRUN)
                    reads = []
                    end_ns = now_ns + round(BLOCK_S * 1e9)
                elif len(frames):
                    reads.append((now_ns, utc_ns, frames[:, self._options.channel - 1] >> 8))
        except library.PortAudioError as error:
            self._loss = DeviceLost(f"sound card/input {self._options.device!r}: {error}")
        self._finish(reads)

    def _finish(self, reads: list[Read]) -> None:
        """Make blocks of what was read."""
        if not reads:
            return
        arrivals_ns, utc_ns, samples = zip(*reads, strict=True)
        count = np.cumsum([len(part) for part in samples])
        indications = np.concatenate(samples)[:, None].astype(np.int32)
        self._ready.extend(self._cutter.cut(Stretch(indications, np.array(arrivals_ns), count, utc_ns[-1])))


def _library() -> Any:
    """sounddevice, imported only by those who name this driver."""
    try:
        return importlib.import_module("sounddevice")
    except (ImportError, OSError) as error:  # OSError: the package is there, PortAudio is not
        raise ConfigurationError(
            f"driver sound-card needs sounddevice (pip install 'fieldcal[sound]') and PortAudio: {error}"
        ) from error
