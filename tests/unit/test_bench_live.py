"""The bench in real time, read through the real drivers."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from hw.adxl355 import Adxl355
from hw.block import BlockFlags, SampleBlock
from hw.serial_stream import SerialCsv
from hw.virtual.live import LiveBench
from hw.virtual.parameters import BenchParameters
from hw.virtual.presets import COUNTS_PER_MPS2, faulty, plain
from hw.virtual.serial_bench import decimals_of
from hw.virtual.timebase import BenchTime


class HandClock:
    """A clock that moves when `sleep` is called, and by 20 us on every read, because running code takes time."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        self.now_s += 20e-6
        return self.now_s

    def pair_ns(self) -> tuple[int, int]:
        now = round(self() * 1e9)
        return now, now

    def sleep(self, duration_s: float) -> None:
        self.now_s += duration_s


def adxl355_of(live: LiveBench, clock: HandClock) -> Adxl355:
    options = Adxl355.options_model.model_validate(live.sensor_options)
    return Adxl355("mems", options, clock=clock.pair_ns, sleep=clock.sleep)


def blocks_of(sensor: Adxl355, number: int) -> list[SampleBlock]:
    found = [sensor.read_block() for _ in range(number)]
    assert None not in found
    return [block for block in found if block is not None]


@pytest.mark.slow
def test_the_driver_gets_the_benchs_counts_from_its_zero_on() -> None:
    clock = HandClock()
    with LiveBench(faulty(2), 2, clock=clock) as live:
        assert not live.time.begun
        sensor = adxl355_of(live, clock)
        info = sensor.open()
        assert live.time.begun, "the bench starts when the sensor is set to measure"
        assert info.nominal_sensitivity == pytest.approx(COUNTS_PER_MPS2)
        blocks = blocks_of(sensor, 40)
        sensor.close()
        bench, zero_s = live.bench, clock.now_s - live.time(clock.now_s)
    counts = np.concatenate([block.indications for block in blocks])
    assert len(counts) > 19_000
    assert np.array_equal(counts, bench.sensor_counts(0, len(counts)))
    assert {block.flags for block in blocks[1:]} == {BlockFlags.NONE}
    for block in blocks:
        newest = block.first_index + block.burst_count - 1
        taken_s = zero_s + bench.parameters.sensor.clock.offset_s + newest / bench.parameters.sensor.clock.rate_hz
        late_s = block.burst_t_monotonic_ns / 1e9 - taken_s
        # The read is at best directly after the newest sample and at worst directly before the next; wander within 20
        # s: < 1 ms.
        assert late_s.min() > -0.5e-3
        assert late_s.max() < 1 / 1013 + 1.5e-3


@pytest.mark.slow
def test_the_chips_temperature_is_the_benchs() -> None:
    clock = HandClock()
    with LiveBench(faulty(2), 2, clock=clock) as live:
        sensor = adxl355_of(live, clock)
        sensor.open()
        clock.sleep(450.0)  # a quarter of the temperature's period: 5 K above 25 degC
        sensor.read_block()
        block = sensor.read_block()
        sensor.close()
    assert block is not None
    assert block.temperature_degc == pytest.approx(30.0, abs=0.06)  # steps of 0.11 K


def test_the_reference_comes_over_its_port_in_real_time() -> None:
    with LiveBench(plain(1), 1) as live:
        reference = SerialCsv("reference", SerialCsv.options_model.model_validate(live.reference_options))
        sensor = Adxl355("mems", Adxl355.options_model.model_validate(live.sensor_options))
        reference.open()
        assert reference.read_block() is None, "nothing is sampled before the bench starts"
        sensor.open()
        start_s = time.monotonic()
        blocks = [block for block in (reference.read_block() for _ in range(3)) if block is not None]
        assert not reference.take_drops()
        reference.close()
        sensor.close()
        values = np.concatenate([block.indications for block in blocks])
        assert np.array_equal(values, live.bench.reference_values(0, len(values)).round(5))
        last_s = blocks[-1].t_monotonic_ns / 1e9 - start_s
        # Limits for bursts and opening; a busy machine reads late
        assert 1000 * last_s - 300 < len(values) < 1000 * last_s + 60
        port = live.port.path
    assert not port.exists()
    assert not port.is_symlink()


def test_only_an_adxl355_can_be_one() -> None:
    with pytest.raises(ValueError, match="1 counts per m/s2"):
        LiveBench(BenchParameters(), 1)
    base = plain(1)
    four_g = replace(base, sensor=replace(base.sensor, nominal_sensitivity=COUNTS_PER_MPS2 / 2))
    assert LiveBench(four_g, 1).sensor_options["range_g"] == 4


@pytest.mark.parametrize(("resolution", "decimals"), [(1.0, 0), (10.0, 0), (0.5, 1), (0.1, 1), (1e-5, 5), (0.0, 6)])
def test_decimals_tell_multiples_of_the_resolution_apart(resolution, decimals) -> None:
    assert decimals_of(resolution) == decimals


def test_bench_time_begins_when_told() -> None:
    bench_time = BenchTime()
    due = bench_time.gated(plain(1).sensor.clock.due)  # type: ignore[arg-type]
    assert due(1e6) == 0
    bench_time.begin(1e6)
    assert bench_time(1e6 + 2.5) == 2.5
    assert due(1e6 + 1.0) == 1003
