"""What a device yields: blocks of indications as they came, with the arrival of every burst in them."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

LARGEST = 1e12  # of an indication: no unit needs more, and squares and sums of it stay finite


class BlockFlags(enum.IntFlag):
    """What a reader must know about a block before it trusts it."""

    NONE = 0
    SATURATED = 1  # at least one indication at the end of the range
    OVERRUN = 2  # the device lost samples before this block, how many is not known
    GAP = 4  # samples before this block are missing, first_index says how many
    RESTART = 8  # the index does not go on in time from the block before: the clock model starts anew


@dataclass(frozen=True, slots=True, eq=False)
class SampleBlock:
    """Consecutive samples of one device, about half a second, read in one or more bursts.

    A burst is what one read of a FIFO or a port returned; its arrival is all that is known of time (the clock model
    makes sample times of it). `burst_t_monotonic_ns[b]` is the arrival (CLOCK_MONOTONIC, ns) of the burst after which
    `burst_count[b]` samples of this block had been read (cumulative, the last one equals N).
    `indications` is (N, 3) for a tri-axial device, (N, 1) for a uniaxial one: int32 counts or float64 decimals, never
    scaled. Sample i of the block has index `first_index + i` in the device's own count, which never repeats in a run.
    """

    device: str
    boot_id: str
    t_utc_ns: int  # UTC at the last burst's arrival
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
    """What a driver read and could not use, for the record of the run."""

    count: int
    unit: Literal["samples", "lines", "bytes"]
    reason: str


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Who a device is, as read from it, and how it was set."""

    driver: str
    kind: str  # part or protocol, e.g. "ADXL355"
    serial_number: str  # "" where the device has none
    unit: str  # of the indications: "count", "m/s2", "m/s", "mV"
    axes: Literal[1, 3]
    nominal_rate_hz: float
    range_mps2: float | None = None
    nominal_sensitivity: float | None = None  # indications per m/s2, from the data sheet
    settings: dict[str, str] = field(default_factory=dict)  # register dump or port settings, as read back
