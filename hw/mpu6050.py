"""Driver `mpu6050`: MPU-6050, MPU-6500 and MPU-9250 on I2C, the accelerometer read through the FIFO."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from hw import mpu6050_registers as chip
from hw.block import DeviceInfo
from hw.fifo import Burst, FifoSamples, plain_samples
from hw.fifo_options import FifoOptions
from hw.fifo_sensor import FifoSensor, Registers
from hw.self_test import SelfTest
from hw.sensor import IdentityError

RESET_WAIT_S = 0.1  # register map: 100 ms; Linux uses the same time
START_WAIT_S = 0.1  # the gyroscope and its clock have started by then (Linux: 60 to 70 ms)
FREE_SAMPLES_MIN = 3  # with less room the FIFO may overrun while it is read; Linux resets it then, too
LOST = "FIFO overrun or incomplete samples; FIFO was reset"


class Mpu6050Options(FifoOptions):
    """Options of `mpu6050`."""

    rates_hz = chip.RATES_HZ
    fifo_samples = 512 // chip.SAMPLE_BYTES  # of the MPU-6500 and later; the FIFO of the MPU-6050 holds twice as much
    bytes_a_sample = 6
    bytes_a_poll = 16  # address, register, address each for INT_STATUS, FIFO_COUNT, data, INT_STATUS; their 4 bytes
    reads_a_poll = 4

    address: Literal[0x68, 0x69] = Field(0x68, description="104 (0x68), or 105 (0x69) with AD0 high")
    rate_hz: float = Field(1000.0, description=f"one of {', '.join(f'{rate:g}' for rate in chip.RATES_HZ)}")
    range_g: Literal[2, 4, 8, 16] = Field(2, description="range, plus and minus")
    clone: bool = Field(False, description="treat a part with an unknown WHO_AM_I as an MPU-6500")

    @property
    def known_filters(self) -> tuple[str, ...]:
        """Of an MPU-6050: the part is known when the device is open. Nothing may be known of a clone."""
        return () if self.clone else chip.filters(self.rate_hz)


class Mpu6050(FifoSensor):
    """Reads the overflow flag and the byte count, then the bytes of all complete samples.

    The samples carry no marker, and the size of the FIFO is not a multiple of a sample. After an overrun it is unknown
    where a sample starts. The driver therefore resets the FIFO if it overran or almost did, if a read was interrupted,
    and if the byte count is not a multiple of a sample twice in a row (once is normal while a sample is being written).
    """

    options_model = Mpu6050Options
    word_bytes = chip.SAMPLE_BYTES
    identity_register = chip.WHO_AM_I
    filter_settings = ("SMPLRT_DIV", "CONFIG", "ACCEL_CONFIG_2")
    _part = chip.PARTS[0x68]

    def _kind(self) -> str:
        return self._part.kind

    def _limits(self) -> tuple[int, int]:
        return chip.LIMITS

    def _settings(self) -> Registers:
        return chip.settings(self._part, self._options.rate_hz, self._options.range_g)

    def _counts_per_g(self) -> float:
        return chip.COUNTS_PER_G[self._options.range_g]

    def _filters(self) -> tuple[str, ...]:
        return chip.filters(self._options.rate_hz, self._part)

    def _self_test(self) -> SelfTest:
        options = self._options
        return chip.self_test(self._part, self._device.read(chip.SELF_TEST, 4), options.rate_hz, options.range_g)

    def _self_test_range_g(self) -> int:
        """An MPU-6050 is set to 8 g, as its register map requires."""
        return super()._self_test_range_g() if self._part.accel_config_2 else chip.SELF_TEST_RANGE_G

    def _identify(self) -> dict[str, int]:
        (found,) = self._device.read(chip.WHO_AM_I, 1)
        if found not in chip.PARTS and not self._options.clone:
            known = ", ".join(f"0x{identity:02X}" for identity in chip.PARTS)
            raise IdentityError(
                f"{self._device.name}: WHO_AM_I is 0x{found:02X}, expected one of {known} "
                "(for a compatible part set the option clone)"
            )
        self._part = chip.PARTS.get(found) or chip.clone(found)
        return {"WHO_AM_I": found}

    def _set_up(self, identity: Mapping[str, int]) -> DeviceInfo:
        self._device.write(chip.POWER_1, chip.DEVICE_RESET)
        self._sleep(RESET_WAIT_S)
        self._device.write(chip.POWER_1, chip.CLOCK_FROM_GYRO)  # the part sleeps after a reset
        self._sleep(START_WAIT_S)
        self._write_settings(last=chip.USER_CTRL)
        self._reset_fifo()
        trims = self._trims()
        untouched = {trims[register]: value for register, value in self._read_back(trims).items()}
        return self._info("mpu6050", self._options.rate_hz, {**identity, **untouched})

    def _trims(self) -> Mapping[int, str]:
        return {register: f"ACCEL_OFFSET_{i}" for i, register in enumerate(self._part.accel_offset)}

    def _reset_fifo(self) -> None:
        self._device.write(chip.USER_CTRL, chip.FIFO_RESET)
        self._device.write(chip.USER_CTRL, chip.FIFO_ON)

    def _temperature(self) -> tuple[int, float]:
        return self._part.temperature(self._device.read(chip.TEMPERATURE, 2))

    def _poll(self) -> Burst:
        retries = self._device.retries
        (status,) = self._device.read(chip.INT_STATUS, 1)
        arrival_ns, utc_ns, found = self._device.read_stamped([(chip.FIFO_COUNT, 2)], self._clock)
        count = int.from_bytes(found, "big")
        # A failed read of INT_STATUS has cleared the flag
        lost = bool(status & chip.OVERFLOW) or self._device.retries > retries
        lost |= count > self._part.fifo_bytes - FREE_SAMPLES_MIN * self.word_bytes
        if count % self.word_bytes:
            again = int.from_bytes(self._device.read(chip.FIFO_COUNT, 2), "big")
            lost |= again % self.word_bytes != 0
        whole = count - count % self.word_bytes
        data = b""
        if whole and not lost:
            data = self._device.read(chip.FIFO_DATA, whole)
            (status,) = self._device.read(chip.INT_STATUS, 1)
            lost = bool(status & chip.OVERFLOW) or self._device.retries > retries
        if lost:
            self._drop(LOST, count // self.word_bytes)
            self._reset_fifo()
            data = b""
        return Burst(arrival_ns, utc_ns, data, lost)

    def _decode(self, data: bytes) -> FifoSamples:
        return plain_samples(data, ">")
