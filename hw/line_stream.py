"""Makes sample blocks of bursts of bytes in the serial text protocol, one sample a line; needs no port."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hw.block import LARGEST, BlockFlags, Drop, SampleBlock
from hw.cutting import MOST_BREAKS, Break, Cutter, Stretch
from hw.line_columns import AXES, IGNORED, TICKS_HZ, Column, DeviceTime, SampleCounter, damaged, kind_of
from hw.lines import MAX_LINE_BYTES, UNREADABLE, decode, with_newlines

OVERLONG = f"no newline within {MAX_LINE_BYTES} bytes"
TELL_LOSSES: tuple[Column, ...] = ("seq", "micros", "millis")  # the first one of them that a line has
NOT_COUNTED = "line whose sample counter (seq) is not a whole number"
NOT_FITTING = "line whose sample counter (seq) fits neither the line before nor the one behind"
RECENT_NUMBERS = 64  # of the counter or time: enough to tell what they are
TEMPERATURE_DEGC = -100.0, 200.0  # outside, the thermometer is at fault: no electronics works there


class LineStream:
    """Collects bursts with `feed` and decodes all of them in `blocks`.

    Between calls it keeps at most one incomplete line.

    `columns` names the fields of a line. A counter or a time tells which samples are missing; see `hw.line_columns`.
    Without them a bad line may have been any number of samples: RESTART. A stretch with more than MOST_BREAKS breaks is
    dropped with the reason: blocks of one sample are of no use and would fill the queue to the pipeline.
    """

    def __init__(self, cutter: Cutter, columns: Sequence[Column], *, longest_gap: float) -> None:
        self._cutter = cutter
        self._columns = tuple(columns)
        self._ignored = frozenset(at for at, name in enumerate(columns) if name == IGNORED)
        read = [name for name in columns if name != IGNORED]
        self._axes = [read.index(name) for name in (*AXES[3], *AXES[1]) if name in read]
        self._temperature = read.index("temperature") if "temperature" in read else None
        told_by = next((name for name in TELL_LOSSES if name in read), None)
        self._numbered = None if told_by is None else read.index(told_by)
        self._numbers: SampleCounter | DeviceTime = SampleCounter(longest_gap)
        if told_by is not None and told_by != "seq":
            self._numbers = DeviceTime(TICKS_HZ[told_by], cutter.nominal_rate_hz, longest_gap)
        self._drops: Counter[tuple[Literal["samples", "lines", "bytes"], str]] = Counter()
        self.begin()

    def begin(self) -> None:
        """Start after a port was opened.

        The bytes up to the first newline are the rest of a line and are not counted.
        """
        self._listening = False
        self._tail = b""
        self._numbers.begin()
        self._recent = np.empty(0)  # the newest numbers of the counter or times
        self._broken = 0  # samples in a row that do not follow the one before
        self._text: list[bytes] = []
        self._lines: list[int] = []
        self._arrivals_ns: list[int] = []
        self._utc_ns = 0
        self.size = 0  # number of collected bytes
        self._cutter.flag(BlockFlags.RESTART)

    def feed(self, data: bytes, arrival_ns: int, utc_ns: int) -> None:
        """Add one burst and its arrival time, ns. Of an overlong line only the beginning is kept."""
        data = with_newlines(data)
        if not self._listening:
            _, newline, data = data.partition(b"\n")
            self._listening = bool(newline)
        head, newline, tail = data.rpartition(b"\n")
        if newline:
            whole = self._tail + head + newline
            self._tail = b""
            self._text.append(whole)
            self._lines.append(whole.count(b"\n"))
            self._arrivals_ns.append(arrival_ns)
            self._utc_ns = utc_ns
            self.size += len(whole)
        self._tail += tail
        if len(self._tail) > MAX_LINE_BYTES:
            self._drops["bytes", OVERLONG] += len(self._tail) - MAX_LINE_BYTES
            self._tail = self._tail[:MAX_LINE_BYTES]

    def blocks(self) -> list[SampleBlock]:
        """Decode everything fed since the last call and return its blocks."""
        if not self._text:
            return []
        decoded = decode(b"".join(self._text), len(self._columns), self._ignored)
        burst_lines = np.cumsum(self._lines)
        arrivals_ns = np.array(self._arrivals_ns, np.int64)
        self._text, self._lines, self._arrivals_ns, self.size = [], [], [], 0
        self._drops["bytes", OVERLONG] += decoded.bad_bytes
        for reason, lines in decoded.bad_lines.items():
            self._drops["lines", reason] += lines
        sound = self._sound(decoded.values)
        line, values = decoded.line[sound], decoded.values[sound]
        breaks = self._breaks(values, np.searchsorted(line, [*decoded.bad_at, *decoded.line[~sound]]))
        self._broken = self._broken + len(breaks) if len(breaks) >= len(values) else 0
        if max(len(breaks), self._broken) > MOST_BREAKS:
            self._drops["samples", self._fault()] += len(values)
            self._cutter.flag(BlockFlags.RESTART)
            return []
        stretch = Stretch(
            np.ascontiguousarray(values[:, self._axes]),
            arrivals_ns,
            np.searchsorted(line, burst_lines),
            self._utc_ns,
            temperature_degc=self._temperature_degc(values),
        )
        return self._cutter.cut(stretch, breaks)

    def take_drops(self) -> list[Drop]:
        """Bad lines, bytes of overlong lines, and samples of dropped stretches since the last call."""
        drops = [Drop(count, unit, reason) for (unit, reason), count in self._drops.items() if count]
        self._drops.clear()
        return drops

    def _sound(self, values: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether each line (n,) has possible indications, and an undamaged whole number where it has a counter."""
        possible = np.asarray((np.abs(values[:, self._axes]) <= LARGEST).all(axis=1))
        self._drops["lines", UNREADABLE] += int(np.count_nonzero(~possible))
        if self._numbered is None or isinstance(self._numbers, DeviceTime):
            return possible
        whole = values[:, self._numbered] % 1 == 0
        self._drops["lines", NOT_COUNTED] += int(np.count_nonzero(possible & ~whole))
        sound = np.asarray(possible & whole)
        alone = damaged(values[sound, self._numbered])
        self._drops["lines", NOT_FITTING] += int(np.count_nonzero(alone))
        sound[sound] = ~alone
        return sound

    def _breaks(self, values: NDArray[np.float64], lost_at: NDArray[np.int64]) -> list[Break]:
        """Breaks by the counter or time; without one, where a line was lost."""
        if self._numbered is None:
            return [Break(at, BlockFlags.RESTART) for at in sorted(set(lost_at.tolist()))]
        if not len(values):
            return []
        numbers = values[:, self._numbered]
        self._recent = np.concatenate([self._recent, numbers])[-RECENT_NUMBERS:]
        return self._numbers.breaks(numbers)

    def _fault(self) -> str:
        """Why so many samples do not follow the one before."""
        if self._numbered is None:
            return f"samples among lines that cannot be read: more than {MOST_BREAKS} such places in half a second"
        rate_hz = self._cutter.nominal_rate_hz
        if isinstance(self._numbers, DeviceTime):
            return f"the time of the device does not rise as at rate_hz = {rate_hz:g}: the rate is another or varies"
        kind = kind_of(self._recent, rate_hz)
        if kind not in TICKS_HZ:
            return f"the sample counter does not rise by one: more than {MOST_BREAKS} jumps in half a second"
        columns = ", ".join(f'"{kind if name == "seq" else name}"' for name in self._columns)
        return f"the sample counter does not rise by one: it is a time; set columns = [{columns}], no sequence"

    def _temperature_degc(self, values: NDArray[np.float64]) -> float | None:
        """Temperature in the last line; None without one, or if no thermometer can be so cold or hot."""
        if self._temperature is None or not len(values):
            return None
        low, high = TEMPERATURE_DEGC
        degc = float(values[-1, self._temperature])
        return degc if low <= degc <= high else None
