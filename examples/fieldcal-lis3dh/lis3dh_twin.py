"""A LIS3DH at register level with its FIFO."""

from __future__ import annotations

import numpy as np

from hw.virtual.fifo_twin import Counts, FifoTwin

WHO_AM_I, CTRL_REG1, CTRL_REG4, CTRL_REG5, OUT_X, FIFO_CTRL, FIFO_SRC = 0x0F, 0x20, 0x23, 0x24, 0x28, 0x2E, 0x2F
SETTINGS = frozenset((*range(CTRL_REG1, 0x28), FIFO_CTRL))


class Lis3dhTwin(FifoTwin):
    """See FifoTwin. A read from OUT_X on with auto-increment continues with the next sample of the FIFO."""

    fifo_bytes = 32 * 6
    sample_bytes = 6
    word_bytes = 6
    data_register = OUT_X | 0x80
    identity = 0x33

    def _reset_registers(self) -> bytearray:
        registers = bytearray(256)
        registers[WHO_AM_I] = self.identity
        registers[CTRL_REG1] = 0x07
        return registers

    @property
    def _filling(self) -> bool:
        on = self.registers[CTRL_REG1] >> 4 and self.registers[CTRL_REG5] & 0x40
        return bool(on) and self.registers[FIFO_CTRL] & 0xC0 == 0x80

    def _encode(self, first: int, counts: Counts) -> bytes:  # noqa: ARG002 - the samples of this part carry no number
        return (counts << 4).astype("<i2").tobytes()

    def _deflection(self) -> Counts:
        return np.array([300, 300, 300] if self.registers[CTRL_REG4] & 0x06 == 0x02 else [0, 0, 0], np.int32)

    def _get(self, register: int) -> int:
        if register == FIFO_SRC:
            level = len(self._fifo) // 6
            return (level >= 32) << 6 | (not level) << 5 | min(level, 31)
        return self.registers[register & 0x7F]

    def _set(self, register: int, value: int) -> None:
        if register not in SETTINGS:
            return
        before = self._filling
        self.registers[register] = value
        if self._filling != before:
            self._empty()
