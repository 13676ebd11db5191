"""Driver `lsm6dso`: LSM6DSO and LSM6DSOX on I2C or SPI, the accelerometer read through the tagged FIFO."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from hw import lsm6dso_registers as chip
from hw.block import DeviceInfo
from hw.fifo import Burst, FifoSamples
from hw.fifo_options import FifoOptions
from hw.fifo_sensor import FifoSensor, Registers
from hw.self_test import SelfTest
from hw.sensor import DeviceLost, IdentityError

RESET_WAIT_S = 0.01
RESET_ATTEMPTS = 5
LOST = "FIFO overrun while it was read, or interrupted FIFO read"
SETTLE_SAMPLES = 5  # AN5192: discard the first one to four samples after a start


class Lsm6dsoOptions(FifoOptions):
    """Options of `lsm6dso`."""

    rates_hz = chip.RATES_HZ
    fifo_samples = chip.FIFO_WORDS
    bytes_a_sample = chip.WORD_BYTES
    bytes_a_poll = 13  # address, register, address each for count, data and FIFO_STATUS; 2 + 2 bytes of FIFO_STATUS
    spi = chip.SPI

    address: Literal[0x6A, 0x6B] = Field(0x6A, description="106 (0x6A), or 107 (0x6B) with SA0 high")
    rate_hz: float = Field(833.0, description=f"one of {', '.join(f'{rate:g}' for rate in chip.RATES_HZ)}")
    range_g: Literal[2, 4, 8, 16] = Field(2, description="range, plus and minus")

    @property
    def known_filters(self) -> tuple[str, ...]:
        """As ST's application note says."""
        return chip.filters(self.rate_hz)


class Lsm6dso(FifoSensor):
    """Reads FIFO_STATUS in one transfer, then the number of words that it states.

    Each word names its sensor and has a counter from 0 to 3, so a lost word is noticed, but not four of them. A read of
    many words is done in several transfers, between which words may be lost: if the FIFO overran after the count, or a
    read of it was interrupted, the driver discards what it read.

    The nominal rate is the one that the part states of itself (INTERNAL_FREQ_FINE). The part's own time stamps are not
    stored: they would double the traffic on the bus. Sample times from the arrivals reach about 40 us within a minute;
    the part's stamps have a step of 25 us.
    """

    options_model = Lsm6dsoOptions
    word_bytes = chip.WORD_BYTES
    identity_register = chip.WHO_AM_I
    _counter: int | None = None

    def _kind(self) -> str:
        return "LSM6DSO"

    def _limits(self) -> tuple[int, int]:
        return chip.LIMITS

    def _settings(self) -> Registers:
        return chip.settings(self._options.rate_hz, self._options.range_g)

    def _counts_per_g(self) -> float:
        return 1000.0 / chip.MG_PER_COUNT[self._options.range_g]

    def _self_test(self) -> SelfTest:
        return chip.self_test(self._options.rate_hz)

    def _identify(self) -> dict[str, int]:
        (found,) = self._device.read(chip.WHO_AM_I, 1)
        if found != chip.IDENTITY:
            raise IdentityError(f"{self._device.name}: expected the ID 0x{chip.IDENTITY:02X}, found 0x{found:02X}")
        return {"WHO_AM_I": found}

    def _set_up(self, identity: Mapping[str, int]) -> DeviceInfo:
        self._reset()
        (freq_fine,) = self._device.read(chip.FREQ_FINE, 1)
        rate_hz = chip.actual_rate_hz(self._options.rate_hz, freq_fine)
        self._write_settings(last=chip.FIFO_CTRL4)
        self._device.write(chip.FIFO_CTRL4, chip.BYPASS)
        self._sleep(SETTLE_SAMPLES / rate_hz)
        self._device.write(chip.FIFO_CTRL4, chip.CONTINUOUS)
        return self._info("lsm6dso", rate_hz, {**identity, "INTERNAL_FREQ_FINE": freq_fine})

    def _trims(self) -> Mapping[int, str]:
        return {chip.FUNC_CFG_ACCESS: "FUNC_CFG_ACCESS"}  # selects which registers answer

    def _reset(self) -> None:
        self._device.write(chip.CTRL3_C, chip.SOFTWARE_RESET)
        for _ in range(RESET_ATTEMPTS):
            self._sleep(RESET_WAIT_S)
            if not self._device.read(chip.CTRL3_C, 1)[0] & chip.SOFTWARE_RESET:
                return
        raise DeviceLost(f"{self._device.name}: the device does not finish its reset; check its supply and wiring")

    def _temperature(self) -> tuple[int, float]:
        return chip.temperature(self._device.read(chip.TEMPERATURE, 2))

    def _forget(self) -> None:
        super()._forget()
        self._counter = None

    def _number_of_samples(self, data: bytes) -> int:
        return sum(tag >> 3 == chip.ACCELEROMETER for tag in data[:: chip.WORD_BYTES])

    def _poll(self) -> Burst:
        arrival_ns, utc_ns, status = self._device.read_stamped([(chip.FIFO_STATUS, 2)], self._clock)
        words = min(int.from_bytes(status, "little") & chip.COUNT_MASK, chip.FIFO_WORDS)
        # The flag may be gone: a read of FIFO_STATUS that failed has cleared it, or one of another program.
        lost = bool(status[1] & chip.OVERRUN) or words >= chip.FIFO_WORDS
        if not words:
            return Burst(arrival_ns, utc_ns, b"", lost)
        retries = self._device.retries
        # FIFO_STATUS is read again after the data: the FIFO may have overrun between the count and the data, even if
        # the count was low.
        data = self._device.read(chip.FIFO_DATA, chip.WORD_BYTES * words)
        if self._device.read(chip.FIFO_STATUS, 2)[1] & chip.OVERRUN or self._device.retries > retries:
            self._drop(LOST, words)
            return Burst(arrival_ns, utc_ns, b"", True)
        return Burst(arrival_ns, utc_ns, data, lost)

    def _decode(self, data: bytes) -> FifoSamples:
        samples, self._counter = chip.tagged_samples(data, self._counter)
        return samples
