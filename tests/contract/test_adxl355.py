"""The driver contract on the twins of the ADXL355, ADXL357 and ADXL359, and the faults that only this family has."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from hw.adxl355 import Adxl355, Adxl357, Adxl359
from hw.block import BlockFlags, Drop, SampleBlock
from hw.conformance.i2c import BUSES, I2cContract, I2cRig, on_one_adapter
from hw.sensor import DeviceLost, IdentityError
from hw.virtual.adxl355_twin import Adxl355Twin, Adxl357Twin, Adxl359Twin, shaken
from hw.virtual.kernel import ADAPTERS


class Adxl355Rig(I2cRig):
    driver, twin_class, address, full = Adxl355, Adxl355Twin, 0x1D, 2**19 - 1


def timed(rig: Adxl355Rig, temperature_raw: Callable[[float], int]) -> Adxl355Twin:
    """A twin whose reads take the time of their bytes on a bus of 400 kHz."""

    class Timed(rig.twin_class):  # type: ignore[name-defined,misc]
        def read(self, count: int) -> bytes:
            data: bytes = super().read(count)
            rig.t_s += 9 * count / 400e3
            return data

    found: Adxl355Twin = Timed(rig.counts, rig.due, lambda: rig.t_s, temperature_raw=temperature_raw)
    return found


class TestAdxl355(I2cContract):
    adapters = BUSES
    kind, counts_per_g = "ADXL355", 256000  # data sheet, at 2 g
    filter_register = 0x28, "FILTER"
    # registers that another user may have written: offsets, high-pass filter, self-test
    trimmed = {0x1E: 0x11, 0x23: 0x11, 0x2E: 0x03}  # noqa: RUF012
    late_s = 0.2
    self_test_range = 4.0  # 8 g: gravity and 3 g, the largest change that passes, need more than 4 g
    # Data sheet: 1885 at 25 degC, -9.05 LSB per degC: 181 LSB less are 20 degC more.
    temperature = 1704, 45.0

    @pytest.fixture
    def rig(self) -> Iterator[Adxl355Rig]:
        rig = Adxl355Rig()
        yield rig
        rig.close()

    def test_says_who_it_is_and_how_it_is_set(self, rig: Adxl355Rig) -> None:
        info = rig.sensor.open()
        assert (info.kind, info.unit, info.axes) == (self.kind, "count", 3)
        # 20 bits: +-2.048 g at 256000 LSB/g
        assert info.nominal_sensitivity == pytest.approx(self.counts_per_g / 9.80665, rel=1e-12)
        assert info.range_mps2 == pytest.approx(2**19 / self.counts_per_g * 9.80665, rel=1e-12)
        assert len(info.settings) == 18
        registers = rig.twin.registers
        assert info.settings["REVID"] == f"0x{registers[3]:02X}"
        assert info.settings["FILTER"] == f"0x{registers[0x28]:02X}" == "0x02"
        assert info.settings["RANGE"] == f"0x{registers[0x2C]:02X}" == "0x81"
        assert info.settings["POWER_CTL"] == f"0x{registers[0x2D]:02X}" == "0x00"

    def test_wrong_identity(self, rig: Adxl355Rig) -> None:  # type: ignore[override]
        adxl359 = Adxl355Twin(rig.counts, rig.due, lambda: rig.t_s, identity=b"\xad\x1d\xe9\x01")
        rig.put(adxl359)
        with pytest.raises(IdentityError, match=f"{rig.name}: expected the IDs ad 1d ed, found ad 1d e9"):
            rig.sensor.open()

    def test_it_waits_while_the_device_loads_its_trim(self, rig: Adxl355Rig) -> None:
        rig.twin.power_cycle()  # reads give 0xFF now
        rig.sensor.open()
        flags, _ = rig.read()
        assert flags == BlockFlags.RESTART

    @pytest.mark.parametrize("busy_s", [0.09, 0.2])
    def test_the_trim_may_take_100_ms_after_a_reset(self, rig: Adxl355Rig, busy_s: float) -> None:
        class Slow(rig.twin_class):  # type: ignore[name-defined,misc]
            reset_s = busy_s

        rig.put(Slow(rig.counts, rig.due, lambda: rig.t_s))
        if busy_s < 0.1:
            rig.sensor.open()
            return
        with pytest.raises(DeviceLost, match=r"the device has not loaded its factory trim 100 ms after the reset"):
            rig.sensor.open()

    def test_a_reset_that_does_not_bring_the_trim_back_is_repeated(self, rig: Adxl355Rig) -> None:
        class Unsure(rig.twin_class):  # type: ignore[name-defined,misc]
            resets = 0

            def power_cycle(self) -> None:
                super().power_cycle()
                self.resets += 1
                self.shadow = bytes(5) if self.resets < 5 else Adxl355Twin.shadow

        rig.put(Unsure(rig.counts, rig.due, lambda: rig.t_s))
        rig.twin.shadow = Adxl355Twin.shadow  # type: ignore[attr-defined]
        rig.sensor.open()
        assert rig.twin.resets == 5  # type: ignore[attr-defined]

    def test_a_part_that_loses_its_trim_is_not_used(self, rig: Adxl355Rig) -> None:
        # The first reset changes the trim for good: the values of before it are those that count.
        class Worn(rig.twin_class):  # type: ignore[name-defined,misc]
            def power_cycle(self) -> None:
                super().power_cycle()
                self.shadow = bytes.fromhex("4c219a0500")

        rig.put(Worn(rig.counts, rig.due, lambda: rig.t_s))
        rig.twin.shadow = bytes.fromhex("4c219a0533")  # type: ignore[attr-defined]
        with pytest.raises(
            DeviceLost, match=r"after a reset the shadow registers read 4c 21 9a 05 00, not 4c 21 9a 05 33"
        ):
            rig.sensor.open()
        with pytest.raises(DeviceLost, match="not 4c 21 9a 05 33; cut its power"):
            rig.sensor.open()  # what the device holds now is not taken for its trim
        rig.put(Adxl355Twin(rig.counts, rig.due, lambda: rig.t_s, identity=rig.twin_class.own_identity))
        rig.sensor.open()

    @pytest.mark.thorough
    @on_one_adapter
    def test_a_temperature_that_changes_while_it_is_read_is_not_torn(self, rig: Adxl355Rig) -> None:
        # 0x6FF and 0x700 in turn, every 1.7 ms: of 300 single readings, some have the high byte of one and the low byte
        # of the other, which is 28 K away. At a low rate the FIFO is polled less often for each block, which has one
        # temperature.
        rig.rate_hz = 62.5
        rig.sensor = rig.build(rate_hz=rig.rate_hz)
        rig.put(timed(rig, lambda t_s: 0x6FF + int(t_s / 1.7e-3) % 2))
        rig.sensor.open()
        blocks = [rig.sensor.read_block() for _ in range(300)]
        raw = [block.temperature_raw for block in blocks if block is not None]
        assert len(raw) == 300
        assert set(raw) == {0x6FF, 0x700}

    def test_a_temperature_that_never_reads_twice_alike_is_none(self, rig: Adxl355Rig) -> None:
        rig.put(timed(rig, lambda t_s: int(t_s * 1e5) * 17 % 4096))
        rig.sensor.open()
        block = rig.sensor.read_block()
        assert block is not None
        assert (block.temperature_raw, block.temperature_degc) == (None, None)

    def test_a_self_test_that_is_too_strong_fails(self, rig: Adxl355Rig) -> None:
        # 1 g of gravity and a change of 3.2 g in z: at 2.048 g the indication would change by 1.05 g.
        class Strong(rig.twin_class):  # type: ignore[name-defined,misc]
            self_test_counts = (0, 0, round(3.2 * self.counts_per_g))

            def _encode(self, first: int, counts: NDArray[np.int32]) -> bytes:
                return bytes(super()._encode(first, np.clip(counts, -(2**19), 2**19 - 1)))

        def gravity(first: int, n: int) -> NDArray[np.int32]:
            z = self.counts_per_g >> (rig.twin.registers[0x2C] & 3) - 1
            return np.array([0, 0, z], np.int32) + np.arange(first, first + n, dtype=np.int32)[:, None] % 2

        rig.put(Strong(gravity, rig.due, lambda: rig.t_s))
        rig.sensor.open()
        report = rig.sensor.self_test()
        assert report.change_g[2] == pytest.approx(3.2, abs=1e-3)
        assert "z changes by 3.200 g, the limits are 0.5 to 3 g" in report.faults

    def test_out_of_step_at_the_front(self, rig: Adxl355Rig) -> None:
        # The X of the oldest sample is lost: its Y and Z are dropped, and each later poll leaves two entries in the
        # FIFO.
        rig.sensor.open()
        rig.read()
        rig.sleep(0.005)
        rig.twin.steal()
        _, before = rig.read()
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART
        assert after[0] == before[-1] + 2
        assert rig.sensor.take_drops() == [Drop(6, "bytes", "incomplete samples in the FIFO")]
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
        first = rig.due(rig.t_s)  # in the FIFO from now on
        rig.sleep(0.01)
        rig.twin.steal(entry)
        _, before = rig.read()
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART
        # Without its X, the Y and Z of a sample could be taken for those of the sample before
        kept = before[-1] + 1 - first
        assert kept in (1, 2)
        assert after[0] == first + 3
        (drop,) = rig.sensor.take_drops()
        assert drop.count == 3 * (3 * (3 - kept) - 1)

    def test_overrun_between_count_and_read(self, rig: Adxl355Rig) -> None:
        # 31 samples are counted, then the process stalls, and the oldest samples are overwritten before they are read.
        class Stalling(rig.twin_class):  # type: ignore[name-defined,misc]
            stall_s = 0.0

            def read(self, count: int) -> bytes:
                data = super().read(count)
                if self._pointer == 0x06 and data[1] >= 90:
                    rig.t_s, Stalling.stall_s = rig.t_s + Stalling.stall_s, 0.0
                return data

        rig.put(Stalling(rig.counts, rig.due, lambda: rig.t_s))
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.0305)  # the poll that became due meanwhile follows at once
        Stalling.stall_s = 0.01
        flags, after = rig.read_restart()
        assert after[0] != before[-1] + 1
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN

    def test_overrun_told_by_a_status_that_got_lost(self, rig: Adxl355Rig) -> None:
        # A read clears STATUS even if the transfer then fails: the driver must recognise the loss by the full FIFO.
        class Garbling(rig.twin_class):  # type: ignore[name-defined,misc]
            garble = False

            def read(self, count: int) -> bytes:
                data = super().read(count)
                if self.garble and self._pointer == 0x06:
                    self.garble = False
                    raise OSError(errno.EIO, "Input/output error")
                return data

        twin = Garbling(rig.counts, rig.due, lambda: rig.t_s)
        rig.put(twin)
        rig.sensor.open()
        _, before = rig.read()
        # No sample is made between the two attempts; it would overrun the FIFO again
        rig.sleep(0.0501 + (-rig.t_s) % 0.001)
        twin.garble = True
        flags, after = rig.read_restart()
        assert after[0] != before[-1] + 1
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN

    def test_full_without_overrun_is_no_loss(self, rig: Adxl355Rig) -> None:
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.0305)
        flags, after = rig.read()
        assert flags == BlockFlags.NONE
        assert after[0] == before[-1] + 1


class Adxl357Rig(Adxl355Rig):
    driver, twin_class = Adxl357, Adxl357Twin


class TestAdxl357(TestAdxl355):
    adapters = ADAPTERS  # over SPI it is the ADXL355's code
    kind, counts_per_g = "ADXL357", 51200  # data sheet, at 10 g
    self_test_range = 1.0
    temperature = 1671, 45.0  # data sheet: 1852 at 25 degC, -9.05 LSB per degC

    @pytest.fixture
    def rig(self) -> Iterator[Adxl355Rig]:
        rig = Adxl357Rig()
        yield rig
        rig.close()


class Adxl359Rig(Adxl355Rig):
    driver, twin_class = Adxl359, Adxl359Twin


class TestAdxl359(TestAdxl357):
    kind = "ADXL359"

    @pytest.fixture
    def rig(self) -> Iterator[Adxl355Rig]:
        rig = Adxl359Rig()
        yield rig
        rig.close()

    def test_wrong_identity(self, rig: Adxl355Rig) -> None:  # type: ignore[override]
        rig.put(Adxl357Twin(rig.counts, rig.due, lambda: rig.t_s))
        with pytest.raises(IdentityError, match=f"{rig.name}: expected the IDs ad 1d e9, found ad 1d ed"):
            rig.sensor.open()


@pytest.mark.parametrize(("range_g", "counts_per_g"), [(10, 51200), (20, 25600), (40, 12800)])
def test_the_wide_ranges(range_g: int, counts_per_g: int) -> None:
    rig = Adxl357Rig()
    try:
        info = rig.build(range_g=range_g).open()
        assert info.nominal_sensitivity == pytest.approx(counts_per_g / 9.80665, rel=1e-12)
        assert info.settings["RANGE"] == {10: "0x81", 20: "0x82", 40: "0x83"}[range_g]
    finally:
        rig.close()


def knocks(starts_s: NDArray[np.float64]) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """At rest, with 5 g for 6.5 ms in x from each of these times on; 20 g in the first and the last 0.4 ms of them. In
    g."""

    def felt_g(t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        since_ms = 1e3 * (t_s - starts_s[np.maximum(np.searchsorted(starts_s, t_s, side="right") - 1, 0)])
        x = np.select([since_ms < 0, since_ms < 0.4, since_ms < 6.1, since_ms < 6.5], [0.0, 20.0, 5.0, 20.0])
        return np.column_stack([x, np.full(len(t_s), 0.2), np.full(len(t_s), 0.9)])

    return felt_g


def shaken_blocks(rate_hz: float, starts_s: NDArray[np.float64], seconds: float) -> tuple[int, list[SampleBlock]]:
    """The number of the first sample, and the blocks."""
    rig = Adxl355Rig()
    rig.rate_hz = rate_hz
    first: list[int] = []

    def source(number: int, n: int) -> NDArray[np.int32]:
        first.append(number)
        return chip(number, n)

    try:
        chip = shaken(knocks(starts_s), rate_hz, 256000, over_g=8.0)
        rig.put(Adxl355Twin(source, rig.due, lambda: rig.t_s))
        sensor = rig.sensor = rig.build(rate_hz=rate_hz, bus_khz=1000.0)
        sensor.open()
        first.clear()
        blocks = list(rig.blocks(seconds))
    finally:
        rig.close()
    return first[0], blocks


@pytest.mark.two_cases
@pytest.mark.parametrize("rate_hz", [500.0, 4000.0, 1000.0])
def test_what_the_stop_of_the_drive_spoils_is_marked_saturated(rate_hz: float) -> None:
    # Over range the output drops to zero before the filters, which spread the drop. Each knock is near a joint of two
    # blocks, so that some spoil samples of one block and reach the end of the range in the other.
    number, plain = shaken_blocks(rate_hz, np.array([-1.0]), 24.0)
    joints_s = np.array([number + block.first_index for block in plain[1:]]) / rate_hz
    starts_s = joints_s[::2] + np.linspace(-9e-3, 1e-3, len(joints_s[::2]))
    again, blocks = shaken_blocks(rate_hz, starts_s, 24.0)
    assert again == number
    n = sum(block.n for block in blocks)
    read = np.concatenate([block.indications for block in blocks])
    assert np.array_equal(read, shaken(knocks(starts_s), rate_hz, 256000, over_g=8.0)(number, n))
    ideal = shaken(knocks(starts_s), rate_hz, 256000 / 16)(number, n) * 16.0  # no stop, and 16 times the range
    spoilt = (np.abs(read - ideal) > 100.0).any(axis=1)  # 0.4 mg; one count is 16 of the ideal ones
    at_end = (np.abs(read) >= 2**19 - 1).any(axis=1)
    of_block = np.repeat(np.arange(len(blocks)), [block.n for block in blocks])
    marked = np.array([bool(block.flags & BlockFlags.SATURATED) for block in blocks])
    # A knock after which no indication is at the end of the range cannot be seen: it is left out here.
    near = np.convolve(at_end, np.ones(2 * round(0.015 * rate_hz + 3) + 1), mode="same") > 0
    assert (spoilt & near).sum() > 3 * len(starts_s)
    assert marked[of_block[spoilt & near]].all()
    has_end = np.bincount(of_block[at_end], minlength=len(blocks)) > 0
    assert (marked & ~has_end).any()  # blocks that only their neighbours have spoilt
