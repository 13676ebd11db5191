"""What each driver on I2C or SPI reads on each kind of adapter: highest rate, bytes on the bus, CPU time.

`python -m benchmarks.i2c_rates [--write]`; with --write the table goes into docs/devices.md. Time is simulated: a
transfer takes 9 bits a byte (SPI: 8) at the clock of the bus, and the time that the adapter adds. The highest rate is
the highest of the driver's rates that the options accept at this clock, that the driver accepts on this adapter, and
that it then reads for SECONDS without a loss. CPU is that of the driver, without the twin and without the kernel.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from benchmarks.page import machine, write_part
from hw.block import BlockFlags
from hw.fifo_sensor import FifoSensor
from hw.sensor import ConfigurationError, load_driver
from hw.virtual.adxl345_twin import Adxl345Twin
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.fifo_twin import FifoTwin
from hw.virtual.icm20948_twin import Icm20948Twin
from hw.virtual.icm42688_twin import Icm42688Twin
from hw.virtual.kernel import BCM2835, PLAIN, SHORT_MESSAGES, SMBUS_ONLY, WRITE_THEN_READ, Adapter, I2CBus, installed
from hw.virtual.lis3dh_twin import Lis3dhTwin
from hw.virtual.lsm6dso_twin import Lsm6dsoTwin
from hw.virtual.mpu6050_twin import Mpu6050Twin
from hw.virtual.spi_bus import SPI, Controller, SpiBus

SECONDS = 20.0
TWINS: dict[str, type[FifoTwin]] = {
    "adxl355": Adxl355Twin,
    "adxl345": Adxl345Twin,
    "lsm6dso": Lsm6dsoTwin,
    "mpu6050": Mpu6050Twin,
    "lis3dh": Lis3dhTwin,
    "icm20948": Icm20948Twin,
    "icm42688": Icm42688Twin,
}
# Time that an adapter adds to a transfer: interrupts and system calls of a small computer; a USB adapter answers in
# frames of 1 ms. These are assumptions: the driver measures the adapter that it finds.
ADDED_S: dict[Adapter | Controller, float] = {
    PLAIN: 1e-4,
    BCM2835: 1e-4,
    WRITE_THEN_READ: 2e-3,
    SHORT_MESSAGES: 1e-4,
    SMBUS_ONLY: 1e-4,
    SPI: 1e-4,
}
CLOCKS_KHZ, SPI_CLOCKS_KHZ = (100.0, 400.0), (1000.0,)


class TimedBus(I2CBus):
    """Counts the CPU time of its targets."""

    cpu_s = 0.0

    def transfer(self, messages: list[tuple[int, int | bytes]]) -> list[bytes | None]:
        """Do all messages, like every bus."""
        before_s = time.process_time()
        try:
            return super().transfer(messages)
        finally:
            self.cpu_s += time.process_time() - before_s


class TimedSpiBus(SpiBus):
    """Counts the CPU time of the simulated bus."""

    cpu_s = 0.0

    def ioctl(self, request: int, argument: Any) -> int:
        """One request, like every bus."""
        before_s = time.process_time()
        try:
            return super().ioctl(request, argument)
        finally:
            self.cpu_s += time.process_time() - before_s


@dataclass(frozen=True)
class Run:
    """What reading for a second costs: bytes on the bus, and CPU time in s."""

    bytes_a_second: float
    cpu_share: float


class Clock:
    """Simulated time."""

    t_s = 0.0

    def __call__(self) -> tuple[int, int]:
        return round(self.t_s * 1e9), round(self.t_s * 1e9)

    def spend(self, seconds: float) -> None:
        """Let time pass."""
        self.t_s += seconds


def counts(first: int, n: int) -> NDArray[np.int32]:
    """Counts (n, 3) of a sensor at rest, with a number in them."""
    return np.column_stack([np.arange(first, first + n) % 1000, np.zeros((n, 2))]).astype(np.int32)


def run(name: str, adapter: Adapter | Controller, clock_khz: float, rate_hz: float) -> Run | None:
    """Read for SECONDS at this rate; None where the options or the driver refuse it, or samples are lost."""
    driver = load_driver(name)
    time_ = Clock()
    over_spi = isinstance(adapter, Controller)
    way = {"bus": "spi0.0", "spi_mhz": clock_khz / 1e3} if over_spi else {"bus_khz": clock_khz}
    try:
        options = driver.options_model.model_validate({"rate_hz": rate_hz} | way)
    except ValidationError:
        return None
    twin = TWINS[name](counts, lambda t_s: int(t_s * rate_hz), lambda: time_.t_s)
    added_s = ADDED_S[adapter]
    bus: TimedBus | TimedSpiBus
    if isinstance(adapter, Controller):
        bus = TimedSpiBus(twin, adapter=adapter, spend=time_.spend, message_s=added_s)
    else:
        targets = {options.address: twin}  # type: ignore[attr-defined]
        bus = TimedBus(targets, adapter=adapter, spend=time_.spend, transfer_s=added_s, clock_hz=1e3 * clock_khz)
    with installed({options.node: bus}):  # type: ignore[attr-defined]
        sensor = driver("imu", options, clock=time_, sleep=time_.spend)
        assert isinstance(sensor, FifoSensor)
        try:
            sensor.open()
        except ConfigurationError:
            return None
        bus.bytes, bus.cpu_s = 0, 0.0
        start_s, cpu_s = time_.t_s, time.process_time()
        while time_.t_s < start_s + SECONDS:
            block = sensor.read_block()
            if block is None or block.flags & BlockFlags.OVERRUN:
                return None
        passed_s = time_.t_s - start_s
        return Run(bus.bytes / passed_s, (time.process_time() - cpu_s - bus.cpu_s) / passed_s)


def table() -> str:
    """The table, in Markdown."""
    head = ("driver", "adapter", "bus", "highest rate", "bytes/s on the bus", "CPU")
    lines = [f"| {' | '.join(head)} |", "| --- " * len(head) + "|"]
    for name in TWINS:
        rates_hz = sorted(load_driver(name).options_model.rates_hz, reverse=True)  # type: ignore[attr-defined]
        for adapter, added_s in ADDED_S.items():
            if isinstance(adapter, Controller) and not TWINS[name].spi_modes:
                continue
            for clock_khz in SPI_CLOCKS_KHZ if isinstance(adapter, Controller) else CLOCKS_KHZ:
                tried = ((rate_hz, run(name, adapter, clock_khz, rate_hz)) for rate_hz in rates_hz)
                rate_hz, found = next(((rate, run) for rate, run in tried if run is not None), (0.0, Run(0.0, 0.0)))
                lines.append(
                    f"| `{name}` | {adapter.name}, + {1e3 * added_s:g} ms | {clock_khz:g} kHz | {rate_hz:g} Hz | "
                    f"{found.bytes_a_second:.0f} | {found.cpu_share:.1%} |"
                )
    return "\n".join(lines)


def main() -> None:
    """Print the table, or write it into the page."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    text = f"{table()}\n\n{machine()}; `python -m benchmarks.i2c_rates`."
    if given.write:
        write_part("i2c rates", text)
    else:
        print(text)


if __name__ == "__main__":
    main()
