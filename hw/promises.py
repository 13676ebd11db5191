"""What a driver must keep to. The agent checks each answer of a driver before anything else of the agent sees it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any, get_args, get_type_hints

import numpy as np

from hw.block import LARGEST, BlockFlags, DeviceInfo, Drop, SampleBlock
from hw.sensor import Clock, boot_id, system_clock

FASTEST_HZ = 1e6  # of any device; memory for a window is reserved by the rate. A sound card has 1.9e5
MOST_SAMPLES = 500_000  # of a block: half a second of the fastest device
LONGEST_TEXT = 256  # characters of kind, serial number and unit of a device
MOST_INFO = 64 << 10  # bytes of all that a driver tells of a device, as JSON
MOST_DROPS = 100  # reasons at a time
LARGEST_INDEX = 2**53  # the clock model computes with floating-point numbers; 285 years of the fastest device
OLDEST_NS = 60_000_000_000  # what a port or a library may have kept from before the opening
AHEAD_NS = 1_000_000_000  # by which the clock of a station on the network may be ahead of this machine's
# A driver reads both clocks together, so they differ as the machine's do, unless UTC was set meanwhile. A day is more
# than any time zone, and does not mislead what is kept for days or years.
UTC_WITHIN_NS = 86_400_000_000_000
UNITS = get_args(get_type_hints(Drop)["unit"])
SHOWN = 60  # characters of a wrong value in a message
TOLD = 500  # characters of the text of an exception
_ARRAYS = (  # of a block: name, number of dimensions, kinds of numbers
    ("indications", 2, (np.dtype(np.int32), np.dtype(np.float64))),
    ("burst_t_monotonic_ns", 1, (np.dtype(np.int64),)),
    ("burst_count", 1, (np.dtype(np.int32),)),
)
_WHOLE = (("first_index", LARGEST_INDEX), ("t_utc_ns", 2**63 - 1), ("flags", sum(BlockFlags)))  # and the largest value


class BadDriverError(Exception):
    """A driver broke a promise of `hw.sensor.Sensor` or `hw.block.SampleBlock`. The message names field and value."""


def block_fault(block: SampleBlock) -> str:
    """What is wrong with the form of a block, with the value; "" if nothing is. Takes some microseconds.

    The agent asks it of each block of a driver, and the reader of a recording of each block in a file.
    """
    rate_hz, count = block.nominal_rate_hz, block.burst_count
    if not isinstance(rate_hz, float | int) or not 0 < rate_hz <= FASTEST_HZ:
        return f"nominal_rate_hz is {shown(rate_hz)}; it must be a number above 0 and at most {FASTEST_HZ:g}"
    for name, dimensions, kinds in _ARRAYS:
        array = getattr(block, name)
        if not isinstance(array, np.ndarray) or array.ndim != dimensions or array.dtype not in kinds:
            wanted = " or ".join(map(str, kinds))
            return f"{name} is {_form(array)}, not an array of {wanted} with {dimensions} dimensions"
    n, axes = block.indications.shape
    if axes not in (1, 3):
        return f"indications has {axes} axes; only 1 and 3 are possible"
    if n > MOST_SAMPLES:
        return f"the block has {n} samples; at most {MOST_SAMPLES} are possible"
    if not len(count) or len(block.burst_t_monotonic_ns) != len(count):
        return f"the block has {len(block.burst_t_monotonic_ns)} times of bursts and {len(count)} counts"
    if count[0] < 0 or np.count_nonzero(count[1:] < count[:-1]) or count[-1] != n:
        return f"burst_count begins with {count[0]} and ends with {count[-1]}; it must never decrease, and end with {n}"
    return ""


class BlockCheck:
    """Checks the blocks of one device from its opening to its loss. A block takes some 20 microseconds."""

    def __init__(self, device: str, info: DeviceInfo, opened: tuple[int, int], clock: Clock = system_clock) -> None:
        """`opened`: CLOCK_MONOTONIC and UTC in ns before the device was opened."""
        self._device = device
        self._info = info
        self._clock = clock
        self._utc_offset_ns = opened[1] - opened[0]
        self._newest_ns = 0 if info.own_clock else opened[0] - OLDEST_NS
        self._next_index = 0
        self._kind: np.dtype[Any] | None = None  # of the indications

    def taken(self, block: object) -> SampleBlock:
        """A copy of the block, which the driver cannot change any more; the first one carries RESTART.

        Raises BadDriverError if the block breaks a promise.
        """
        if not isinstance(block, SampleBlock):
            raise BadDriverError(f"read_block returned a {type(block).__name__}, not a SampleBlock or None")
        own = _copy(block)
        if fault := self._labels_fault(own) or block_fault(own) or self._order_fault(own) or self._time_fault(own):
            raise BadDriverError(f"a block that cannot be used: {fault}")
        if self._kind is None:
            own = replace(own, flags=own.flags | BlockFlags.RESTART)
        self._kind = own.indications.dtype
        self._next_index, self._newest_ns = own.first_index + own.n, own.t_monotonic_ns
        return own

    def _labels_fault(self, block: SampleBlock) -> str:
        """What is wrong with what a block says beside its arrays."""
        for name, wanted in (("device", self._device), ("boot_id", boot_id())):
            if (said := getattr(block, name)) != wanted:
                return f"{name} is {shown(said)}, not {shown(wanted)}"
        if block.nominal_rate_hz != self._info.nominal_rate_hz:
            return f"nominal_rate_hz is {shown(block.nominal_rate_hz)}; open said {self._info.nominal_rate_hz:g}"
        for name, most in _WHOLE:
            value = getattr(block, name)
            if not isinstance(value, int) or not 0 <= value <= most:
                return f"{name} is {shown(value)}; it must be a whole number from 0 to {most}"
        raw, degc = block.temperature_raw, block.temperature_degc
        if raw is not None and not (isinstance(raw, int) and -(2**63) <= raw < 2**63):
            return f"temperature_raw is {shown(raw)}; it must be None or a whole number of 64 bits"
        if degc is not None and not isinstance(degc, float) and not (isinstance(degc, int) and abs(degc) <= LARGEST):
            return f"temperature_degc is {shown(degc)}; it must be None or a number of at most {LARGEST:g}"
        return ""

    def _order_fault(self, block: SampleBlock) -> str:
        """What does not follow from the opening or the block before."""
        axes, kind = block.indications.shape[1], block.indications.dtype
        if axes != self._info.axes:
            return f"it has {axes} axes; open said {self._info.axes}"
        if self._kind not in (None, kind):
            return f"its indications are {kind}, those of the block before {self._kind}"
        if block.first_index < self._next_index:
            return f"first_index is {block.first_index}; {self._next_index} or more follows the block before"
        if np.count_nonzero(np.diff(block.burst_count, prepend=0) <= 0):
            return "burst_count must rise from burst to burst, and begin with 1 or more"
        return ""

    def _time_fault(self, block: SampleBlock) -> str:
        """What is wrong with the times; those of an own clock need not agree with this machine's."""
        times_ns = block.burst_t_monotonic_ns
        if np.count_nonzero(times_ns[1:] <= times_ns[:-1]):
            return "burst_t_monotonic_ns must rise from burst to burst"
        if times_ns[0] < self._newest_ns:
            before_s = (self._newest_ns - int(times_ns[0])) * 1e-9
            return f"its first burst arrived {before_s:.3g} s before the block before it, or the opening, allows"
        if self._info.own_clock:
            return ""
        now_ns, utc_ns = self._clock()
        if (ahead_ns := block.t_monotonic_ns - now_ns) > AHEAD_NS:
            return f"its last burst arrives in {ahead_ns * 1e-9:.3g} s from now"
        before_ns, self._utc_offset_ns = self._utc_offset_ns, utc_ns - now_ns
        low_ns, high_ns = sorted((before_ns, self._utc_offset_ns))
        if not low_ns - UTC_WITHIN_NS <= block.t_utc_ns - block.t_monotonic_ns <= high_ns + UTC_WITHIN_NS:
            return f"t_utc_ns is {block.t_utc_ns}; this machine's clock says {utc_ns}"
        return ""


