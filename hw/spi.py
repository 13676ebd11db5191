"""One device on an SPI bus, over spidev: register reads and writes, and a lock.

The ioctls and the structure are those of Linux, include/uapi/linux/spi/spidev.h. A message holds at most `bufsiz` bytes
of all its transfers, else EMSGSIZE. The mode of a node outlives the program that set it, and has bits of the wiring,
such as an active-high chip select (drivers/spi/spidev.c). Between two transfers of a message `cs_change` deselects the
device for 10 us (drivers/spi/spi.c). Not every controller does that, so `learn` compares.

SPI has no acknowledge. Where no device answers, the line floats or is pulled, and all bits read alike.
"""

from __future__ import annotations

import ctypes
import errno
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fcntl import ioctl
from pathlib import Path

from hw.bus_device import READS_MAX, BusDevice, Read
from hw.sensor import AdapterError, ConfigurationError, DeviceError, DeviceLost

SPI_BUS = r"spi\d+\.\d+"  # what the option `bus` holds: spiB.C is chip select C of bus B, as in /sys/bus/spi/devices
SYSFS = Path("/sys")
MESSAGE_BYTES = 4096  # default of spidev's bufsiz
READY_S, READY_POLLS = 0.1, 10  # an ADXL355 may load its trim for so long (Zephyr, adxl355.c)
CHECKED_BYTES = 3  # of the registers from the identity on; no supported part holds the same in all their bits
RD_MODE32, WR_MODE32 = 0x80046B05, 0x40046B05  # SPI_IOC_RD_MODE32, SPI_IOC_WR_MODE32
CS_HIGH = 0x04  # SPI_CS_HIGH


class Transfer(ctypes.Structure):
    """`struct spi_ioc_transfer`."""

    _fields_ = (
        ("tx_buf", ctypes.c_uint64),
        ("rx_buf", ctypes.c_uint64),
        ("len", ctypes.c_uint32),
        ("speed_hz", ctypes.c_uint32),
        ("delay_usecs", ctypes.c_uint16),
        ("bits_per_word", ctypes.c_uint8),
        ("cs_change", ctypes.c_uint8),
        ("tx_nbits", ctypes.c_uint8),
        ("rx_nbits", ctypes.c_uint8),
        ("word_delay_usecs", ctypes.c_uint8),
        ("pad", ctypes.c_uint8),
    )


def message(transfers: int) -> int:
    """SPI_IOC_MESSAGE(`transfers`). Its field for the size has 14 bits: at most 511 transfers."""
    return 1 << 30 | (transfers * ctypes.sizeof(Transfer)) << 16 | ord("k") << 8


def spi_node(bus: str) -> str:
    """Device node of `bus` (spiB.C)."""
    return f"/dev/spidev{bus.removeprefix('spi')}"


@dataclass(frozen=True, slots=True)
class SpiProtocol:
    """How a part is addressed over SPI. The first byte of a frame names a register and what is done; data follow.

    - `mode`: 0 to 3, twice the clock's polarity plus its phase.
    - `highest_mhz`: of the clock, with which the driver may read the part.
    - `shift`: by which the register is shifted to the left in the first byte.
    - `read`: bits of the first byte of a read.
    - `several`: further bits of it where several bytes are read.
    """

    mode: int
    highest_mhz: float
    read: int
    several: int = 0
    shift: int = 0


