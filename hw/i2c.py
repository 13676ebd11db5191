"""One device on an I2C bus, over smbus2: register reads and writes as the adapter takes them, and a lock.

Adapters differ. One register read (write of the register, then read) a transfer works on every adapter of i2c-dev.
Several reads in one transfer do not: i2c-bcm2835 (Raspberry Pi Zero to 4; Linux, bcm2835_i2c_xfer) takes a read only as
the last message, MCP2221 and CP2112 (Linux, hid-mcp2221.c and hid-cp2112.c) take only write-then-read. CH341 and others
bound the length of a message. Some adapters only know the transfers of SMBus, at most 32 bytes each. What an adapter
does not take it refuses with EOPNOTSUPP (Linux, i2c_check_for_quirks).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

from smbus2 import SMBus, i2c_msg
from smbus2.smbus2 import I2cFunc

from hw.bus_device import BusDevice, Read
from hw.sensor import AdapterError, DeviceLost

MESSAGE_BYTES = 8192  # of a message that Linux accepts
SMBUS_BYTES = 32  # of a block, by the SMBus specification


class I2CDevice(BusDevice):
    """A device at `address` of /dev/i2c-`bus`; `kind` names it in messages. Errors as in BusDevice."""

    def __init__(self, kind: str, bus: int, address: int, sleep: Callable[[float], None], unit: int = 1) -> None:
        path = f"/dev/i2c-{bus}"
        super().__init__(path, address, f"{kind} at 0x{address:02X} on {path}", MESSAGE_BYTES, sleep, unit)
        self._address = address
        self._bus: SMBus | None = None
        self._smbus_only = False
        self._starts: dict[int, i2c_msg] = {}  # messages that name a register; they do not change from read to read

    def open(self) -> None:
        """Open the bus. Raises AdapterError where the adapter cannot read a block of bytes."""
        self.close()
        try:
            self._bus = SMBus(self.path)
        except FileNotFoundError as error:
            raise DeviceLost(
                f"{self.path} does not exist; state a bus that is there, or enable this one (on a Raspberry Pi "
                "dtparam=i2c_arm=on in config.txt, then restart), and load the kernel module: sudo modprobe i2c-dev"
            ) from error
        except PermissionError as error:
            raise DeviceLost(
                f"{self.path}: {error.strerror}; add the user to the group of the node: sudo usermod -aG i2c USER"
            ) from error
        except OSError as error:
            raise DeviceLost(f"{self.path}: {error.strerror}") from error
        functions = self._bus.funcs
        self._smbus_only = not functions & I2cFunc.I2C
        self.joins = False
        self.longest = SMBUS_BYTES if self._smbus_only else MESSAGE_BYTES
        if self._smbus_only and not functions & I2cFunc.SMBUS_READ_I2C_BLOCK:
            self.close()
            raise AdapterError(
                f"{self.path}: the adapter can neither do plain I2C transfers nor read an I2C block over SMBus, and "
                f"{self.name} needs one of them; use another adapter"
            )

    def close(self) -> None:
        """Release the bus; never raises."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(OSError):
                bus.close()

    def check_free(self, register: int) -> None:
        """Raise ConfigurationError if a kernel driver holds the address, DeviceLost if no device answers there."""
        self._retry(lambda: self._opened().read_byte_data(self._address, register))

    def write(self, register: int, value: int) -> None:
        """Write one byte to a register, as an SMBus call.

        While a kernel driver holds the address, the kernel refuses SMBus calls, but not plain I2C transfers.
        """
        self._retry(lambda: self._opened().write_byte_data(self._address, register, value))

    def _transfer(self, reads: Sequence[Read]) -> bytes:
        bus = self._opened()
        if self._smbus_only and len(reads) == 1:
            return bytes(bus.read_i2c_block_data(self._address, *reads[0]))
        messages = []
        for register, count in reads:
            if register not in self._starts:
                self._starts[register] = i2c_msg.write(self._address, [register])
            messages += [self._starts[register], i2c_msg.read(self._address, count)]
        bus.i2c_rdwr(*messages)
        return b"".join(map(bytes, messages[1::2]))

    def _descriptor(self) -> int:
        file = self._opened().fd
        assert file is not None
        return file

    def _opened(self) -> SMBus:
        if self._bus is None:
            raise DeviceLost(f"{self.name} is not open")
        return self._bus
