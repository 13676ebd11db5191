"""Common part of all drivers that poll a FIFO over I2C: polls, blocks, losses.

A subclass adds the registers of its chip.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags, DeviceInfo, Drop, SampleBlock
from hw.cutting import Break, Cutter, Stretch
from hw.fifo import Burst, FifoSamples
from hw.i2c import I2CDevice
from hw.self_test import SelfTest, SelfTestReport
from hw.sensor import GOLDEN, Clock, ConfigurationError, DeviceError, DeviceLost, Options, system_clock

STANDARD_GRAVITY_MPS2 = 9.80665
BLOCK_S = 0.5
OUT_OF_STEP = "incomplete samples in the FIFO"

Registers = Mapping[int, tuple[str, int]]
"""Settings: register -> (name, value)."""


class FifoSensor(ABC):
    """Polls a FIFO for half a second and makes blocks of the samples.

    The number of lost samples is unknown if the FIFO overran, if a read was interrupted, or if FIFO entries did not
    form complete samples. The next block then carries RESTART. A subclass implements the abstract methods; `options`
    must be FifoOptions with an `address`.
    """

    options_model: ClassVar[type[Options]]
    word_bytes: ClassVar[int]  # bytes that the FIFO stores at a time
    filter_settings: ClassVar[tuple[str, ...]] = ()  # as in DeviceInfo, where the options tell the filters

    def __init__(
        self,
        name: str,
        options: Any,
        *,
        clock: Clock = system_clock,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options
        self._clock = clock
        self._sleep = sleep
        self._device = I2CDevice(self._kind(), options.bus, options.address, sleep)
        self._cutter = Cutter(name, options.rate_hz, *self._limits())
        self._ready: deque[SampleBlock] = deque()
        self._loss: DeviceLost | None = None
        self._dropped: Counter[str] = Counter()  # number of words by reason
        self._rest = b""
        self._next_poll_ns = 0
        self._phase = 0.0

    @abstractmethod
    def _kind(self) -> str:
        """Name of the part, for messages."""

    @abstractmethod
    def _limits(self) -> tuple[int, int]:
        """Lowest and highest count of the range."""

    @abstractmethod
    def _identify(self) -> Mapping[str, int]:
        """Read the identity registers and return them by name; write nothing. Raises IdentityError."""

    @abstractmethod
    def _set_up(self, identity: Mapping[str, int]) -> DeviceInfo:
        """Reset, configure, read back, start the FIFO."""

    @abstractmethod
    def _counts_per_g(self) -> float:
        """Nominal counts per g at the range that is set."""

    @abstractmethod
    def _self_test(self) -> SelfTest:
        """The self-test of the device at its present settings."""

    @abstractmethod
    def _settings(self) -> Registers:
        """The settings while measuring, in ascending order of register."""

    @abstractmethod
    def _poll(self) -> Burst:
        """Read what the FIFO holds now."""

    @abstractmethod
    def _decode(self, data: bytes) -> FifoSamples:
        """Samples in the words of half a second; `data` begins with the rest of the words before."""

    def _temperature(self) -> tuple[int | None, float | None]:
        """Raw value and degC; called before the first poll of each block."""
        return None, None

    def _forget(self) -> None:
        """Discard the incomplete sample, because the next word does not follow the last one."""
        self._drop(OUT_OF_STEP, len(self._rest) // self.word_bytes)
        self._rest = b""

    def open(self) -> DeviceInfo:
        """Identify the device, reset it, write the settings and read them back.

        Raises ConfigurationError (a kernel driver holds the address, or a setting was not accepted), IdentityError, or
        DeviceLost (no bus, or no device answers).
        """
        self._device.open()
        try:
            info = self._set_up(self._identify())
        except BaseException:
            self.close()
            raise
        self._loss = None
        self._rest = b""
        self._forget()
        self._cutter.nominal_rate_hz = info.nominal_rate_hz
        self._cutter.flag(BlockFlags.RESTART)
        self._next_poll_ns = self._clock()[0]
        return info

    def identify(self) -> str:
        """Name the device at the address. Reads only the identity registers, so a device in use is not disturbed.

        Raises the same errors as `open`.
        """
        self._device.open()
        try:
            self._device.check_free()
            identity = self._identify()
        finally:
            self.close()
        return f"{self._kind()} ({', '.join(f'{name} 0x{value:02X}' for name, value in identity.items())})"

    def self_test(self) -> SelfTestReport:
        """Run the self-test of the open device; takes about 3 s. Open the device again afterwards.

        Raises the same errors as `read_block`.
        """
        test = self._self_test()
        g = self._counts_per_g()
        still = self._settled(0.0)
        for register, value in test.writes:
            self._device.write(register, value)
        change = (self._settled(test.settle_s).mean(axis=0) - still.mean(axis=0)) / g
        noise = still.std(axis=0) / g
        self.close()
        return SelfTestReport(test, tuple(change.tolist()), tuple(noise.tolist()))

    def _settled(self, settle_s: float) -> NDArray[np.generic]:
        """Indications of one block, after the samples of the first `settle_s` and of the block before are discarded."""
        self._sleep(settle_s)
        self.read_block()
        block = self.read_block()
        if block is None:
            raise DeviceLost(f"{self._device.name}: sent no samples during the self-test")
        return block.indications

    def close(self) -> None:
        """Release the bus; the device goes on measuring until the next reset."""
        self._device.close()

    def take_drops(self) -> list[Drop]:
        """Bytes of FIFO entries that became no sample since the last call, by reason."""
        drops = [Drop(self.word_bytes * words, "bytes", reason) for reason, words in self._dropped.items() if words]
        self._dropped.clear()
        return drops

    def read_block(self) -> SampleBlock | None:
        """The next block, or None if no sample came. Raises DeviceLost."""
        if not self._ready and self._loss is None:
            self._gather()
        if self._ready:
            return self._ready.popleft()
        if self._loss is not None:
            raise self._loss
        return None

    def _gather(self) -> None:
        """Poll for BLOCK_S, or until samples or the device are lost."""
        bursts: list[Burst] = []
        raw_degc: tuple[int | None, float | None] = None, None
        end_ns = self._next_poll_ns + round(BLOCK_S * 1e9)
        try:
            raw_degc = self._temperature()
            while self._next_poll_ns < end_ns and not self._ready:
                self._wait()
                burst = self._poll()
                if burst.lost:
                    self._finish(bursts, raw_degc)
                    self._forget()
                    self._cutter.flag(BlockFlags.RESTART | BlockFlags.OVERRUN)
                    bursts = []
                    end_ns = self._next_poll_ns + round(BLOCK_S * 1e9)
                bursts.append(burst)
            if not any(burst.data for burst in bursts):
                self._check_settings(DeviceLost)
        except DeviceLost as loss:
            self._loss = loss  # raised after all earlier samples have been returned
        self._finish(bursts, raw_degc)

    def _wait(self) -> None:
        """Sleep until the next poll.

        The polls are spread over a sample period by the golden ratio, so that polls and sample clock do not beat and
        the arrivals of each second cover the whole sample period.
        """
        now_ns, _ = self._clock()
        self._next_poll_ns += round(self._options.interval_s * 1e9)
        self._phase = (self._phase + GOLDEN) % 1.0
        wait_s = (self._next_poll_ns - now_ns) * 1e-9 + self._phase / self._cutter.nominal_rate_hz
        if wait_s > 0:
            self._sleep(wait_s)
        else:
            self._next_poll_ns = now_ns

    def _finish(self, bursts: list[Burst], raw_degc: tuple[int | None, float | None]) -> None:
        """Decode the bursts and make blocks of the samples."""
        if not bursts:
            return
        lengths = [len(burst.data) // self.word_bytes for burst in bursts]
        words_read = len(self._rest) // self.word_bytes + np.cumsum(lengths)
        found = self._decode(self._rest + b"".join(burst.data for burst in bursts))
        self._rest = found.rest
        self._drop(OUT_OF_STEP, found.dropped)
        stretch = Stretch(
            indications=found.counts,
            burst_t_monotonic_ns=np.array([burst.arrival_ns for burst in bursts]),
            burst_count=np.searchsorted(found.last, words_read),
            t_utc_ns=bursts[-1].utc_ns,
            temperature_raw=raw_degc[0],
            temperature_degc=raw_degc[1],
        )
        self._ready.extend(self._cutter.cut(stretch, [Break(at, BlockFlags.RESTART) for at in found.breaks]))

    def _drop(self, reason: str, words: int) -> None:
        self._dropped[reason] += words

    def _check_settings(self, error: type[DeviceError] = ConfigurationError) -> None:
        """Read every setting back (neighbouring registers in one read) and raise `error` if one differs."""
        settings = self._settings()
        runs: list[list[int]] = []
        for register in settings:
            if runs and register == runs[-1][-1] + 1:
                runs[-1].append(register)
            else:
                runs.append([register])
        found = self._device.read_each([(run[0], len(run)) for run in runs])
        wrong = [
            f"{name} is 0x{value:02X}, not 0x{wanted:02X}"
            for value, (name, wanted) in zip(found, settings.values(), strict=True)
            if value != wanted
        ]
        if wrong:
            raise error(f"{self._device.name} does not hold its settings (did it lose power?): {', '.join(wrong)}")

    def _write_settings(self, *, last: int) -> None:
        """Write all settings, register `last` after the others, and read them back."""
        settings = self._settings()
        for register, (_, value) in settings.items():
            if register != last:
                self._device.write(register, value)
        self._device.write(last, settings[last][1])
        self._check_settings()

    def _info(self, driver: str, rate_hz: float, found: Mapping[str, int]) -> DeviceInfo:
        """Build the result of `open`; `found` are registers that were read but not set, by name."""
        counts_per_g, filters = self._counts_per_g(), self._options.known_filters
        registers = dict(found) | dict(self._settings().values())
        return DeviceInfo(
            driver=driver,
            kind=self._kind(),
            serial_number=self._options.serial_number,
            unit="count",
            axes=3,
            nominal_rate_hz=rate_hz,
            range_mps2=-self._limits()[0] / counts_per_g * STANDARD_GRAVITY_MPS2,
            nominal_sensitivity=counts_per_g / STANDARD_GRAVITY_MPS2,
            settings={name: f"0x{value:02X}" for name, value in registers.items()},
            filters=filters,
            filter_settings=self.filter_settings if filters else (),
        )
