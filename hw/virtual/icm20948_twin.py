"""The accelerometer of an ICM-20948 at register level, with its FIFO, which overruns byte by byte."""

from __future__ import annotations

import numpy as np

from hw.virtual.banked_twin import BankedTwin
from hw.virtual.fifo_twin import Counts
from hw.virtual.response import Response, lowpass

WHO_AM_I, USER_CTRL, LP_CONFIG, POWER_1, POWER_2, INT_ENABLE_2, INT_STATUS_2, DATA, TEMPERATURE = (
    *(0x00, 0x03, 0x05, 0x06, 0x07, 0x12, 0x1B, 0x2D, 0x39),
)
FIFO_EN_2, FIFO_RST, FIFO_COUNT, FIFO_DATA, BANK_SELECT = 0x67, 0x68, 0x70, 0x72, 0x7F
SELF_TEST_CODES, OFFSETS, ACCEL_CONFIG, ACCEL_CONFIG_2 = 0x10E, 0x114, 0x214, 0x215
TRIM = bytes([0x12, 0x34, 0x00, 0x56, 0x78, 0x00, 0x9A, 0xBC])  # factory trim; any constant will do
READ_ONLY = frozenset((WHO_AM_I, INT_STATUS_2, *range(DATA, TEMPERATURE + 2), *range(FIFO_COUNT, 0x75)))
# SparkFun, ICM_20948_ENUMERATIONS.h: bandwidth in Hz by the code in ACCEL_CONFIG
BANDWIDTH_HZ = (246.0, 246.0, 111.4, 50.4, 23.9, 11.5, 5.7, 473.0)


def filters(code: int) -> Response:
    """The filter of the chip with this code in ACCEL_CONFIG. The sources tell no order; this one has the second."""
    return lowpass(2, BANDWIDTH_HZ[code])


class Icm20948Twin(BankedTwin):
    """See FifoTwin."""

    fifo_bytes = 512
    sample_bytes = 6
    word_bytes = 1
    data_register = FIFO_DATA
    identity = 0xEA
    bank_select, bank_unit = BANK_SELECT, 0x10
    self_test_codes = bytes([113, 113, 113])  # 0.487 g each
    temperature_at_25_degc = round((25 - 21) * 333.87)

    def _reset_registers(self) -> bytearray:
        registers = bytearray(4 * 256)
        registers[WHO_AM_I] = self.identity
        registers[LP_CONFIG], registers[POWER_1] = 0x40, 0x41  # asleep
        registers[ACCEL_CONFIG] = 0x01
        registers[SELF_TEST_CODES : SELF_TEST_CODES + 3] = self.self_test_codes
        registers[OFFSETS : OFFSETS + len(TRIM)] = TRIM
        return registers

    @property
    def _filling(self) -> bool:
        on = not self.registers[POWER_1] & 0x40 and not self.registers[POWER_2] & 0x38
        to_fifo = self.registers[USER_CTRL] & 0x40 and self.registers[FIFO_EN_2] == 0x10
        return on and bool(to_fifo) and not self.registers[FIFO_RST] & 0x1F

    @property
    def response(self) -> Response:
        return filters(self.registers[ACCEL_CONFIG] >> 3 & 7)

    def _encode(self, first: int, counts: Counts) -> bytes:  # noqa: ARG002 - the samples of this part carry no number
        return counts.astype(">i2").tobytes()

    def _nothing(self, count: int) -> bytes:
        return b"\xff" * count

    def _deflection(self) -> Counts:
        on = self.registers[ACCEL_CONFIG_2] & 0x1C == 0x1C
        return np.full(3, 8000 >> (self.registers[ACCEL_CONFIG] >> 1 & 3) if on else 0, np.int32)  # 0.49 g

    def _get(self, register: int) -> int:
        if register == INT_STATUS_2:
            status = self._overrun and bool(self.registers[INT_ENABLE_2] & 0x01)
            self._overrun = False
            return int(status)
        if register in (FIFO_COUNT, FIFO_COUNT + 1):
            return len(self._fifo).to_bytes(2, "big")[register - FIFO_COUNT]
        return self._reading(register, TEMPERATURE, DATA)

    def _set(self, register: int, value: int) -> None:
        if register == POWER_1 and value & 0x80:
            self.power_cycle()
        elif register not in READ_ONLY:
            before = self._filling
            self.registers[register] = value
            if self._filling != before:
                self._empty()
