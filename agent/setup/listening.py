"""What devices send that write lines of text: columns, rate and mean, from some seconds of their lines."""

from __future__ import annotations

import contextlib
import selectors
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np
import serial

from hw.line_columns import AXES, IGNORED, Column, kind_of
from hw.lines import MOST_COLUMNS, Decoded, decode, with_newlines
from hw.serial_sensor import LOST, READ_BYTES, reason_of

FIRST_LINE_S = 5.0  # opening the port restarts some boards, which need two seconds
LISTEN_S = 3.0  # a burst of 20 ms at each end changes the rate by 1 % at most
LONGER_S = 7.0  # beyond LISTEN_S at most, where fewer lines than ENOUGH_LINES have come by then
ENOUGH_LINES = 100  # a counter that begins anew after 50 or 60 numbers has done so: it is no sample counter
FEWEST_LINES = 8
MOST_BYTES = 1 << 22  # 4 Mbaud for ten seconds
# Rates of data sheets. A device whose counted rate is nearer than this to one of them has it as its nominal rate.
USUAL_HZ = (
    1, 2, 4, 5, 8, 10, 12.5, 16, 20, 25, 26, 31.25, 32, 40, 50, 52, 62.5, 64, 75, 80, 100, 104, 119, 125, 128, 150, 160,
    200, 208, 238, 250, 256, 300, 400, 416, 476, 500, 512, 600, 800, 833, 952, 1000, 1024, 1600, 1666, 2000, 2048, 2560,
    3200, 4000, 4096, 5000, 5120, 8000, 8192, 10000, 10240, 12800, 20000, 25600, 50000, 51200,
)  # fmt: skip
USUAL_WITHIN = 0.02  # relative


MOST_UNREAD = 0.1  # part of the lines behind the first good one that may be unreadable
EXAMPLE_BYTES = 60
TRIED_LINES = 500  # from which the number of columns is found


@dataclass(frozen=True, slots=True)
class PortLines:
    """Lines of one port: the columns, None where they cannot be told apart, and the mean of each; the rate (Hz) as
    counted and as it is probably meant; whether a column is of whole numbers only; the last line."""

    columns: tuple[Column, ...] | None
    means: tuple[float, ...]
    whole: tuple[bool, ...]
    counted_hz: float
    nominal_hz: float
    example: str


@dataclass(slots=True)
class _PortBytes:
    """One port: bytes and the number of bytes at each arrival."""

    port: serial.Serial
    data: bytearray = field(default_factory=bytearray)
    arrivals: list[tuple[float, int]] = field(default_factory=list)


def hear(ports: Mapping[str, int]) -> dict[str, PortLines | str]:
    """Listen to all ports at the same time; `ports` is the baud rate by path. Where nothing is heard: why.

    Some devices wait for each other: a bench sends nothing from one port until the other is open too.
    """
    found: dict[str, PortLines | str] = {}
    with ExitStack() as stack:
        lines: dict[str, _PortBytes] = {}
        for path, baud_rate in ports.items():
            try:
                port = serial.Serial(path, baud_rate, timeout=0, exclusive=True)
            except (*LOST, ValueError) as error:
                found[path] = f"cannot be opened: {reason_of(error)}"
                continue
            stack.callback(port.close)
            lines[path] = _PortBytes(port)
        _collect(lines)
        for path, line in lines.items():
            found[path] = _understood(line, ports[path])
    return found


def _collect(lines: Mapping[str, _PortBytes]) -> None:
    ports = lines.values()
    with selectors.DefaultSelector() as selector:
        for line in ports:
            selector.register(line.port.fileno(), selectors.EVENT_READ, line)
        _read(selector, FIRST_LINE_S, lambda: all(line.arrivals for line in ports))
        if all(line.arrivals for line in ports):
            _read(selector, LISTEN_S, lambda: False)
            _read(selector, LONGER_S, lambda: all(line.data.count(b"\n") > ENOUGH_LINES for line in ports))


