"""Twins behind a socket behave like twins in the same process."""

from __future__ import annotations

import contextlib
import errno
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hw.adxl355 import Adxl355, Adxl355Options
from hw.sensor import DeviceLost
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.kernel import I2CBus, installed
from hw.virtual.remote_bus import RemoteBus, serve


class Machine:
    t_s = 0.0

    def clock(self) -> tuple[int, int]:
        ns = round(self.t_s * 1e9)
        return ns, ns

    def sleep(self, seconds: float) -> None:
        self.t_s += seconds


@pytest.fixture
def machine() -> Machine:
    return Machine()


@pytest.fixture
def bus(machine: Machine, tmp_path: Path) -> Iterator[I2CBus]:
    """The bus with the twins; the driver uses the other end of the socket."""
    twin = Adxl355Twin(
        lambda first, n: np.arange(3 * first, 3 * (first + n), dtype=np.int32).reshape(n, 3),
        lambda t_s: int(1000 * t_s + 1e-6),
        lambda: machine.t_s,
    )
    bus = I2CBus({0x1D: twin})
    serve(bus, tmp_path / "bus")
    with contextlib.closing(RemoteBus(tmp_path / "bus")) as remote, installed({"/dev/i2c-1": remote}):
        yield bus


def opened(machine: Machine) -> Adxl355:
    sensor = Adxl355("sensor", Adxl355Options(), clock=machine.clock, sleep=machine.sleep)
    sensor.open()
    return sensor


@pytest.mark.usefixtures("bus")
def test_a_driver_reads_them(machine: Machine) -> None:
    sensor = opened(machine)
    first, second = sensor.read_block(), sensor.read_block()
    assert first is not None
    assert second is not None
    values = np.concatenate([first.indications, second.indications]).ravel()
    assert len(values) > 2500
    assert (np.diff(values) == 1).all()


def test_errors_come_through(bus: I2CBus, machine: Machine) -> None:
    sensor = opened(machine)
    bus.targets[0x1D].fail(errno.ENODEV)  # type: ignore[attr-defined]
    with pytest.raises(DeviceLost, match="0x1D on /dev/i2c-1: No such device"):
        list(iter(sensor.read_block, None))
    del bus.targets[0x1D]
    with pytest.raises(DeviceLost, match="Remote I/O error"):
        sensor.open()


def test_transfers_of_several_threads_do_not_mix(tmp_path: Path) -> None:
    class Echo:
        """Returns bytes that name the target and the number of requested bytes."""

        def __init__(self, number: int) -> None:
            self.number = number

        def write(self, data: bytes) -> None:
            pass

        def read(self, count: int) -> bytes:
            return bytes([self.number, *[count] * (count - 1)])

    serve(I2CBus({number: Echo(number) for number in range(4)}), tmp_path / "echo")
    bus = RemoteBus(tmp_path / "echo")
    wrong: list[object] = []

    def ask(number: int) -> None:
        for count in range(1, 100):
            answer = bus.transfer([(number, b"\x00"), (number, count)])
            if answer != [None, bytes([number, *[count] * (count - 1)])]:
                wrong.append(answer)

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    bus.close()
    assert wrong == []
