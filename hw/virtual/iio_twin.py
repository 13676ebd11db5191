"""An accelerometer as the kernel's industrial I/O presents it: files in a directory, and a pipe as its node."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import struct
import termios
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

NODE = "iio:device0"
UNSTAMPED = np.dtype([("x", ">i2"), ("y", ">i2"), ("z", ">i2")])
SCAN = np.dtype([*((axis, ">i2") for axis in "xyz"), ("_", "V2"), ("timestamp", "<i8")])
FILES = {
    "name": "twin345",
    "in_accel_scale": "0.038300",
    "in_accel_sampling_frequency": "100.000000",
    "in_accel_x_calibbias": "12",
    "in_accel_y_calibbias": "0",
    "in_accel_z_calibbias": "-3",
    "current_timestamp_clock": "realtime",
    "buffer/enable": "0",
    "buffer/length": "2",
    "scan_elements/in_timestamp_en": "0",
    "scan_elements/in_timestamp_index": "4",
    "scan_elements/in_timestamp_type": "le:s64/64>>0",
    "scan_elements/in_temp_en": "1",
    "scan_elements/in_temp_index": "3",
    "scan_elements/in_temp_type": "be:s16/16>>0",
}
for _i, _axis in enumerate("xyz"):
    FILES[f"scan_elements/in_accel_{_axis}_en"] = "0"
    FILES[f"scan_elements/in_accel_{_axis}_index"] = str(_i)
    FILES[f"scan_elements/in_accel_{_axis}_type"] = "be:s14/16>>2"


class IioTwin:
    """Files in `root`/sys and the node in `root`/dev.

    - `source(first, n)` returns (n, 3) counts.
    - `stamps_ns(first, n)` returns their stamps.
    - `samples_due(t_s)`: number of samples that exist at `t_s`.

    `stamped`: whether it has a time stamp. `together`: how many samples of a FIFO the kernel driver passes on at a
    time. A full buffer drops the newest samples, like the kernel's.
    """

    def __init__(
        self,
        root: Path,
        source: Callable[[int, int], NDArray[np.int32]],
        stamps_ns: Callable[[int, int], NDArray[np.int64]],
        samples_due: Callable[[float], int],
        *,
        stamped: bool = True,
        together: int = 1,
    ) -> None:
        self.sysfs, self.dev = root / "sys", root / "dev"
        self._source = source
        self._stamps_ns = stamps_ns
        self._samples_due = samples_due
        self._scan = SCAN if stamped else UNSTAMPED
        self._together = together
        self.next = 0
        self._pending = b""
        self._pipe: int | None = None
        self.plug()

    def plug(self) -> None:
        """Bind the kernel driver: files and node exist."""
        files = {name: text for name, text in FILES.items() if self._scan is SCAN or "timestamp" not in name}
        for name, text in (files | {"buffer/watermark": "1", "buffer/hwfifo_watermark": str(self._together)}).items():
            path = self.sysfs / NODE / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        self.dev.mkdir(exist_ok=True)
        os.mkfifo(self.dev / NODE)
        self._pipe = os.open(self.dev / NODE, os.O_RDWR | os.O_NONBLOCK)

    def unplug(self) -> None:
        """Remove files and node."""
        if self._pipe is not None:
            os.close(self._pipe)
            self._pipe = None
            (self.dev / NODE).unlink()
            shutil.rmtree(self.sysfs / NODE)

    def serve(self, t_s: float) -> None:
        """Store the samples made up to `t_s`, and pass on as many as the reader has room for."""
        due = self._samples_due(t_s) // self._together * self._together
        first, self.next = self.next, max(self.next, due)
        if self._pipe is None:
            return
        if (self.sysfs / NODE / "buffer" / "enable").read_text() != "1":
            self._pending = b""
            return
        waiting = struct.unpack("I", fcntl.ioctl(self._pipe, termios.FIONREAD, bytes(4)))[0] + len(self._pending)
        room = int((self.sysfs / NODE / "buffer" / "length").read_text()) - waiting // self._scan.itemsize
        n = min(self.next - first, room)
        scans = np.zeros(n, self._scan)
        counts = self._source(first, n)
        for i, axis in enumerate("xyz"):
            scans[axis] = counts[:, i] << 2
        if self._scan is SCAN:
            scans["timestamp"] = self._stamps_ns(first, n)
        self._pending += scans.tobytes()
        with contextlib.suppress(BlockingIOError):
            self._pending = self._pending[os.write(self._pipe, self._pending) :]
