"""Driver `icm42688`: the ICM-42688-P on I2C, the accelerometer read through the FIFO."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from hw import icm42688_registers as chip
from hw.banks import BankedDevice, BankedSensor
from hw.block import DeviceInfo
from hw.fifo import Burst, FifoSamples
from hw.fifo_options import FifoOptions
from hw.fifo_sensor import Registers
from hw.self_test import SelfTest

RESET_WAIT_S = 0.01  # data sheet: 1 ms
START_WAIT_S = 0.1  # data sheet: the gyroscope is ready after 30 ms and must stay on for 45 ms
FLUSH_WAIT_S = 0.001
LOST = "FIFO overrun or incomplete samples; FIFO was flushed"


class Icm42688Options(FifoOptions):
    """Options of `icm42688`."""

    rates_hz = tuple(chip.RATES)
    fifo_samples = chip.FIFO_PACKETS
    bytes_a_sample = chip.PACKET_BYTES
    bytes_a_poll = 15  # address, register, address each for twice FIFO_COUNTL, data, INT_STATUS; three bytes
    reads_a_poll = 4

    address: Literal[0x68, 0x69] = Field(0x68, description="104 (0x68), or 105 (0x69) with AP_AD0 high")
    rate_hz: float = Field(1000.0, description=f"one of {', '.join(f'{rate:g}' for rate in chip.RATES)}")
    range_g: Literal[2, 4, 8, 16] = Field(2, description="range, plus and minus")

    @property
    def known_filters(self) -> tuple[str, ...]:
        """As the data sheet says."""
        return chip.filters(self.rate_hz)


class _Icm42688(BankedDevice):
    bank_select, bank_unit, banks = chip.BANK_SELECT, 1, range(5)


class Icm42688(BankedSensor):
    """Reads the number of packets, then these packets, then whether the FIFO was full since the poll before.

    The number is below 256, so its lower byte tells it. That byte is read twice, and the first value is not used: the
    first read latches the number. A packet has a header, but no counter. The driver discards what a poll has read and
    flushes the FIFO if it was full, if a read was interrupted, or if a header is not that of a packet.
    """

    options_model = Icm42688Options
    device_class = _Icm42688
    identity_register, identity = chip.WHO_AM_I, chip.IDENTITY
    word_bytes = chip.PACKET_BYTES

    def _kind(self) -> str:
        return "ICM-42688-P"

    def _limits(self) -> tuple[int, int]:
        return chip.LIMITS

    def _settings(self) -> Registers:
        return chip.settings(self._options.rate_hz, self._options.range_g)

    def _counts_per_g(self) -> float:
        return chip.COUNTS_PER_G[self._options.range_g]

    def _self_test(self) -> SelfTest:
        return chip.self_test(self._device.read(chip.SELF_TEST_CODES, 3), self._options.rate_hz)

    def _self_test_range_g(self) -> int:
        return max(int(self._options.range_g), chip.SELF_TEST_RANGE_G)

    def _set_up(self, identity: Mapping[str, int]) -> DeviceInfo:
        self._device.write(chip.DEVICE_CONFIG, chip.RESET)
        self._sleep(RESET_WAIT_S)
        self._write_settings(last=chip.POWER)
        self._sleep(START_WAIT_S)
        self._flush()
        self._device.read(chip.INT_STATUS, 1)
        return self._info("icm42688", self._options.rate_hz, identity)

    def _flush(self) -> None:
        self._device.write(chip.SIGNAL_PATH_RESET, chip.FLUSH)
        self._sleep(FLUSH_WAIT_S)

    def _temperature(self) -> tuple[int, float]:
        return chip.temperature(self._device.read(chip.TEMPERATURE, 2))

    def _poll(self) -> Burst:
        retries = self._device.retries
        count = [(chip.FIFO_COUNT_L, 1)]
        arrival_ns, utc_ns, (_, packets) = self._device.read_stamped(2 * count, self._clock)
        data = self._device.read(chip.FIFO_DATA, self.word_bytes * packets) if packets else b""
        data = chip.without_empty(data)
        (status,) = self._device.read(chip.INT_STATUS, 1)
        # A failed read of INT_STATUS has cleared the flag
        lost = bool(status & chip.FULL) or self._device.retries > retries or not chip.in_step(data)
        if lost:
            self._check_bank()  # a flush would write to a register of the other bank
            self._drop(LOST, packets)
            self._flush()
            data = b""
        return Burst(arrival_ns, utc_ns, data, lost)

    def _decode(self, data: bytes) -> FifoSamples:
        return chip.samples(data)
