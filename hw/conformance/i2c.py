"""Tests that every driver which polls a FIFO over I2C or SPI must pass, on a register-level twin.

Under it are the real smbus2 and the real `hw.spi`.
"""

from __future__ import annotations

import errno
import functools
import itertools
import tempfile
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import patch

import numpy as np
import pytest
from numpy.typing import NDArray
from smbus2.smbus2 import I2cFunc

from hw.block import BlockFlags, SampleBlock
from hw.conformance.sensor import Rig, SensorContract
from hw.fifo_sensor import UNCHECKED, FifoSensor
from hw.sensor import AdapterError, ConfigurationError, DeviceLost, IdentityError
from hw.virtual.fifo_twin import FifoTwin
from hw.virtual.kernel import ADAPTERS, PLAIN, SMBUS_FUNCTIONS, Adapter, I2CBus, installed
from hw.virtual.spi_bus import CONTROLLERS, SPI, Controller, SpiBus

BUSES: tuple[Adapter | Controller, ...] = (*ADAPTERS, *CONTROLLERS)  # for a driver that reads over SPI, too
LAP = 1000
FEWER_SAMPLES = 20_000
FOREIGN_ACCESSES = 24
NOTICED_S = 2.0  # after an access by another program


@functools.cache
def numbered_counts() -> NDArray[np.int32]:
    """Counts (n, 3) that number the samples: x + 500 is the place within a lap, y + 550 the lap, z = -(x + y).

    There are enough samples for the longest test.
    """
    lap, place = np.divmod(np.arange(1_100_000, dtype=np.int32), LAP)
    return np.column_stack([place - 500, lap - 550, 1050 - place - lap])


