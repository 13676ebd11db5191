"""Options of all drivers that poll a FIFO over I2C, and what of them cannot work: rate, poll interval, bus."""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import Field, field_validator, model_validator

from hw.sensor import Options

POLL_SAMPLES = 16  # a read costs as much as a few of them
FIFO_SHARE = 1 / 4  # of the FIFO: at 1 kHz 32 samples then outlast a stall of 20 ms, which gateways have
# A sample's time is told by the polls that came just after one: at 125 Hz polls of 100 ms leave errors up to 0.6 ms,
# polls of 20 ms half of it. Polls are spread over a sample period: at slow rates one takes two of them, up to a limit.
LONGEST_POLL_S, FEWEST_SAMPLES, SLOWEST_POLL_S = 0.02, 2, 0.1
FIFO_SHARE_MAX = 7 / 8  # of the FIFO may fill between polls: the rest is for a late one
BUS_SHARE_MAX = 0.7  # of the bus in use: the rest is for clock stretching, retries and other devices
BITS_A_BYTE = 9  # with its acknowledge
RATE_TOLERANCE = 2e-3  # 3.906 is what people write for 3.90625


class FifoOptions(Options):
    """Common options. A chip names its rates, how many samples its FIFO holds, and the bytes on the bus."""

    rates_hz: ClassVar[tuple[float, ...]]
    fifo_samples: ClassVar[int]
    bytes_a_sample: ClassVar[int]
    bytes_a_poll: ClassVar[int]  # addresses, registers, status and count

    bus: int = Field(1, ge=0, description="N of /dev/i2c-N")
    rate_hz: float
    poll_interval_s: float | None = Field(
        None, gt=0, description="time between reads; by default a quarter of the FIFO, 20 ms"
    )
    serial_number: str = Field("", description="as on the plate: these chips have none, and a calibration is one's own")
    bus_khz: float = Field(400.0, gt=0, le=3400, description="clock of the bus, as the machine sets it")

    @field_validator("rate_hz")
    @classmethod
    def _known_rate(cls, value: float) -> float:
        for rate in cls.rates_hz:
            if abs(value - rate) <= RATE_TOLERANCE * rate:
                return rate
        known = ", ".join(f"{rate:g}" for rate in cls.rates_hz)
        raise ValueError(f"{value:g} Hz is not a rate of this device: {known}")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        samples = self.interval_s * self.rate_hz
        longest = FIFO_SHARE_MAX * self.fifo_samples
        if samples > longest:
            raise ValueError(
                f"poll_interval_s {self.interval_s:g} at {self.rate_hz:g} Hz lets {samples:g} samples gather; "
                f"the FIFO holds {self.fifo_samples}, at most {longest:.0f} leave room for a late read"
            )
        bits_hz = BITS_A_BYTE * (self.bytes_a_sample * self.rate_hz + self.bytes_a_poll / self.interval_s)
        share = bits_hz / (1e3 * self.bus_khz)
        if share > BUS_SHARE_MAX:
            raise ValueError(
                f"bus too slow: {self.rate_hz:g} samples/s of {self.bytes_a_sample} bytes and "
                f"{1 / self.interval_s:.4g} polls/s of {self.bytes_a_poll} bytes, {BITS_A_BYTE} bits each, are "
                f"{bits_hz / 1e3:.4g} kbit/s, {share:.0%} of bus_khz {self.bus_khz:g}; "
                f"at most {BUS_SHARE_MAX:.0%} may be used"
            )
        return self

    @property
    def interval_s(self) -> float:
        """Time between reads."""
        samples = min(POLL_SAMPLES, FIFO_SHARE * self.fifo_samples)
        longest_s = max(LONGEST_POLL_S, min(FEWEST_SAMPLES / self.rate_hz, SLOWEST_POLL_S))
        return self.poll_interval_s or min(samples / self.rate_hz, longest_s)
