"""Common part of all drivers on a serial port: the port and the bursts. A subclass decodes the bytes."""

from __future__ import annotations

import contextlib
import errno
import os
import termios
from abc import abstractmethod
from typing import Annotated, Any, Protocol

import serial
from pydantic import Field

from hw.block import DeviceInfo, Drop, SampleBlock
from hw.polling import BLOCK_S, PollingSensor
from hw.sensor import ConfigurationError, DeviceLost, Options
from hw.serial_ports import present_ports

GATHER_S = 0.010  # at 1 kHz one wake-up serves ten samples; 115 bytes of the kernel's 4 kB at 115200 baud
# Below this rate each sample is read as it arrives: the port wakes the reader, GATHER_SLOW_S lets the sample finish
SLOW_RATE_HZ = 100.0
GATHER_SLOW_S = 0.002
READ_BYTES = 65536  # upper limit of a single read
BLOCK_BYTES = 262144  # upper limit of the bytes of a block; 0.5 s at 4 Mbaud is 200 kB
LONGEST_GAP_S = 10.0  # a longer jump of the sequence number means that the counter restarted or the number was damaged
BITS_A_BYTE = 10  # with start and stop bit
# Pyserial raises any of these when the port is unplugged; termios.error is not an OSError
LOST = (serial.SerialException, OSError, termios.error)


def reason_of(error: Exception) -> str:
    """Why a port was lost: what the system says, which pyserial repeats in words of its own."""
    number = getattr(error, "errno", None)
    if number == errno.EWOULDBLOCK:
        return "another program has locked it; end that program, or state another port"
    if number == errno.EACCES:
        return f"{os.strerror(number)}; add the user to the group of the port: sudo usermod -aG dialout USER"
    if isinstance(error.__context__, termios.error) and error.__context__.args[0] == errno.ENOTTY:
        return "it is no serial port; state one that is"
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


class SerialSensor(PollingSensor):
    """Lets bytes collect, stamps each burst with the time at which its read returned, decodes the bursts into
    blocks."""

    def __init__(self, name: str, options: Any, **timing: Any) -> None:
        super().__init__(name, options, **timing)
        self._stream = self._build_stream(name)
        self._port: serial.Serial | None = None

    @abstractmethod
    def _build_stream(self, name: str) -> Stream:
        """The stream that makes blocks of the bytes; `name` is the device."""

    @abstractmethod
    def _set_up(self, port: serial.Serial) -> DeviceInfo:
        """Identify and set up the device once its port is open."""

    def _where(self) -> str:
        return f"port {self._options.port}"

    def _start(self) -> DeviceInfo:
        self._port = self._connect()
        try:
            info = self._set_up(self._port)
        except LOST as error:
            raise DeviceLost(f"{self._where()}: {reason_of(error)}") from error
        self._stream.begin()
        return info

    def _connect(self) -> serial.Serial:
        options = self._options
        try:
            return serial.Serial(options.port, options.baud_rate, timeout=BLOCK_S, exclusive=True)
        except LOST as error:
            there = f"; {present_ports()}" if getattr(error, "errno", None) == errno.ENOENT else ""
            raise DeviceLost(f"{self._where()}: {reason_of(error)}{there}") from error
        except ValueError as error:
            raise ConfigurationError(f"{self._where()}, baud_rate {options.baud_rate}: {error}") from error

    def _stop(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(*LOST):
                port.close()

    def take_drops(self) -> list[Drop]:
        """Data since the last call that became no sample."""
        return self._stream.take_drops()

    def _wait(self) -> None:
        """Let a burst collect; at slow rates the port wakes the reader, and the rest of a sample follows."""
        slow = self._options.rate_hz < SLOW_RATE_HZ
        self._sleep(GATHER_SLOW_S if slow else GATHER_S + self._next_phase() / self._rate_hz)

    def _poll_once(self) -> bool:
        assert self._port is not None
        try:
            data = self._port.read(min(max(1, self._port.in_waiting), READ_BYTES))
        except LOST as error:
            raise DeviceLost(f"{self._where()}: {reason_of(error)}") from error
        if data:
            self._stream.feed(data, *self._clock())
        return bool(data) and self._stream.size < BLOCK_BYTES

    def _finish(self) -> None:
        self._ready.extend(self._stream.blocks())

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


class AskedSensor(SerialSensor):
    """A sensor that answers when it is asked who it is."""

    @abstractmethod
    def _recognise(self, port: serial.Serial) -> dict[str, Any]:
        """Options that follow from the device. Raises IdentityError where it is none of this driver's."""

    def identify(self) -> dict[str, Any]:
        """Ask the device at this port and baud rate who it is; it stops sending.

        Returns the options that follow from the device. Raises IdentityError, ConfigurationError or DeviceLost.
        """
        try:
            self._port = self._connect()
            return self._recognise(self._port)
        except LOST as error:
            raise DeviceLost(f"{self._where()}: {reason_of(error)}") from error
        finally:
            self._stop()
