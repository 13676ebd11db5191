"""Driver `lis3dh`: LIS3DH and LIS2DH12 on I2C, read through the FIFO."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from hw import lis3dh_registers as chip
from hw.block import DeviceInfo
from hw.fifo import Burst, FifoSamples
from hw.fifo_options import FifoOptions
from hw.fifo_sensor import FifoSensor, Registers
from hw.self_test import SelfTest
from hw.sensor import IdentityError

# Of 32 samples. A sample may be overwritten between the read of the level and that of the data, and no flag tells it
# afterwards; the margin covers a part that samples up to 14 % faster than its nominal rate.
NEARLY_FULL = 28
LOST = "FIFO overrun or interrupted FIFO read"


class Lis3dhOptions(FifoOptions):
    """Options of `lis3dh`."""

    rates_hz = tuple(chip.RATE_CODES)
    fifo_samples = NEARLY_FULL
    bytes_a_sample = chip.SAMPLE_BYTES
    bytes_a_poll = 7  # address, register, address, FIFO_SRC_REG; address, register, address before the data
    reads_a_poll = 2

    address: Literal[0x18, 0x19] = Field(0x18, description="24 (0x18), or 25 (0x19) with SA0 high")
    rate_hz: float = Field(400.0, description=f"one of {', '.join(f'{rate:g}' for rate in chip.RATE_CODES)}")
    range_g: Literal[2, 4, 8, 16] = Field(2, description="range, plus and minus")

    @property
    def known_filters(self) -> tuple[str, ...]:
        """As the data sheet says."""
        return chip.filters(self.rate_hz)


class Lis3dh(FifoSensor):
    """Reads the number of stored samples in one transfer, then these samples.

    The samples carry no counter. If the FIFO was nearly full or a read was interrupted, the driver discards the samples
    of that poll and flags the next block RESTART. The part does not tell a LIS3DH from a LIS2DH12; the registers used
    here are the same. Its temperature is not read: it has no stated zero, and users find it off by more than 10 degC
    (rickkas7/LIS3DH issue 4).
    """

    options_model = Lis3dhOptions
    word_bytes = chip.SAMPLE_BYTES
    auto_increment = chip.AUTO_INCREMENT
    identity_register = chip.WHO_AM_I
    filter_settings = ("CTRL_REG1",)

    def _kind(self) -> str:
        return "LIS3DH"

    def _limits(self) -> tuple[int, int]:
        return chip.limits(self._options.range_g)

    def _settings(self) -> Registers:
        return chip.settings(self._options.rate_hz, self._options.range_g)

    def _counts_per_g(self) -> float:
        return 1000.0 / chip.MG_PER_COUNT[self._options.range_g]

    def _self_test(self) -> SelfTest:
        return chip.self_test(self._options.rate_hz, self._options.range_g)

    def _self_test_range_g(self) -> int:
        return max(int(self._options.range_g), chip.SELF_TEST_RANGE_G)

    def _identify(self) -> dict[str, int]:
        (found,) = self._device.read(chip.WHO_AM_I, 1)
        if found != chip.IDENTITY:
            raise IdentityError(f"{self._device.name}: expected the ID 0x{chip.IDENTITY:02X}, found 0x{found:02X}")
        return {"WHO_AM_I": found}

    def _set_up(self, identity: Mapping[str, int]) -> DeviceInfo:
        self._write_settings(last=chip.FIFO_CTRL_REG)
        self._device.write(chip.FIFO_CTRL_REG, chip.BYPASS)  # This empties the FIFO.
        self._sleep(chip.SETTLE_SAMPLES / self._options.rate_hz)
        self._device.write(chip.FIFO_CTRL_REG, chip.STREAM)
        return self._info("lis3dh", self._options.rate_hz, identity)

    def _poll(self) -> Burst:
        retries, began_ns = self._device.retries, self._clock()[0]
        arrival_ns, utc_ns, (source,) = self._device.read_stamped([(chip.FIFO_SRC_REG, 1)], self._clock)
        level = chip.FIFO_SAMPLES if source & chip.OVERRUN else source & chip.LEVEL_MASK
        data = self._device.read(chip.DATA | chip.AUTO_INCREMENT, self.word_bytes * level) if level else b""
        made_since = (self._clock()[0] - began_ns) * 1e-9 * self._options.rate_hz
        lost = level + made_since > NEARLY_FULL or self._device.retries > retries
        if lost:
            self._drop(LOST, level)
            data = b""
        return Burst(arrival_ns, utc_ns, data, lost)

    def _decode(self, data: bytes) -> FifoSamples:
        return chip.samples(data)