def _read(selector: selectors.BaseSelector, most_s: float, enough: Callable[[], bool]) -> None:
    """Read what arrives until it is `enough`, `most_s` at most. A port that fails or sends too much is left out."""
    latest_s = time.monotonic() + most_s
    while not enough() and (now_s := time.monotonic()) < latest_s and selector.get_map():
        for key, _ in selector.select(latest_s - now_s):
            line = key.data
            data = b""
            with contextlib.suppress(*LOST):
                data = line.port.read(READ_BYTES)
            if not data or len(line.data) > MOST_BYTES:
                selector.unregister(key.fileobj)
                continue
            line.data += with_newlines(data)
            line.arrivals.append((time.monotonic(), len(line.data)))


def _understood(line: _PortBytes, baud_rate: int) -> PortLines | str:
    if not line.arrivals:
        return f"nothing was sent within {FIRST_LINE_S:g} s"
    begin = line.data.find(b"\n", line.arrivals[0][1] - 1) + 1  # the first arrival tells when counting begins
    lines = bytes(line.data[begin:]).split(b"\n")[:-1]
    last = _text(lines[-TRIED_LINES:])
    count = max(range(1, MOST_COLUMNS + 1), key=lambda count: len(decode(last, count).line))
    decoded = decode(_text(lines), count)
    values = decoded.values
    if len(values) < FEWEST_LINES:
        return f"no lines of numbers at {baud_rate} baud{_unreadable_reason(decoded, lines, count)}"
    first = int(decoded.line[0])  # before it, a board that was restarted may write what it likes
    unread = sum(at > first for at in decoded.bad_at)
    if unread > MOST_UNREAD * (len(values) + unread):
        return f"{unread} of {len(values) + unread} lines cannot be read{_unreadable_reason(decoded, lines, count)}"
    begin += len(_text(lines[:first]))
    octets, arrivals = len(_text(lines[first:])), [arrival for arrival in line.arrivals if arrival[1] >= begin]
    if len(arrivals) < 2:
        return f"all lines came at once at {baud_rate} baud, so their rate is not known"
    counted_hz = _octets_per_s(arrivals) * len(values) / octets
    return PortLines(
        _columns([kind_of(column, counted_hz) for column in values.T]),
        tuple(values.mean(axis=0).tolist()),
        tuple((values % 1 == 0).all(axis=0).tolist()),
        counted_hz,
        nominal_hz(counted_hz),
        _escaped(lines[int(decoded.line[-1])]),
    )


def _text(lines: Sequence[bytes]) -> bytes:
    return b"".join(line + b"\n" for line in lines)


def _columns(kinds: Sequence[Column | None]) -> tuple[Column, ...] | None:
    """The names of all columns, where one or three are left when counters and times are known; else None."""
    if kinds.count(None) not in AXES:
        return None
    axes = iter(AXES[kinds.count(None)])
    columns: list[Column] = []
    for kind in kinds:
        columns.append(next(axes) if kind is None else IGNORED if kind in columns else kind)
    return tuple(columns)


def _unreadable_reason(decoded: Decoded, lines: Sequence[bytes], count: int) -> str:
    """What is wrong with the last line that cannot be read; "" without one."""
    if not decoded.bad_at:
        return ""
    line = lines[decoded.bad_at[-1]]
    reason = next(iter(decode(line + b"\n", count).bad_lines), "no newline within the longest line")
    return f" ({reason}, as {_escaped(line)})"


def _escaped(line: bytes) -> str:
    """A line of a device for a message: characters that a terminal would obey are escaped."""
    return repr(line[:EXAMPLE_BYTES].decode("ascii", "backslashreplace"))


def _octets_per_s(arrivals: Sequence[tuple[float, int]]) -> float:
    """Median over pairs of arrivals that are half of the time apart: a stall of this machine delays few of them."""
    times_s, octets = np.array(arrivals).T
    half = len(arrivals) // 2
    return float(np.median((octets[half:] - octets[:-half]) / (times_s[half:] - times_s[:-half])))


def nominal_hz(counted_hz: float) -> float:
    """The rate that is probably meant where this one was counted, Hz."""
    usual = min(USUAL_HZ, key=lambda rate: abs(rate - counted_hz))
    return float(usual) if abs(usual - counted_hz) <= USUAL_WITHIN * usual else float(f"{counted_hz:.3g}")
