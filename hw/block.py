"""What a device returns: blocks of indications as they were read, with the arrival time of every burst in them."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

LARGEST = 1e12  # of an indication: no unit needs more, and squares and sums of it stay finite


class BlockFlags(enum.IntFlag):
    """What a reader must know about a block before it uses it."""

    NONE = 0
    SATURATED = 1  # at least one indication is at the end of the range, or spoilt by a neighbour that is
    OVERRUN = 2  # the device lost an unknown number of samples before this block
    GAP = 4  # samples before this block are missing; first_index tells how many
    RESTART = 8  # the time of this block cannot be counted on from the block before: the clock model starts again


@dataclass(frozen=True, slots=True, eq=False)
class SampleBlock:
    """Consecutive samples of one device, about half a second, read in one or more bursts.

    A burst is the result of one read of a FIFO or a port. Only the arrival time of a burst is known; the clock model
    computes the sample times from the arrival times.

    - `burst_t_monotonic_ns` (B,): arrival of each burst, CLOCK_MONOTONIC, ns.
    - `burst_count` (B,): how many samples of this block had been read with burst b; cumulative, the last element is N.
    - `indications`: (N, 3) for a tri-axial device, (N, 1) for a uniaxial one; int32 counts or float64 decimals, not
      scaled.
    - `first_index`: sample i of the block has index `first_index + i` in the device's own count. An index never repeats
      in a run.

    The agent checks each block (hw.promises).
    """

    device: str
    boot_id: str
    t_utc_ns: int  # UTC at the arrival of the last burst
    first_index: int
    nominal_rate_hz: float
    burst_t_monotonic_ns: NDArray[np.int64]
    burst_count: NDArray[np.int32]
    indications: NDArray[np.int32] | NDArray[np.float64]
    flags: BlockFlags = BlockFlags.NONE
    temperature_raw: int | None = None
    temperature_degc: float | None = None

    @property
    def t_monotonic_ns(self) -> int:
        """Arrival of the last burst, CLOCK_MONOTONIC in ns."""
        return int(self.burst_t_monotonic_ns[-1])

    @property
    def n(self) -> int:
        """Number of samples."""
        return int(self.indications.shape[0])


@dataclass(frozen=True, slots=True)
class Drop:
    """Data that a driver read and could not use, for the record of the run."""

    count: int
    unit: Literal["samples", "lines", "bytes"]
    reason: str


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Identity of a device, as read from the device, and its settings."""

    driver: str
    kind: str  # part or protocol, e.g. "ADXL355"
    serial_number: str  # "" where the device has none
    unit: str  # of the indications: "count", "m/s2", "g", "m/s", "mV"
    axes: Literal[1, 3]
    nominal_rate_hz: float
    range_mps2: float | None = None
    nominal_sensitivity: float | None = None  # indications per m/s2, from the data sheet
    settings: dict[str, str] = field(default_factory=dict)  # register contents or port settings, as read back
    # Known filters as set, one after the other, each a line such as "lowpass order=2 corner_hz=31 u_corner_pct=10"
    # (docs/frequency.md, "Known filters"); empty where no data sheet tells them.
    filters: tuple[str, ...] = ()
    filter_settings: tuple[str, ...] = ()  # names of the settings that change nothing but the rate and these filters
    own_clock: bool = False  # the stamps are of played or simulated data, whose time runs faster or slower than here