def checked_info(info: object) -> DeviceInfo:
    """What `open` returned. Raises BadDriverError if it cannot be used."""
    if not isinstance(info, DeviceInfo):
        raise BadDriverError(f"open returned a {type(info).__name__}, not a DeviceInfo")
    if fault := _info_fault(info):
        raise BadDriverError(f"open returned information that cannot be used: {fault}")
    return info


def checked_drops(drops: object) -> list[Drop]:
    """What `take_drops` returned. Raises BadDriverError if it cannot be used."""
    if not isinstance(drops, list):
        raise BadDriverError(f"take_drops returned a {type(drops).__name__}, not a list")
    if len(drops) > MOST_DROPS:
        raise BadDriverError(f"take_drops returned {len(drops)} drops, more than {MOST_DROPS} reasons at a time")
    for drop in drops:
        if not isinstance(drop, Drop) or not isinstance(drop.count, int) or not 0 <= drop.count < 2**63:
            raise BadDriverError(f"take_drops returned {shown(drop)}, not a Drop with a count")
        if drop.unit not in UNITS or not isinstance(drop.reason, str):
            raise BadDriverError(f"take_drops returned {shown(drop)}; its unit must be one of {', '.join(UNITS)}")
    return drops


def words(value: object) -> str:
    """The text of an exception or of another object of a driver, which may be too long, or no Unicode, or not there."""
    try:
        text = str(value)[:TOLD]
    except BaseException as error:  # the driver's own method makes the text
        text = f"{type(value).__name__} without a text ({type(error).__name__})"
    return text.encode("utf-8", "backslashreplace").decode()


