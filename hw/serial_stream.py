"""Driver `serial-csv`: a device that writes one sample a line, `[seq,]x,y,z` or `[seq,]a`, on a serial port."""

from __future__ import annotations

import math
import termios
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import ClassVar, Literal

import numpy as np
import serial
from numpy.typing import NDArray
from pydantic import Field

from hw.block import BlockFlags, DeviceInfo, Drop, SampleBlock
from hw.cutting import Break, Cutter, Stretch
from hw.lines import MAX_LINE_BYTES, decode
from hw.sensor import Clock, ConfigurationError, DeviceLost, Options, system_clock

BLOCK_S = 0.5
GATHER_S = 0.010  # a wake-up for ten samples at 1 kHz, not for each; 115 B of the kernel's 4 kB at 115200 baud
SLOW_RATE_HZ = 100.0  # below, a line is read as it comes: the port wakes the reader, and GATHER_SLOW_S lets it end
GATHER_SLOW_S = 0.002
GOLDEN = (math.sqrt(5) - 1) / 2
READ_BYTES = 65536  # bounds a single read
BLOCK_BYTES = 262144  # bounds a block's memory: 0.5 s at 4 Mbaud is 200 kB
LONGEST_GAP_S = 10.0  # a longer jump in the sequence is a counter that began anew, or a damaged number
UNREADABLE = "not the expected decimals"
OVERLONG = f"no newline within {MAX_LINE_BYTES} bytes"
LOST = (serial.SerialException, OSError, termios.error)  # termios.error is no OSError; all three come at an unplug


class SerialCsvOptions(Options):
    """Options of `serial-csv`."""

    port: str = Field(min_length=1, description="path of the port, best one of /dev/serial/by-id")
    baud_rate: int = Field(115200, gt=0, le=4_000_000)
    axes: Literal[1, 3] = Field(3, description="1: a uniaxial device, 3: x,y,z")
    rate_hz: float = Field(gt=0, le=100_000, allow_inf_nan=False, description="nominal rate of the samples")
    sequence: bool = Field(False, description="each line begins with a sample count; without it lost lines go unseen")
    unit: Literal["count", "m/s2", "m/s", "mV"] = Field("m/s2", description="of the indications")
    full_scale: float | None = Field(None, gt=0, description="indications of this size or more are saturated")
    serial_number: str = Field("", description="of the device, as on its plate")


