"""A driver that works, but for one bug, which shows some times: each bug is one function of the table of its place."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import numpy as np

from hw.block import BlockFlags, DeviceInfo, Drop, SampleBlock
from hw.sensor import AdapterError, Clock, DeviceLost, Options, boot_id, system_clock

RATE_HZ = 100.0
BLOCK_S = 0.1
DAY_NS = 86_400_000_000_000
HOSTILE = "imu\ud800\x1b[2J\x00/../raw"


class BuggyOptions(Options):
    """`bug`: its name, "" for none. `times`: how often it shows before the driver works."""

    bug: str = ""
    times: int = 2


class UnspeakableError(Exception):
    """An exception that cannot be told."""

    def __str__(self) -> str:
        raise RuntimeError("no text")


class EndingError(BaseException):
    """What nobody catches who catches Exception."""


def raising(error: BaseException) -> Callable[[Any], NoReturn]:
    """A bug that raises."""

    def bug(_: Any) -> NoReturn:
        raise error

    return bug


def with_(**changes: Any) -> Callable[[Any], Any]:
    """A bug that states something else."""
    return lambda stated: replace(stated, **changes)


def indicating(make: Callable[[Any], Any]) -> Callable[[SampleBlock], SampleBlock]:
    """A bug in the array of indications."""
    return lambda block: replace(block, indications=make(block.indications))


def at(make: Callable[[Any], Any]) -> Callable[[SampleBlock], SampleBlock]:
    """A bug in the times of the bursts."""
    return lambda block: replace(block, burst_t_monotonic_ns=make(block.burst_t_monotonic_ns))


def counting(make: Callable[[Any], Any]) -> Callable[[SampleBlock], SampleBlock]:
    """A bug in the counts of the bursts."""
    return lambda block: replace(block, burst_count=make(block.burst_count))


def of_length(n: int) -> Callable[[SampleBlock], SampleBlock]:
    """A block of so many samples."""

    def bug(block: SampleBlock) -> SampleBlock:
        bursts = slice(None) if n else slice(0, 0)
        count = np.array([max(1, n - 1), n] if n else [], np.int32)
        return replace(
            block, indications=np.zeros((n, 3), np.int32), burst_count=count,
            burst_t_monotonic_ns=block.burst_t_monotonic_ns[bursts],
        )  # fmt: skip

    return bug


IN_BLOCKS: dict[str, Callable[[SampleBlock], Any]] = {
    "no samples, no bursts": of_length(0),
    "no samples in two bursts": lambda b: replace(of_length(0)(b), burst_t_monotonic_ns=b.burst_t_monotonic_ns,
                                                  burst_count=np.zeros(2, np.int32)),
    "no bursts": lambda b: replace(b, burst_t_monotonic_ns=b.burst_t_monotonic_ns[:0], burst_count=b.burst_count[:0]),
    "three million samples": of_length(3_000_000),
    "a list of blocks": lambda b: [b],
    "a dictionary": lambda b: {"indications": b.indications},
    "bytes": lambda b: b.indications.tobytes(),
    "a block without content": lambda _: object.__new__(SampleBlock),
    "rate 0": with_(nominal_rate_hz=0.0),
    "rate NaN": with_(nominal_rate_hz=float("nan")),
    "rate 1e300": with_(nominal_rate_hz=1e300),
    "rate -100": with_(nominal_rate_hz=-RATE_HZ),
    "another rate than it said": with_(nominal_rate_hz=2 * RATE_HZ),
    "rate as text": with_(nominal_rate_hz="100"),
    "UTC 2^70": with_(t_utc_ns=2**70),
    "UTC before 1970": with_(t_utc_ns=-1),
    "UTC in s": lambda b: replace(b, t_utc_ns=b.t_utc_ns // 1_000_000_000),
    "UTC a year ahead": lambda b: replace(b, t_utc_ns=b.t_utc_ns + 365 * DAY_NS),
    "UTC as a float": lambda b: replace(b, t_utc_ns=b.t_utc_ns * 1.0),  # type: ignore[arg-type]
    "no UTC": with_(t_utc_ns=None),
    "the name of another device": with_(device="good"),
    "the name of no device": with_(device="elsewhere"),
    "a hostile name": with_(device=HOSTILE),
    "no name": with_(device=None),
    "another boot": with_(boot_id="00000000-0000-0000-0000-000000000000"),
    "one axis instead of three": indicating(lambda x: x[:, :1]),
    "two axes": indicating(lambda x: x[:, :2]),
    "four axes": indicating(lambda x: np.hstack([x, x[:, :1]])),
    "a flat array": indicating(np.ravel),
    "samples and axes exchanged": indicating(lambda x: x.T.copy()),
    "indications as a list": indicating(lambda x: x.tolist()),
    "counts of 64 bits beyond int32": indicating(lambda x: x.astype(np.int64) + 2**40),
    "counts without a sign": indicating(lambda x: x.astype(np.uint32)),
    "single precision": indicating(lambda x: x.astype(np.float32)),
    "complex indications": indicating(lambda x: x.astype(np.complex128)),
    "objects as indications": indicating(lambda x: x.astype(object)),
    "text as indications": indicating(lambda x: x.astype(str)),
    "bytes in the other order": indicating(lambda x: x.astype(">i4")),
    "bursts in the wrong order": at(lambda t: t[::-1].copy()),
    "bursts at the same time": at(lambda t: np.full_like(t, t[0])),
    "a time as a float": at(lambda t: t.astype(np.float64)),
    "more times than counts": at(lambda t: np.append(t, t[-1] + 1)),
    "arrivals before the boot": at(lambda t: t - 2**62),
    "arrivals of yesterday": at(lambda t: t - DAY_NS),
    "arrivals tomorrow": at(lambda t: t + DAY_NS),
    "arrivals in two seconds": at(lambda t: t + 2_000_000_000),
    "arrivals in a million years": at(lambda t: np.full_like(t, 2**63 - 1)),
    "counts that decrease": counting(lambda c: np.array([c[-1] + 1, c[-1]], np.int32)),
    "counts that do not rise": counting(lambda c: np.array([c[-1], c[-1]], np.int32)),
    "counts that miss samples": counting(lambda c: c - 1),
    "counts of more samples": counting(lambda c: c + 1),
    "a negative count": counting(lambda c: np.array([-1, c[-1]], np.int32)),
    "counts of 64 bits in bursts": counting(lambda c: c.astype(np.int64)),
    "no counts": with_(burst_count=None),
    "index -1": with_(first_index=-1),
    "index 2^70": with_(first_index=2**70),
    "index 2^62": with_(first_index=2**62),
    "index as text": with_(first_index="7"),
    "flags of 64 bits": with_(flags=1 << 40),
    "flag 64": with_(flags=BlockFlags(64)),
    "no flags": with_(flags=None),
    "temperature as text": with_(temperature_degc="21"),
    "temperature 10^400": with_(temperature_degc=10**400),
    "temperature register 2^70": with_(temperature_raw=2**70),
}  # fmt: skip
INSTEAD_OF_BLOCKS: dict[str, Callable[[SampleBlock], Any]] = {
    "ValueError": raising(ValueError("could not convert b'\\x00' to float")),
    "KeyError": raising(KeyError("port")),
    "StopIteration": raising(StopIteration()),
    "MemoryError": raising(MemoryError()),
    "RecursionError": raising(RecursionError("maximum recursion depth exceeded")),
    "SystemExit": raising(SystemExit(3)),
    "KeyboardInterrupt": raising(KeyboardInterrupt()),
    "GeneratorExit": raising(GeneratorExit()),
    "an exception of its own": raising(EndingError("ended")),
    "an exception without a text": raising(UnspeakableError()),
    "a hostile text": raising(ValueError(HOSTILE)),
    "a text of 10 MB": raising(ValueError("x" * 10_000_000)),
    "a loss with a hostile text": raising(DeviceLost(HOSTILE)),
}
NOT_FIRST: dict[str, Callable[[SampleBlock], Any]] = {  # bugs that only a block after a good one can have
    "decimals after counts": indicating(lambda x: x.astype(np.float64)),
    "the first block again": with_(first_index=0),
    "an index that goes back": lambda b: replace(b, first_index=b.first_index - 1),
    "a block that came before": at(lambda t: t - 1_000_000_000),
}
IN_OPEN: dict[str, Callable[[DeviceInfo], Any]] = {
    "nothing from open": lambda _: None,
    "a dictionary from open": lambda _: {"driver": "buggy"},
    "open: rate NaN": with_(nominal_rate_hz=float("nan")),
    "open: rate 0": with_(nominal_rate_hz=0.0),
    "open: rate 1e300": with_(nominal_rate_hz=1e300),
    "open: rate as text": with_(nominal_rate_hz="fast"),
    "open: two axes": with_(axes=2),
    "open: a hostile kind": with_(kind=HOSTILE),
    "open: a serial number of 1 MB": with_(serial_number="9" * 1_000_000),
    "open: no unit": with_(unit=None),
    "open: no settings": with_(settings=None),
    "open: settings of 10 MB": with_(settings={"registers": "00" * 5_000_000}),
    "open: settings that are objects": with_(settings={"port": object()}),
    "open: settings with numbers as names": with_(settings={7: "on"}),
    "open: sensitivity NaN": with_(nominal_sensitivity=float("nan")),
    "open: sensitivity 0": with_(nominal_sensitivity=0.0),
    "open: sensitivity 1e300": with_(nominal_sensitivity=1e300),
    "open: range as text": with_(range_mps2="8 g"),
    "open: its clock as text": with_(own_clock="own"),
    "open: filters as text": with_(filters="lowpass order=2 corner_hz=31"),
    "open: filters that are numbers": with_(filters=(31.0,)),
    "open: SystemExit": raising(SystemExit(3)),
    "open: KeyboardInterrupt": raising(KeyboardInterrupt()),
    "open: AttributeError": raising(AttributeError("'NoneType' object has no attribute 'write'")),
}
IN_DROPS: dict[str, Callable[[list[Drop]], Any]] = {
    "drops: ValueError": raising(ValueError("no drops")),
    "drops: SystemExit": raising(SystemExit(3)),
    "drops: nothing": lambda _: None,
    "drops: a number": lambda _: 7,
    "drops: not a drop": lambda _: [{"count": 7}],
    "drops: count -1": lambda _: [Drop(-1, "samples", "lost")],
    "drops: count 2^70": lambda _: [Drop(2**70, "samples", "lost")],
    "drops: count as a float": lambda _: [Drop(1.5, "samples", "lost")],  # type: ignore[arg-type]
    "drops: another unit": lambda _: [Drop(1, "apples", "lost")],  # type: ignore[arg-type]
    "drops: no reason": lambda _: [Drop(1, "samples", None)],  # type: ignore[arg-type]
    "drops: a million": lambda _: [Drop(1, "samples", "lost")] * 1_000_000,
}
IN_CLOSE: dict[str, Callable[[None], Any]] = {
    "close: OSError": raising(OSError(9, "Bad file descriptor")),
    "close: KeyboardInterrupt": raising(KeyboardInterrupt()),
}
REFUSED = "/dev/i2c-1: the adapter refuses a transfer of 33 bytes"
REFUSING: dict[str, Callable[[Any], Any]] = {"the adapter refuses": raising(AdapterError(REFUSED))}
REFUSING_LATER: dict[str, Callable[[Any], Any]] = {"the adapter refuses later": raising(AdapterError(REFUSED))}
FOR_EVER_S = 3600.0
HANGING: dict[str, tuple[str, float]] = {  # method, and how long it takes in s
    "open: does not return": ("open", FOR_EVER_S),
    "read_block: does not return": ("read_block", FOR_EVER_S),
    "close: does not return": ("close", FOR_EVER_S),
    "read_block: returns after two seconds": ("read_block", 2.0),
}
BUGS = [*IN_BLOCKS, *NOT_FIRST, *INSTEAD_OF_BLOCKS, *IN_OPEN, *IN_DROPS, *IN_CLOSE]


class Buggy:
    """Three axes of counts, 100 a second, in blocks of 0.1 s with two bursts."""

    options_model: ClassVar[type[Options]] = BuggyOptions

    def __init__(
        self,
        name: str,
        options: BuggyOptions,
        *,
        clock: Clock = system_clock,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if options.bug == "it cannot be made":
            raise TypeError("unsupported operand type(s) for /: 'str' and 'int'")
        self._name, self._options, self._clock, self._sleep = name, options, clock, sleep
        self._left = options.times  # how often the bug still shows
        self._index = 0
        self._restarted = False
        self._array = np.zeros((1, 3), np.int32)  # of a flood, and of the driver that has one array only

    def _hang(self, method: str) -> None:
        """Wait, if the bug is that this method does not return."""
        where, seconds = HANGING.get(self._options.bug, ("", 0.0))
        if where == method and self._left:
            self._left -= 1
            time.sleep(seconds)

    def _has(self, table: dict[str, Callable[[Any], Any]]) -> Callable[[Any], Any] | None:
        """The bug, if it is of this place and shows now."""
        if self._options.bug not in table or not self._left:
            return None
        self._left -= 1
        return table[self._options.bug]

    def open(self) -> DeviceInfo:
        """What the device is."""
        self._hang("open")
        self._restarted = True
        info = DeviceInfo("buggy", "buggy", self._name, "count", 3, RATE_HZ, nominal_sensitivity=1000.0)
        bug = self._has(IN_OPEN | REFUSING)
        return info if bug is None else bug(info)

    def read_block(self) -> SampleBlock:
        """The next ten samples: gravity on z."""
        if self._options.bug in ("a flood", "one array for all blocks"):
            return self._one_sample()
        self._hang("read_block")
        now_ns, utc_ns = self._clock()
        self._sleep(BLOCK_S)
        arrival_ns, utc_ns = self._clock()
        n = round(BLOCK_S * RATE_HZ)
        block = SampleBlock(
            self._name, boot_id(), utc_ns, self._index, RATE_HZ, np.array([now_ns + 1, arrival_ns], np.int64),
            np.array([n - 1, n], np.int32), np.tile(np.array([3, -5, 9810], np.int32), (n, 1)),
            BlockFlags.RESTART if self._restarted else BlockFlags.NONE, 7, 21.5,
        )  # fmt: skip
        bug = self._has(IN_BLOCKS | INSTEAD_OF_BLOCKS) or (
            None if self._restarted else self._has(NOT_FIRST | REFUSING_LATER)
        )
        if bug is not None:
            return bug(block)
        if (
            (self._options.bug in IN_CLOSE or self._options.bug.startswith("close"))
            and self._left
            and not self._restarted
        ):
            raise DeviceLost("port: gone")
        self._index += n
        self._restarted = False
        return block

    def _one_sample(self) -> SampleBlock:
        """A block of one sample, whose x is the number of the block; a flood does not wait for it."""
        self._array[0] = -1
        if self._options.bug != "a flood":
            self._sleep(BLOCK_S)
        arrival_ns, utc_ns = self._clock()
        self._array[0] = self._index, -5, 9810
        self._index += 1
        return SampleBlock(
            self._name, boot_id(), utc_ns, self._index - 1, RATE_HZ, np.array([arrival_ns], np.int64),
            np.array([1], np.int32), self._array,
        )  # fmt: skip

    def take_drops(self) -> list[Drop]:
        """Nothing is lost."""
        bug = self._has(IN_DROPS)
        return [] if bug is None else bug([])

    def close(self) -> None:
        """Nothing is to close."""
        self._hang("close")
        bug = self._has(IN_CLOSE)
        if bug is not None:
            bug(None)


def install(site: Path) -> None:
    """Make the driver a plug-in of the name `buggy` where `site` is a directory of Python's packages."""
    plug_in = site / "fieldcal_buggy-0.dist-info"
    plug_in.mkdir(parents=True, exist_ok=True)
    (plug_in / "METADATA").write_text("Metadata-Version: 2.1\nName: fieldcal-buggy\nVersion: 0\n")
    (plug_in / "entry_points.txt").write_text("[fieldcal.sensors]\nbuggy = tests.unit.buggy_driver:Buggy\n")
