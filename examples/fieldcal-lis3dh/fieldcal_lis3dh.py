"""Driver `lis3dh`: the LIS3DH on I2C, read through its FIFO. Source: data sheet LIS3DH, application note AN3308."""

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

WHO_AM_I, IDENTITY = 0x0F, 0x33
CTRL_REG1, CTRL_REG2, CTRL_REG3, CTRL_REG4, CTRL_REG5, FIFO_CTRL, FIFO_SRC, OUT_X = (
    *(0x20, 0x21, 0x22, 0x23, 0x24, 0x2E, 0x2F, 0x28),
)
AUTO_INCREMENT = 0x80  # added to a register's number for a read of several registers
STREAM, OVERRUN, LEVEL_MASK = 0x80, 0x40, 0x1F
RATE_CODES: Mapping[float, int] = {400.0: 7, 200.0: 6, 100.0: 5, 50.0: 4, 25.0: 3, 10.0: 2}
MG_PER_COUNT: Mapping[int, int] = {2: 1, 4: 2, 8: 4, 16: 12}  # high resolution, 12 bits
NEARLY_FULL = 28  # of 32 samples; if the FIFO may be full before the data are read, the driver treats it as overrun


class Lis3dhOptions(FifoOptions):
    """Options of `lis3dh`."""

    rates_hz = tuple(RATE_CODES)
    fifo_samples = 32
    bytes_a_sample = 6
    bytes_a_poll = 7

    address: Literal[0x18, 0x19] = Field(0x18, description="24 (0x18), or 25 (0x19) with SA0 high")
    rate_hz: float = Field(400.0, description=f"one of {', '.join(f'{rate:g}' for rate in RATE_CODES)}")
    range_g: Literal[2, 4, 8, 16] = Field(2, description="range, plus and minus")

    @property
    def known_filters(self) -> tuple[str, ...]:
        """As the data sheet says: in high resolution a ninth of the output data rate; it tells no order."""
        return (f"lowpass order=1 corner_hz={self.rate_hz / 9:g} u_corner_pct=50",)


class Lis3dh(FifoSensor):
    """Reads the number of stored samples in one transfer, then these samples."""

    options_model = Lis3dhOptions
    word_bytes = 6

    def _kind(self) -> str:
        return "LIS3DH"

    def _limits(self) -> tuple[int, int]:
        return -(2**11), 2**11 - 1

    def _counts_per_g(self) -> float:
        return 1000.0 / MG_PER_COUNT[self._options.range_g]

    def _settings(self) -> Registers:
        range_code = list(MG_PER_COUNT).index(self._options.range_g)
        return {
            CTRL_REG1: ("CTRL_REG1", RATE_CODES[self._options.rate_hz] << 4 | 0x07),  # all axes
            CTRL_REG2: ("CTRL_REG2", 0x00),  # no high-pass filter
            CTRL_REG3: ("CTRL_REG3", 0x00),
            CTRL_REG4: ("CTRL_REG4", 0x88 | range_code << 4),  # block data update, high resolution, no self-test
            CTRL_REG5: ("CTRL_REG5", 0x40),  # FIFO on
            FIFO_CTRL: ("FIFO_CTRL", STREAM),
        }

    def _self_test(self) -> SelfTest:
        """Self-test 0. Data sheet: 17 to 360 counts of 4 mg, at 2 g, normal mode; noise typically 3 mg rms, 100 Hz."""
        return SelfTest(
            writes=((CTRL_REG4, self._settings()[CTRL_REG4][1] | 0x02),),
            settle_s=0.1,
            low_g=(0.068, 0.068, 0.068),
            high_g=(1.44, 1.44, 1.44),
            noise_g=(0.003, 0.003, 0.003),
            source="LIS3DH data sheet, self-test output change",
        )

    def _identify(self) -> dict[str, int]:
        (found,) = self._device.read(WHO_AM_I, 1)
        if found != IDENTITY:
            raise IdentityError(f"{self._device.name}: expected the ID 0x{IDENTITY:02X}, found 0x{found:02X}")
        return {"WHO_AM_I": found}

    def _set_up(self, identity: Mapping[str, int]) -> DeviceInfo:
        self._device.write(CTRL_REG1, 0x00)
        self._device.write(FIFO_CTRL, 0x00)  # bypass mode empties the FIFO
        self._write_settings(last=CTRL_REG1)
        return self._info("lis3dh", self._options.rate_hz, identity)

    def _poll(self) -> Burst:
        retries = self._device.retries
        arrival_ns, utc_ns, (source,) = self._device.read_stamped([(FIFO_SRC, 1)], self._clock)
        level = 32 if source & OVERRUN else source & LEVEL_MASK
        data = self._device.read(OUT_X | AUTO_INCREMENT, 6 * level) if level else b""
        # Samples made since the count was read, with which the FIFO may have overrun
        made_since = (self._clock()[0] - arrival_ns) * 1e-9 * self._options.rate_hz
        lost = level + made_since > NEARLY_FULL or self._device.retries > retries
        if lost:  # after an interrupted read an unknown number of samples is missing, at most `level`
            self._drop("FIFO overrun or interrupted FIFO read", level)
            data = b""
        return Burst(arrival_ns, utc_ns, data, lost)

    def _decode(self, data: bytes) -> FifoSamples:
        left_justified = plain_samples(data, "<")
        counts = (left_justified.counts >> 4).astype(np.int32)
        return FifoSamples(counts, left_justified.last, [], 0, b"")
