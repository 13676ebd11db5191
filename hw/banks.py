"""Chips whose registers lie in several banks, of which one register selects one."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import ClassVar

from hw.bus_device import Read
from hw.fifo_sensor import FifoSensor
from hw.i2c import I2CDevice
from hw.sensor import DeviceLost, IdentityError


class BankedDevice(I2CDevice):
    """A register's number has its bank in the upper byte. Bank 0 is selected, except during an access to another.

    Users of other drivers report parts that nobody could identify until their power was switched off, because a program
    was ended during such an access (SparkFun_ICM-20948_ArduinoLibrary issue 71, PX4-Autopilot pull request 25894).
    """

    bank_select: ClassVar[int]  # the register that selects a bank, in all banks
    bank_unit: ClassVar[int]  # its value for bank 1
    banks: ClassVar[range]

    def lock(self) -> None:
        """As in I2CDevice. Then nobody else uses the device, and a bank that was left selected is put back to 0."""
        super().lock()
        if self.bank_left():
            super().write(self.bank_select, 0)

    def bank_left(self) -> int:
        """The bank that is selected; 0 also where the register holds what selects no bank."""
        bank, rest = divmod(self.selection(), self.bank_unit)
        return bank if not rest and bank in self.banks else 0

    def selection(self) -> int:
        """What the register that selects a bank holds."""
        return super().read(self.bank_select, 1)[0]

    def read(self, register: int, count: int) -> bytes:
        """As in I2CDevice."""
        with self._bank(register >> 8):
            return super().read(register & 0xFF, count)

    def read_each(self, reads: Sequence[Read]) -> bytes:
        """As in I2CDevice, one transfer a read."""
        return b"".join(self.read(register, count) for register, count in reads)

    def write(self, register: int, value: int) -> None:
        """As in I2CDevice."""
        with self._bank(register >> 8):
            super().write(register & 0xFF, value)

    @contextlib.contextmanager
    def _bank(self, bank: int) -> Iterator[None]:
        if not bank:
            yield
            return
        try:
            super().write(self.bank_select, bank * self.bank_unit)
            yield
        finally:
            super().write(self.bank_select, 0)


class BankedSensor(FifoSensor):
    """Base of the drivers of these chips. The register that selects a bank must be one of their settings."""

    device_class: ClassVar[type[BankedDevice]]
    identity: ClassVar[int]  # what `identity_register` holds
    _device: BankedDevice

    def _identify(self) -> dict[str, int]:
        (found,) = self._device.read(self.identity_register, 1)
        if found != self.identity:
            bank = self._device.bank_left()
            hint = f" (register bank {bank} is selected: another program uses the device or was ended)" if bank else ""
            raise IdentityError(
                f"{self._device.name}: expected the ID 0x{self.identity:02X}, found 0x{found:02X}{hint}"
            )
        return {"WHO_AM_I": found}

    def _check_bank(self) -> None:
        """Raise DeviceLost if another bank is selected: the numbers used here are then those of other registers."""
        if selection := self._device.selection():
            raise DeviceLost(
                f"{self._device.name}: REG_BANK_SEL is 0x{selection:02X}, not 0x00: another program uses the device"
            )
