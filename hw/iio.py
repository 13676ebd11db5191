"""Driver `iio`: an accelerometer that a Linux kernel driver (industrial I/O) reads, through the kernel's buffer.

Kernel drivers that read the FIFO of a chip (adxl345, adxl372: drivers/iio/accel) pass its samples on together, without
time stamps. The kernel's buffer (drivers/iio/buffer/kfifo_buf.c) has a length rounded up to a power of two; when it is
full, new samples are dropped, and nobody is told.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hw import iio_scan
from hw.block import BlockFlags, DeviceInfo
from hw.cutting import Break, Cutter, Stretch
from hw.pace import Pace
from hw.polling import PollingSensor
from hw.sensor import ConfigurationError, DeviceLost, Options

SYSFS, DEV = Path("/sys/bus/iio/devices"), Path("/dev")
BUFFER_S = 4.0  # least length of the kernel's buffer
UNSTAMPED_POLL_S = 0.01  # between polls, where the arrival is the only stamp
READ_BYTES = 1 << 20
LONGEST_GAP = 100  # samples; the length of a longer gap is uncertain if the rate is 1 % off
AXES = ("accel_x", "accel_y", "accel_z")
STAMP = "timestamp"
TOGETHER = ("watermark", "hwfifo_watermark")  # files in `buffer`: samples that come together
MOST_MISSING = 4  # blocks one after the other that do not fit the clock: then the rate is another one
MISSING = "samples among which others are missing, by their number against the clock"
OFF = ("in_accel_x_calibbias", "in_accel_y_calibbias", "in_accel_z_calibbias")
HIGH_PASS = "in_accel_filter_high_pass_3db_frequency"
LOW_PASS = "in_accel_filter_low_pass_3db_frequency"
LOWEST_STATED_HZ = 1.0  # of the corners: a lower one remembers longer than the windows can spare


class IioOptions(Options):
    """Options of `iio`."""

    device: str = Field(min_length=1, description="name of the device, e.g. adxl355, or its node, e.g. iio:device0")
    rate_hz: float = Field(gt=0, le=100_000, description="sampling frequency; the kernel driver must offer it")
    trigger: str | None = Field(None, description="name of the trigger; needed if the kernel driver sets none itself")


class Iio(PollingSensor):
    """Reads the files in sysfs and the device's node; needs no library.

    Where the kernel stamps every sample at its interrupt (CLOCK_MONOTONIC), each sample is a burst with this arrival
    time, and a larger step between two stamps tells how many samples the buffer dropped. Where it does not, each read
    is a burst. Samples are then lost, an unknown number, after a read that found the buffer full, and where the number
    of samples falls behind the clock by more than those that come together and those of the time between two polls.
    """

    options_model = IioOptions
    poll_s = 0.05

    def __init__(self, name: str, options: IioOptions, **timing: Any) -> None:
        super().__init__(name, options, **timing)
        self._cutter = Cutter(name, options.rate_hz)
        self._file: int | None = None
        self._directory = SYSFS
        self._data = b""  # scans that were read, and the beginning of the next one
        self._last_ns: int | None = None
        self._bursts: list[tuple[int, int]] = []  # arrival of each read, and the number of scans in `_data` then
        self._polled_ns = 0  # the last poll
        self._unfit = 0  # blocks one after the other that did not fit the clock
        self._pace = Pace(options.rate_hz)

    def _where(self) -> str:
        return f"IIO device {self._options.device} (/dev/{self._directory.name})"

    def _start(self) -> DeviceInfo:
        """Find the device, write its settings, read them back, start its buffer."""
        self._directory = self._find()
        if not (self._directory / "buffer").is_dir():
            raise ConfigurationError(
                f"{self._directory}: the device has no buffer; most kernel drivers need its interrupt line for one"
            )
        try:
            # The node is opened before any setting is written: if another process has it open, the settings stay as
            # they are.
            self._file = os.open(DEV / self._directory.name, os.O_RDONLY | os.O_NONBLOCK)
            settings = self._configure()
            scale = _number(self._directory / "in_accel_scale") if "in_accel_scale" in settings else 0.0
            filters = _filters(self._directory / LOW_PASS)
        except OSError as error:
            message = f"IIO device {self._options.device}: {error.filename or ''}: {error.strerror}"
            held = error.errno == errno.EBUSY
            raise (ConfigurationError if held else DeviceLost)(message) from error
        self._data = b""
        self._last_ns = None
        self._bursts, self._unfit = [], 0
        self._pace = Pace(self._options.rate_hz, self._together())
        self._polled_ns = self._clock()[0]
        self._cutter.flag(BlockFlags.RESTART)
        return DeviceInfo(
            driver="iio",
            kind=settings["name"],
            serial_number="",
            unit="count",
            axes=3,
            nominal_rate_hz=self._options.rate_hz,
            range_mps2=-self._cutter.lowest * scale if scale > 0 else None,
            nominal_sensitivity=1 / scale if scale > 0 else None,
            settings=settings,
            filters=filters,
        )

    def _stop(self) -> None:
        """Close the node and stop the buffer."""
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):
                os.close(file)
            with contextlib.suppress(OSError):
                (self._directory / "buffer" / "enable").write_text("0")

    def _wait(self) -> None:
        # The stamps are the kernel's, so that polls need not be spread; else they avoid a beat with the interrupts.
        self._sleep(self.poll_s if self._stamped else UNSTAMPED_POLL_S * (0.5 + self._next_phase()))

    def _poll_once(self) -> bool:
        assert self._file is not None
        data = self._read(self._file)
        self._data += data
        while len(data) == READ_BYTES:
            data = self._read(self._file)
            self._data += data
        if not self._stamped:
            self._note_arrival()
        return True

    def _note_arrival(self) -> None:
        """The scans that this poll found came after the poll before. Of a full buffer what came next was dropped."""
        before_ns, self._polled_ns = self._polled_ns, self._clock()[0]
        count = len(self._data) // self._scan.itemsize
        new = count - (self._bursts[-1][1] if self._bursts else 0)
        if not new:
            return
        self._bursts.append((self._polled_ns, count))
        self._pace.add((self._polled_ns + before_ns) // 2, (self._polled_ns - before_ns) // 2, new)
        if new >= self._length:
            self._finish()
            self._begin_again()

    def _begin_again(self) -> None:
        """The samples from now on do not follow those before."""
        self._pace.restart()
        self._cutter.flag(BlockFlags.RESTART | BlockFlags.OVERRUN)

    def _finish(self) -> None:
        whole = len(self._data) // self._scan.itemsize * self._scan.itemsize
        scans, self._data = np.frombuffer(self._data[:whole], self._scan), self._data[whole:]
        if not len(scans):
            return
        counts = np.column_stack([self._elements[axis].value(scans[axis]) for axis in AXES]).astype(np.int32)
        if self._stamped:
            self._finish_stamped(counts, self._elements[STAMP].value(scans[STAMP]))
        else:
            self._finish_unstamped(counts)

    def _finish_stamped(self, counts: NDArray[np.int32], stamps_ns: NDArray[np.int64]) -> None:
        now_ns, utc_ns = self._clock()
        lost = iio_scan.missing(stamps_ns, self._last_ns, self._options.rate_hz)
        self._last_ns = int(stamps_ns[-1])
        breaks = [
            Break(at, BlockFlags.GAP, int(lost[at])) if lost[at] <= LONGEST_GAP else Break(at, BlockFlags.RESTART)
            for at in np.flatnonzero(lost).tolist()
        ]
        newer = np.diff(np.maximum.accumulate(stamps_ns), prepend=-1) > 0
        stretch = Stretch(
            counts, stamps_ns[newer], np.flatnonzero(newer) + 1, utc_ns - now_ns + int(stamps_ns[newer][-1])
        )
        self._ready.extend(self._cutter.cut(stretch, breaks))

    def _finish_unstamped(self, counts: NDArray[np.int32]) -> None:
        bursts, self._bursts = np.array(self._bursts, np.int64), []
        self._unfit = self._unfit + 1 if self._pace.missing else 0
        if self._unfit:
            self._dropped["samples", MISSING] += len(counts)
            self._begin_again()
            if self._unfit == MOST_MISSING:
                raise DeviceLost(self._other_rate(bursts))
            return
        now_ns, utc_ns = self._clock()
        stretch = Stretch(counts, bursts[:, 0], bursts[:, 1], utc_ns - now_ns + int(bursts[-1, 0]))
        self._ready.extend(self._cutter.cut(stretch))

    def _other_rate(self, bursts: NDArray[np.int64]) -> str:
        """What is told where no block fits the clock."""
        ns, count = (bursts[-1] - bursts[0]).tolist()
        return (
            f"/dev/{self._directory.name}: {count} samples came in {1e-9 * ns:.3g} s, which is not rate_hz "
            f"{self._options.rate_hz:g} within 10 %; state the rate of the device or its trigger, or use a rate that "
            "the kernel driver can read without loss"
        )

    def _read(self, file: int) -> bytes:
        try:
            data = os.read(file, READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise DeviceLost(f"/dev/{self._directory.name}: {error.strerror}") from error
        if not data:
            raise DeviceLost(f"/dev/{self._directory.name}: the device returned end of file")
        return data

    def _find(self) -> Path:
        """Directory of the device in sysfs. Raises DeviceLost."""
        names = {path: _text(path / "name") for path in sorted(SYSFS.glob("iio:device*"))}
        for path, name in names.items():
            if self._options.device in (path.name, name):
                return path
        known = ", ".join(f"{name} ({path.name})" for path, name in names.items()) or "none"
        raise DeviceLost(f"{SYSFS}: no IIO device {self._options.device!r}; available: {known}")

    def _configure(self) -> dict[str, str]:
        """Write all settings and start the buffer; returns the settings as read back, by file name."""
        here = self._directory
        _write(here / "buffer" / "enable", "0")
        rate = next(
            (path for path in (here / "in_accel_sampling_frequency", here / "sampling_frequency") if path.exists()),
            None,
        )
        wanted = {} if rate is None else {rate: f"{self._options.rate_hz:g}"}
        wanted |= {here / name: "0" for name in (*OFF, HIGH_PASS) if (here / name).exists()}
        if self._options.trigger is not None:
            wanted[here / "trigger" / "current_trigger"] = self._options.trigger
        if (clock := here / "current_timestamp_clock").exists():  # only where there is a time stamp
            wanted[clock] = "monotonic"
        for path, value in wanted.items():
            _write(path, value)
            found = _text(path)
            if found != value and not _same_number(found, value):
                raise ConfigurationError(f"{path}: wrote {value}, the kernel driver set {found}")
        self._elements = self._choose(here / "scan_elements")
        self._stamped = STAMP in self._elements
        self._scan = iio_scan.layout(self._elements)
        bits = self._elements["accel_x"].bits
        self._cutter.lowest, self._cutter.highest = -(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1
        self._length = 1 << math.ceil(math.log2(max(2.0, BUFFER_S * self._options.rate_hz)))
        _write(here / "buffer" / "length", str(self._length))
        _write(here / "buffer" / "enable", "1")
        kept = [here / "name", here / "in_accel_scale", here / "in_accel_offset", *wanted]
        return {path.name: _text(path) for path in kept if path.exists()}

    def _together(self) -> int:
        """The most samples that the kernel driver passes on together, as its files say."""
        there = [path for name in TOGETHER if (path := self._directory / "buffer" / name).exists()]
        return round(max([1.0, *(_number(path) for path in there)]))

    def _choose(self, directory: Path) -> dict[str, iio_scan.Element]:
        """Store the acceleration, and the time stamp if there is one, and nothing else; returns the stored elements."""
        elements = {}
        for path in sorted(directory.glob("in_*_en")):
            name = path.name.removeprefix("in_").removesuffix("_en")
            chosen = name in (*AXES, STAMP)
            _write(path, "1" if chosen else "0")
            if chosen:
                index = int(_number(directory / f"in_{name}_index"))
                elements[name] = iio_scan.Element.parse(index, _text(directory / f"in_{name}_type"))
        absent = [name for name in AXES if name not in elements]
        if absent:
            raise ConfigurationError(f"{directory}: the device does not have {', '.join(absent)}")
        return elements


def _text(path: Path) -> str:
    return path.read_text("ascii", errors="replace").strip()


def _write(path: Path, value: str) -> None:
    """Write a file of sysfs.

    Raises ConfigurationError if the kernel driver refuses the value, otherwise OSError with the path.
    """
    try:
        path.write_text(value)
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise OSError(error.errno, error.strerror, str(path)) from error
        known = path.with_name(f"{path.name}_available")
        if path.name == "enable":
            triggers = ", ".join(_text(name) for name in sorted(SYSFS.glob("trigger*/name"))) or "none"
            hint = f"; set the option trigger if the device needs one (triggers here: {triggers})"
        else:
            hint = f"; accepted values: {_text(known)}" if known.exists() else ""
        raise ConfigurationError(f"{path}: {value} is refused{hint}") from error


def _number(path: Path) -> float:
    """The number in a file. Raises ConfigurationError if the text is not a number."""
    text = _text(path)
    try:
        return float(text)
    except ValueError:
        raise ConfigurationError(f"{path}: {text!r} is not a number") from None


def _same_number(found: str, wanted: str) -> bool:
    """Whether two texts are the same number: 1000.000000 and 1000 are, a rate that the kernel driver rounded is not."""
    try:
        return abs(float(found) - float(wanted)) <= 1e-3 * abs(float(wanted))
    except ValueError:
        return False


def _filters(low_pass: Path) -> tuple[str, ...]:
    """The low-pass filter that the kernel driver names in a file of sysfs, as in DeviceInfo; the high-pass one is off.

    The kernel tells where the filter is 3 dB down and no order: the standard uncertainty is so large that first and
    second order lie within U.
    """
    corner_hz = _number(low_pass) if low_pass.exists() else 0.0
    if not LOWEST_STATED_HZ <= corner_hz < math.inf:
        return ()
    return (f"lowpass order=1 corner_hz={corner_hz:g} u_corner_pct=50",)
