"""Common part of all drivers that poll a FIFO over I2C or SPI: bursts, settings, self-test.

A subclass adds the registers of its chip.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, get_args

import numpy as np
from pydantic import ValidationError

from hw.block import BlockFlags, DeviceInfo, SampleBlock
from hw.bus_device import READS_MAX, BusDevice
from hw.cutting import Break, Cutter, Stretch
from hw.fifo import Burst, FifoSamples
from hw.fifo_options import BUS_SHARE_MAX
from hw.i2c import I2CDevice
from hw.pace import Pace
from hw.polling import PollingSensor
from hw.self_test import SelfTest, SelfTestPhase, SelfTestReport
from hw.sensor import GOLDEN, ConfigurationError, DeviceError, DeviceLost
from hw.spi import SpiDevice

STANDARD_GRAVITY_MPS2 = 9.80665
# Steps, in parts of a sample period, by which polls come later from one to the next, and polls until they take turns.
# Of sqrt(3) - 1 and the samples from poll to poll, no driver's defaults make a whole number.
STEPS, STEP_POLLS = (GOLDEN, 3**0.5 - 1), 8
PROOF_POLLS = 8  # about every second poll proves that no sample is missing
OUT_OF_STEP = "incomplete samples in the FIFO"
UNCHECKED = "samples behind which the settings did not read back as they were set"
TAKEN = "samples among which others are missing: does another program read the FIFO?"

Registers = Mapping[int, tuple[str, int]]
"""Settings: register -> (name, value)."""


class FifoSensor(PollingSensor):
    """Polls a FIFO and makes blocks of the samples.

    The number of lost samples is unknown if the FIFO overran, if a read was interrupted, if FIFO entries did not form
    complete samples, or if the count of the samples falls behind the clock. The next block then carries RESTART.

    Another program on the bus may change a register. Therefore the settings are read back behind the samples of each
    block, and the block is returned only if they are as they were set; else the device is lost.

    A subclass implements the abstract methods; `options` must be FifoOptions with an `address`.
    """

    device_class: ClassVar[type[I2CDevice]] = I2CDevice  # on I2C
    word_bytes: ClassVar[int]  # bytes that the FIFO stores at a time
    sample_words: ClassVar[int] = 1
    read_bytes: ClassVar[int] = 0  # least bytes of a read; 0: those of a sample
    auto_increment: ClassVar[int] = 0  # bits that a register number needs for a read of several registers
    identity_register: ClassVar[int] = 0  # reading on from it, before the device is set up, does no harm
    filter_settings: ClassVar[tuple[str, ...]] = ()  # as in DeviceInfo, where the options tell the filters

    def __init__(self, name: str, options: Any, **timing: Any) -> None:
        super().__init__(name, options, **timing)
        self._device: BusDevice = self._bus_device(self.read_bytes or self.word_bytes * self.sample_words)
        before, after = self._spoilt_samples()
        self._cutter = Cutter(name, options.rate_hz, *self._limits(), before=before, after=after)
        self._pace = Pace(options.rate_hz)
        self._stated = options  # a self-test may need a larger range
        self._self_test_writes: dict[bool, Sequence[tuple[int, int]]] = {}  # that switch it on and off
        self._settle_s = 0.0  # after these writes
        self._held: Registers = {}  # what must read the same behind each block: settings, and trims as found
        self._bursts: list[Burst] = []
        self._rest = b""
        self._next_poll_ns = 0
        self._polls = 0

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

    def _number_of_samples(self, data: bytes) -> int:
        """How many samples the words of one poll are, for the comparison with the clock."""
        return len(data) // (self.word_bytes * self.sample_words)

    def _spoilt_samples(self) -> tuple[int, int]:
        """How many samples before and behind an indication at the end of the range are spoilt, too."""
        return 0, 0

    def _filters(self) -> tuple[str, ...]:
        """The filters as in DeviceInfo, where the part tells them better than the options do."""
        return tuple(self._options.known_filters)

    def _temperature(self) -> tuple[int | None, float | None]:
        """Raw value and degC; called at the end of each block."""
        return None, None

    def _trims(self) -> Mapping[int, str]:
        """Names of registers besides `_settings` that must not change, such as trims of the factory."""
        return {}

    def _forget(self) -> None:
        """Discard the incomplete sample, because the next word does not follow the last one."""
        self._drop(OUT_OF_STEP, len(self._rest) // self.word_bytes)
        self._rest = b""

    def _bus_device(self, unit: int) -> BusDevice:
        """The device on the bus of the options."""
        options = self._options
        if options.spi and options.over_spi:
            return SpiDevice(self._kind(), options.bus, options.spi, 1e6 * options.spi_mhz, self._sleep, unit)
        return self.device_class(self._kind(), options.bus, options.address, self._sleep, unit)

    def _where(self) -> str:
        return self._device.name

    def _start(self) -> DeviceInfo:
        """Identify the device, reset it, write the settings and read them back."""
        self._device.open()
        self._device.lock()
        self._device.check_free(self.identity_register)
        identity = self._identify()
        self._device.learn(self.identity_register | self.auto_increment, self._longest_read(), self._clock)
        self._check_speed()
        info = self._set_up(identity)
        trims = self._trims()
        self._held = dict(self._settings()) | {r: (trims[r], value) for r, value in self._read_back(trims).items()}
        self._bursts, self._rest = [], b""
        self._cutter.flush()
        self._pace = Pace(info.nominal_rate_hz)
        self._forget()
        self._cutter.nominal_rate_hz = info.nominal_rate_hz
        self._cutter.flag(BlockFlags.RESTART)
        self._next_poll_ns = self._clock()[0]
        return info

    def _stop(self) -> None:
        """Release the bus; the device goes on measuring until the next reset."""
        self._device.close()
        self._options = self._stated

    def _longest_read(self) -> int:
        """Bytes of the samples that one poll usually finds."""
        options = self._options
        return int(options.interval_s * options.rate_hz + 2) * self.word_bytes * self.sample_words

    def _check_speed(self) -> None:
        """Raise ConfigurationError if reading takes too much of the time of this adapter, as measured by `learn`."""
        share = self._busy(self._options)
        if share <= BUS_SHARE_MAX:
            return
        possible = []
        for rate_hz in self._options.rates_hz:
            try:
                slower = type(self._options).model_validate(
                    self._options.model_dump(exclude_unset=True) | {"rate_hz": rate_hz}
                )
            except ValidationError:
                continue
            if self._busy(slower) <= BUS_SHARE_MAX:
                possible.append(rate_hz)
        highest = f"the highest rate_hz that can be read is {max(possible):g}" if possible else "no rate can be read"
        raise ConfigurationError(
            f"{self._device.name}: at rate_hz {self._options.rate_hz:g} reading takes {share:.0%} of the time of this "
            f"adapter ({1e3 * self._device.time_s(1, 1):.2g} ms for a byte), at most {BUS_SHARE_MAX:.0%} may be used: "
            f"{highest}; use a faster adapter or another rate"
        )

    def _busy(self, options: Any) -> float:
        """Share of the time that reading takes on this adapter with these options."""
        samples = options.interval_s * options.rate_hz
        parts = max(0, math.ceil(samples * options.bytes_a_sample / self._device.longest) - 1)
        joined = READS_MAX if self._device.joins else 1
        transfers = options.reads_a_poll + max(parts, samples * options.reads_a_sample / joined)
        data_bytes = options.bytes_a_poll + samples * options.bytes_a_sample
        return float(self._device.time_s(transfers, data_bytes) / options.interval_s)

    @property
    def must_be_alone(self) -> str:
        """Why no other device may be on the bus of the device that was identified; "" where others may."""
        return str(self._options.must_be_alone)

    def identify(self) -> str:
        """Name the device at the address. Reads only the identity registers, so a device in use is not disturbed.

        Each register is read in a transfer of its own, as `open` and `read_block` do. Raises the same errors as `open`.
        """
        self._device.open()
        try:
            self._device.check_free(self.identity_register)
            identity = self._identify()
        finally:
            self._device.close()
        return f"{self._kind()} ({', '.join(f'{name} 0x{value:02X}' for name, value in identity.items())})"

    def used_by(self) -> str:
        """The process that has this device open, e.g. "process 812 (fieldcal)"; "" where none is known."""
        return self._device.used_by()

    def self_test(self) -> SelfTestReport:
        """Run the self-test of the open device once; takes about 3 s. Open the device again afterwards.

        Raises the same errors as `open` and `read_block`.
        """
        test = self.begin_self_test()
        off, on = self.self_test_phase(on=False), self.self_test_phase(on=True)
        self.close()
        x, y, z = (with_it - without for with_it, without in zip(on.mean_g, off.mean_g, strict=True))
        return SelfTestReport(test, (x, y, z), off.scatter_g)

    def begin_self_test(self) -> SelfTest:
        """As in SelfTestingSensor. Until the device is closed its range is the one of the self-test."""
        range_g = self._self_test_range_g()
        if range_g != self._options.range_g:
            self.close()
            self._options = self._options.model_copy(update={"range_g": range_g})
            self.open()
        test = self._self_test()
        self._switch(test.before)
        # Off by the same writes, which may change the mode meanwhile, with each register at last as it is now.
        last = {register: k for k, (register, _) in enumerate(test.writes)}
        off = [(r, self._held[r][1] if last[r] == k else value) for k, (r, value) in enumerate(test.writes)]
        self._self_test_writes = {True: test.writes, False: off}
        self._settle_s = test.settle_s
        return test

    def self_test_phase(self, *, on: bool) -> SelfTestPhase:
        """As in SelfTestingSensor."""
        self._switch(self._self_test_writes[on])
        block = self._settled(self._settle_s)
        counts, g = block.indications, self._counts_per_g()
        mean, scatter = (tuple((part / g).tolist()) for part in (counts.mean(axis=0), counts.std(axis=0)))
        return SelfTestPhase(mean, scatter, block.temperature_degc)

    def _self_test_range_g(self) -> int:
        """The range for the self-test, g: that of the options, or the first above gravity and the largest change."""
        ranges_g = get_args(type(self._options).model_fields["range_g"].annotation)
        above_g = 1.0 + self._self_test().highest_g
        fitting = (range_g for range_g in ranges_g if range_g >= self._options.range_g and range_g > above_g)
        return int(min(fitting, default=max(ranges_g)))

    def _switch(self, writes: Sequence[tuple[int, int]]) -> None:
        """Write settings of the self-test. The samples from now on do not follow those before."""
        for register, value in writes:
            self._device.write(register, value)
        self._held = dict(self._held) | {r: (self._held[r][0], value) for r, value in writes}
        self._bursts = []
        self._pace.restart()

    def _settled(self, settle_s: float) -> SampleBlock:
        """One block, after the samples of the first `settle_s` and of the block before are discarded."""
        self._sleep(settle_s)
        self.read_block()
        block = self.read_block()
        if block is None:
            raise DeviceLost(f"{self._device.name}: sent no samples during the self-test")
        return block

    def _wait(self) -> None:
        now_ns, _ = self._clock()
        self._next_poll_ns += round(self._options.interval_s * 1e9)
        wait_s = (self._next_poll_ns - now_ns) * 1e-9 + self._next_phase() / self._rate_hz
        if wait_s > 0:
            self._sleep(wait_s)
        else:
            self._next_poll_ns = now_ns

    def _next_phase(self) -> float:
        """As in PollingSensor, but two steps take turns.

        With equal steps there are clocks of devices with which all polls come at the same part of a sample period.
        """
        self._polls += 1
        self._phase = (self._phase + STEPS[self._polls // STEP_POLLS % 2]) % 1.0
        return self._phase

    def _poll_once(self) -> bool:
        burst = self._poll()
        if burst.lost:
            if any(earlier.data for earlier in self._bursts):  # a part that loses samples for ever gives no block
                self._extend()
            self._hand_on()
            self._begin_again()
        else:
            self._pace.add(burst.arrival_ns, self._device.stamp_half_ns, self._number_of_samples(burst.data))
        self._bursts.append(burst)
        return True

    def _begin_again(self) -> None:
        """The samples from now on do not follow those before."""
        self._ready.extend(self._cutter.flush())
        self._forget()
        self._pace.restart()
        self._cutter.flag(BlockFlags.RESTART | BlockFlags.OVERRUN)

    def _finish(self) -> None:
        if self._loss is not None:
            self._ready.extend(self._cutter.flush())
            self._discard(UNCHECKED)
            return
        for _ in range(PROOF_POLLS):
            if self._pace.proved:
                break
            self._wait()
            self._poll_once()
        self._hand_on()

    def _hand_on(self) -> None:
        """Read the settings back, compare the count of the samples with the clock, then make blocks of the bursts."""
        temperature = self._temperature()
        self._check_settings(DeviceLost)
        if not self._bursts:
            return
        bursts, self._bursts = self._bursts, []
        lengths = [len(burst.data) // self.word_bytes for burst in bursts]
        words_read = len(self._rest) // self.word_bytes + np.cumsum(lengths)
        found = self._decode(self._rest + b"".join(burst.data for burst in bursts))
        self._rest = found.rest
        if len(found.breaks) > 1 or (sum(lengths) >= self.sample_words and not len(found.counts)):
            self._drop(OUT_OF_STEP, sum(lengths))
            raise DeviceLost(
                f"{self._device.name}: the contents of the FIFO form no samples; does another program read the FIFO?"
            )
        self._drop(OUT_OF_STEP, found.dropped)
        if found.breaks:
            self._pace.restart()  # the words themselves tell where samples are missing
        elif self._pace.missing:
            self._drop(TAKEN, sum(lengths))
            self._begin_again()
            self._extend()
            return
        stretch = Stretch(
            indications=found.counts,
            burst_t_monotonic_ns=np.array([burst.arrival_ns for burst in bursts]),
            burst_count=np.searchsorted(found.last, words_read),
            t_utc_ns=bursts[-1].utc_ns,
            temperature_raw=temperature[0],
            temperature_degc=temperature[1],
        )
        self._ready.extend(self._cutter.cut(stretch, [Break(at, BlockFlags.RESTART) for at in found.breaks]))

    def _discard(self, reason: str) -> None:
        """Discard the bursts that wait."""
        self._drop(reason, sum(len(burst.data) for burst in self._bursts) // self.word_bytes)
        self._bursts = []

    def _drop(self, reason: str, words: int) -> None:
        self._dropped["bytes", reason] += self.word_bytes * words

    def _read_back(self, registers: Mapping[int, object]) -> dict[int, int]:
        """Contents of these registers; neighbours are read together."""
        runs: list[list[int]] = []
        for register in registers:
            if runs and register == runs[-1][-1] + 1 and len(runs[-1]) < self._device.longest:
                runs[-1].append(register)
            else:
                runs.append([register])
        reads = [(run[0] | (self.auto_increment if len(run) > 1 else 0), len(run)) for run in runs]
        return dict(zip(registers, self._device.read_each(reads), strict=True)) if reads else {}

    def _check_settings(self, error: type[DeviceError] = ConfigurationError) -> None:
        """Read every setting and trim back and raise `error` if one differs."""
        held = self._held if error is DeviceLost else self._settings()
        found = self._read_back(held)
        wrong = [
            f"{name} is 0x{found[register]:02X}, not 0x{wanted:02X}"
            for register, (name, wanted) in held.items()
            if found[register] != wanted
        ]
        if wrong:
            why = "did it lose power, or did another program write to it?"
            raise error(f"{self._device.name} does not hold its settings ({why}): {', '.join(wrong)}")

    def _write_settings(self, *, last: int) -> None:
        """Write all settings, register `last` after the others, and read them back."""
        settings = self._settings()
        for register, (_, value) in settings.items():
            if register != last:
                self._device.write(register, value)
        self._device.write(last, settings[last][1])
        self._check_settings()

    @property
    def nominal_sensitivity(self) -> float:
        """Counts per m/s2 by the data sheet, for the range that the options state."""
        return self._counts_per_g() / STANDARD_GRAVITY_MPS2

    def _info(self, driver: str, rate_hz: float, found: Mapping[str, int]) -> DeviceInfo:
        """Build the result of `open`; `found` are registers that were read but not set, by name."""
        counts_per_g, filters = self._counts_per_g(), self._filters()
        registers = dict(found) | dict(self._settings().values())
        return DeviceInfo(
            driver=driver,
            kind=self._kind(),
            serial_number=self._options.serial_number,
            unit="count",
            axes=3,
            nominal_rate_hz=rate_hz,
            range_mps2=-self._limits()[0] / counts_per_g * STANDARD_GRAVITY_MPS2,
            nominal_sensitivity=self.nominal_sensitivity,
            settings={name: f"0x{value:02X}" for name, value in registers.items()},
            filters=filters,
            filter_settings=self.filter_settings if filters else (),
        )
