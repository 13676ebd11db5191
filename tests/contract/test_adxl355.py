"""The contract on the register-level twin under the real smbus2, and the faults only this device has."""

from __future__ import annotations

import errno
import functools
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from hw.adxl355 import Adxl355, Adxl355Options
from hw.block import BlockFlags, Drop
from hw.sensor import ConfigurationError, DeviceLost, IdentityError
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.kernel import FUNCTIONS, I2CBus, installed
from tests.contract.contract import Rig, SensorContract

FULL = 2**19 - 1
LAP = 1000


@functools.cache
def numbered_counts() -> NDArray[np.int32]:
    """x and y count samples in laps and laps, z is their negative sum; enough for the longest test."""
    lap, place = np.divmod(np.arange(1_100_000, dtype=np.int32), LAP)
    return np.column_stack([place - 500, lap * 7, 500 - place - lap * 7])


class Adxl355Rig(Rig):
    def __init__(self) -> None:
        self.saturated = range(0)
        self.twin = Adxl355Twin(self.counts, self.due, lambda: self.t_s)
        self.bus = I2CBus({0x1D: self.twin})
        self._kernel = installed({"/dev/i2c-1": self.bus})
        self._kernel.__enter__()
        self.sensor = Adxl355("sensor", Adxl355Options(), clock=self.clock, sleep=lambda s: self.sleep(s))

    def build_elsewhere(self) -> Adxl355:
        return Adxl355("sensor", Adxl355Options(bus=7), clock=self.clock, sleep=self.sleep)

    def counts(self, first: int, n: int) -> NDArray[np.int32]:
        counts = numbered_counts()[first : first + n]
        if self.saturated:
            counts = counts.copy()
            counts[[i - first for i in self.saturated if first <= i < first + n], 2] = FULL
        return counts

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = indications.astype(np.int64).T
        numbers = y // 7 * LAP + x + 500
        assert ((x + y + z == 0) | ((z == FULL) & np.isin(numbers, self.saturated))).all()
        return numbers

    def saturate(self, first: int, last: int) -> None:
        self.saturated = range(first, last + 1)

    def lose(self) -> None:
        self.twin.steal(entry=7)

    def unplug(self) -> None:
        self.bus.unplug()

    def replug(self) -> None:
        self.bus.replug()

    def close(self) -> None:
        self.sensor.close()
        self._kernel.__exit__(None, None, None)

    def read(self) -> tuple[BlockFlags, NDArray[np.int64]]:
        block = self.sensor.read_block()
        assert block is not None
        return block.flags, self.number(block.indications)


