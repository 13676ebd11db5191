"""An ADXL345 at register level with its FIFO of 32 samples; one more sample is in the output registers.

Without the FIFO (bypass mode) the output registers hold the newest sample.
"""

from __future__ import annotations

import numpy as np

from hw.virtual.fifo_twin import Counts, FifoTwin
from hw.virtual.response import Response, lowpass

DEVID, FIRST_SETTING, BW_RATE, POWER_CTL, INT_SOURCE, DATA_FORMAT, DATA, FIFO_CTL, FIFO_STATUS = (
    *(0x00, 0x1D, 0x2C, 0x2D, 0x30, 0x31, 0x32, 0x38, 0x39),
)
FIFO_SAMPLES = 32
READ_ONLY = frozenset((0x2B, INT_SOURCE, *range(DATA, DATA + 6), FIFO_STATUS))


def filters(rate_hz: float) -> Response:
    """The filter of the chip at an output data rate. The data sheet tells no order; this one has the second."""
    return lowpass(2, rate_hz / 2.0)


class Adxl345Twin(FifoTwin):
    """See FifoTwin. A read that starts at DATA takes one sample from the FIFO and clears the overrun bit.

    A new sample that fills the FIFO sets the overrun bit, as the data sheets of the family say, though none is lost.
    """

    fifo_bytes = 33 * 6
    sample_bytes = 6
    word_bytes = 6
    data_register = DATA
    identity = 0xE5
    spi_modes = (3,)
    spi_highest_hz = 5e6

    def _reset_registers(self) -> bytearray:
        registers = bytearray(256)
        registers[DEVID] = self.identity
        registers[BW_RATE] = 0x0A
        return registers

    @property
    def _filling(self) -> bool:
        return bool(self.registers[POWER_CTL] & 0x08) and self.registers[FIFO_CTL] & 0xC0 == 0x80

    @property
    def response(self) -> Response:
        return filters(3200.0 / 2 ** (0x0F - (self.registers[BW_RATE] & 0x0F)))

    def _encode(self, first: int, counts: Counts) -> bytes:  # noqa: ARG002 - the samples of this part carry no number
        return counts.astype("<i2").tobytes()

    def _fill(self) -> None:
        before = self._next
        super()._fill()
        self._overrun |= self._next > before and len(self._fifo) >= FIFO_SAMPLES * self.word_bytes

    def _spi_command(self, first: int) -> tuple[int, bool, bool]:
        return first % 64, first >= 128, first % 128 >= 64

    def _read_fifo(self, count: int) -> bytes:
        self._pointer += min(count, self.word_bytes)
        self._overrun = False
        bypass = not self.registers[FIFO_CTL] & 0xC0
        sample = self._newest().astype("<i2").tobytes() if bypass else self._take(self.word_bytes)
        return sample[:count]

    def _deflection(self) -> Counts:
        return np.array([200, -200, 300] if self.registers[DATA_FORMAT] & 0x80 else [0, 0, 0], np.int32)

    def _get(self, register: int) -> int:
        entries = len(self._fifo) // self.word_bytes
        if register == INT_SOURCE:
            return bool(entries) << 7 | (entries >= 32) << 1 | self._overrun
        if register == FIFO_STATUS:
            return entries
        if DATA < register < DATA + 6:
            return self._newest().astype("<i2").tobytes()[register - DATA]
        return self.registers[register]

    def _set(self, register: int, value: int) -> None:
        if register < FIRST_SETTING or register in READ_ONLY:
            return
        before = self._filling
        self.registers[register] = value
        if self._filling != before or not self.registers[FIFO_CTL]:
            self._empty()