class I2cRig(Rig):
    """Rig for a driver on I2C, or on SPI where `adapter` is a controller of it.

    A subclass names the driver, the twin, the options and the highest count of the range.
    """

    driver: ClassVar[type[FifoSensor]]
    twin_class: ClassVar[type[FifoTwin]]
    address: ClassVar[int]
    full: ClassVar[int]
    options: ClassVar[dict[str, Any]] = {}
    adapter: ClassVar[Adapter | Controller] = PLAIN

    sensor: FifoSensor

    @property
    def fifo_register(self) -> int:
        """Register at which a read that takes samples starts."""
        return self.twin_class.data_register

    def __init__(self) -> None:
        self.saturated = range(0)
        self.temperature_raw: int | None = None
        self.twin = self.build_twin()
        self.bus: Any  # I2CBus or SpiBus
        if isinstance(self.adapter, Controller):
            self.over_spi, self.name, self.node = True, "on /dev/spidev0.0", "/dev/spidev0.0"
            self.bus = SpiBus(self.twin, adapter=self.adapter)
        else:
            self.over_spi, self.name, self.node = False, f"at 0x{self.address:02X} on /dev/i2c-1", "/dev/i2c-1"
            self.bus = I2CBus({self.address: self.twin}, adapter=self.adapter)
        self._held = ExitStack()
        self._held.enter_context(installed({self.node: self.bus}))
        self.sensor = self.build()

    def build_twin(self) -> FifoTwin:
        return self.twin_class(self.counts, self.due, lambda: self.t_s, temperature_raw=self.temperature)

    def temperature(self, t_s: float) -> int:  # noqa: ARG002
        return self.twin_class.temperature_at_25_degc if self.temperature_raw is None else self.temperature_raw

    def build(self, **options: Any) -> FifoSensor:
        way = {"bus": "spi0.0"} if self.over_spi else {}
        given = self.driver.options_model.model_validate(way | self.options | options)
        return self.driver("sensor", given, clock=self.clock, sleep=lambda s: self.sleep(s))

    def build_elsewhere(self) -> FifoSensor:
        return self.build(bus="spi7.0" if self.over_spi else 7)

    def put(self, twin: FifoTwin) -> None:
        """Put another device in the place of the twin."""
        self.twin = twin
        if self.over_spi:
            self.bus.target = twin
        else:
            self.bus.targets[self.address] = twin

    def nobody(self, number: int) -> AbstractContextManager[None]:
        """While this context is active, there is no device; on I2C the adapter then tells the errno `number`."""
        return installed({self.node: SpiBus(None) if self.over_spi else I2CBus({}, absent_errno=number)})

    def claim(self) -> None:
        """A kernel driver takes the device."""
        if not self.over_spi:
            self.bus.claimed.add(self.address)
            return
        sysfs = Path(self._held.enter_context(tempfile.TemporaryDirectory()))
        (sysfs / "bus/spi/devices/spi0.0").mkdir(parents=True)
        (sysfs / "bus/spi/drivers/chip").mkdir(parents=True)
        (sysfs / "bus/spi/devices/spi0.0/driver").symlink_to(sysfs / "bus/spi/drivers/chip")
        self._held.enter_context(patch("hw.spi.SYSFS", sysfs))
        self.unplug()

    def counts(self, first: int, n: int) -> NDArray[np.int32]:
        counts = numbered_counts()[first : first + n]
        if self.saturated:
            counts = counts.copy()
            counts[[i - first for i in self.saturated if first <= i < first + n], 2] = self.full
        return counts

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = indications.astype(np.int64).T
        numbers = (y + 550) * LAP + x + 500
        assert ((x + y + z == 0) | ((z == self.full) & np.isin(numbers, self.saturated))).all()
        return np.asarray(numbers)

    def saturate(self, first: int, last: int) -> None:
        self.saturated = range(first, last + 1)

    def lose(self) -> None:
        self.twin.steal(7)

    def unplug(self) -> None:
        self.bus.unplug()

    def replug(self) -> None:
        self.bus.replug()

    def close(self) -> None:
        self.sensor.close()
        self._held.close()

    def write_elsewhere(self, register: int, value: int) -> None:
        """What another program does that writes to one register."""
        self.bus.transfer([(self.address, bytes([register, value]))])

    def at(self, moment_s: float, act: Callable[[], object]) -> None:
        """Let another program act once, when the time comes."""
        sleep = self.sleep
        acted: list[object] = []

        def until(seconds: float) -> None:
            end_s = self.t_s + seconds
            if not acted and end_s >= moment_s:
                sleep(max(0.0, moment_s - self.t_s))
                acted.append(act())
            sleep(end_s - self.t_s)

        self.sleep = until  # type: ignore[method-assign]

    def read_until(self, end_s: float) -> tuple[list[SampleBlock], DeviceLost | None]:
        """The blocks until `end_s`, or until the device is lost, and the loss."""
        blocks: list[SampleBlock] = []
        try:
            while self.t_s < end_s:
                block = self.sensor.read_block()
                blocks += [] if block is None else [block]
        except DeviceLost as loss:
            return blocks, loss
        return blocks, None

    def read(self) -> tuple[BlockFlags, NDArray[np.int64]]:
        block = self.sensor.read_block()
        assert block is not None
        return block.flags, self.number(block.indications)

    def read_restart(self) -> tuple[BlockFlags, NDArray[np.int64]]:
        """The next block that does not follow the one before; at most one block and a time without samples come before
        it."""
        for _ in range(3):
            block = self.sensor.read_block()
            if block is not None and block.flags & BlockFlags.RESTART:
                return block.flags, self.number(block.indications)
        raise AssertionError("no block restarts")


def on_one_adapter(test: Callable[..., None]) -> Callable[..., None]:
    """Mark a test of the contract that runs on one kind of adapter only."""
    test.on_one_adapter = True  # type: ignore[attr-defined]
    return test