class SpiDevice(BusDevice):
    """The device that `bus` (spiB.C) selects, with its protocol and clock; `kind` names it. Errors as in BusDevice."""

    def __init__(
        self, kind: str, bus: str, protocol: SpiProtocol, clock_hz: float, sleep: Callable[[float], None], unit: int = 1
    ) -> None:
        path = spi_node(bus)
        super().__init__(path, 0, f"{kind} on {path}", MESSAGE_BYTES - 1, sleep, unit)
        self._bus = bus
        self._protocol = protocol
        self._clock_hz = round(clock_hz)
        self._file: int | None = None

    def open(self) -> None:
        """Open the node and set the mode. Raises AdapterError where the controller does not have the mode."""
        self.close()
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CLOEXEC)
        except FileNotFoundError as error:
            raise self._absent() from error
        except PermissionError as error:
            raise DeviceLost(
                f"{self.path}: {error.strerror}; add the user to the group of the node: sudo usermod -aG spi USER"
            ) from error
        except OSError as error:
            raise DeviceLost(f"{self.path}: {error.strerror}") from error
        self.joins, self.longest = False, MESSAGE_BYTES - 1
        mode = ctypes.c_uint32()
        try:
            ioctl(self._file, RD_MODE32, mode)
            mode.value = mode.value & CS_HIGH | self._protocol.mode
            ioctl(self._file, WR_MODE32, mode)
        except OSError as error:
            self.close()
            kind = AdapterError if error.errno == errno.EINVAL else DeviceLost
            raise kind(
                f"{self.name}: the SPI bus refuses mode {self._protocol.mode} ({error.strerror}); use another bus"
            ) from error

    def close(self) -> None:
        """Release the node; never raises."""
        file, self._file = self._file, None
        if file is not None:
            os.close(file)

    def check_free(self, register: int) -> None:
        """Raise DeviceLost if no device answers: all bits of the registers from `register` on read alike.

        The first transfer behind a change of the mode may be wrong, since the clock then rests at another level. This
        is that transfer. (A kernel driver that holds the device leaves no node, which `open` tells.) A part that loads
        its trim after power-on reads alike too, so the device has READY_S to answer.
        """
        alike = bytes(CHECKED_BYTES), b"\xff" * CHECKED_BYTES
        for _ in range(READY_POLLS):
            answer = self.read(register, CHECKED_BYTES)
            if answer not in alike:
                break
            self._sleep(READY_S / READY_POLLS)
        else:
            raise DeviceLost(
                f"{self.name}: no device answers, all bits read {answer[0] & 1}; check its supply, the lines of clock, "
                f"data in and data out, and whether it is wired to the chip select of {self._bus}"
            )

    def write(self, register: int, value: int) -> None:
        """Write one byte to a register."""
        self._retry(lambda: self._exchange([bytes((register << self._protocol.shift, value))]))

    def _transfer(self, reads: Sequence[Read]) -> bytes:
        protocol = self._protocol
        frames = [
            bytes((register << protocol.shift | protocol.read | (protocol.several if count > 1 else 0),)) + bytes(count)
            for register, count in reads
        ]
        return b"".join(answer[1:] for answer in self._exchange(frames))

    def _exchange(self, frames: Sequence[bytes]) -> list[bytes]:
        """Send the frames in one message, each with a selection of its own; what came back for each."""
        file = self._descriptor()
        sent = ctypes.create_string_buffer(b"".join(frames))
        received = ctypes.create_string_buffer(len(sent))
        transfers = (Transfer * len(frames))()
        ends = [0]
        for transfer, frame in zip(transfers, frames, strict=True):
            transfer.tx_buf = ctypes.addressof(sent) + ends[-1]
            transfer.rx_buf = ctypes.addressof(received) + ends[-1]
            transfer.len, transfer.speed_hz, transfer.bits_per_word = len(frame), self._clock_hz, 8
            transfer.cs_change = 1
            ends.append(ends[-1] + len(frame))
        transfers[-1].cs_change = 0  # behind the last transfer, 1 would leave the device selected
        ioctl(file, message(len(frames)), transfers)
        return [received.raw[first:end] for first, end in itertools.pairwise(ends)]

    def _together(self, reads: Sequence[Read]) -> Iterator[Sequence[Read]]:
        """The reads in parts: a message takes no more bytes than the longest read has with its first byte."""
        part: list[Read] = []
        for read in reads:
            if len(part) == READS_MAX or sum(1 + count for _, count in (*part, read)) > 1 + self.longest:
                yield part
                part = []
            part.append(read)
        if part:
            yield part

    def _descriptor(self) -> int:
        if self._file is None:
            raise DeviceLost(f"{self.name} is not open")
        return self._file

    def _absent(self) -> DeviceError:
        """Why there is no node, as sysfs tells."""
        device = SYSFS / "bus/spi/devices" / self._bus
        if not device.exists():
            return DeviceLost(
                f"{self.path} does not exist; enable the SPI bus (on a Raspberry Pi dtparam=spi=on in config.txt, then "
                "restart), and load the kernel module: sudo modprobe spidev"
            )
        driver = device / "driver"
        if not driver.exists():
            return DeviceLost(f"{self.path} does not exist, and no kernel driver has {self._bus}: sudo modprobe spidev")
        return ConfigurationError(
            f"{self.path} does not exist, because the kernel driver {driver.resolve().name} holds {self._bus}; remove "
            "its dtoverlay from config.txt, or use the driver iio"
        )
