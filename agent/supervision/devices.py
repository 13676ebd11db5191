"""What is known of one device's way into the agent: rate, losses, lag, clock, temperature."""

from __future__ import annotations

from collections import deque
from typing import Literal

import msgspec
import numpy as np

from agent.core.events import DeviceChange, Gap
from calib.signal.timing import ClockModel
from hw.block import BlockFlags, SampleBlock

RATE_OVER_BLOCKS = 20  # ten seconds of most devices: what a person calls "now"
CLOCK_FROM_BURSTS = 20  # before, the model gives the nominal rate back (calib.signal.timing)


class ClockQuality(msgspec.Struct, frozen=True, kw_only=True):
    """The device's clock against the gateway's, over the last minute."""

    rate_hz: float
    u_rate_hz: float  # standard uncertainty
    residual_sd_s: float  # of the bursts' arrivals about the model: polling, transport and stalls


class DeviceHealth(msgspec.Struct, frozen=True, kw_only=True):
    """One device since the run began. Counts only grow; what is not known is null."""

    state: Literal["opening", "open", "lost"]
    message: str  # who it is, or why it is lost
    samples: int
    blocks: int
    gaps: int  # times that samples were missing
    missing: int  # samples that are known to be missing there
    overruns: int
    saturated: int  # blocks with an indication at the end of the range
    dropped: dict[str, int]  # by unit: what was read and could not be used
    losses: int  # times the device was lost
    nominal_rate_hz: float | None
    rate_hz: float | None
    lag_s: float | None  # age of the newest sample
    clock: ClockQuality | None
    temperature_degc: float | None


class DeviceWatch:
    """Follows one device by the events of the run. Only `health` costs more than a few microseconds."""

    def __init__(self) -> None:
        self._state: Literal["opening", "open", "lost"] = "opening"
        self._message = ""
        self._samples = self._blocks = self._gaps = self._missing = self._overruns = 0
        self._saturated = self._losses = 0
        self._dropped: dict[str, int] = {}
        self._newest: deque[tuple[int, int]] = deque(maxlen=RATE_OVER_BLOCKS)  # index after the block, arrival in ns
        self._nominal_rate_hz: float | None = None
        self._temperature_degc: float | None = None
        self._clock: ClockModel | None = None
        self._bursts = 0  # in the clock model since it began
        self._origin_ns = 0
        self._opened_ns = 0

    @property
    def tried(self) -> bool:
        """Whether the device was opened, or has said why it cannot be."""
        return self._state != "opening"

    def fault(self, now_ns: int, silent_s: float) -> str:
        """Why the device is not well, without numbers that change; "" where it is."""
        if self._state != "open":
            return f"is lost: {self._message}" if self._state == "lost" else "is not open yet"
        newest_ns = self._newest[-1][1] if self._newest else self._opened_ns
        return f"is silent for more than {silent_s:g} s" if now_ns - newest_ns > silent_s * 1e9 else ""

    def on_block(self, block: SampleBlock) -> None:
        """A block went through the pipeline."""
        restarts = bool(block.flags & BlockFlags.RESTART) or self._clock is None
        self._blocks += 1
        self._samples += block.n
        self._overruns += bool(block.flags & BlockFlags.OVERRUN)
        self._saturated += bool(block.flags & BlockFlags.SATURATED)
        if block.flags & BlockFlags.GAP:
            self._gaps += 1
            if not restarts:
                self._missing += max(0, block.first_index - self._newest[-1][0])
        if restarts:
            self._newest.clear()
            self._clock = ClockModel(block.nominal_rate_hz)
            self._bursts, self._origin_ns = 0, int(block.burst_t_monotonic_ns[0])
        assert self._clock is not None
        arrivals_s = (block.burst_t_monotonic_ns - self._origin_ns) * 1e-9
        self._clock.update(block.first_index + block.burst_count.astype(np.int64) - 1, arrivals_s)
        self._bursts += len(arrivals_s)
        self._newest.append((block.first_index + block.n, block.t_monotonic_ns))
        self._nominal_rate_hz = block.nominal_rate_hz
        if block.temperature_degc is not None:
            self._temperature_degc = block.temperature_degc

    def on_change(self, change: DeviceChange) -> None:
        """The device was opened or lost."""
        self._losses += change.state == "lost"
        self._state, self._message = change.state, change.message
        self._opened_ns = change.t_monotonic_ns
        self._newest.clear()
        self._clock = None

    def on_gap(self, gap: Gap) -> None:
        """Something was dropped on the way."""
        self._dropped[gap.unit] = self._dropped.get(gap.unit, 0) + gap.dropped

    def health(self, now_ns: int) -> DeviceHealth:
        """As it is at `now_ns` (CLOCK_MONOTONIC); fits the clock, some milliseconds."""
        return DeviceHealth(
            state=self._state,
            message=self._message,
            samples=self._samples,
            blocks=self._blocks,
            gaps=self._gaps,
            missing=self._missing,
            overruns=self._overruns,
            saturated=self._saturated,
            dropped=dict(self._dropped),
            losses=self._losses,
            nominal_rate_hz=self._nominal_rate_hz,
            rate_hz=self._rate_hz(),
            lag_s=(now_ns - self._newest[-1][1]) * 1e-9 if self._newest else None,
            clock=self._clock_quality(),
            temperature_degc=self._temperature_degc,
        )

    def _rate_hz(self) -> float | None:
        if len(self._newest) < 2 or (elapsed_ns := self._newest[-1][1] - self._newest[0][1]) <= 0:
            return None
        return (self._newest[-1][0] - self._newest[0][0]) * 1e9 / elapsed_ns

    def _clock_quality(self) -> ClockQuality | None:
        if self._clock is None or self._bursts < CLOCK_FROM_BURSTS:
            return None
        try:
            with np.errstate(all="ignore"):
                fit = self._clock.result()
                figures = (fit.rate_hz, fit.u_rate_hz, float(self._clock.lateness_s(fit).std()))
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(figures).all():
            return None  # of a count that jumps at will no arrivals make a clock
        return ClockQuality(rate_hz=figures[0], u_rate_hz=figures[1], residual_sd_s=figures[2])
