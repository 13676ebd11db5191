"""The driver contract on `virtual`, and that sensor and reference belong to one bench."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from hw.block import BlockFlags, SampleBlock
from hw.buffered_sensor import Indications
from hw.conformance.sensor import Rig, SensorContract
from hw.virtual.bench import Bench
from hw.virtual.device import Virtual, VirtualOptions
from hw.virtual.presets import PRESETS

FULL = 2**19 - 1  # highest count of the preset's sensor


class VirtualRig(Rig):
    """The bench's samples are replaced by their numbers; everything else is the real driver."""

    def __init__(self) -> None:
        self.saturated = range(0)
        self.sensor: Virtual = self.build()

    def build(self, **options: Any) -> Virtual:
        rig = self

        class Numbered(Virtual):
            def _due(self) -> int:
                return rig.due(rig.t_s)

            def _values(self, first: int, n: int) -> Indications:
                return rig.counts(first, n)

        given = VirtualOptions.model_validate({"role": "sensor"} | options)
        return Numbered("sensor", given, clock=self.clock, sleep=lambda s: self.sleep(s))

    def build_elsewhere(self) -> Virtual:
        sensor = self.build()
        sensor.plugged = False
        return sensor

    def counts(self, first: int, n: int) -> NDArray[np.int32]:
        k = np.arange(first, first + n, dtype=np.int32)
        return np.column_stack([k % 1000, k // 1000, np.where(np.isin(k, self.saturated), FULL, -1)]).astype(np.int32)

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = indications.astype(np.int64).T
        numbers = x + 1000 * y
        assert ((z == -1) | ((z == FULL) & np.isin(numbers, self.saturated))).all()
        return np.asarray(numbers)

    def saturate(self, first: int, last: int) -> None:
        self.saturated = range(first, last + 1)

    def lose(self) -> None:
        # Longer than the buffer: samples are missing among those that wait, as after any overflow.
        self.sleep(1.1)

    def unplug(self) -> None:
        self.sensor.plugged = False

    def replug(self) -> None:
        self.sensor.plugged = True

    def close(self) -> None:
        self.sensor.close()


class TestVirtual(SensorContract):
    @pytest.fixture
    def rig(self) -> Iterator[VirtualRig]:
        rig = VirtualRig()
        yield rig
        rig.close()

    def test_an_overflow_throws_away_what_waited(self, rig: VirtualRig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        rig.sleep(2.0)
        after = next(rig.blocks(0.1))
        assert after.flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after.first_index == before.first_index + before.n
        (drop,) = rig.sensor.take_drops()
        assert (drop.count, drop.unit) == (1000, "samples")


class Machine:
    def __init__(self) -> None:
        self.t_s = 100.0

    def clock(self) -> tuple[int, int]:
        ns = round(self.t_s * 1e9)
        return ns, 10**18 + ns

    def sleep(self, seconds: float) -> None:
        self.t_s += seconds

    def build(self, **options: Any) -> Virtual:
        return Virtual("device", VirtualOptions.model_validate(options), clock=self.clock, sleep=self.sleep)


def read(sensor: Virtual) -> SampleBlock:
    block = sensor.read_block()
    assert block is not None
    return block


def test_sensor_and_reference_are_of_one_bench_that_begins_with_the_first_of_them() -> None:
    machine = Machine()
    sensor, reference = machine.build(role="sensor"), machine.build(role="reference")
    sensor.open()
    machine.sleep(2.0)
    reference.open()
    bench = Bench(PRESETS["plain"](1), 1)
    due = bench.reference_samples_due(2.0)
    assert np.array_equal(read(reference).indications[:100], bench.reference_values(due, 100))


def test_another_clock_is_another_bench() -> None:
    early, late = Machine(), Machine()
    held = early.build(role="sensor")
    held.open()
    early.sleep(50.0)
    sensor = late.build(role="sensor")
    sensor.open()
    assert np.array_equal(read(sensor).indications[:50], Bench(PRESETS["plain"](1), 1).sensor_counts(0, 50))


@pytest.mark.parametrize("speed", [0.5, 1.0, 20.0])
def test_speed_is_that_of_time_not_of_samples_a_second_of_it(speed: float) -> None:
    machine = Machine()
    sensor = machine.build(role="sensor", speed=speed)
    info = sensor.open()
    began_s = machine.t_s
    blocks = [read(sensor) for _ in range(20)]
    assert machine.t_s - began_s == pytest.approx(20 * 0.5 / speed, rel=0.06)
    stamps_s = (blocks[-1].t_monotonic_ns - blocks[0].t_monotonic_ns) * 1e-9
    samples = sum(block.n for block in blocks[1:])
    # the clock of the preset is off by 0.33 %; half a sample of tolerance at each end
    assert samples / stamps_s == pytest.approx(1.0033 * info.nominal_rate_hz, abs=1.5 / stamps_s)
    assert blocks[-1].t_utc_ns - blocks[-1].t_monotonic_ns == 10**18
    assert {block.flags for block in blocks[1:]} == {BlockFlags.NONE}


def test_what_each_device_says_of_itself() -> None:
    machine = Machine()
    sensor = machine.build(role="sensor", preset="faulty", seed=7).open()
    assert (sensor.unit, sensor.axes, sensor.serial_number) == ("count", 3, "faulty-7")
    assert sensor.nominal_sensitivity == pytest.approx(256000 / 9.80665)
    for kind, unit, axes in [("preset", "m/s2", 1), ("vibrometer", "m/s", 1), ("tri-axial", "m/s2", 3)]:
        reference = machine.build(role="reference", reference=kind)
        info = reference.open()
        assert (info.unit, info.axes) == (unit, axes)
        assert read(reference).indications.shape[1] == axes


def test_the_temperature_is_the_bench_s() -> None:
    machine = Machine()
    sensor = machine.build(role="sensor", preset="faulty")
    sensor.open()
    machine.sleep(450.0 - 0.5)  # a quarter of the thermal cycle: 5 K above 25 degC
    assert read(sensor).temperature_degc == pytest.approx(30.0, abs=0.01)


def test_an_unknown_preset_is_named() -> None:
    with pytest.raises(ValidationError, match="no preset 'plane'; available: plain, faulty"):
        VirtualOptions.model_validate({"role": "sensor", "preset": "plane"})
