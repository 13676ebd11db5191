"""Driver `adxl355`: the ADXL355 on I2C, read through its FIFO."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from hw import adxl355_registers as chip
from hw.block import BlockFlags, DeviceInfo, Drop, SampleBlock
from hw.cutting import Break, Cutter, Stretch
from hw.i2c import I2CDevice
from hw.sensor import Clock, ConfigurationError, DeviceError, DeviceLost, IdentityError, Options, system_clock

BLOCK_S = 0.5
GOLDEN = (5**0.5 - 1) / 2
LONGEST_POLL_S = 0.1  # at slow rates half a FIFO would be seconds
FIFO_TRIPLES = chip.FIFO_ENTRIES_MAX // 3
LONGEST_POLL_TRIPLES = 28  # leaves room for a read 4 samples late
NEARLY_FULL = chip.FIFO_ENTRIES_MAX - 12  # with less room it may run over before it is read
RESET_WAIT_S = 0.01  # twice the data sheet's 5 ms
RESET_ATTEMPTS = 5  # as the Linux driver does
BUS_SHARE_MAX = 0.7  # of the bus in use: the rest is for clock stretching, retries and other devices
BITS_A_BYTE = 9  # with its acknowledge
BYTES_A_POLL = 8  # address, register, address, STATUS, FIFO_ENTRIES; address, register, address


class Adxl355Options(Options):
    """Options of `adxl355`."""

    bus: int = Field(1, ge=0, description="N of /dev/i2c-N")
    address: Literal[0x1D, 0x53] = Field(0x1D, description="29 (0x1D), or 83 (0x53) with ASEL high")
    rate_hz: float = Field(1000.0, description=f"one of {', '.join(f'{rate:g}' for rate in chip.RATES_HZ)}")
    range_g: Literal[2, 4, 8] = Field(2, description="range, plus and minus")
    poll_interval_s: float | None = Field(None, gt=0, description="time between reads; by default half a FIFO")
    bus_khz: float = Field(400.0, gt=0, le=3400, description="clock of the bus, as the machine sets it")

    @field_validator("rate_hz")
    @classmethod
    def _known_rate(cls, value: float) -> float:
        # 3.906 is what people write for 3.90625
        for rate in chip.RATES_HZ:
            if abs(value - rate) <= 1e-3 * rate:
                return rate
        known = ", ".join(f"{rate:g}" for rate in chip.RATES_HZ)
        raise ValueError(f"{value:g} Hz is not a rate of this device: {known}")

    @model_validator(mode="after")
    def _fits(self) -> Adxl355Options:
        samples = self.interval_s * self.rate_hz
        if samples > LONGEST_POLL_TRIPLES:
            raise ValueError(
                f"poll_interval_s {self.interval_s:g} at {self.rate_hz:g} Hz lets {samples:g} samples gather; "
                f"the FIFO holds {FIFO_TRIPLES}, at most {LONGEST_POLL_TRIPLES} leave room for a late read"
            )
        bits_hz = BITS_A_BYTE * (9 * self.rate_hz + BYTES_A_POLL / self.interval_s)
        share = bits_hz / (1e3 * self.bus_khz)
        if share > BUS_SHARE_MAX:
            raise ValueError(
                f"bus too slow: {self.rate_hz:g} samples/s of 9 bytes and {1 / self.interval_s:.4g} polls/s of "
                f"{BYTES_A_POLL} bytes, {BITS_A_BYTE} bits each, are {bits_hz / 1e3:.4g} kbit/s, {share:.0%} of "
                f"bus_khz {self.bus_khz:g}; at most {BUS_SHARE_MAX:.0%} may be used"
            )
        return self

    @property
    def interval_s(self) -> float:
        """Time between reads."""
        return self.poll_interval_s or min(FIFO_TRIPLES / 2 / self.rate_hz, LONGEST_POLL_S)


@dataclass(frozen=True, slots=True)
class Burst:
    """One read of the FIFO; `overrun` tells that samples before it are lost."""

    arrival_ns: int
    utc_ns: int
    entries: bytes
    overrun: bool


class Adxl355:
    """Polls the FIFO: STATUS and the entry count in one transfer, then as many entries as make whole samples.

    A poll that came too late finds OVERRUN set; a read that broke off may have taken entries with it; entries out of
    step are dropped up to the next X marker. How many samples are lost is unknown each time: RESTART.
    """

    options_model: ClassVar[type[Options]] = Adxl355Options

    def __init__(
        self,
        name: str,
        options: Adxl355Options,
        *,
        clock: Clock = system_clock,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options
        self._clock = clock
        self._sleep = sleep
        self._device = I2CDevice("ADXL355", options.bus, options.address, sleep)
        self._settings = chip.settings(options.rate_hz, options.range_g)
        self._cutter = Cutter(name, options.rate_hz, chip.COUNTS_MIN, chip.COUNTS_MAX)
        self._ready: deque[SampleBlock] = deque()
        self._loss: DeviceLost | None = None
        self._dropped_entries = 0
        self._rest = b""
        self._next_poll_ns = 0
        self._phase = 0.0

    def open(self) -> DeviceInfo:
        """Identify, reset, configure, read back.

        Raises ConfigurationError (address held by a kernel driver, settings not taken), IdentityError or DeviceLost
        (no bus, nothing answers).
        """
        self._device.open()
        try:
            revision = self._identify()
            self._reset()
            self._configure()
        except BaseException:
            self.close()
            raise
        self._loss = None
        self._rest = b""
        self._cutter.flag(BlockFlags.RESTART)
        self._next_poll_ns = self._clock()[0]
        counts_per_g = chip.COUNTS_PER_G[self._options.range_g]
        settings = dict(zip(("REVID", *chip.SETTING_NAMES), (revision, *self._settings), strict=True))
        return DeviceInfo(
            driver="adxl355",
            kind="ADXL355",
            serial_number="",
            unit="count",
            axes=3,
            nominal_rate_hz=self._options.rate_hz,
            range_mps2=-chip.COUNTS_MIN / counts_per_g * chip.STANDARD_GRAVITY_MPS2,
            nominal_sensitivity=counts_per_g / chip.STANDARD_GRAVITY_MPS2,
            settings={register: f"0x{value:02X}" for register, value in settings.items()},
        )

    def close(self) -> None:
        """Release the bus; the device goes on measuring until the next reset."""
        self._device.close()

    def take_drops(self) -> list[Drop]:
        """FIFO entries that belonged to no whole sample since the last call, in bytes."""
        entries, self._dropped_entries = self._dropped_entries, 0
        return [Drop(3 * entries, "bytes", "FIFO entries out of step")] if entries else []

    def read_block(self) -> SampleBlock | None:
        """The next block, or None. Raises DeviceLost."""
        if not self._ready and self._loss is None:
            self._gather()
        if self._ready:
            return self._ready.popleft()
        if self._loss is not None:
            raise self._loss
        return None

    def _gather(self) -> None:
        """Poll for BLOCK_S; a loss, of samples or of the device, ends it earlier."""
        bursts: list[Burst] = []
        raw_degc: tuple[int | None, float | None] = None, None
        end_ns = self._next_poll_ns + round(BLOCK_S * 1e9)
        try:
            raw_degc = chip.temperature(self._device.read(chip.TEMPERATURE, 2))
            while self._next_poll_ns < end_ns and not self._ready:
                self._wait()
                burst = self._poll()
                if burst.overrun:
                    self._finish(bursts, raw_degc)
                    self._dropped_entries += len(self._rest) // 3
                    self._rest = b""
                    self._cutter.flag(BlockFlags.RESTART | BlockFlags.OVERRUN)
                    bursts = []
                bursts.append(burst)
            if not any(burst.entries for burst in bursts):
                self._check_settings(DeviceLost)
        except DeviceLost as loss:
            self._loss = loss  # raised once all that came before it has been returned
        self._finish(bursts, raw_degc)

    def _wait(self) -> None:
        """Sleep to the next poll; spread over a sample period by the golden ratio, so that poll and sample clock do
        not beat and each second's arrivals sample all of the period."""
        now_ns, _ = self._clock()
        self._next_poll_ns += round(self._options.interval_s * 1e9)
        self._phase = (self._phase + GOLDEN) % 1.0
        wait_s = (self._next_poll_ns - now_ns) * 1e-9 + self._phase / self._options.rate_hz
        if wait_s > 0:
            self._sleep(wait_s)
        else:
            self._next_poll_ns = now_ns

    def _poll(self) -> Burst:
        """STATUS and the number of entries, then the entries of whole samples."""
        retries = self._device.retries
        arrival_ns, utc_ns, (status, entries) = self._device.read_stamped(chip.STATUS, 2, self._clock)
        # a STATUS read that failed may have cleared the flag
        overrun = bool(status & chip.OVERRUN) or (self._device.retries > retries and entries >= chip.FIFO_ENTRIES_MAX)
        whole = min(entries, chip.FIFO_ENTRIES_MAX) // 3 * 3
        if not whole:
            return Burst(arrival_ns, utc_ns, b"", overrun)
        retries = self._device.retries
        data = chip.without_empty(self._device.read(chip.FIFO_DATA, 3 * whole))
        if self._device.retries > retries:
            overrun = True
        elif whole > NEARLY_FULL:
            overrun |= bool(self._device.read(chip.STATUS, 1)[0] & chip.OVERRUN)
        return Burst(arrival_ns, utc_ns, data, overrun)

    def _finish(self, bursts: list[Burst], raw_degc: tuple[int | None, float | None]) -> None:
        """Decode what was read and make blocks of it."""
        if not bursts:
            return
        entries_read = len(self._rest) // 3 + np.cumsum([len(burst.entries) // 3 for burst in bursts])
        found = chip.triples(self._rest + b"".join(burst.entries for burst in bursts))
        self._rest = found.rest
        self._dropped_entries += found.dropped
        stretch = Stretch(
            indications=found.counts,
            burst_t_monotonic_ns=np.array([burst.arrival_ns for burst in bursts]),
            burst_count=np.searchsorted(found.last, entries_read),
            t_utc_ns=bursts[-1].utc_ns,
            temperature_raw=raw_degc[0],
            temperature_degc=raw_degc[1],
        )
        self._ready.extend(self._cutter.cut(stretch, [Break(at, BlockFlags.RESTART) for at in found.breaks]))

    def _identify(self) -> int:
        """Check who answers; returns the revision."""
        found = self._device.read(chip.DEVID, 4)
        if found[:3] != chip.IDENTITY:
            raise IdentityError(f"{self._device.name}: expected {chip.IDENTITY.hex(' ')}, found {found[:3].hex(' ')}")
        return found[chip.REVISION]

    def _reset(self) -> None:
        """Reset until the part's trim is back as it was before."""
        for _ in range(RESET_ATTEMPTS):
            before = self._device.read(chip.SHADOW, chip.SHADOW_BYTES)
            self._device.write(chip.RESET, chip.RESET_CODE)
            self._sleep(RESET_WAIT_S)
            after = self._device.read(chip.SHADOW, chip.SHADOW_BYTES)
            if after == before:
                return
        raise DeviceLost(
            f"{self._device.name}: after a reset the shadow registers read {after.hex(' ')}, not {before.hex(' ')}"
        )

    def _configure(self) -> None:
        """Settings in standby, measuring last; then all of them are read back."""
        for register, value in enumerate(self._settings, chip.FIRST_SETTING):
            if register != chip.POWER_CTL:
                self._device.write(register, value)
        self._device.write(chip.POWER_CTL, chip.MEASURE)
        self._check_settings(ConfigurationError)

    def _check_settings(self, error: type[DeviceError]) -> None:
        found = self._device.read(chip.FIRST_SETTING, len(self._settings))
        wrong = [
            f"{name} is 0x{value:02X}, not 0x{wanted:02X}"
            for name, value, wanted in zip(chip.SETTING_NAMES, found, self._settings, strict=True)
            if value != wanted
        ]
        if wrong:
            raise error(f"{self._device.name} is not set as it should be (did it lose power?): {', '.join(wrong)}")
