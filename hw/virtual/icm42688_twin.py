"""An ICM-42688-P at register level with its FIFO of packets."""

from __future__ import annotations

import numpy as np

from hw.virtual.banked_twin import BankedTwin
from hw.virtual.fifo_twin import Counts
from hw.virtual.response import Response, delay, in_turn, lowpass

DEVICE_CONFIG, FIFO_CONFIG, TEMPERATURE, DATA, INT_STATUS, FIFO_COUNT, FIFO_DATA = (
    *(0x11, 0x16, 0x1D, 0x1F, 0x2D, 0x2E, 0x30),
)
SIGNAL_PATH_RESET, INTF_CONFIG0, POWER, ACCEL_CONFIG0, FIFO_CONFIG1 = 0x4B, 0x4C, 0x4E, 0x50, 0x5F
SELF_TEST_CONFIG, WHO_AM_I, BANK_SELECT, SELF_TEST_CODES = 0x70, 0x75, 0x76, 0x23B
RUNNING = frozenset((SIGNAL_PATH_RESET, POWER, 0x4F, ACCEL_CONFIG0))  # may be written while the sensors are on
READ_ONLY = frozenset((*range(TEMPERATURE, 0x39), 0x6C, 0x6D, WHO_AM_I))
RESET_VALUES = {
    0x13: 0x05, INT_STATUS: 0x10, INTF_CONFIG0: 0x30, 0x4D: 0x91, 0x4F: 0x06, ACCEL_CONFIG0: 0x06, 0x51: 0x16,
    0x52: 0x11, 0x53: 0x0D, 0x54: 0x23, 0x56: 0x82, 0x62: 0x10, 0x65: 0x10, 0x17A: 0x83, 0x17C: 0x5F, 0x203: 0x30,
    0x204: 0x40, 0x205: 0x62,
}  # fmt: skip
# Data sheet, section 5.5, second-order filter, bandwidth code 0: by code of the rate, corner in Hz and delay in ms
FILTERS = {
    6: (493.3, 0.7), 15: (246.7, 1.3), 7: (98.7, 3.3), 8: (49.3, 6.5), 9: (24.7, 12.9), 10: (12.3, 25.7),
}  # fmt: skip


def filters(rate_code: int) -> Response:
    """The filters of the chip at an output data rate: the one of the table, and the anti-alias filter after a reset."""
    corner_hz, delay_ms = FILTERS[rate_code]
    later_s = 1e-3 * delay_ms - 2**0.5 / (2 * np.pi * corner_hz)
    return in_turn(lowpass(2, corner_hz), lowpass(2, 1163.0), delay(later_s))


class Icm42688Twin(BankedTwin):
    """See FifoTwin. A read of FIFO_COUNTL gives the count that the read before it has latched."""

    fifo_bytes = 255 * 8
    sample_bytes = 8
    word_bytes = 8
    data_register = FIFO_DATA
    identity = 0x47
    bank_select, bank_unit = BANK_SELECT, 1
    self_test_codes = bytes([113, 113, 113])  # 0.487 g each

    def _reset_registers(self) -> bytearray:
        registers = bytearray(5 * 256)
        for register, value in RESET_VALUES.items():
            registers[register] = value
        registers[WHO_AM_I] = self.identity
        registers[SELF_TEST_CODES : SELF_TEST_CODES + 3] = self.self_test_codes
        self._count = 0
        return registers

    @property
    def _filling(self) -> bool:
        to_fifo = self.registers[FIFO_CONFIG] >> 6 == 1 and self.registers[FIFO_CONFIG1] & 0x13 == 0x01
        return to_fifo and self.registers[POWER] & 0x03 == 0x03

    @property
    def response(self) -> Response:
        return filters(self.registers[ACCEL_CONFIG0] & 0x0F)

    def _encode(self, first: int, counts: Counts) -> bytes:  # noqa: ARG002 - the samples of this part carry no number
        numbers = np.maximum(counts, -32766).astype(">i2").view(np.uint8).reshape(-1, 6)
        ends = np.zeros((len(counts), 1), np.uint8)
        return np.column_stack([ends + 0x40, numbers, ends]).tobytes()

    def _fill(self) -> None:
        super()._fill()
        self._overrun |= len(self._fifo) >= self.fifo_bytes

    def _nothing(self, count: int) -> bytes:
        return b"\xff" * count

    def _deflection(self) -> Counts:
        on = self.registers[SELF_TEST_CONFIG] & 0x78 == 0x78
        return np.full(3, 1000 << (self.registers[ACCEL_CONFIG0] >> 5) if on else 0, np.int32)  # 0.49 g

    def _get(self, register: int) -> int:
        if register == INT_STATUS:
            status = self.registers[INT_STATUS] | self._overrun << 1
            self.registers[INT_STATUS], self._overrun = 0, False
            return status
        if register in (FIFO_COUNT, FIFO_COUNT + 1):
            count = self._count.to_bytes(2, "big")[register - FIFO_COUNT]
            if register == FIFO_COUNT + 1:
                self._count = len(self._fifo) // (8 if self.registers[INTF_CONFIG0] & 0x40 else 1)
            return count
        return self._reading(register, TEMPERATURE, DATA)

    def _set(self, register: int, value: int) -> None:
        if register == DEVICE_CONFIG and value & 0x01:
            self.power_cycle()
        elif register == SIGNAL_PATH_RESET:
            if value & 0x02:
                self._empty()
        elif register == BANK_SELECT or (
            register not in READ_ONLY and (register in RUNNING or register > 0xFF or not self.registers[POWER] & 0x0F)
        ):
            before = self._filling
            self.registers[register] = value
            if self._filling != before:
                self._empty()
