"""What a driver finds out about the adapter of an I2C bus, and how it obeys it."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from hw.adxl345 import Adxl345
from hw.adxl355 import Adxl355
from hw.i2c import I2CDevice
from hw.sensor import AdapterError, ConfigurationError
from hw.virtual.adxl345_twin import Adxl345Twin
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.kernel import BCM2835, PLAIN, SHORT_MESSAGES, SMBUS_ONLY, WRITE_THEN_READ, Adapter, I2CBus, installed

Messages = list[tuple[int, int | bytes]]


class Clock:
    t_s = 0.0

    def __call__(self) -> tuple[int, int]:
        return round(self.t_s * 1e9), round(self.t_s * 1e9)

    def spend(self, seconds: float) -> None:
        self.t_s += seconds


class Bus(I2CBus):
    """An ADXL355 behind an adapter that treats transfers as the test says; all transfers are kept."""

    def __init__(
        self, adapter: Adapter = PLAIN, treat: Callable[[Messages], None] | None = None, **time: float
    ) -> None:
        self.clock = Clock()
        twin = Adxl355Twin(lambda first, n: np.zeros((n, 3), np.int32) + first * 0, self.due, lambda: self.clock.t_s)
        super().__init__({0x1D: twin}, adapter=adapter, spend=self.clock.spend, **time)  # type: ignore[arg-type]
        self.seen: list[Messages] = []
        self.treat = treat

    def due(self, t_s: float) -> int:
        return int(1000 * t_s)

    def transfer(self, messages: Messages) -> list[bytes | None]:
        self.seen.append(messages)
        if self.treat is not None:
            self.treat(messages)
        return super().transfer(messages)


@pytest.fixture
def learned() -> Iterator[Callable[[Bus, int], I2CDevice]]:
    contexts = []

    def learn(bus: Bus, wanted: int) -> I2CDevice:
        contexts.append(installed({"/dev/i2c-1": bus}))
        contexts[-1].__enter__()
        device = I2CDevice("ADXL355", 1, 0x1D, bus.clock.spend, unit=9)
        device.open()
        device.learn(0, wanted, bus.clock)
        return device

    yield learn
    for context in contexts:
        context.__exit__(None, None, None)


Learn = Callable[[Bus, int], I2CDevice]


@pytest.mark.parametrize(
    ("adapter", "joins", "longest"),
    [
        (PLAIN, True, 162),
        (BCM2835, False, 162),
        (WRITE_THEN_READ, False, 162),
        (SHORT_MESSAGES, True, 32),
        (SMBUS_ONLY, False, 32),
        (Adapter("60", longest=60), True, 60),
        (Adapter("161", longest=161), True, 161),
        (Adapter("9", longest=9), True, 9),  # one sample
    ],
)
def test_what_an_adapter_takes_is_found_out(learned: Learn, adapter: Adapter, joins: bool, longest: int) -> None:
    device = learned(Bus(adapter), 162)
    assert (device.joins, device.longest) == (joins, longest)


@pytest.mark.parametrize("number", [errno.EIO, errno.EOVERFLOW, errno.EINVAL, errno.EMSGSIZE])
def test_an_adapter_that_fails_at_a_long_read_is_not_a_lost_device(learned: Learn, number: int) -> None:
    def at_most_38(messages: Messages) -> None:
        if any(isinstance(content, int) and content > 38 for _, content in messages):
            raise OSError(number, os.strerror(number))

    assert learned(Bus(treat=at_most_38), 162).longest == 38


def test_an_adapter_that_returns_other_bytes_for_a_long_read_is_not_believed(learned: Learn) -> None:
    class Wrong(Bus):
        def transfer(self, messages: Messages) -> list[bytes | None]:
            return [b"\xff" * len(x) if x and len(x) > 16 else x for x in super().transfer(messages)]

    assert learned(Wrong(), 162).longest == 16


def test_an_adapter_too_short_for_a_sample_is_refused(learned: Learn) -> None:
    with pytest.raises(AdapterError, match="at most 8 bytes in a transfer, the driver needs 9"):
        learned(Bus(Adapter("8", longest=8)), 162)


def test_a_long_read_is_split_at_whole_samples(learned: Learn) -> None:
    bus = Bus(SHORT_MESSAGES)
    device = learned(bus, 162)
    bus.seen.clear()
    assert len(device.read(0x11, 90)) == 90
    assert [content for messages in bus.seen for _, content in messages] == [b"\x11", 27] * 3 + [b"\x11", 9]


def test_the_time_of_a_transfer_is_measured(learned: Learn) -> None:
    device = learned(Bus(transfer_s=1.5e-3, clock_hz=100e3), 162)
    # two addresses, a register and the data, 9 bits each at 100 kHz
    assert device.time_s(1, 1) == pytest.approx(1.5e-3 + 4 * 90e-6, rel=1e-6)
    assert device.time_s(1, 100) == pytest.approx(1.5e-3 + 103 * 90e-6, rel=1e-6)


def opened(bus: Bus, rate_hz: float) -> None:
    with installed({"/dev/i2c-1": bus}):
        options = Adxl355.options_model(rate_hz=rate_hz)  # type: ignore[call-arg]
        sensor = Adxl355("imu", options, clock=bus.clock, sleep=bus.clock.spend)
        try:
            sensor.open()
        finally:
            sensor.close()


def test_a_rate_that_cannot_be_read_is_refused_with_the_highest_that_can() -> None:
    # A poll has three transfers of 3 ms at least every 20 ms; at 1 kHz every 8 ms.
    with pytest.raises(ConfigurationError, match=r"at rate_hz 1000 reading takes 1\d\d% .*highest .* read is 500;"):
        opened(Bus(transfer_s=3e-3), 1000.0)
    opened(Bus(transfer_s=3e-3), 500.0)
    with pytest.raises(ConfigurationError, match="no rate can be read"):
        opened(Bus(transfer_s=0.1), 3.90625)


@pytest.mark.parametrize(
    ("adapter", "least", "most"),
    [(BCM2835, 1.0, 1.3), (PLAIN, 0.0, 0.3)],  # a transfer a sample and one a poll; joined up to 21 reads
)
def test_reads_are_joined_only_where_the_adapter_takes_that(adapter: Adapter, least: float, most: float) -> None:
    clock = Clock()
    twin = Adxl345Twin(
        lambda first, n: np.zeros((n, 3), np.int32) + first * 0, lambda t: int(800 * t), lambda: clock.t_s
    )
    bus = I2CBus({0x53: twin}, adapter=adapter)
    with installed({"/dev/i2c-1": bus}):
        sensor = Adxl345("imu", Adxl345.options_model(), clock=clock, sleep=clock.spend)
        sensor.open()
        bus.transfers = 0
        block = sensor.read_block()
        assert block is not None
        assert least < bus.transfers / block.n < most
        sensor.close()
