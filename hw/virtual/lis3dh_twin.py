"""A LIS3DH or LIS2DH12 at register level with its FIFO; without it the output registers hold the newest sample."""

from __future__ import annotations

import numpy as np

from hw.virtual.fifo_twin import Counts, FifoTwin
from hw.virtual.response import Response, lowpass

WHO_AM_I, TEMP_CFG_REG, CTRL_REG1, CTRL_REG4, CTRL_REG5, DATA, FIFO_CTRL_REG, FIFO_SRC_REG = (
    *(0x0F, 0x1F, 0x20, 0x23, 0x24, 0x28, 0x2E, 0x2F),
)
SETTINGS = frozenset((*range(TEMP_CFG_REG, 0x27), FIFO_CTRL_REG, 0x30, *range(0x32, 0x35), *range(0x36, 0x40)))
RATES_HZ = (0.0, 1.0, 10.0, 25.0, 50.0, 100.0, 200.0, 400.0, 1620.0, 1344.0)  # by the code in CTRL_REG1


def filters(rate_hz: float) -> Response:
    """The filter of the chip in high resolution. The data sheet tells no order; this one has the second."""
    return lowpass(2, rate_hz / 9.0)


class Lis3dhTwin(FifoTwin):
    """See FifoTwin. A read from DATA on continues with the next sample of the FIFO, which loses a sample with the last
    of its bytes.

    The topmost bit of a register's number makes a read or write go on to the next register.
    """

    fifo_bytes = 32 * 6
    sample_bytes = 6
    word_bytes = 6
    data_register = DATA
    identity = 0x33

    def _reset_registers(self) -> bytearray:
        registers = bytearray(256)
        registers[WHO_AM_I] = self.identity
        registers[CTRL_REG1] = 0x07
        return registers

    @property
    def _filling(self) -> bool:
        return bool(self.registers[CTRL_REG1] >> 4) and self._stream

    @property
    def _stream(self) -> bool:
        return bool(self.registers[CTRL_REG5] & 0x40) and self.registers[FIFO_CTRL_REG] & 0xC0 == 0x80

    @property
    def response(self) -> Response:
        return filters(RATES_HZ[self.registers[CTRL_REG1] >> 4])

    def _selected(self, address: int) -> int:
        self._step = address >> 7
        return address & 0x7F

    def _after(self, register: int) -> int:
        return register + self._step & 0x7F

    def _encode(self, first: int, counts: Counts) -> bytes:  # noqa: ARG002 - the samples of this part carry no number
        return (counts << 4).astype("<i2").tobytes()

    def _read_fifo(self, count: int) -> bytes:
        if self._stream and self._step:
            return self._take(count - count % 6) + self._sample()[: count % 6]
        sample = self._sample()[: count if self._step else 1]
        self._pointer += len(sample) * self._step
        return sample

    def _sample(self) -> bytes:
        """Contents of the output registers."""
        return bytes(self._fifo[:6]).ljust(6, b"\0") if self._stream else self._encode(0, self._newest())

    def _deflection(self) -> Counts:
        if self.registers[CTRL_REG4] & 0x06 != 0x02:
            return np.zeros(3, np.int32)
        return np.full(3, (600, 300, 150, 50)[self.registers[CTRL_REG4] >> 4 & 3], np.int32)  # 0.6 g

    def _get(self, register: int) -> int:
        if register == FIFO_SRC_REG:
            level = len(self._fifo) // 6
            return (level >= 32) << 6 | (not level) << 5 | min(level, 31)
        if DATA < register < DATA + 6:
            value = self._sample()[register - DATA]
            if self._stream and register == DATA + 5:
                self._take(6)
            return value
        return self.registers[register]

    def _set(self, register: int, value: int) -> None:
        if register not in SETTINGS:
            return
        before = self._filling
        self.registers[register] = value
        if self._filling != before or not self._stream:
            self._empty()
