"""Options of all drivers that poll a FIFO over I2C or SPI, and the checks of rate, poll interval and bus load."""

from __future__ import annotations

import re
from typing import ClassVar, Self

from pydantic import Field, field_validator, model_validator

from hw.sensor import Options
from hw.spi import SPI_BUS, SpiProtocol, spi_node

POLL_SAMPLES = 16  # default samples per poll; the fixed cost of a read is that of a few samples
# Default share of the FIFO per poll: at 1 kHz a FIFO of 32 samples then survives a stall of 20 ms, which occurs on
# gateways
FIFO_SHARE = 1 / 4
# Sample times are computed from the polls that came shortly after a sample. At 125 Hz, polls of 100 ms leave errors up
# to 0.6 ms, polls of 20 ms half of that. Polls are spread over a sample period; therefore at slow rates one poll takes
# two samples, up to an interval of SLOWEST_POLL_S.
LONGEST_POLL_S, FEWEST_SAMPLES, SLOWEST_POLL_S = 0.02, 2, 0.1
FIFO_SHARE_MAX = 7 / 8  # share of the FIFO that may fill between polls; the rest is reserve for a late poll
# Share of the bus time that may be used; the rest is for clock stretching, retries and other devices
BUS_SHARE_MAX = 0.7
I2C_BITS, SPI_BITS = 9, 8  # of a byte; on I2C with the acknowledge bit
ADDRESS_BYTES = 2  # of a register read on I2C, one before the register and one before the data
RATE_TOLERANCE = 2e-3  # relative; people write 3.906 for 3.90625


def foreign_options(bus: int | str) -> tuple[str, ...]:
    """Names of the options that do not apply to this bus."""
    return ("address", "bus_khz") if isinstance(bus, str) else ("spi_mhz",)


