"""Drivers `adxl355`, `adxl357` and `adxl359`: one family of parts on I2C or SPI, read through their FIFO."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from hw import adxl355_registers as chip
from hw.block import DeviceInfo
from hw.fifo import Burst, FifoSamples
from hw.fifo_options import FifoOptions
from hw.fifo_sensor import FifoSensor, Registers
from hw.self_test import SelfTest
from hw.sensor import DeviceLost, IdentityError, Options

RESET_WAIT_S = 0.01  # twice the data sheet's 5 ms
RESET_ATTEMPTS = 5  # as the Linux driver does
LOADING_S, LOADING_POLL_S = 0.1, 0.005  # longest time for loading the trim, as in Zephyr (adxl355.c), and between looks
TEMPERATURE_READINGS = 4  # at most, until two of them in a row belong together
LOST = "FIFO overrun while it was read, or interrupted FIFO read"


class Adxl355Options(FifoOptions):
    """Options of `adxl355`."""

    rates_hz = chip.RATES_HZ
    fifo_samples = chip.FIFO_ENTRIES_MAX // 3
    bytes_a_sample = 9
    spi = chip.SPI
    bytes_a_poll = 12  # address, register, address, STATUS, FIFO_ENTRIES; twice address, register, address; STATUS
    stated_hz_a_khz = chip.STATED_HZ_A_KHZ
    must_be_alone = chip.MUST_BE_ALONE

    address: Literal[0x1D, 0x53] = Field(0x1D, description="29 (0x1D), or 83 (0x53) with ASEL high")
    rate_hz: float = Field(1000.0, description=f"one of {', '.join(f'{rate:g}' for rate in chip.RATES_HZ)}")
    range_g: Literal[2, 4, 8] = Field(2, description="range, plus and minus")

    @property
    def known_filters(self) -> tuple[str, ...]:
        """As the data sheet says."""
        return chip.filters(self.rate_hz)


class Adxl357Options(Adxl355Options):
    """Options of `adxl357` and `adxl359`."""

    range_g: Literal[10, 20, 40] = Field(10, description="range, plus and minus")  # type: ignore[assignment]


class Adxl355(FifoSensor):
    """Reads STATUS and the number of FIFO entries together, then as many entries as make whole samples.

    If a poll comes too late, OVERRUN is set. If a read is interrupted, it may have removed entries from the FIFO. A
    read of many entries is done in several transfers, so entries may be missing in its midst: if the FIFO overran after
    the count, or a read of it was interrupted, the driver discards what it read. Entries that do not form x, y, z are
    dropped up to the next entry with the X marker.
    """

    options_model: ClassVar[type[Options]] = Adxl355Options
    part: ClassVar[chip.Part] = chip.ADXL355
    word_bytes, sample_words = 3, 3
    filter_settings = ("FILTER",)
    _revision = 0
    _lost_trim = b""  # what the shadow registers held before resets that did not bring it back

    @property
    def must_be_alone(self) -> str:
        """As in FifoSensor."""
        return "" if self._revision >= chip.FIRST_FREE_REVISION else chip.MUST_BE_ALONE

    def _kind(self) -> str:
        return self.part.kind

    def _limits(self) -> tuple[int, int]:
        return chip.COUNTS_MIN, chip.COUNTS_MAX

    def _settings(self) -> Registers:
        values = chip.settings(self.part, self._options.rate_hz, self._options.range_g)
        return dict(enumerate(zip(chip.SETTING_NAMES, values, strict=True), chip.FIRST_SETTING))

    def _spoilt_samples(self) -> tuple[int, int]:
        return chip.spoilt_samples(self._options.rate_hz)

    def _counts_per_g(self) -> float:
        return self.part.counts_per_g[self._options.range_g]

    def _self_test(self) -> SelfTest:
        return chip.self_test(self.part, self._options.rate_hz)

    def _identify(self) -> dict[str, int]:
        found = self._device.read(chip.DEVID, 4)
        if found == chip.LOADING and self._is_loaded():
            found = self._device.read(chip.DEVID, 4)
        if found[:3] != self.part.identity:
            wanted = self.part.identity.hex(" ")
            raise IdentityError(f"{self._device.name}: expected the IDs {wanted}, found {found[:3].hex(' ')}")
        self._revision = found[chip.REVISION]
        return {"REVID": self._revision}

    def _trims(self) -> Mapping[int, str]:
        return {chip.SHADOW + i: f"SHADOW_{i + 1}" for i in range(chip.SHADOW_BYTES)}

    def _set_up(self, identity: Mapping[str, int]) -> DeviceInfo:
        self._reset()
        self._write_settings(last=chip.POWER_CTL)  # settings are accepted in standby only
        return self._info(self.part.kind.lower(), self._options.rate_hz, identity)

    def _reset(self) -> None:
        """Reset until the shadow registers, which hold the factory trim, read as before the first reset.

        Rarely a reset spoils the trim, which a power cycle brings back (data sheet ADXL355, rev. C, as quoted in issue
        5 of plasmapper/adxl355-arduino). What a device holds after such a reset is not taken for its trim at the next
        `open`. Raises DeviceLost.
        """
        before = self._lost_trim or self._shadow("start")
        for _ in range(RESET_ATTEMPTS):
            self._device.write(chip.RESET, chip.RESET_CODE)
            self._sleep(RESET_WAIT_S)
            after = self._shadow("reset")
            if after == before:
                self._lost_trim = b""
                return
        self._lost_trim = before
        raise DeviceLost(
            f"{self._device.name}: after a reset the shadow registers read {after.hex(' ')}, not {before.hex(' ')}; "
            "cut its power for a second; if it is another device than before, start the program again"
        )

    def _shadow(self, since: str) -> bytes:
        if not self._is_loaded():
            raise DeviceLost(
                f"{self._device.name}: the device has not loaded its factory trim {1e3 * LOADING_S:g} ms after the "
                f"{since} (NVM_BUSY); check supply and wiring"
            )
        return self._device.read(chip.SHADOW, chip.SHADOW_BYTES)

    def _is_loaded(self) -> bool:
        """Wait until the device has loaded its trim; whether it has."""
        for _ in range(round(LOADING_S / LOADING_POLL_S)):
            (status,) = self._device.read(chip.STATUS, 1)
            if not status & chip.NVM_BUSY:
                return True
            self._sleep(LOADING_POLL_S)
        return False

    def _temperature(self) -> tuple[int | None, float | None]:
        """Of two readings that belong together: the device may change the value between its two bytes."""
        before, _ = chip.temperature(self.part, self._device.read(chip.TEMPERATURE, 2))
        for _ in range(TEMPERATURE_READINGS - 1):
            raw, degc = chip.temperature(self.part, self._device.read(chip.TEMPERATURE, 2))
            if abs(raw - before) <= chip.TEMPERATURE_WITHIN:
                return raw, degc
            before = raw
        return None, None

    def _poll(self) -> Burst:
        arrival_ns, utc_ns, (status, entries) = self._device.read_stamped([(chip.STATUS, 2)], self._clock)
        # The flag may be gone: a STATUS read that failed has cleared it, or one of another program.
        lost = bool(status & chip.OVERRUN) or entries >= chip.FIFO_ENTRIES_MAX
        whole = min(entries, chip.FIFO_ENTRIES_MAX) // 3 * 3
        if not whole:
            return Burst(arrival_ns, utc_ns, b"", lost)
        retries = self._device.retries
        # STATUS is read again after the data: the FIFO may have overrun between the count and the data, even if the
        # count was low.
        data = chip.without_empty(self._device.read(chip.FIFO_DATA, 3 * whole))
        (status,) = self._device.read(chip.STATUS, 1)
        if status & chip.OVERRUN or self._device.retries > retries:
            self._drop(LOST, whole)
            return Burst(arrival_ns, utc_ns, b"", True)
        return Burst(arrival_ns, utc_ns, data, lost)

    def _decode(self, data: bytes) -> FifoSamples:
        return chip.triples(data)


class Adxl357(Adxl355):
    """Like the ADXL355, with five times its range."""

    options_model = Adxl357Options
    part = chip.ADXL357


class Adxl359(Adxl357):
    """Like the ADXL357, with a different part ID."""

    part = chip.ADXL359