class TestAdxl355(SensorContract):
    @pytest.fixture
    def rig(self) -> Iterator[Adxl355Rig]:
        rig = Adxl355Rig()
        yield rig
        rig.close()

    def test_says_who_it_is_and_how_it_is_set(self, rig: Adxl355Rig) -> None:
        info = rig.sensor.open()
        assert (info.kind, info.unit, info.axes) == ("ADXL355", "count", 3)
        # Data sheet: 256000 LSB/g at 2 g, and 20 bits make +-2.048 g of that.
        assert info.nominal_sensitivity == pytest.approx(256000 / 9.80665, rel=1e-12)
        assert info.range_mps2 == pytest.approx(2.048 * 9.80665, rel=1e-12)
        assert len(info.settings) == 18
        registers = rig.twin.registers
        assert info.settings["REVID"] == f"0x{registers[3]:02X}"
        assert info.settings["FILTER"] == f"0x{registers[0x28]:02X}" == "0x02"
        assert info.settings["RANGE"] == f"0x{registers[0x2C]:02X}" == "0x81"
        assert info.settings["POWER_CTL"] == f"0x{registers[0x2D]:02X}" == "0x00"

    def test_touched_registers_are_put_back(self, rig: Adxl355Rig) -> None:
        rig.twin.registers[0x1E:0x24] = b"\x11" * 6  # offsets somebody trimmed
        rig.twin.registers[0x28] = 0x32  # a high-pass filter somebody turned on
        rig.twin.registers[0x2E] = 0x03  # self-test
        rig.sensor.open()
        assert rig.twin.registers[0x1E:0x24] == bytes(6)
        assert rig.twin.registers[0x28] == 0x02
        assert rig.twin.registers[0x2E] == 0x00

    @pytest.mark.parametrize("number", [errno.ENXIO, errno.EREMOTEIO])
    def test_nobody_at_the_address(self, rig: Adxl355Rig, number: int) -> None:
        with installed({"/dev/i2c-1": I2CBus({}, absent_errno=number)}):
            with pytest.raises(DeviceLost, match=r"ADXL355 at 0x1D on /dev/i2c-1: "):
                rig.sensor.open()
            rig.sensor.close()

    def test_wrong_identity(self, rig: Adxl355Rig) -> None:
        adxl359 = Adxl355Twin(rig.counts, rig.due, lambda: rig.t_s, identity=b"\xad\x1d\xe9\x01")
        rig.bus.targets[0x1D] = adxl359
        with pytest.raises(IdentityError, match=r"0x1D on /dev/i2c-1: expected ad 1d ed, found ad 1d e9"):
            rig.sensor.open()

    def test_address_of_a_kernel_driver_is_not_forced(self, rig: Adxl355Rig) -> None:
        rig.bus.claimed.add(0x1D)
        with pytest.raises(ConfigurationError, match=r"0x1D on /dev/i2c-1: a kernel driver holds the address"):
            rig.sensor.open()
        assert rig.twin.registers[0x2D] == 0x01  # nobody touched it

    def test_smbus_only_adapter(self, rig: Adxl355Rig) -> None:
        rig.bus.functions = FUNCTIONS & ~1
        with pytest.raises(ConfigurationError, match="plain I2C"):
            rig.sensor.open()

    def test_setting_that_does_not_take(self, rig: Adxl355Rig) -> None:
        class Stubborn(Adxl355Twin):
            def write(self, data: bytes) -> None:
                super().write(data if data[0] != 0x28 else bytes([0x28, 0x05]))

        rig.bus.targets[0x1D] = Stubborn(rig.counts, rig.due, lambda: rig.t_s)
        with pytest.raises(ConfigurationError, match="FILTER is 0x05, not 0x02"):
            rig.sensor.open()

    def test_reset_is_repeated_until_the_trim_is_back(self, rig: Adxl355Rig) -> None:
        rig.twin.power_cycle()  # just now: the trim that is compared is not loaded yet
        rig.sensor.open()
        flags, _ = rig.read()
        assert flags == BlockFlags.RESTART

    def test_a_part_that_loses_its_trim_is_not_used(self, rig: Adxl355Rig) -> None:
        class Worn(Adxl355Twin):
            wear = 0

            def read(self, count: int) -> bytes:
                data = super().read(count)
                if self._pointer != 0x55:
                    return data
                self.wear += 1
                return data[:4] + bytes([self.wear])

        rig.bus.targets[0x1D] = Worn(rig.counts, rig.due, lambda: rig.t_s)
        with pytest.raises(DeviceLost, match=r"after a reset the shadow registers read .* 0a, not .* 09"):
            rig.sensor.open()

    @pytest.mark.parametrize("number", [errno.ENXIO, errno.EREMOTEIO, errno.EIO, errno.ETIMEDOUT, errno.EAGAIN])
    def test_three_failures_pass_a_fourth_is_a_loss(self, rig: Adxl355Rig, number: int) -> None:
        rig.sensor.open()
        rig.read()
        rig.twin.fail(number, 3)
        flags, _ = rig.read()
        assert flags == BlockFlags.NONE
        rig.twin.fail(number, 4)
        with pytest.raises(DeviceLost, match="0x1D on /dev/i2c-1"):
            rig.sensor.read_block()

    def test_another_error_is_a_loss_at_once(self, rig: Adxl355Rig) -> None:
        rig.sensor.open()
        rig.twin.fail(errno.ENODEV, 1)
        with pytest.raises(DeviceLost, match="No such device"):
            rig.sensor.read_block()

    @pytest.mark.parametrize("entries", [1, 9, 48])
    def test_a_read_that_broke_off_restarts(self, rig: Adxl355Rig, entries: int) -> None:
        # 9 and 48 entries are whole samples: no marker is missing, and still they are gone.
        rig.sensor.open()
        _, before = rig.read()
        rig.twin.break_off(errno.EIO, entries)
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after[0] == before[-1] + 1 + -(-entries // 3)
        assert (np.diff(after) == 1).all()

    def test_out_of_step_at_the_front(self, rig: Adxl355Rig) -> None:
        # The X of the oldest sample is gone: its Y and Z are dropped, and each later poll leaves two entries behind.
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.005)
        rig.twin.steal()
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART
        assert after[0] == before[-1] + 2
        assert rig.sensor.take_drops() == [Drop(6, "bytes", "FIFO entries out of step")]
        number = after[-1]
        for _ in range(4):
            flags, numbers = rig.read()
            assert flags == BlockFlags.NONE
            assert np.array_equal(numbers, np.arange(number + 1, number + 1 + len(numbers)))
            number = numbers[-1]
        assert rig.sensor.take_drops() == []

    @pytest.mark.parametrize("entry", [6, 7, 8])
    def test_entry_lost_inside(self, rig: Adxl355Rig, entry: int) -> None:
        rig.sensor.open()
        rig.read()
        rig.sleep(0.01)
        rig.twin.steal(entry)
        _, before = rig.read()
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART
        assert len(before) in (1, 2)  # without its X a sample's Y and Z could belong to the one before
        assert after[0] == before[-1] + 4 - len(before)
        (drop,) = rig.sensor.take_drops()
        assert drop.count == 3 * (3 * (3 - len(before)) - 1)

    def test_late_poll_is_an_overrun(self, rig: Adxl355Rig) -> None:
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.2)
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after[0] > before[-1] + 150
        assert rig.sensor.take_drops() == []

    def test_overrun_between_count_and_read(self, rig: Adxl355Rig) -> None:
        # 31 samples are counted, then the process stalls and the oldest go before they are read.
        class Stalling(Adxl355Twin):
            stall_s = 0.0

            def read(self, count: int) -> bytes:
                data = super().read(count)
                if self._pointer == 0x06 and data[1] >= 90:
                    rig.t_s, Stalling.stall_s = rig.t_s + Stalling.stall_s, 0.0
                return data

        rig.bus.targets[0x1D] = Stalling(rig.counts, rig.due, lambda: rig.t_s)
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.0305)  # the poll that was due meanwhile comes at once
        Stalling.stall_s = 0.01
        flags, after = rig.read()
        assert after[0] != before[-1] + 1
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN

    def test_overrun_told_by_a_status_that_got_lost(self, rig: Adxl355Rig) -> None:
        # STATUS clears by being read, also when the transfer then fails: the full FIFO must tell.
        class Garbling(Adxl355Twin):
            garble = False

            def read(self, count: int) -> bytes:
                data = super().read(count)
                if self.garble and self._pointer == 0x06:
                    self.garble = False
                    raise OSError(errno.EIO, "Input/output error")
                return data

        twin = rig.bus.targets[0x1D] = Garbling(rig.counts, rig.due, lambda: rig.t_s)
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.0501 + (-rig.t_s) % 0.001)  # no sample is made between the two attempts, which would run over anew
        twin.garble = True
        flags, after = rig.read()
        assert after[0] != before[-1] + 1
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN

    def test_full_without_overrun_is_no_loss(self, rig: Adxl355Rig) -> None:
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.0305)
        flags, after = rig.read()
        assert flags == BlockFlags.NONE
        assert after[0] == before[-1] + 1

    def test_power_lost_underway(self, rig: Adxl355Rig) -> None:
        rig.sensor.open()
        rig.read()
        rig.twin.power_cycle()
        with pytest.raises(DeviceLost, match=r"did it lose power\?.*POWER_CTL is 0x01, not 0x00"):
            rig.sensor.read_block()
        rig.sensor.open()
        flags, _ = rig.read()
        assert flags == BlockFlags.RESTART

    def test_temperature(self, rig: Adxl355Rig) -> None:
        rig.bus.targets[0x1D] = Adxl355Twin(rig.counts, rig.due, lambda: rig.t_s, temperature_raw=lambda _: 1704)
        rig.sensor.open()
        block = rig.sensor.read_block()
        assert block is not None
        # Data sheet: 1885 at 25 degC, -9.05 LSB a degree: 181 LSB less are 20 degrees more.
        assert block.temperature_raw == 1704
        assert block.temperature_degc == pytest.approx(45.0)