class FifoOptions(Options):
    """Common options. A subclass states its rates, the samples in its FIFO, and the bytes on the bus.

    A subclass whose part can also be read over SPI states how (`spi`).
    """

    rates_hz: ClassVar[tuple[float, ...]]
    fifo_samples: ClassVar[int]
    bytes_a_sample: ClassVar[int]
    bytes_a_poll: ClassVar[int]  # on I2C: addresses, registers, status and count
    reads_a_sample: ClassVar[int] = 0  # register reads, where each sample needs its own
    reads_a_poll: ClassVar[int] = 3  # register reads besides: status, data, status
    # Highest rate that the data sheet states for I2C, Hz for each kHz of the bus; None where it states none
    stated_hz_a_khz: ClassVar[float | None] = None
    must_be_alone: ClassVar[str] = ""  # why no other device may be on the bus; "" where others may

    spi: ClassVar[SpiProtocol | None] = None

    bus: int | str = Field(
        1, description='N of /dev/i2c-N; or "spiB.C" for /dev/spidevB.C, where the driver reads over SPI'
    )
    rate_hz: float
    poll_interval_s: float | None = Field(
        None,
        gt=0,
        description="time between reads; default: 16 samples or a quarter of the FIFO, at most 20 ms, 100 ms if slow",
    )
    serial_number: str = Field(
        "", description="of the device, as on its label; the chip has none, and a calibration belongs to one device"
    )
    bus_khz: float = Field(400.0, gt=0, le=3400, description="clock of the I2C bus as set on this machine")
    spi_mhz: float = Field(1.0, ge=0.1, description="clock with which the driver reads over SPI; slower for long wires")

    @property
    def tests_itself(self) -> bool:
        """All these parts have a self-test."""
        return True

    @field_validator("rate_hz")
    @classmethod
    def _check_rate(cls, value: float) -> float:
        for rate in cls.rates_hz:
            if abs(value - rate) <= RATE_TOLERANCE * rate:
                return rate
        known = ", ".join(f"{rate:g}" for rate in cls.rates_hz)
        raise ValueError(f"{value:g} Hz is not a rate of this device; use one of {known}")

    @field_validator("bus")
    @classmethod
    def _check_bus(cls, value: int | str) -> int | str:
        text = str(value)
        if text.isdecimal():
            return int(text)
        if re.fullmatch(SPI_BUS, text) is None:
            raise ValueError(f'{text!r} is no bus: N of /dev/i2c-N, as 1, or "spiB.C" of /dev/spidevB.C, as "spi0.0"')
        if cls.spi is None:
            raise ValueError(f"this driver does not read over SPI ({text!r}); use N of /dev/i2c-N")
        return text

    @model_validator(mode="after")
    def _check_address(self) -> Self:
        for name in foreign_options(self.bus):
            if name in self.model_fields_set:
                why = "on SPI the chip select in bus names the device" if self.over_spi else "bus names an I2C bus"
                raise ValueError(f"{name} does not apply to bus {self.bus}, remove it: {why}")
        if self.over_spi and self.spi and self.spi_mhz > self.spi.highest_mhz:
            raise ValueError(f"spi_mhz {self.spi_mhz:g} is too fast: at most {self.spi.highest_mhz:g} for this device")
        return self

    @model_validator(mode="after")
    def _fits(self) -> Self:
        samples = self.interval_s * self.rate_hz
        longest = FIFO_SHARE_MAX * self.fifo_samples
        if samples > longest:
            raise ValueError(
                f"poll_interval_s {self.interval_s:g} at {self.rate_hz:g} Hz gathers {samples:g} samples; "
                f"the FIFO holds {self.fifo_samples} and at most {longest:.0f} leave room for a late "
                f"read; lower poll_interval_s"
            )
        sample_bytes, poll_bytes, bits = self._on_the_bus
        if self._share > BUS_SHARE_MAX:
            clock = f"spi_mhz {self.spi_mhz:g}" if self.over_spi else f"bus_khz {self.bus_khz:g}"
            lower = [
                rate for rate in self.rates_hz if self.model_copy(update={"rate_hz": rate})._share <= BUS_SHARE_MAX
            ]
            remedy = f"set rate_hz = {max(lower):g}, or " if lower else ""
            raise ValueError(
                f"bus too slow: {self.rate_hz:g} samples/s of {sample_bytes} bytes and "
                f"{1 / self.interval_s:.4g} polls/s of {poll_bytes} bytes, {bits} bits each, are "
                f"{self._bits_hz / 1e3:.4g} kbit/s, {self._share:.0%} of {clock}; "
                f"at most {BUS_SHARE_MAX:.0%} may be used: {remedy}use a faster bus"
            )
        return self

    @property
    def _on_the_bus(self) -> tuple[int, int, int]:
        """Bytes of a sample, bytes of a poll, and bits of a byte."""
        addresses = ADDRESS_BYTES if self.over_spi else 0
        sample_bytes = self.bytes_a_sample - addresses * self.reads_a_sample
        poll_bytes = self.bytes_a_poll - addresses * self.reads_a_poll
        return sample_bytes, poll_bytes, SPI_BITS if self.over_spi else I2C_BITS

    @property
    def _bits_hz(self) -> float:
        sample_bytes, poll_bytes, bits = self._on_the_bus
        return bits * (sample_bytes * self.rate_hz + poll_bytes / self.interval_s)

    @property
    def _share(self) -> float:
        """Of the bus time that reading takes."""
        return self._bits_hz / (1e6 * self.spi_mhz if self.over_spi else 1e3 * self.bus_khz)

    @property
    def advice(self) -> tuple[str, ...]:
        """A rate above what the data sheet states for this I2C bus."""
        if self.over_spi or self.stated_hz_a_khz is None or self.rate_hz <= self.stated_hz_a_khz * self.bus_khz:
            return ()
        stated_hz = self.stated_hz_a_khz * self.bus_khz
        lower = [rate for rate in self.rates_hz if rate <= stated_hz]
        remedy = f"set rate_hz = {max(lower):g}, or " if lower else ""
        return (
            f"rate_hz {self.rate_hz:g} is above {stated_hz:g} Hz, the highest rate that the data sheet states for a "
            f"bus of {self.bus_khz:g} kHz; samples may be missing and noise added: {remedy}use a bus of at least "
            f"{self.rate_hz / self.stated_hz_a_khz:g} kHz and state it as bus_khz",
        )

    @property
    def over_spi(self) -> bool:
        """Whether `bus` names an SPI bus."""
        return isinstance(self.bus, str)

    @property
    def node(self) -> str:
        """Device node of the bus."""
        return spi_node(str(self.bus)) if self.over_spi else f"/dev/i2c-{self.bus}"

    @property
    def interval_s(self) -> float:
        """Time between reads, s."""
        samples = min(POLL_SAMPLES, FIFO_SHARE * self.fifo_samples)
        longest_s = max(LONGEST_POLL_S, min(FEWEST_SAMPLES / self.rate_hz, SLOWEST_POLL_S))
        return self.poll_interval_s or min(samples / self.rate_hz, longest_s)
