"""An MPU-6050 or one of its successors at register level with its FIFO, which overruns byte by byte."""

from __future__ import annotations

import numpy as np

from hw.virtual.fifo_twin import Counts, FifoTwin
from hw.virtual.response import Response, lowpass

SMPLRT_DIV, CONFIG, FIFO_EN, INT_ENABLE, INT_STATUS, DATA, TEMPERATURE = 0x19, 0x1A, 0x23, 0x38, 0x3A, 0x3B, 0x41
USER_CTRL, POWER_1, POWER_2, FIFO_COUNT, FIFO_DATA, WHO_AM_I = 0x6A, 0x6B, 0x6C, 0x72, 0x74, 0x75
TRIM = bytes([0x12, 0x34, 0x56, 0x78, 0x9A, 0xBC])  # factory trim; any constant will do


# Register map, accelerometer bandwidth in Hz by the code in CONFIG.
BANDWIDTH_HZ = {1: 184.0, 2: 94.0, 3: 44.0, 4: 21.0, 5: 10.0, 6: 5.0}


def filters(code: int) -> Response:
    """The filter of the chip with this code in CONFIG. The register map tells no order; this one has the second."""
    return lowpass(2, BANDWIDTH_HZ[code])


class Mpu6050Twin(FifoTwin):
    """See FifoTwin."""

    fifo_bytes = 1024
    sample_bytes = 6
    word_bytes = 1
    data_register = FIFO_DATA
    identity = 0x68
    trim_register = 0x06
    # factory value 0.488 g: code 12 in the five bits of the MPU-6050, 113 in later parts
    self_test_codes = bytes([3 << 5, 3 << 5, 3 << 5, 0])
    temperature_at_25_degc = round((25 - 36.53) * 340)

    def _reset_registers(self) -> bytearray:
        registers = bytearray(256)
        registers[WHO_AM_I] = self.identity
        registers[0x0D:0x11] = self.self_test_codes
        registers[POWER_1] = 0x40  # sleep mode
        registers[self.trim_register : self.trim_register + len(TRIM)] = TRIM
        return registers

    @property
    def _filling(self) -> bool:
        awake = not self.registers[POWER_1] & 0x40
        return awake and bool(self.registers[USER_CTRL] & 0x40) and bool(self.registers[FIFO_EN] & 0x08)

    @property
    def response(self) -> Response:
        return filters(self.registers[CONFIG] & 7)

    def _encode(self, first: int, counts: Counts) -> bytes:  # noqa: ARG002 - these samples carry no number
        return counts.astype(">i2").tobytes()

    def _deflection(self) -> Counts:
        change = 8000 >> (self.registers[0x1C] >> 3 & 3)  # the same in g at every range
        return np.full(3, change if self.registers[0x1C] & 0xE0 == 0xE0 else 0, np.int32)

    def _get(self, register: int) -> int:
        if register == INT_STATUS:
            status = (self._overrun and bool(self.registers[INT_ENABLE] & 0x10)) << 4
            self._overrun = False
            return status
        if register in (FIFO_COUNT, FIFO_COUNT + 1):
            return len(self._fifo).to_bytes(2, "big")[register - FIFO_COUNT]
        return self._reading(register, TEMPERATURE, DATA)

    def _set(self, register: int, value: int) -> None:
        if register == POWER_1 and value & 0x80:
            self.power_cycle()
        elif register == USER_CTRL:
            before = self._filling
            self.registers[USER_CTRL] = value & ~0x04
            if value & 0x04 or self._filling != before:
                self._empty()
        elif register in (POWER_1, POWER_2) or (SMPLRT_DIV <= register <= INT_ENABLE and self._awake):
            self.registers[register] = value

    @property
    def _awake(self) -> bool:
        return not self.registers[POWER_1] & 0x40


class Mpu6500Twin(Mpu6050Twin):
    """The MPU-6500: another identity, half the FIFO, another temperature line."""

    fifo_bytes = 512
    identity = 0x70
    trim_register = 0x77
    self_test_codes = bytes([113, 113, 113, 0])
    temperature_at_25_degc = round((25 - 21) * 333.87)
