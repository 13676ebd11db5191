"""A sensor at rest on a serial port, one position a second, and an agent that records it signed, a file a second."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from hw.virtual.serial_port import PtyDevice

_CONFIG = """
[[devices]]
name = "imu"
driver = "serial-csv"
options = {{ port = "{port}", rate_hz = 100, axes = 3, sequence = true, unit = "m/s2", serial_number = "A1" }}
[[channels]]
sensor = "imu"
prior = {{}}
guard_s = 0.1
poses = [{{ start_s = 0, stop_s = 1, gravity_mps2 = [0, 0, 9.81] }}]
poses_repeat_s = 1
[recording]
rotate_s = 1
{recording}
signing_key = "{key}"
[zenoh]
enabled = false
"""


def config_text(port: PtyDevice, signing_key: Path, recording: str = "") -> str:
    """The configuration as TOML; `recording` is a further line of its section of that name."""
    return _CONFIG.format(port=port.path, key=signing_key, recording=recording)


@pytest.fixture
def port(tmp_path: Path) -> Iterator[PtyDevice]:
    numbers = itertools.count()
    began_s, sent = time.monotonic(), 0

    def text_due(t_s: float) -> bytes:
        nonlocal sent
        due = int((t_s - began_s) * 100) - sent
        sent += due
        return "".join(f"{next(numbers)},0.01,-0.02,9.81\n" for _ in range(due)).encode()

    device = PtyDevice(text_due, link=tmp_path / "port")
    device.start()
    yield device
    device.stop()