class I2cContract(SensorContract):
    """What every driver on I2C or SPI must do, on every kind of adapter."""

    adapters: ClassVar[Sequence[Adapter | Controller]] = ADAPTERS  # BUSES where the driver reads over SPI, too
    filter_register: ClassVar[tuple[int, str]]  # a settings register, and its name in messages
    # Registers (offsets, high-pass filter, self-test) with values that somebody may have left in them
    trimmed: ClassVar[dict[int, int]]
    late_s: ClassVar[float]  # longer than the time in which the FIFO fills
    temperature: ClassVar[tuple[int, float] | None]  # a raw value and its degC
    self_test_range: ClassVar[float] = 1.0  # range during the self-test as a multiple of the range that is set

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Every test runs on every kind of adapter, but for those that take long or are many: `on_one_adapter`."""
        adapters = self.adapters[:1] if hasattr(metafunc.function, "on_one_adapter") else self.adapters
        metafunc.parametrize("adapter", adapters, indirect=True, ids=lambda adapter: adapter.name)

    @pytest.fixture(autouse=True)
    def adapter(self, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
        """The most samples are read on the plain adapter."""
        monkeypatch.setattr(I2cRig, "adapter", request.param)
        if request.param not in (PLAIN, SPI):
            monkeypatch.setattr(self, "samples", min(self.samples, FEWER_SAMPLES))

    @pytest.mark.parametrize("number", [errno.ENXIO, errno.EREMOTEIO])
    def test_nobody_at_the_address(self, rig: I2cRig, number: int) -> None:
        with rig.nobody(number):
            with pytest.raises(DeviceLost, match=rf" {rig.name}: "):
                rig.sensor.open()
            rig.sensor.close()

    def test_wrong_identity(self, rig: I2cRig) -> None:
        class Stranger(rig.twin_class):  # type: ignore[name-defined,misc]
            identity = 0x2A

            def _get(self, register: int) -> int:  # noqa: ARG002 - it answers the same everywhere
                return 0x2A

        rig.put(Stranger(rig.counts, rig.due, lambda: rig.t_s))
        before = bytes(rig.twin.registers)
        with pytest.raises(IdentityError, match=rf"{rig.name}: .*(2A|2a)"):
            rig.sensor.open()
        assert bytes(rig.twin.registers) == before

    def test_address_of_a_kernel_driver_is_not_forced(self, rig: I2cRig) -> None:
        rig.claim()
        before = bytes(rig.twin.registers)
        with pytest.raises(ConfigurationError, match=rf"{rig.node}.* kernel driver .*holds "):
            rig.sensor.open()
        assert bytes(rig.twin.registers) == before

    def test_adapter_that_cannot_do_what_the_driver_needs(self, rig: I2cRig) -> None:
        single = Adapter("bytes", functions=SMBUS_FUNCTIONS & ~I2cFunc.SMBUS_READ_I2C_BLOCK)
        rig.bus.adapter = replace(rig.adapter, modes=()) if isinstance(rig.adapter, Controller) else single
        why = "the SPI bus refuses mode" if rig.over_spi else "the adapter can neither do plain I2C transfers nor"
        with pytest.raises(AdapterError, match=f"{rig.node}: {why}"):
            rig.sensor.open()

    def test_adapter_whose_messages_are_too_short(self, rig: I2cRig) -> None:
        short = Adapter("short", longest=5)
        rig.bus.adapter = replace(rig.adapter, bufsiz=5) if isinstance(rig.adapter, Controller) else short
        with pytest.raises(AdapterError, match=f"{rig.name}: the adapter "):
            rig.sensor.open()

    def test_a_second_reader_of_the_address_is_kept_off(self, rig: I2cRig) -> None:
        rig.sensor.open()
        with pytest.raises(DeviceLost, match=rf"{rig.name}: .* uses it; end that first"):
            rig.build().open()
        rig.read()
        rig.sensor.close()
        rig.build().open()

    def test_the_dump_is_what_the_device_holds(self, rig: I2cRig) -> None:
        info = rig.sensor.open()
        register, name = self.filter_register
        assert info.settings[name] == f"0x{rig.twin.registers[register]:02X}"
        assert len(info.settings) > 5
        assert (info.unit, info.axes) == ("count", 3)

    def test_touched_registers_are_put_back(self, rig: I2cRig) -> None:
        for register, value in self.trimmed.items():
            rig.twin.registers[register] = value
        rig.sensor.open()
        assert {register: rig.twin.registers[register] for register in self.trimmed} == dict.fromkeys(self.trimmed, 0)

    def test_setting_that_does_not_take(self, rig: I2cRig) -> None:
        stubborn_register, name = self.filter_register

        class Stubborn(rig.twin_class):  # type: ignore[name-defined,misc]
            def _get(self, register: int) -> int:
                return 0x77 if register == stubborn_register else super()._get(register)

        rig.put(Stubborn(rig.counts, rig.due, lambda: rig.t_s))
        with pytest.raises(ConfigurationError, match=f"{name} is 0x77, not 0x"):
            rig.sensor.open()

    @pytest.mark.parametrize("number", [errno.ENXIO, errno.EREMOTEIO, errno.EIO, errno.ETIMEDOUT, errno.EAGAIN])
    def test_three_failures_pass_a_fourth_is_a_loss(self, rig: I2cRig, number: int) -> None:
        rig.sensor.open()
        rig.read()
        rig.twin.fail(number, 3)
        rig.read()
        rig.twin.fail(number, 4)
        with pytest.raises(DeviceLost, match=rig.name):
            list(rig.blocks(2.0))

    def test_another_error_is_a_loss_at_once(self, rig: I2cRig) -> None:
        rig.sensor.open()
        rig.twin.fail(errno.ENODEV, 1)
        with pytest.raises(DeviceLost, match="No such device"):
            rig.sensor.read_block()

    @pytest.mark.parametrize("words", [1, 9, 12, 48])
    def test_a_read_that_broke_off_restarts(self, rig: I2cRig, words: int) -> None:
        # 12 and 48 words are whole samples and whole cycles of the word counter: the counter shows no gap, but samples
        # are lost.
        rig.sensor.open()
        _, before = rig.read()
        rig.twin.break_off(errno.EIO, words)
        flags, after = rig.read_restart()
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after[0] > before[-1] + 1
        assert (np.diff(after) == 1).all()

    def test_a_long_read_that_broke_off_in_its_midst(self, rig: I2cRig) -> None:
        # Many samples wait, so that reading them needs several transfers: samples are missing behind those of the first
        # one. A read of 12 words leaves no trace in a counter of the words.
        class Interrupted(rig.twin_class):  # type: ignore[name-defined,misc]
            armed, transfers = False, 0

            def write(self, data: bytes) -> None:
                self.transfers = self.transfers + 1 if data == bytes([rig.fifo_register]) else 0
                if self.armed and self.transfers == 2:
                    self.armed = False
                    self.break_off(errno.EIO, 12)
                super().write(data)

        twin = Interrupted(rig.counts, rig.due, lambda: rig.t_s)
        rig.put(twin)
        rig.sensor.open()
        _, before = rig.read()
        twin.armed = True
        rig.sleep(2.5 * rig.sensor._options.interval_s)
        flags, after = rig.read_restart()
        assert not twin.armed
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after[0] > before[-1] + 1
        assert (np.diff(after) == 1).all()

    def test_late_poll_is_an_overrun(self, rig: I2cRig) -> None:
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(self.late_s)
        flags, after = rig.read_restart()
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after[0] > before[-1] + 1

    def test_a_reader_that_is_always_late_gets_an_answer(self, rig: I2cRig) -> None:
        # Each poll finds an overrun, or a part whose FIFO does not work reports one for ever.
        rig.sensor.open()
        sleep, polls = rig.sleep, itertools.count()

        def late(seconds: float) -> None:
            assert next(polls) < 100, "a block is waited for without end"
            sleep(seconds + self.late_s)

        rig.sleep = late  # type: ignore[method-assign]
        for _ in range(3):
            rig.sensor.read_block()

    def test_fifo_that_runs_over_between_count_and_read(self, rig: I2cRig) -> None:
        # The process does not get the processor between the two reads: the data do not follow the data read before.
        class Stalling(rig.twin_class):  # type: ignore[name-defined,misc]
            stall_s = 0.0

            def write(self, data: bytes) -> None:
                if data == bytes([rig.fifo_register]):
                    rig.t_s, Stalling.stall_s = rig.t_s + Stalling.stall_s, 0.0
                super().write(data)

        rig.put(Stalling(rig.counts, rig.due, lambda: rig.t_s))
        rig.sensor.open()
        _, before = rig.read()
        Stalling.stall_s = self.late_s
        flags, after = rig.read_restart()
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after[0] > before[-1] + 1
        assert (np.diff(after) == 1).all()

    def test_power_lost_underway(self, rig: I2cRig) -> None:
        rig.sensor.open()
        rig.read()
        rig.twin.power_cycle()
        rig.sleep(0.02)
        with pytest.raises(DeviceLost, match=r"did it lose power, or"):
            list(rig.blocks(2.0))
        rig.sensor.open()
        flags, _ = rig.read()
        assert flags == BlockFlags.RESTART

    def test_what_came_before_the_loss_is_returned_first(self, rig: I2cRig) -> None:  # type: ignore[override]
        # Only what was checked: the settings cannot be read back behind the last samples.
        rig.sensor.open()
        list(rig.blocks(0.6))
        rig.sensor.take_drops()
        sleep, start_s = rig.sleep, rig.t_s

        def unplugged_underway(seconds: float) -> None:
            sleep(seconds)
            if rig.t_s > start_s + 0.2:
                rig.unplug()

        rig.sleep = unplugged_underway  # type: ignore[method-assign]
        with pytest.raises(DeviceLost):
            list(rig.blocks(1.0))
        (drop,) = rig.sensor.take_drops()
        assert drop.reason == UNCHECKED
        assert 0.15 * rig.rate_hz < drop.count / rig.twin_class.sample_bytes < 0.3 * rig.rate_hz

    def test_temperature(self, rig: I2cRig) -> None:
        raw, degc = self.temperature or (None, None)
        rig.temperature_raw = raw
        rig.sensor.open()
        block = rig.sensor.read_block()
        assert block is not None
        assert block.temperature_raw == raw
        assert block.temperature_degc == (None if degc is None else pytest.approx(degc, abs=1e-3))

    def test_identity_is_read_without_disturbing(self, rig: I2cRig) -> None:
        info = rig.sensor.open()
        before = bytes(rig.twin.registers)
        assert rig.build().identify().startswith(info.kind)
        assert bytes(rig.twin.registers) == before
        rig.claim()
        with pytest.raises(ConfigurationError, match=r"kernel driver .*holds "):
            rig.build().identify()

    def test_self_test_passes_on_a_sound_part_and_tells_a_stuck_one(self, rig: I2cRig) -> None:
        def noise(first: int, n: int) -> NDArray[np.int32]:
            return np.arange(first, first + n, dtype=np.int32)[:, None] % np.array([2, 4, 8], np.int32)

        rig.put(rig.twin_class(noise, rig.due, lambda: rig.t_s))
        info = rig.sensor.open()
        report = rig.sensor.self_test()
        assert report.faults == []
        assert info.nominal_sensitivity is not None
        counts_per_g = info.nominal_sensitivity * 9.80665 / self.self_test_range
        # The noise is that of the indications 0, 1, 0, 1 in x, 0 to 3 in y, 0 to 7 in z.
        assert [g * counts_per_g for g in report.noise_g] == pytest.approx([0.5, 1.118, 2.291], rel=0.01)
        rig.sensor.open()  # this switches the self-test off
        block = rig.sensor.read_block()
        assert block is not None
        assert block.indications.max() == 7

        class Stuck(rig.twin_class):  # type: ignore[name-defined,misc]
            def _deflection(self) -> NDArray[np.int32]:
                return np.zeros(3, np.int32)

        rig.put(Stuck(lambda first, n: np.zeros((n, 3), np.int32) + 0 * first, rig.due, lambda: rig.t_s))
        rig.sensor.open()
        faults = rig.sensor.self_test().faults
        assert len(faults) == 6
        assert "x changes by 0.000 g, the limits are" in faults[0]
        assert "may be dead" in faults[1]

    @on_one_adapter
    def test_phases_of_the_self_test_take_turns(self, rig: I2cRig) -> None:
        rig.put(rig.twin_class(lambda first, n: np.zeros((n, 3), np.int32) + 0 * first, rig.due, lambda: rig.t_s))
        info = rig.sensor.open()
        test = rig.sensor.begin_self_test()
        off, on, again, once_more = (rig.sensor.self_test_phase(on=on).mean_g for on in (False, True, False, True))
        assert (off, on) == (again, once_more)
        change = np.subtract(on, off)
        assert np.all((np.array(test.low_g) <= change) & (change <= np.array(test.high_g)))
        assert rig.sensor.open() == info
        block = rig.sensor.read_block()
        assert block is not None
        assert not block.indications.any()

    @on_one_adapter
    @pytest.mark.parametrize("seed", range(FOREIGN_ACCESSES))
    def test_what_another_program_writes_is_noticed(self, rig: I2cRig, seed: int) -> None:
        rng = np.random.default_rng(seed)
        rig.sensor.open()
        list(rig.blocks(rng.uniform(0.5, 2.0)))
        held = [*rig.sensor._settings(), *rig.sensor._trims()]
        register = int(rng.choice(held)) if seed % 4 else int(rng.integers(256))
        value = int(rng.integers(256))
        before = bytes(rig.twin.registers[r] for r in held)
        moment_s = rig.t_s + rng.uniform(0.0, 0.6)
        rig.at(moment_s, lambda: rig.write_elsewhere(register, value))
        blocks, loss = rig.read_until(moment_s + NOTICED_S)
        check_joints(rig, blocks)
        if bytes(rig.twin.registers[r] for r in held) == before:
            return
        assert loss is not None, f"0x{value:02X} in register 0x{register:02X} was not noticed"
        assert "did it lose power, or did another program write to it?" in str(loss)
        assert all(block.t_monotonic_ns < moment_s * 1e9 for block in blocks)
        rig.sensor.open()
        assert rig.read()[0] == BlockFlags.RESTART

    @on_one_adapter
    @pytest.mark.parametrize("seed", range(FOREIGN_ACCESSES))
    def test_what_another_program_reads_is_noticed(self, rig: I2cRig, seed: int) -> None:
        rng = np.random.default_rng(seed)
        rig.sensor.open()
        list(rig.blocks(rng.uniform(1.0, 3.0)))
        register = rig.fifo_register if seed % 2 else int(rng.integers(256))
        count = int(rng.integers(1, 65))
        dump = seed % 4 == 0  # as i2cdump does: every register by itself
        reads = [(r, 1) for r in range(256)] if dump else [(register, count)]

        def read() -> None:
            for first, n in reads:
                rig.bus.transfer([(rig.address, bytes([first])), (rig.address, n)])

        moment_s = rig.t_s + rng.uniform(0.0, 0.6)
        rig.at(moment_s, read)
        blocks, loss = rig.read_until(moment_s + NOTICED_S)
        check_joints(rig, blocks)
        if loss is None:
            assert blocks[-1].t_monotonic_ns > (moment_s + NOTICED_S - 0.7) * 1e9
            return
        assert "does another program read the FIFO?" in str(loss)
        rig.sensor.open()
        assert rig.read()[0] == BlockFlags.RESTART


def check_joints(rig: I2cRig, blocks: list[SampleBlock]) -> None:
    """Neighbours in a block must be neighbours in the device, and a block that does not follow must say so."""
    for block in blocks:
        assert (np.diff(rig.number(block.indications)) == 1).all()
    for a, b in itertools.pairwise(blocks):
        if int(rig.number(b.indications)[0] - rig.number(a.indications)[-1]) != 1:
            assert b.flags & (BlockFlags.GAP | BlockFlags.RESTART)
