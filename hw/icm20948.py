"""Driver `icm20948`: the accelerometer of the ICM-20948 on I2C, read through the FIFO."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from hw import icm20948_registers as chip
from hw import mpu6050_registers
from hw.banks import BankedDevice, BankedSensor
from hw.block import DeviceInfo
from hw.fifo import Burst, FifoSamples, plain_samples
from hw.fifo_options import FifoOptions
from hw.fifo_sensor import Registers
from hw.self_test import SelfTest
from hw.sensor import IdentityError

RESET_WAIT_S = 0.1
START_WAIT_S = 0.03  # data sheet: the accelerometer starts within 20 ms
FREE_SAMPLES_MIN = 3  # with less room the FIFO may overrun while it is read
LOST = "FIFO overrun or incomplete samples; FIFO was reset"


class Icm20948Options(FifoOptions):
    """Options of `icm20948`."""

    rates_hz = chip.RATES_HZ
    fifo_samples = chip.FIFO_BYTES // chip.SAMPLE_BYTES - FREE_SAMPLES_MIN
    bytes_a_sample = chip.SAMPLE_BYTES
    bytes_a_poll = 12  # address, register, address each for FIFO_COUNT, data, INT_STATUS_2; three bytes

    address: Literal[0x68, 0x69] = Field(0x68, description="104 (0x68), or 105 (0x69) with AD0 high")
    rate_hz: float = Field(1125.0, description=f"one of {', '.join(f'{rate:g}' for rate in chip.RATES_HZ)}")
    range_g: Literal[2, 4, 8, 16] = Field(2, description="range, plus and minus")

    @property
    def known_filters(self) -> tuple[str, ...]:
        """As the sources say."""
        return chip.filters(self.rate_hz)


class _Icm20948(BankedDevice):
    bank_select, bank_unit, banks = chip.BANK_SELECT, 0x10, range(4)


class Icm20948(BankedSensor):
    """Reads the byte count, then the bytes of all complete samples, then the overflow flag.

    The samples carry no marker, and the size of the FIFO is not a multiple of a sample. After an overrun it is unknown
    where a sample starts. The driver therefore resets the FIFO if it overran or almost did, if a read was interrupted,
    and if the byte count is not a multiple of a sample twice in a row (once is normal while a sample is being written).
    """

    options_model = Icm20948Options
    device_class = _Icm20948
    identity_register, identity = chip.WHO_AM_I, chip.IDENTITY
    word_bytes = chip.SAMPLE_BYTES

    def _kind(self) -> str:
        return "ICM-20948"

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

    def _identify(self) -> dict[str, int]:
        """The register of the identity holds a factory value in an MPU-6500, which may be the same by chance."""
        identity = super()._identify()
        (other,) = self._device.read(chip.OTHER_WHO_AM_I, 1)
        if other in mpu6050_registers.PARTS:
            kind = mpu6050_registers.PARTS[other].kind
            raise IdentityError(f"{self._device.name}: WHO_AM_I is 0x{other:02X}, this is an {kind}: use mpu6050")
        return identity

    def _set_up(self, identity: Mapping[str, int]) -> DeviceInfo:
        self._device.write(chip.POWER_1, chip.DEVICE_RESET)
        self._sleep(RESET_WAIT_S)
        self._device.write(chip.POWER_1, chip.AWAKE)  # the part sleeps after a reset
        self._sleep(START_WAIT_S)
        self._write_settings(last=chip.USER_CTRL)
        self._reset_fifo()
        self._device.read(chip.INT_STATUS_2, 1)
        trims = self._trims()
        untouched = {trims[register]: value for register, value in self._read_back(trims).items()}
        return self._info("icm20948", self._options.rate_hz, {**identity, **untouched})

    def _trims(self) -> Mapping[int, str]:
        return chip.TRIMS

    def _reset_fifo(self) -> None:
        self._device.write(chip.FIFO_RST, chip.ALL_FIFOS)
        self._device.write(chip.FIFO_RST, 0x00)

    def _temperature(self) -> tuple[int, float]:
        return chip.temperature(self._device.read(chip.TEMPERATURE, 2))

    def _poll(self) -> Burst:
        retries = self._device.retries
        arrival_ns, utc_ns, found = self._device.read_stamped([(chip.FIFO_COUNT, 2)], self._clock)
        count = int.from_bytes(found, "big") & chip.COUNT_MASK
        lost = count > chip.FIFO_BYTES - FREE_SAMPLES_MIN * self.word_bytes
        if count % self.word_bytes:
            again = int.from_bytes(self._device.read(chip.FIFO_COUNT, 2), "big") & chip.COUNT_MASK
            lost |= again % self.word_bytes != 0
        whole = count - count % self.word_bytes
        data = self._device.read(chip.FIFO_DATA, whole) if whole and not lost else b""
        (status,) = self._device.read(chip.INT_STATUS_2, 1)
        # A failed read of INT_STATUS_2 has cleared the flag
        if lost or status & chip.OVERFLOW or self._device.retries > retries:
            self._check_bank()  # a reset would write to a register of the other bank
            self._drop(LOST, count // self.word_bytes)
            self._reset_fifo()
            return Burst(arrival_ns, utc_ns, b"", True)
        return Burst(arrival_ns, utc_ns, data, False)

    def _decode(self, data: bytes) -> FifoSamples:
        return plain_samples(data, ">")
