"""What devices send that write lines of text: columns, rate and mean, from some seconds of their lines."""

from __future__ import annotations

import contextlib
import selectors
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np
import serial

from hw.lines import decode
from hw.serial_sensor import LOST, READ_BYTES, reason_of

FIRST_LINE_S = 5.0  # opening the port restarts some boards, which need two seconds
LISTEN_S = 3.0  # a burst of 20 ms at each end changes the rate by 1 % at most
FEWEST_LINES = 8
MOST_BYTES = 1 << 22  # 4 Mbaud for ten seconds
# Rates of data sheets. A device whose counted rate is nearer than this to one of them has it as its nominal rate.
USUAL_HZ = (
    1, 2, 4, 5, 8, 10, 12.5, 16, 20, 25, 26, 31.25, 32, 40, 50, 52, 62.5, 64, 75, 80, 100, 104, 119, 125, 128, 150, 160,
    200, 208, 238, 250, 256, 300, 400, 416, 476, 500, 512, 600, 800, 833, 952, 1000, 1024, 1600, 1666, 2000, 2048, 2560,
    3200, 4000, 4096, 5000, 5120, 8000, 8192, 10000, 10240, 12800, 20000, 25600, 50000, 51200,
)  # fmt: skip
USUAL_WITHIN = 0.02  # relative


@dataclass(frozen=True, slots=True)
class Heard:
    """Lines of one port: `axes` and `sequence` as the driver `serial-csv` needs them, the rate (Hz) as counted and as
    it is probably meant, the mean of each axis, and whether all indications are whole numbers."""

    axes: int
    sequence: bool
    counted_hz: float
    nominal_hz: float
    mean: tuple[float, ...]
    whole: bool


@dataclass(slots=True)
class _Line:
    """One port: bytes and the number of bytes at each arrival."""

    port: serial.Serial
    data: bytearray = field(default_factory=bytearray)
    arrivals: list[tuple[float, int]] = field(default_factory=list)


def hear(ports: Mapping[str, int]) -> dict[str, Heard | str]:
    """Listen to all ports at the same time; `ports` is the baud rate by path. Where nothing is heard: why.

    Some devices wait for each other: a bench sends nothing from one port until the other is open too.
    """
    found: dict[str, Heard | str] = {}
    with ExitStack() as stack:
        lines: dict[str, _Line] = {}
        for path, baud_rate in ports.items():
            try:
                port = serial.Serial(path, baud_rate, timeout=0, exclusive=True)
            except (*LOST, ValueError) as error:
                found[path] = f"cannot be opened: {reason_of(error)}"
                continue
            stack.callback(port.close)
            lines[path] = _Line(port)
        _collect(lines)
        for path, line in lines.items():
            found[path] = _understood(line, ports[path])
    return found


def _collect(lines: Mapping[str, _Line]) -> None:
    with selectors.DefaultSelector() as selector:
        for line in lines.values():
            selector.register(line.port.fileno(), selectors.EVENT_READ, line)
        latest_s, ends = time.monotonic() + FIRST_LINE_S, False
        while (now_s := time.monotonic()) < latest_s and selector.get_map():
            for key, _ in selector.select(latest_s - now_s):
                line = key.data
                data = b""
                with contextlib.suppress(*LOST):
                    data = line.port.read(READ_BYTES)
                if not data or len(line.data) > MOST_BYTES:
                    selector.unregister(key.fileobj)
                    continue
                line.data += data
                line.arrivals.append((time.monotonic(), len(line.data)))
            if not ends and all(line.arrivals for line in lines.values()):
                latest_s, ends = time.monotonic() + LISTEN_S, True


def _understood(line: _Line, baud_rate: int) -> Heard | str:
    if not line.arrivals:
        return f"nothing was sent within {FIRST_LINE_S:g} s"
    begin, text = line.arrivals[0][1], bytes(line.data)
    begin = text.find(b"\n", begin - 1) + 1  # the first arrival tells when counting begins
    text = text[begin : text.rfind(b"\n") + 1]
    columns = max(range(1, 5), key=lambda count: len(decode(text, count).line))
    values = decode(text, columns).values
    if len(values) < FEWEST_LINES or len(line.arrivals) < 2:
        return f"no lines of numbers at {baud_rate} baud ([seq,]x,y,z or [seq,]a)"
    sequence = columns in (2, 4)
    axes = values[:, 1:] if sequence else values
    counted_hz = _octets_per_s(line.arrivals) * len(values) / len(text)
    return Heard(
        axes.shape[1], sequence, counted_hz, _nominal(counted_hz), tuple(axes.mean(axis=0).tolist()),
        bool(np.all(axes == np.round(axes))),
    )  # fmt: skip


def _octets_per_s(arrivals: Sequence[tuple[float, int]]) -> float:
    """Median over pairs of arrivals that are half of the time apart: a stall of this machine delays few of them."""
    times_s, octets = np.array(arrivals).T
    half = len(arrivals) // 2
    return float(np.median((octets[half:] - octets[:-half]) / (times_s[half:] - times_s[:-half])))


def _nominal(counted_hz: float) -> float:
    usual = min(USUAL_HZ, key=lambda rate: abs(rate - counted_hz))
    return float(usual) if abs(usual - counted_hz) <= USUAL_WITHIN * usual else float(f"{counted_hz:.3g}")
