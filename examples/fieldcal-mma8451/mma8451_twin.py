"""An MMA8451Q at register level with its FIFO."""

from __future__ import annotations

import numpy as np

from hw.virtual.fifo_twin import Counts, FifoTwin

F_STATUS, OUT_X, F_SETUP, WHO_AM_I, XYZ_DATA_CFG, CTRL_REG1, CTRL_REG2 = 0x00, 0x01, 0x09, 0x0D, 0x0E, 0x2A, 0x2B
SETTINGS = frozenset((F_SETUP, XYZ_DATA_CFG, 0x0F, *range(CTRL_REG1, 0x32)))


class Mma8451Twin(FifoTwin):
    """See FifoTwin. A read from OUT_X on continues with the next sample of the FIFO."""

    fifo_bytes = 32 * 6
    sample_bytes = 6
    word_bytes = 6
    data_register = OUT_X
    identity = 0x1A

    def _reset_registers(self) -> bytearray:
        registers = bytearray(256)
        registers[WHO_AM_I] = self.identity
        return registers

    @property
    def _filling(self) -> bool:
        return bool(self.registers[CTRL_REG1] & 0x01) and self.registers[F_SETUP] & 0xC0 == 0x40

    def _encode(self, first: int, counts: Counts) -> bytes:  # noqa: ARG002 - the samples of this part carry no number
        return (counts << 2).astype(">i2").tobytes()

    def _read_fifo(self, count: int) -> bytes:
        """A sample leaves the FIFO with the last of its bytes."""
        part = count % 6
        return self._take(count - part) + bytes(self._fifo[:part]).ljust(part, b"\0")

    def _deflection(self) -> Counts:
        # Data sheet, typical values at 4 g: 181, 255 and 1680 counts
        change = np.array([181, 255, 1680]) * 2 >> (self.registers[XYZ_DATA_CFG] & 0x03)
        return (change if self.registers[CTRL_REG2] & 0x80 else np.zeros(3)).astype(np.int32)

    def _get(self, register: int) -> int:
        if register == F_STATUS:
            overrun, self._overrun = self._overrun, False
            return overrun << 7 | len(self._fifo) // 6
        return self.registers[register]

    def _set(self, register: int, value: int) -> None:
        if register not in SETTINGS or (register != CTRL_REG1 and self.registers[CTRL_REG1] & 0x01):
            return  # settings can be changed in standby only
        before = self._filling
        self.registers[register] = value
        if self._filling != before or not self.registers[F_SETUP]:
            self._empty()
