"""Driver `adxl345`: the ADXL345 on I2C or SPI, read through its FIFO."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from pydantic import Field

from hw import adxl345_registers as chip
from hw.block import DeviceInfo
from hw.fifo import Burst, FifoSamples, plain_samples
from hw.fifo_options import FifoOptions
from hw.fifo_sensor import FifoSensor, Registers
from hw.self_test import SelfTest
from hw.sensor import IdentityError

LOST = "a full FIFO, which may have lost samples, or an interrupted FIFO read"


class Adxl345Options(FifoOptions):
    """Options of `adxl345`."""

    rates_hz = tuple(chip.RATE_CODES)
    fifo_samples = chip.FIFO_SAMPLES
    bytes_a_sample = 11  # one read per sample: address, register, address, INT_SOURCE, DATA_FORMAT, six data bytes
    bytes_a_poll = 4  # address, register, address, FIFO_STATUS
    reads_a_sample, reads_a_poll = 1, 1
    stated_hz_a_khz = chip.STATED_HZ_A_KHZ
    spi = chip.SPI

    address: Literal[0x53, 0x1D] = Field(0x53, description="83 (0x53), or 29 (0x1D) with ALT ADDRESS high")
    rate_hz: float = Field(800.0, description=f"one of {', '.join(f'{rate:g}' for rate in chip.RATE_CODES)}")
    range_g: Literal[2, 4, 8, 16] = Field(16, description="range, plus and minus; all ranges have the same resolution")

    @property
    def known_filters(self) -> tuple[str, ...]:
        """As the data sheet says."""
        return chip.filters(self.rate_hz)


class Adxl345(FifoSensor):
    """Reads the number of FIFO entries, then the samples, one register read per sample.

    Each register read starts at INT_SOURCE, two registers before the data, because reading the data clears the overrun
    bit in INT_SOURCE, and the adapter may stall between two reads. The samples of this part carry no counter, and the
    overrun bit tells a full FIFO, whether samples were lost or not. If the FIFO was full during a poll, the driver
    therefore discards all samples of that poll and flags the next block RESTART and OVERRUN.
    """

    options_model = Adxl345Options
    word_bytes = 6
    read_bytes = chip.SAMPLE_BYTES
    filter_settings = ("BW_RATE",)

    def _kind(self) -> str:
        return "ADXL345"

    def _limits(self) -> tuple[int, int]:
        return chip.limits(self._options.range_g)

    def _settings(self) -> Registers:
        return chip.settings(self._options.rate_hz, self._options.range_g)

    def _counts_per_g(self) -> float:
        return chip.COUNTS_PER_G

    def _self_test(self) -> SelfTest:
        return chip.self_test(self._options.range_g)

    def _identify(self) -> dict[str, int]:
        (found,) = self._device.read(chip.DEVID, 1)
        if found != chip.IDENTITY:
            raise IdentityError(f"{self._device.name}: expected the ID 0x{chip.IDENTITY:02X}, found 0x{found:02X}")
        return {"DEVID": found}

    def _set_up(self, identity: Mapping[str, int]) -> DeviceInfo:
        self._device.write(chip.POWER_CTL, chip.STANDBY)
        self._device.write(chip.FIFO_CTL, chip.BYPASS)  # This empties the FIFO.
        self._device.read(chip.DATA, 6)  # This clears the flags that an earlier run left in INT_SOURCE.
        self._write_settings(last=chip.POWER_CTL)
        return self._info("adxl345", self._options.rate_hz, identity)

    def _poll(self) -> Burst:
        retries = self._device.retries
        arrival_ns, utc_ns, (status,) = self._device.read_stamped([(chip.FIFO_STATUS, 1)], self._clock)
        left = status & chip.ENTRIES_MASK
        answer = self._device.read_each([(chip.INT_SOURCE, chip.SAMPLE_BYTES)] * left)
        reads = np.frombuffer(answer, np.uint8).reshape(left, chip.SAMPLE_BYTES)
        lost = bool((reads[:, 0] & chip.OVERRUN).any()) or self._device.retries > retries
        data = reads[:, -self.word_bytes :].tobytes()
        if lost:
            self._drop(LOST, len(data) // self.word_bytes)
            data = b""
        return Burst(arrival_ns, utc_ns, data, lost)

    def _decode(self, data: bytes) -> FifoSamples:
        return plain_samples(data, "<")
