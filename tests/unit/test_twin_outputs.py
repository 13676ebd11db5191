"""Output registers of the register-level twins: what a driver that uses no FIFO reads, the kernel's own among them."""

from __future__ import annotations

import numpy as np
import pytest

from hw.virtual.adxl345_twin import Adxl345Twin
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.fifo_twin import Counts, FifoTwin
from hw.virtual.icm20948_twin import Icm20948Twin
from hw.virtual.icm42688_twin import Icm42688Twin
from hw.virtual.lis3dh_twin import Lis3dhTwin
from hw.virtual.lsm6dso_twin import Lsm6dsoTwin
from hw.virtual.mpu6050_twin import Mpu6050Twin


def source(first: int, n: int) -> Counts:
    number = np.arange(first, first + n, dtype=np.int32)
    return np.column_stack([number, -number, 256 + number])


# Sample 9 of the source, as the data sheets lay out the output registers.
@pytest.mark.parametrize(
    ("twin_class", "register", "wanted"),
    [
        (Adxl345Twin, 0x32, "0900 f7ff 0901"),
        (Icm20948Twin, 0x2D, "0009 fff7 0109"),
        (Icm42688Twin, 0x1F, "0009 fff7 0109"),
        (Lis3dhTwin, 0xA8, "9000 70ff 9010"),
        (Lsm6dsoTwin, 0x28, "0900 f7ff 0901"),
        (Mpu6050Twin, 0x3B, "0009 fff7 0109"),
        (Adxl355Twin, 0x08, "000090 ffff70 001090"),
    ],
)
def test_they_hold_the_sample_made_last(twin_class: type[FifoTwin], register: int, wanted: str) -> None:
    t_s = 0.0955
    twin = twin_class(source, lambda t: int(t * 100) + 1, lambda: t_s)
    expected = bytes.fromhex(wanted)
    twin.write(bytes([0x2D, 0x00]))  # the ADXL355 measures
    twin.write(bytes([register]))
    assert twin.read(len(expected)) == expected
    axis = len(expected) // 3  # each axis by itself, as the kernel's adxl345 does
    for i in range(3):
        twin.write(bytes([register + axis * i]))
        assert twin.read(axis) == expected[axis * i : axis * (i + 1)]
    t_s = 0.1055
    twin.write(bytes([register]))
    assert twin.read(len(expected)) != expected
