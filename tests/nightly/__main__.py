"""`python -m tests.nightly`: start the machine, compare, print the table. Exit status 1 if any row differs."""

from __future__ import annotations

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.nightly import checks, runs
from tests.nightly.checks import Machine, Row
from tests.nightly.debian_kernel import DebianKernel, fetched
from tests.nightly.guest import Guest, GuestError
from tests.nightly.initramfs import initramfs
from tests.nightly.site import Twins
from tests.nightly.tiny_usb import TinyUsb

MODULES = [
    *("virtio_pci", "9pnet_virtio", "9p", "xhci_pci", "i2c_tiny_usb", "i2c_dev", "kfifo_buf", "iio_trig_hrtimer"),
    *("st_lsm6dsx_i2c", "inv_mpu6050_i2c"),
]
ADXL355 = "adxl355_i2c"  # not in Debian's kernel
Step = Callable[[Machine], Iterator[Row]]


def steps(kernel: DebianKernel) -> list[Step]:
    """The comparisons in order.

    After the kernel's drivers hold their devices no other may, and unplugging ends everything.
    """
    before: list[Step] = [checks.i2c_dev, checks.probe, runs.own_drivers]
    bound: list[Step] = [checks.mpu6050, checks.held_address, checks.lsm6dso]
    if kernel.has(ADXL355):
        bound.append(checks.adxl355)
    return [*before, *bound, runs.through_iio, runs.iio_refusals, checks.unplugging]


def compared() -> Iterator[Row]:
    """All rows, as they are produced."""
    kernel = fetched()
    without = "" if kernel.has(ADXL355) else "; no module adxl355_i2c, so the ADXL355 is read by fieldcal alone"
    print(f"Linux {kernel.release} under QEMU{without}", flush=True)
    modules = kernel.modules([*MODULES, *([ADXL355] if kernel.has(ADXL355) else [])])
    twins = Twins()
    with tempfile.TemporaryDirectory(prefix="fieldcal-") as name:
        directory = Path(name)
        usb = directory / "usb"
        with (
            TinyUsb(twins.bus, usb) as adapter,
            Guest(kernel.image, initramfs(modules), directory, usb) as guest,
        ):
            machine = Machine(guest, twins, adapter)
            for step in steps(kernel):
                yield from step(machine)


def main() -> int:
    """Print one line per row; returns the exit status, 2 if no machine could be started."""
    began_s = time.monotonic()
    differing = rows = 0
    try:
        for row in compared():
            rows += 1
            differing += not row.agree
            mark = "  " if row.agree else "! "
            print(f"{mark}{row.subject:13} {row.what:34} {row.kernel:44} {row.fieldcal}", flush=True)
    except (FileNotFoundError, subprocess.CalledProcessError, GuestError) as error:
        print(f"the comparison stopped before its end: {error}", file=sys.stderr)
        return 2
    print(f"{rows} rows, {differing} differ, {time.monotonic() - began_s:.0f} s")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
