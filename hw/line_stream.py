"""Makes sample blocks of bursts of bytes in the serial text protocol `[seq,]x,y,z` or `[seq,]a`; needs no port."""

from __future__ import annotations

from collections import Counter
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags, Drop, SampleBlock
from hw.cutting import Break, Cutter, Stretch, follow
from hw.lines import MAX_LINE_BYTES, decode

UNREADABLE = "line without the expected decimal numbers"
OVERLONG = f"no newline within {MAX_LINE_BYTES} bytes"


class LineStream:
    """Collects bursts with `feed` and decodes all of them in `blocks`.

    Between calls it keeps at most one incomplete line.

    With a sequence number, missing samples are a GAP of known length; a number that repeats, goes back or jumps by more
    than `longest_gap` samples is a RESTART. Without a sequence number, a bad line may have been any number of samples:
    RESTART.
    """

    def __init__(self, cutter: Cutter, axes: int, *, sequence: bool, longest_gap: float) -> None:
        self._cutter = cutter
        self._columns = axes + sequence
        self._sequence = sequence
        self._longest_gap = longest_gap
        self._drops: Counter[tuple[Literal["lines", "bytes"], str]] = Counter()
        self.begin()

    def begin(self) -> None:
        """Start after a port was opened.

        The bytes up to the first newline are the rest of a line and are not counted.
        """
        self._listening = False
        self._tail = b""
        self._last_sequence: float | None = None
        self._text: list[bytes] = []
        self._lines: list[int] = []
        self._arrivals_ns: list[int] = []
        self._utc_ns = 0
        self.size = 0  # number of collected bytes
        self._cutter.flag(BlockFlags.RESTART)

    def feed(self, data: bytes, arrival_ns: int, utc_ns: int) -> None:
        """Add one burst and its arrival time, ns. Of an overlong line only the beginning is kept."""
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
        decoded = decode(b"".join(self._text), self._columns)
        burst_lines = np.cumsum(self._lines)
        arrivals_ns = np.array(self._arrivals_ns, np.int64)
        self._text, self._lines, self._arrivals_ns, self.size = [], [], [], 0
        self._drops["lines", UNREADABLE] += decoded.bad_lines
        self._drops["bytes", OVERLONG] += decoded.bad_bytes
        line, values = decoded.line, decoded.values
        if self._sequence:
            counted = (values[:, 0] >= 0) & (values[:, 0] % 1 == 0)
            self._drops["lines", UNREADABLE] += int(np.count_nonzero(~counted))
            line, values = line[counted], values[counted]
            breaks = self._follow(values[:, 0])
            values = np.ascontiguousarray(values[:, 1:])
        else:
            lost_at = set(np.searchsorted(line, decoded.bad_at).tolist())
            breaks = [Break(at, BlockFlags.RESTART) for at in sorted(lost_at)]
        return self._cutter.cut(Stretch(values, arrivals_ns, np.searchsorted(line, burst_lines), self._utc_ns), breaks)

    def take_drops(self) -> list[Drop]:
        """Bad lines and bytes of overlong lines since the last call."""
        drops = [Drop(count, unit, reason) for (unit, reason), count in self._drops.items() if count]
        self._drops.clear()
        return drops

    def _follow(self, sequence: NDArray[np.float64]) -> list[Break]:
        """Breaks where the sequence number does not increase by one."""
        if not len(sequence):
            return []
        before = sequence[0] - 1 if self._last_sequence is None else self._last_sequence
        self._last_sequence = float(sequence[-1])
        return follow(np.diff(sequence, prepend=before), self._longest_gap)