class SerialCsv:
    """Reads bursts of lines and decodes them block by block.

    With a sequence, missing samples are a GAP of known length; a count that goes back, repeats or leaps beyond
    LONGEST_GAP_S is a RESTART. Without one, a bad line may stand for any number of samples: RESTART.
    """

    options_model: ClassVar[type[Options]] = SerialCsvOptions

    def __init__(
        self,
        name: str,
        options: SerialCsvOptions,
        *,
        clock: Clock = system_clock,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options
        self._clock = clock
        self._sleep = sleep
        limit = options.full_scale or math.inf
        self._cutter = Cutter(name, options.rate_hz, -limit, limit)
        self._drops: Counter[tuple[Literal["lines", "bytes"], str]] = Counter()
        self._port: serial.Serial | None = None
        self._ready: deque[SampleBlock] = deque()
        self._tail = b""
        self._listening = False  # a newline has come since open
        self._last_sequence: float | None = None
        self._phase = 0.0

    def open(self) -> DeviceInfo:
        """Open the port. Raises DeviceLost (absent, in use, no right), ConfigurationError (settings it cannot do)."""
        self.close()
        options = self._options
        try:
            self._port = serial.Serial(options.port, options.baud_rate, timeout=BLOCK_S, exclusive=True)
        except LOST as error:
            raise DeviceLost(f"port {options.port}: {error}") from error
        except ValueError as error:
            raise ConfigurationError(f"port {options.port}, baud_rate {options.baud_rate}: {error}") from error
        self._tail, self._listening, self._last_sequence = b"", False, None
        self._cutter.flag(BlockFlags.RESTART)
        return DeviceInfo(
            driver="serial-csv",
            kind="serial-csv",
            serial_number=options.serial_number,
            unit=options.unit,
            axes=options.axes,
            nominal_rate_hz=options.rate_hz,
            settings={"port": options.port, "baud_rate": str(options.baud_rate), "sequence": str(options.sequence)},
        )

    def close(self) -> None:
        """Release the port."""
        if self._port is not None:
            try:
                self._port.close()
            except LOST:  # it is gone already
                pass
            finally:
                self._port = None

    def take_drops(self) -> list[Drop]:
        """Bad lines and overlong ones since the last call."""
        drops = [Drop(count, unit, reason) for (unit, reason), count in self._drops.items() if count]
        self._drops.clear()
        return drops

    def read_block(self) -> SampleBlock | None:
        """The next block, or None. Raises DeviceLost."""
        if not self._ready:
            if self._port is None:
                raise DeviceLost(f"port {self._options.port} is not open")
            self._ready.extend(self._gather(self._port))
        return self._ready.popleft() if self._ready else None

    def _gather(self, port: serial.Serial) -> list[SampleBlock]:
        text: list[bytes] = []
        lines: list[int] = []
        arrivals: list[int] = []
        size = 0
        now_ns, utc_ns = self._clock()
        end_ns = now_ns + round(BLOCK_S * 1e9)
        while now_ns < end_ns and size < BLOCK_BYTES:
            self._sleep(self._pause_s())
            try:
                data = port.read(min(max(1, port.in_waiting), READ_BYTES))
            except LOST as error:
                self.close()
                if text:
                    break  # what came before the loss is good; the next call finds the port closed
                raise DeviceLost(f"port {self._options.port}: {error}") from error
            now_ns, now_utc_ns = self._clock()
            if not data:
                break
            whole = self._whole_lines(data)
            if whole:
                text.append(whole)
                lines.append(whole.count(b"\n"))
                arrivals.append(now_ns)
                utc_ns = now_utc_ns
                size += len(whole)
        if not text:
            return []
        return self._blocks(b"".join(text), np.cumsum(lines), np.array(arrivals), utc_ns)

    def _pause_s(self) -> float:
        """Time to let a burst gather; spread over a sample period by the golden ratio, so that poll and sample clock
        do not beat and each second's arrivals sample all of the period."""
        if self._options.rate_hz < SLOW_RATE_HZ:
            return GATHER_SLOW_S
        self._phase = (self._phase + GOLDEN) % 1.0
        return GATHER_S + self._phase / self._options.rate_hz

    def _whole_lines(self, data: bytes) -> bytes:
        """The lines that end in this burst; the rest waits for the next, of an overlong line its beginning."""
        if not self._listening:  # the line within which the port was opened tells nothing, and is no loss
            _, newline, data = data.partition(b"\n")
            self._listening = bool(newline)
        head, newline, tail = data.rpartition(b"\n")
        whole = self._tail + head + newline if newline else b""
        self._tail = tail if newline else self._tail + tail
        if len(self._tail) > MAX_LINE_BYTES:
            self._drops["bytes", OVERLONG] += len(self._tail) - MAX_LINE_BYTES
            self._tail = self._tail[:MAX_LINE_BYTES]
        return whole

    def _blocks(
        self, text: bytes, burst_lines: NDArray[np.int64], arrivals_ns: NDArray[np.int64], utc_ns: int
    ) -> list[SampleBlock]:
        decoded = decode(text, self._options.axes + self._options.sequence)
        self._drops["lines", UNREADABLE] += decoded.bad_lines
        self._drops["bytes", OVERLONG] += decoded.bad_bytes
        line, values = decoded.line, decoded.values
        if self._options.sequence:
            counted = (values[:, 0] >= 0) & (values[:, 0] % 1 == 0)
            self._drops["lines", UNREADABLE] += int(np.count_nonzero(~counted))
            line, values = line[counted], values[counted]
            breaks = self._follow(values[:, 0])
            values = np.ascontiguousarray(values[:, 1:])
        else:
            lost_at = np.unique(np.searchsorted(line, decoded.bad_at))
            breaks = [Break(int(at), BlockFlags.RESTART) for at in lost_at]
        return self._cutter.cut(Stretch(values, arrivals_ns, np.searchsorted(line, burst_lines), utc_ns), breaks)

    def _follow(self, sequence: NDArray[np.float64]) -> list[Break]:
        """Where the sequence does not go on by one, and what that means."""
        if not len(sequence):
            return []
        before = sequence[0] - 1 if self._last_sequence is None else self._last_sequence
        self._last_sequence = float(sequence[-1])
        steps = np.diff(sequence, prepend=before)
        breaks = []
        for at in np.flatnonzero(steps != 1).tolist():
            missing = int(steps[at]) - 1
            if 0 < missing <= LONGEST_GAP_S * self._options.rate_hz:
                breaks.append(Break(at, BlockFlags.GAP, missing))
            else:
                breaks.append(Break(at, BlockFlags.RESTART))
        return breaks
