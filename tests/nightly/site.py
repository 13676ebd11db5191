"""The twins on one bus, connected to the machine over USB; register writes of the drivers are kept."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hw.virtual.adxl345_twin import Adxl345Twin
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.fifo_twin import FifoTwin
from hw.virtual.kernel import I2CBus
from hw.virtual.lsm6dso_twin import Lsm6dsoTwin
from hw.virtual.mpu6050_twin import Mpu6050Twin
from tests.numbered import numbered, since_now

ADDRESSES = {"adxl355": 0x1D, "adxl345": 0x53, "mpu6050": 0x68, "lsm6dso": 0x6A}
# The FIFOs of the first two hold 32 samples: a low rate for an emulated machine that may wait for a processor.
RATES_HZ = {"adxl355": 31.25, "adxl345": 25.0, "mpu6050": 100.0, "lsm6dso": 104.0}


class Twins:
    """All twins, with numbered samples or with the constant indication set by `hold`."""

    def __init__(self) -> None:
        self.written: list[tuple[str, int, int]] = []  # device, register, value
        self._held: NDArray[np.int32] | None = None
        self._temperature: dict[str, int] = {}
        classes: dict[str, type[FifoTwin]] = {
            "adxl355": Adxl355Twin,
            "adxl345": Adxl345Twin,
            "mpu6050": Mpu6050Twin,
            "lsm6dso": Lsm6dsoTwin,
        }
        self.by_name = {name: self._twin(name, twin) for name, twin in classes.items()}
        self.bus = I2CBus(
            {ADDRESSES[name]: twin for name, twin in self.by_name.items()},
            absent_errno=errno.ENXIO,  # as i2c-tiny-usb reports it
        )

    def hold(self, counts: tuple[int, int, int] | None) -> None:
        """Set a constant indication from now on; None: numbered samples again."""
        self._held = None if counts is None else np.array(counts, np.int32)

    def warm(self, device: str, raw: int) -> None:
        """Set a constant raw temperature from now on."""
        self._temperature[device] = raw

    def _twin(self, name: str, twin: type[FifoTwin]) -> FifoTwin:
        def write(register: int, value: int) -> None:
            self.written.append((name, register, value))
            plain(register, value)

        made = twin(self._counts, since_now(RATES_HZ[name]), time.monotonic, temperature_raw=self._degrees(name, twin))
        plain: Callable[[int, int], None] = made._set
        made._set = write  # type: ignore[method-assign]
        return made

    def _degrees(self, name: str, twin: type[FifoTwin]) -> Callable[[float], int]:
        return lambda _: self._temperature.get(name, twin.temperature_at_25_degc)

    def _counts(self, first: int, n: int) -> Any:
        return numbered(first, n) if self._held is None else np.tile(self._held, (n, 1))
