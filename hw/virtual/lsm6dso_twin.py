"""An LSM6DSO or LSM6DSOX at register level with its tagged FIFO."""

from __future__ import annotations

import numpy as np

from hw.virtual.fifo_twin import Counts, FifoTwin
from hw.virtual.response import Response, lowpass

FIFO_CTRL1, FIFO_CTRL3, FIFO_CTRL4, WHO_AM_I, CTRL1_XL, CTRL3_C, CTRL9_XL, CTRL10_C = (
    *(0x07, 0x09, 0x0A, 0x0F, 0x10, 0x12, 0x18, 0x19),
)
TEMPERATURE, DATA, FIFO_STATUS, FREQ_FINE, USER_OFFSET, FIFO_DATA = 0x20, 0x28, 0x3A, 0x63, 0x73, 0x78
SETTINGS = frozenset((*range(FIFO_CTRL1, FIFO_CTRL4 + 1), *range(CTRL1_XL, CTRL10_C + 1), *range(0x73, 0x76)))


def filters(rate_hz: float) -> Response:
    """The filter of the chip at an output data rate. The data sheet tells no order; this one has the second."""
    return lowpass(2, rate_hz / 2.0)


def words(tag: int, first: int, numbers: Counts) -> bytes:
    """FIFO words: tag with sensor, counter of the slot and even parity; then three 16-bit numbers."""
    tags = (tag << 3 | (np.arange(first, first + len(numbers)) & 3) << 1).astype(np.uint8)
    tags |= np.bitwise_count(tags) & 1
    return np.column_stack([tags, numbers.astype("<i2").view(np.uint8).reshape(-1, 6)]).tobytes()


class Lsm6dsoTwin(FifoTwin):
    """See FifoTwin. `freq_fine` is the register with which the part states its own rate.

    Seven registers from FIFO_DATA on hold the oldest word; it leaves the FIFO when the last of them is read (ST,
    lsm6dsox_reg.c, reads the first by itself, then the other six).
    """

    fifo_bytes = 512 * 7
    sample_bytes = 7
    word_bytes = 7
    data_register = FIFO_DATA
    identity = 0x6C
    freq_fine = 0
    spi_modes = (0, 3)
    spi_highest_hz = 10e6

    def _reset_registers(self) -> bytearray:
        registers = bytearray(256)
        registers[WHO_AM_I] = self.identity
        registers[CTRL3_C], registers[CTRL9_XL] = 0x04, 0xE0
        registers[FREQ_FINE] = self.freq_fine & 0xFF
        return registers

    @property
    def _filling(self) -> bool:
        batched = bool(self.registers[FIFO_CTRL3] & 0x0F) and bool(self.registers[CTRL1_XL] >> 4)
        return batched and self.registers[FIFO_CTRL4] & 7 == 6

    @property
    def response(self) -> Response:
        return filters(6667.0 / 2 ** (10 - (self.registers[CTRL1_XL] >> 4)))

    def _encode(self, first: int, counts: Counts) -> bytes:
        return words(2, first, counts)

    def _read_fifo(self, count: int) -> bytes:
        whole = count // 7 * 7
        return self._take(whole) + (bytes(self._fifo[:7]) + bytes(7))[: count - whole]

    def _spi_command(self, first: int) -> tuple[int, bool, bool]:
        return first % 128, first >= 128, self.registers[CTRL3_C] % 8 >= 4

    def _deflection(self) -> Counts:
        change = np.array([6000, 7000, 8000] if self.registers[0x14] & 3 == 1 else [0, 0, 0], np.int32)
        return change // (1, 8, 2, 4)[self.registers[CTRL1_XL] >> 2 & 3]  # the same in g at every range

    def _get(self, register: int) -> int:
        if register == FIFO_STATUS:
            return len(self._fifo) // 7 & 0xFF
        if register == FIFO_STATUS + 1:
            status = len(self._fifo) // 7 >> 8 | self._overrun << 3
            self._overrun = False
            return status
        if register in (TEMPERATURE, TEMPERATURE + 1):
            raw = self._temperature_raw(self._clock())
            return raw.to_bytes(2, "little", signed=True)[register - TEMPERATURE]
        if DATA <= register < DATA + 6:
            return self._newest().astype("<i2").tobytes()[register - DATA]
        if FIFO_DATA < register < FIFO_DATA + 7:
            word = (bytes(self._fifo[:7]) + bytes(7))[:7]
            if register == FIFO_DATA + 6:
                self._take(7)
            return word[register - FIFO_DATA]
        return self.registers[register]

    def _set(self, register: int, value: int) -> None:
        if register == CTRL3_C and value & 0x01:
            self.power_cycle()
        elif register in SETTINGS:
            before = self._filling
            self.registers[register] = value
            if self._filling != before:
                self._empty()
