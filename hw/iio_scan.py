"""Scans in the buffers of Linux industrial I/O: their layout and the meaning of their bytes. Pure functions, no files.

Source: Linux, Documentation/ABI/testing/sysfs-bus-iio (scan_elements: `[be|le]:[s|u]bits/storagebitsXrepeat>>shift`).
The elements stand in ascending order of their index. Each element is aligned to its own size, the scan to the size of
its largest element.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.sensor import ConfigurationError

_TYPE = re.compile(r"(be|le):([su])(\d{1,2})/(8|16|32|64)>>(\d{1,2})", re.ASCII)


@dataclass(frozen=True, slots=True)
class Element:
    """One number of a scan."""

    index: int
    order: str
    signed: bool
    bits: int
    storage_bits: int
    shift: int

    @classmethod
    def parse(cls, index: int, text: str) -> Element:
        """Read the contents of the files `*_index` and `*_type`.

        Raises ConfigurationError if `text` is not a type, or is a type of several numbers.
        """
        found = _TYPE.fullmatch(text)
        bits, storage_bits, shift = map(int, found.groups()[2:]) if found else (0, 0, 0)
        if found is None or not 0 < bits <= storage_bits - shift:
            raise ConfigurationError(f"{text!r} is not the type of a scan element with one number")
        return cls(index, found[1], found[2] == "s", bits, storage_bits, shift)

    @property
    def dtype(self) -> str:
        """Type of the element in memory."""
        return f"{'<' if self.order == 'le' else '>'}{'i' if self.signed else 'u'}{self.storage_bits // 8}"

    def value(self, stored: NDArray[np.generic]) -> NDArray[np.int64]:
        """The numbers (n,) from the stored words (n,): shifted, reduced to their bits, with sign."""
        numbers = stored.astype(np.int64) >> self.shift
        if self.bits >= 64:
            return numbers
        numbers &= (1 << self.bits) - 1
        return numbers - ((numbers >> (self.bits - 1)) << self.bits) if self.signed else numbers


def layout(elements: Mapping[str, Element]) -> np.dtype[np.void]:
    """Layout of a scan of these elements in memory."""
    names = sorted(elements, key=lambda name: elements[name].index)
    offsets, end = [], 0
    for name in names:
        size = elements[name].storage_bits // 8
        offsets.append(-(-end // size) * size)
        end = offsets[-1] + size
    widest = max(elements[name].storage_bits // 8 for name in names)
    formats = [elements[name].dtype for name in names]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": -(-end // widest) * widest})


def missing(stamps_ns: NDArray[np.int64], before_ns: int | None, rate_hz: float) -> NDArray[np.int64]:
    """Number of samples missing before each stamp (n,); `before_ns` is the stamp before the first one, or None.

    A step of up to 1.7 sample periods counts as one period.
    """
    first = stamps_ns[:1] - round(1e9 / rate_hz) if before_ns is None else np.array([before_ns])
    steps = np.diff(np.concatenate([first, stamps_ns])) * 1e-9 * rate_hz
    return np.where(steps > 1.7, np.round(steps) - 1, 0).astype(np.int64)
