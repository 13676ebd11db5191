"""Driver `mma8451`: the MMA8451Q on I2C, read through its FIFO.

Sources: NXP's data sheet MMA8451Q and application note AN4073 (FIFO); registers and codes also in Linux,
drivers/iio/accel/mma8452.c, counts per g in Adafruit_MMA8451_Library.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from pydantic import Field

from hw.block import DeviceInfo
from hw.fifo import Burst, FifoSamples, plain_samples
from hw.fifo_options import FifoOptions
from hw.fifo_sensor import FifoSensor, Registers
from hw.self_test import SelfTest
from hw.sensor import IdentityError

WHO_AM_I, IDENTITY = 0x0D, 0x1A
F_STATUS, OUT_X, F_SETUP, XYZ_DATA_CFG, CTRL_REG1, CTRL_REG2, OFFSET = 0x00, 0x01, 0x09, 0x0E, 0x2A, 0x2B, 0x2F
OVERFLOW, COUNT_MASK = 0x80, 0x3F
CIRCULAR, ACTIVE, HIGH_RESOLUTION, SELF_TEST = 0x40, 0x01, 0x02, 0x80
RATES_HZ = (800.0, 400.0, 200.0, 100.0, 50.0, 12.5, 6.25)  # by code
COUNTS_PER_G: Mapping[int, int] = {2: 4096, 4: 2048, 8: 1024}  # in the order of the codes
NEARLY_FULL = 28  # of 32 samples; if the FIFO may be full before the data are read, the driver treats it as overrun


class Mma8451Options(FifoOptions):
    """Options of `mma8451`."""

    rates_hz = RATES_HZ
    fifo_samples = NEARLY_FULL
    bytes_a_sample = 6
    bytes_a_poll = 7
    reads_a_poll = 2

    address: Literal[0x1C, 0x1D] = Field(0x1C, description="28 (0x1C), or 29 (0x1D) with SA0 high")
    rate_hz: float = Field(400.0, description=f"one of {', '.join(f'{rate:g}' for rate in RATES_HZ)}")
    range_g: Literal[2, 4, 8] = Field(2, description="range, plus and minus")


class Mma8451(FifoSensor):
    """Reads the number of stored samples in one transfer, then these samples."""

    options_model = Mma8451Options
    word_bytes = 6
    identity_register = WHO_AM_I

    def _kind(self) -> str:
        return "MMA8451Q"

    def _limits(self) -> tuple[int, int]:
        return -(2**13), 2**13 - 1

    def _counts_per_g(self) -> float:
        return COUNTS_PER_G[self._options.range_g]

    def _settings(self) -> Registers:
        offsets = {OFFSET + i: (f"OFF_{axis}", 0x00) for i, axis in enumerate("XYZ")}
        return {
            F_SETUP: ("F_SETUP", CIRCULAR),
            XYZ_DATA_CFG: ("XYZ_DATA_CFG", list(COUNTS_PER_G).index(self._options.range_g)),  # no high-pass filter
            CTRL_REG1: ("CTRL_REG1", RATES_HZ.index(self._options.rate_hz) << 3 | ACTIVE),
            CTRL_REG2: ("CTRL_REG2", HIGH_RESOLUTION),  # no automatic sleep, no self-test
        } | offsets

    def _self_test(self) -> SelfTest:
        """NXP (community thread 365445): at 4 g, 50 to 1000 counts in x and y, 50 to 6000 in z. Data sheet: noise."""
        noise_g = 99e-6 * (self._options.rate_hz / 2) ** 0.5
        active = self._settings()[CTRL_REG1][1]
        return SelfTest(
            writes=((CTRL_REG1, 0x00), (CTRL_REG2, HIGH_RESOLUTION | SELF_TEST), (CTRL_REG1, active)),
            settle_s=0.1,
            low_g=(50 / 2048, 50 / 2048, 50 / 2048),
            high_g=(1000 / 2048, 1000 / 2048, 6000 / 2048),
            noise_g=(noise_g, noise_g, noise_g),
            source="NXP, internal limits of the MMA8451Q's self-test",
        )

    def _identify(self) -> dict[str, int]:
        (found,) = self._device.read(WHO_AM_I, 1)
        if found != IDENTITY:
            raise IdentityError(f"{self._device.name}: expected the ID 0x{IDENTITY:02X}, found 0x{found:02X}")
        return {"WHO_AM_I": found}

    def _set_up(self, identity: Mapping[str, int]) -> DeviceInfo:
        self._device.write(CTRL_REG1, 0x00)  # settings can be changed in standby only
        self._device.write(F_SETUP, 0x00)  # this empties the FIFO
        self._write_settings(last=CTRL_REG1)
        self._device.read(F_STATUS, 1)  # this clears an overflow flag that an earlier run left
        return self._info("mma8451", self._options.rate_hz, identity)

    def _poll(self) -> Burst:
        retries, began_ns = self._device.retries, self._clock()[0]
        arrival_ns, utc_ns, (status,) = self._device.read_stamped([(F_STATUS, 1)], self._clock)
        level = status & COUNT_MASK
        data = self._device.read(OUT_X, 6 * level) if level else b""
        # Samples made since the count was read, with which the FIFO may have overrun
        made_since = (self._clock()[0] - began_ns) * 1e-9 * self._options.rate_hz
        lost = bool(status & OVERFLOW) or level + made_since > NEARLY_FULL or self._device.retries > retries
        if lost:  # after an interrupted read an unknown number of samples is missing, at most `level`
            self._drop("FIFO overrun or interrupted FIFO read", level)
            data = b""
        return Burst(arrival_ns, utc_ns, data, lost)

    def _decode(self, data: bytes) -> FifoSamples:
        left_justified = plain_samples(data, ">")
        counts = (left_justified.counts >> 2).astype(np.int32)
        return FifoSamples(counts, left_justified.last, [], 0, b"")
