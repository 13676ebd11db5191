"""What all drivers on a serial port have in common: the port, bursts and losses. A subclass says what bytes mean."""

from __future__ import annotations

import contextlib
import termios
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

import serial
from pydantic import Field

from hw.block import DeviceInfo, Drop, SampleBlock
from hw.sensor import GOLDEN, Clock, ConfigurationError, DeviceLost, Options, system_clock

BLOCK_S = 0.5
GATHER_S = 0.010  # a wake-up for ten samples at 1 kHz, not for each; 115 B of the kernel's 4 kB at 115200 baud
SLOW_RATE_HZ = 100.0  # below, a sample is read as it comes: the port wakes the reader, and GATHER_SLOW_S lets it end
GATHER_SLOW_S = 0.002
READ_BYTES = 65536  # bounds a single read
BLOCK_BYTES = 262144  # bounds a block's memory: 0.5 s at 4 Mbaud is 200 kB
LONGEST_GAP_S = 10.0  # a longer jump in the sequence is a counter that began anew, or a damaged number
LOST = (serial.SerialException, OSError, termios.error)  # termios.error is no OSError; all three come at an unplug


class SerialOptions(Options):
    """Options of every driver on a serial port."""

    port: str = Field(min_length=1, description="path of the port, best one of /dev/serial/by-id")
    baud_rate: int = Field(115200, gt=0, le=4_000_000, description="as the device was set")


class Stream(Protocol):
    """Makes sample blocks of bursts of bytes; `size` counts the bytes that wait to be decoded."""

    size: int

    def begin(self) -> None:
        """A port was opened."""

    def feed(self, data: bytes, arrival_ns: int, utc_ns: int) -> None:
        """One burst and its arrival."""

    def blocks(self) -> list[SampleBlock]:
        """Blocks of all that was fed since the last call."""

    def take_drops(self) -> list[Drop]:
        """What was no sample since the last call."""


class SerialSensor(ABC):
    """Lets bursts gather, stamps each with the time at which its read returned, decodes them block by block."""

    options_model: ClassVar[type[Options]]

    def __init__(
        self,
        name: str,
        options: Any,
        *,
        clock: Clock = system_clock,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options
        self._clock = clock
        self._sleep = sleep
        self._stream = self._build_stream(name)
        self._port: serial.Serial | None = None
        self._loss: DeviceLost | None = None
        self._ready: deque[SampleBlock] = deque()
        self._phase = 0.0

    @abstractmethod
    def _build_stream(self, name: str) -> Stream:
        """What makes blocks of the bytes."""

    @abstractmethod
    def _set_up(self, port: serial.Serial) -> DeviceInfo:
        """Whatever the device needs once its port is open."""

    def open(self) -> DeviceInfo:
        """Open the port. Raises DeviceLost (absent, in use, no right), ConfigurationError (settings it cannot do)."""
        self.close()
        options = self._options
        try:
            port = serial.Serial(options.port, options.baud_rate, timeout=BLOCK_S, exclusive=True)
        except LOST as error:
            raise DeviceLost(f"port {options.port}: {error}") from error
        except ValueError as error:
            raise ConfigurationError(f"port {options.port}, baud_rate {options.baud_rate}: {error}") from error
        self._port = port
        try:
            info = self._set_up(port)
        except LOST as error:
            self.close()
            raise DeviceLost(f"port {options.port}: {error}") from error
        except BaseException:
            self.close()
            raise
        self._loss = None
        self._stream.begin()
        return info

    def close(self) -> None:
        """Release the port."""
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(*LOST):
                port.close()

    def take_drops(self) -> list[Drop]:
        """What was no sample since the last call."""
        return self._stream.take_drops()

    def read_block(self) -> SampleBlock | None:
        """The next block, or None. Raises DeviceLost."""
        if not self._ready and self._loss is None:
            if self._port is None:
                raise DeviceLost(f"port {self._options.port} is not open")
            self._gather(self._port)
        if self._ready:
            return self._ready.popleft()
        if self._loss is not None:
            raise self._loss
        return None

    def _gather(self, port: serial.Serial) -> None:
        """Read bursts for BLOCK_S and decode them; silence or a loss ends it earlier."""
        now_ns, _ = self._clock()
        end_ns = now_ns + round(BLOCK_S * 1e9)
        while now_ns < end_ns and self._stream.size < BLOCK_BYTES:
            self._sleep(self._pause_s())
            try:
                data = port.read(min(max(1, port.in_waiting), READ_BYTES))
            except LOST as error:
                self._loss = DeviceLost(f"port {self._options.port}: {error}")  # raised once all before it is returned
                break
            now_ns, utc_ns = self._clock()
            if not data:
                break
            self._stream.feed(data, now_ns, utc_ns)
        self._ready.extend(self._stream.blocks())

    def _pause_s(self) -> float:
        """Time to let a burst gather; spread over a sample period by the golden ratio, so that poll and sample clock
        do not beat and each second's arrivals sample all of the period."""
        if self._options.rate_hz < SLOW_RATE_HZ:
            return GATHER_SLOW_S
        self._phase = (self._phase + GOLDEN) % 1.0
        return GATHER_S + self._phase / float(self._options.rate_hz)

    def _info(self, driver: str, settings: dict[str, str], **known: Any) -> DeviceInfo:
        """What `open` returns: `known` besides the driver, the rate and the port's settings."""
        options = self._options
        port = {"port": options.port, "baud_rate": str(options.baud_rate)}
        return DeviceInfo(driver=driver, nominal_rate_hz=options.rate_hz, settings=port | settings, **known)