def driver_of(sensor: object) -> str:
    """The name of a driver's class with its package, for the person who must look for the fault."""
    return f"{type(sensor).__module__}.{type(sensor).__qualname__}"


def as_driver_fault(error: BaseException) -> str:
    """An exception that a driver raised; a promise that it broke tells itself."""
    return words(error) if isinstance(error, BadDriverError) else f"{type(error).__name__}: {words(error)}"


def shown(value: object) -> str:
    """A value that is wrong, for a message: its beginning, in one line."""
    text = ascii(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def _is_rate(value: Any) -> bool:
    return isinstance(value, float | int) and 0 < value <= FASTEST_HZ


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= LONGEST_TEXT


def _is_unit(value: Any) -> bool:
    return _is_text(value) and bool(value)


def _is_size(value: Any) -> bool:
    return value is None or (isinstance(value, float | int) and 1 / LARGEST <= value <= LARGEST)


def _is_named(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(name, str) for name in value)


def _are_lines(value: Any) -> bool:
    return isinstance(value, tuple | list) and all(isinstance(line, str) for line in value)


_TEXT = f"it must be a text of at most {LONGEST_TEXT} characters"
_SIZE = f"it must be None or a number from {1 / LARGEST:g} to {LARGEST:g}"
# What each field of DeviceInfo must be, and this in words.
_INFO: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
    ("nominal_rate_hz", _is_rate, f"it must be a number above 0 and at most {FASTEST_HZ:g}"),
    ("axes", lambda value: value in (1, 3), "only 1 and 3 are possible"),
    *((name, _is_text, _TEXT) for name in ("driver", "kind", "serial_number")),
    ("unit", _is_unit, _TEXT),
    *((name, _is_size, _SIZE) for name in ("range_mps2", "nominal_sensitivity")),
    ("own_clock", lambda value: isinstance(value, bool), "it must be True or False"),
    ("settings", _is_named, "it must be a dictionary of texts"),
    *((name, _are_lines, "it must be a tuple of texts") for name in ("filters", "filter_settings")),
)


def _info_fault(info: DeviceInfo) -> str:
    """What of the information on a device cannot be used, with the value; "" if all can."""
    for name, good, wanted in _INFO:
        value = getattr(info, name)
        if not good(value):
            return f"{name} is {shown(value)}; {wanted}"
    try:
        size = len(json.dumps(asdict(info), ensure_ascii=False, allow_nan=False).encode())
    except (TypeError, ValueError) as error:
        return f"it cannot be written down: {error}"
    return f"it has {size} bytes; at most {MOST_INFO} are possible" if size > MOST_INFO else ""


def _copy(block: SampleBlock) -> SampleBlock:
    """The block with arrays of its own, and Python's numbers instead of numpy's."""
    fields = {name: getattr(block, name) for name in SampleBlock.__slots__}
    for name, value in fields.items():
        if isinstance(value, np.ndarray):
            fields[name] = np.array(value, order="C")
        elif isinstance(value, np.generic):
            fields[name] = value.item()
    return SampleBlock(**fields)


def _form(value: object) -> str:
    """What stands where an array should be."""
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype} with {value.ndim} dimensions"
    return f"a {type(value).__name__}"
