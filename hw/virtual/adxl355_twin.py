"""An ADXL355, ADXL357 or ADXL359 at register level with its FIFO."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hw.virtual.fifo_twin import Counts, FifoTwin
from hw.virtual.response import Array, Response, delay, in_turn, lowpass, taps

IDENTITY = bytes([0xAD, 0x1D, 0xED, 0x01])
EMPTY_ENTRY = b"\x00\x00\x02"
BYTE_S = 9 / 400e3  # time of a byte on a bus of 400 kHz
DRIVE_STOPS_S = 0.5e-3
HIGHEST = 2**19 - 1
STATUS, FIFO_ENTRIES, TEMPERATURE, DATA, FIFO_DATA = 0x04, 0x05, 0x06, 0x08, 0x11
FIRST_SETTING, FILTER, RANGE, POWER_CTL, SELF_TEST, RESET, RESET_CODE, SHADOW_1 = (
    *(0x1E, 0x28, 0x2C, 0x2D, 0x2E, 0x2F, 0x52, 0x50),
)
LAST_SETTING = SELF_TEST
RESET_VALUES = {0x27: 0x01, 0x29: 0x60, RANGE: 0x81, POWER_CTL: 0x01}


# Data sheet, "Digital filter group delay and profile": a fixed stage decimates to 4 kHz, a variable one to the rate.
HALVING = np.array([1.0, 5.0, 10.0, 10.0, 5.0, 1.0])  # five means of two samples, at 8 kHz
FIXED_HZ = 4000.0


def filters(rate_hz: float) -> Response:
    """The filters of the chip at an output data rate."""
    decimation = round(FIXED_HZ / rate_hz)
    variable = np.convolve(np.ones(decimation), np.ones(decimation))  # two means over the decimation, at 4 kHz
    waiting = delay(0.17e-3 + 0.5 / rate_hz)
    return in_turn(lowpass(1, 4700.0), taps(HALVING, 2.0 * FIXED_HZ), taps(variable, FIXED_HZ), waiting)


def shaken(
    felt_g: Callable[[Array], Array], rate_hz: float, counts_per_g: float, over_g: float = np.inf
) -> Callable[[int, int], Counts]:
    """A `source` of the twin in the time domain: the chip feels `felt_g(t_s)`, (n,) -> (n, 3), in g.

    Beyond `over_g` on any axis the drive of the sensor stops for 0.5 ms, and all axes read zero (data sheet, "Overrange
    protection": 8 g at a range of 2 g). The filters come behind it, and the end of the range behind them.
    """
    decimation = round(FIXED_HZ / rate_hz)
    mean = np.zeros(2 * decimation - 1)
    mean[::2] = 1.0  # of the samples at 4 kHz, among those at 8 kHz
    weights = np.convolve(HALVING, np.convolve(mean, mean) if decimation > 1 else [1.0])
    fine_hz, stopped = 2.0 * FIXED_HZ, round(DRIVE_STOPS_S * 2.0 * FIXED_HZ)

    def source(first: int, n: int) -> Counts:
        sample = np.arange(first, first + n) * 2 * decimation
        reach = len(weights) + stopped
        felt = felt_g(np.arange(sample[0] - reach, sample[-1] + 1) / fine_hz)
        over = np.max(np.abs(felt), axis=1) > over_g
        felt[np.convolve(over, np.ones(stopped))[: len(over)] > 0] = 0.0
        passed = np.column_stack([np.convolve(axis, weights / weights.sum())[: len(axis)] for axis in felt.T])
        counts = np.rint(passed[sample - sample[0] + reach] * counts_per_g)
        return np.asarray(np.clip(counts, -HIGHEST - 1, HIGHEST), np.int32)

    return source


def encode(counts: NDArray[np.int32]) -> bytes:
    """FIFO entries of (n, 3) counts: 20 bits each, left-justified in 3 bytes; bit 0 marks X."""
    words = (counts.astype(np.uint32) & 0xFFFFF) << 4
    words[:, 0] |= 1
    return words.astype(">u4").view(np.uint8).reshape(-1, 4)[:, 1:].tobytes()


class Adxl355Twin(FifoTwin):
    """See FifoTwin. `identity` are the four ID registers, by default those of the real part.

    For `reset_s` after a reset the trim is not loaded: all registers read 0xFF (NVM_BUSY is a bit of STATUS), and
    settings are not accepted. The temperature may change between its two bytes.
    """

    own_identity = IDENTITY
    # At the lowest range: by ST2, the typical values of the data sheet, 0.3, 0.3 and 1.5 g; by ST1 alone any constants
    self_test_counts = (76800, 76800, 384000)
    self_test_mode_counts = (-70000, 60000, 50000)

    fifo_bytes = 96 * 3
    sample_bytes = 9
    word_bytes = 3
    data_register = FIFO_DATA
    temperature_at_25_degc = 1885
    reset_s = 0.005
    shadow = bytes([0x4C, 0x21, 0x9A, 0x05, 0x33])  # factory trim; any constant will do
    spi_modes: ClassVar[tuple[int, ...]] = (0,)
    spi_highest_hz: ClassVar[float] = 10e6

    def __init__(
        self,
        source: Callable[[int, int], Counts],
        samples_due: Callable[[float], int],
        clock: Callable[[], float],
        *,
        identity: bytes | None = None,
        temperature_raw: Callable[[float], int] | None = None,
        electrostatic: Callable[[float], NDArray[np.float64]] | None = None,
    ) -> None:
        self._identity = identity or self.own_identity
        super().__init__(source, samples_due, clock, temperature_raw=temperature_raw, electrostatic=electrostatic)
        self._ready_s = clock()  # the device has had power for a long time

    def power_cycle(self) -> None:
        """Power fails and comes back: registers as after a reset, device in standby."""
        super().power_cycle()
        self._ready_s = self._clock() + self.reset_s

    def _reset_registers(self) -> bytearray:
        registers = bytearray(256)
        registers[: len(self._identity)] = self._identity
        for register, value in RESET_VALUES.items():
            registers[register] = value
        return registers

    @property
    def _filling(self) -> bool:
        return not self.registers[POWER_CTL] & 1

    @property
    def response(self) -> Response:
        return filters(FIXED_HZ / 2 ** (self.registers[FILTER] & 0x0F))

    def _encode(self, first: int, counts: Counts) -> bytes:  # noqa: ARG002 - these entries carry no number
        return encode(counts)

    def _spi_command(self, first: int) -> tuple[int, bool, bool]:
        return first // 2, first % 2 == 1, True

    def _nothing(self, count: int) -> bytes:
        return (EMPTY_ENTRY * (count // 3 + 1))[:count]

    def _deflection(self) -> Counts:
        st1, st2 = self.registers[SELF_TEST] & 1, self.registers[SELF_TEST] >> 1 & 1
        lowest = st1 * (np.array(self.self_test_mode_counts) + st2 * np.array(self.self_test_counts))
        return np.asarray(lowest >> (self.registers[RANGE] & 3) - 1, np.int32)

    def _get(self, register: int) -> int:
        if self._clock() < self._ready_s:
            return 0xFF
        if register == STATUS:
            entries = len(self._fifo) // 3
            full = entries >= self.registers[0x29]
            status = bool(entries) | full << 1 | self._overrun << 2
            self._overrun = False
            return status
        if register == FIFO_ENTRIES:
            return len(self._fifo) // 3
        if register == TEMPERATURE:
            return self._temperature_raw(self._clock()) >> 8 & 0x0F
        if register == TEMPERATURE + 1:
            return self._temperature_raw(self._clock() + BYTE_S) & 0xFF
        if DATA <= register < DATA + 9:
            newest = self._newest() if self._filling else np.zeros(3, np.int32)  # in standby nothing is measured
            return encode(newest[None])[register - DATA] & (0xFE if register == DATA + 2 else 0xFF)
        if SHADOW_1 <= register < SHADOW_1 + len(self.shadow):
            return self.shadow[register - SHADOW_1]
        return self.registers[register]

    def _set(self, register: int, value: int) -> None:
        if register == RESET and value == RESET_CODE:
            self.power_cycle()
        elif self._clock() < self._ready_s:
            return
        elif register == POWER_CTL:
            before = self._filling
            self.registers[register] = value
            if self._filling != before:
                self._empty()
        elif register == SELF_TEST or (FIRST_SETTING <= register <= LAST_SETTING and not self._filling):
            self.registers[register] = value


class Adxl357Twin(Adxl355Twin):
    """Like the ADXL355, with five times the range and another temperature line."""

    self_test_counts = (15360, 15360, 64000)  # z: typical value of the data sheet, 1.25 g
    temperature_at_25_degc = 1852


class Adxl359Twin(Adxl357Twin):
    """Like the ADXL357, with a different part ID."""

    own_identity = bytes([0xAD, 0x1D, 0xE9, 0x01])
