"""Common part of all drivers on a serial port: the port, bursts and losses. A subclass decodes the bytes."""

from __future__ import annotations

import contextlib
import errno
import os
import termios
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Protocol

import serial
from pydantic import Field

from hw.block import DeviceInfo, Drop, SampleBlock
from hw.sensor import GOLDEN, Clock, ConfigurationError, DeviceLost, Options, system_clock

BLOCK_S = 0.5
GATHER_S = 0.010  # at 1 kHz one wake-up serves ten samples; 115 bytes of the kernel's 4 kB at 115200 baud
# Below this rate each sample is read as it arrives: the port wakes the reader, GATHER_SLOW_S lets the sample finish
SLOW_RATE_HZ = 100.0
GATHER_SLOW_S = 0.002
READ_BYTES = 65536  # upper limit of a single read
BLOCK_BYTES = 262144  # upper limit of the bytes of a block; 0.5 s at 4 Mbaud is 200 kB
LONGEST_GAP_S = 10.0  # a longer jump of the sequence number means that the counter restarted or the number was damaged
# Pyserial raises any of these when the port is unplugged; termios.error is not an OSError
LOST = (serial.SerialException, OSError, termios.error)


def reason_of(error: Exception) -> str:
    """Why a port was lost: what the system says, which pyserial repeats in words of its own."""
    number = getattr(error, "errno", None)
    if number == errno.EWOULDBLOCK:
        return "another program has locked it"
    return os.strerror(number) if number else str(error)


Filters = Annotated[
    tuple[str, ...],
    Field(
        max_length=8, description="known filters of the device, of its data sheet, as 'lowpass order=2 corner_hz=31'"
    ),
]


class SerialOptions(Options):
    """Options of every driver on a serial port."""

    port: str = Field(min_length=1, description="path of the port, best one of /dev/serial/by-id")
    baud_rate: int = Field(115200, gt=0, le=4_000_000, description="as set in the device")


class Stream(Protocol):
    """Makes sample blocks of bursts of bytes; `size` is the number of bytes that wait to be decoded."""

    size: int

    def begin(self) -> None:
        """Start after a port was opened."""

    def feed(self, data: bytes, arrival_ns: int, utc_ns: int) -> None:
        """Add one burst and its arrival time, ns."""

    def blocks(self) -> list[SampleBlock]:
        """Decode everything fed since the last call and return its blocks."""

    def take_drops(self) -> list[Drop]:
        """Data since the last call that became no sample."""


class SerialSensor(ABC):
    """Lets bytes collect, stamps each burst with the time at which its read returned, decodes the bursts into
    blocks."""

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
        """The stream that makes blocks of the bytes; `name` is the device."""

    @abstractmethod
    def _set_up(self, port: serial.Serial) -> DeviceInfo:
        """Identify and set up the device once its port is open."""

    def open(self) -> DeviceInfo:
        """Open the port and set up the device.

        Raises DeviceLost (the port does not exist, is in use or may not be opened) or ConfigurationError (the port does
        not support the settings).
        """
        self.close()
        options = self._options
        try:
            port = serial.Serial(options.port, options.baud_rate, timeout=BLOCK_S, exclusive=True)
        except LOST as error:
            raise DeviceLost(f"port {options.port}: {reason_of(error)}") from error
        except ValueError as error:
            raise ConfigurationError(f"port {options.port}, baud_rate {options.baud_rate}: {error}") from error
        self._port = port
        try:
            info = self._set_up(port)
        except LOST as error:
            self.close()
            raise DeviceLost(f"port {options.port}: {reason_of(error)}") from error
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
        """Data since the last call that became no sample."""
        return self._stream.take_drops()

    def read_block(self) -> SampleBlock | None:
        """The next block, or None if no sample came. Raises DeviceLost."""
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
        """Read bursts for BLOCK_S, or until the device is silent or lost, and decode them."""
        now_ns, _ = self._clock()
        end_ns = now_ns + round(BLOCK_S * 1e9)
        while now_ns < end_ns and self._stream.size < BLOCK_BYTES:
            self._sleep(self._pause_s())
            try:
                data = port.read(min(max(1, port.in_waiting), READ_BYTES))
            except LOST as error:
                # Raised after all earlier samples have been returned
                self._loss = DeviceLost(f"port {self._options.port}: {reason_of(error)}")
                break
            now_ns, utc_ns = self._clock()
            if not data:
                break
            self._stream.feed(data, now_ns, utc_ns)
        self._ready.extend(self._stream.blocks())

    def _pause_s(self) -> float:
        """Time in s in which a burst collects.

        The reads are spread over a sample period by the golden ratio, so that reads and sample clock do not beat and
        the arrivals of each second cover the whole sample period.
        """
        if self._options.rate_hz < SLOW_RATE_HZ:
            return GATHER_SLOW_S
        self._phase = (self._phase + GOLDEN) % 1.0
        return GATHER_S + self._phase / float(self._options.rate_hz)

    def _info(self, driver: str, settings: dict[str, str], **known: Any) -> DeviceInfo:
        """Build the result of `open`; `known` are its fields except driver, rate and the settings of the port."""
        options = self._options
        port = {"port": options.port, "baud_rate": str(options.baud_rate)}
        return DeviceInfo(
            driver=driver,
            nominal_rate_hz=options.rate_hz,
            settings=port | settings,
            filters=options.known_filters,
            **known,
        )
