"""The health of one device: rate, lost samples, lag, clock and temperature."""

from __future__ import annotations

from collections import deque
from typing import Literal

import msgspec
import numpy as np

from agent.core.events import DeviceChange, Gap, SelfTestRun
from agent.core.self_tests import LONGEST_S as SELF_TEST_S
from calib.signal.timing import ClockModel
from hw.block import BlockFlags, SampleBlock

RATE_OVER_BLOCKS = 20  # blocks for the present rate; ten seconds of most devices
CLOCK_FROM_BURSTS = 20  # with fewer bursts, the clock model only returns the nominal rate (calib.signal.timing)


class ClockQuality(msgspec.Struct, frozen=True, kw_only=True):
    """The device's clock compared with the gateway's, over the last minute."""

    rate_hz: float
    u_rate_hz: float  # standard uncertainty
    residual_sd_s: float  # standard deviation of the bursts' arrivals about the model: polling, transport and stalls


class DeviceHealth(msgspec.Struct, frozen=True, kw_only=True):
    """One device since the run began. Counts never decrease; unknown values are null."""

    state: Literal["opening", "open", "lost"]
    message: str  # kind and serial number, or why the device is lost
    samples: int
    blocks: int
    gaps: int  # number of gaps in the samples
    missing: int  # samples known to be missing in these gaps
    overruns: int
    saturated: int  # blocks with an indication at the end of the range
    dropped: dict[str, int]  # by unit (lines, blocks, ...): the amount that was read but could not be used
    losses: int  # number of times that the device was lost
    nominal_rate_hz: float | None
    rate_hz: float | None
    lag_s: float | None  # age of the newest sample
    clock: ClockQuality | None
    temperature_degc: float | None


class DeviceWatch:
    """Collects the health of one device from the events of the run. Only `health` takes more than some microseconds."""

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
        self._bursts = 0  # number of bursts in the clock model
        self._origin_ns = 0
        self._opened_ns = 0

    @property
    def tried(self) -> bool:
        """Whether the device was opened, or the attempt failed and gave a reason."""
        return self._state != "opening"

    def fault(self, now_ns: int, silent_s: float) -> str:
        """The device's fault, without numbers that change with time; "" where it has none."""
        if self._state != "open":
            return f"is lost: {self._message}" if self._state == "lost" else "is not open yet"
        newest_ns = self._newest[-1][1] if self._newest else self._opened_ns
        return f"is silent for more than {silent_s:g} s" if now_ns - newest_ns > silent_s * 1e9 else ""

    def on_block(self, block: SampleBlock) -> None:
        """Take a block that the pipeline has processed."""
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
        """Take a DeviceChange: the device was opened or lost."""
        self._losses += change.state == "lost"
        self._state, self._message = change.state, change.message
        self._opened_ns = change.t_monotonic_ns
        self._newest.clear()
        self._clock = None

    def on_self_test(self, run: SelfTestRun) -> None:
        """Take a SelfTestRun: no samples are due until it ends."""
        if run.state == "begun":
            self._opened_ns = run.t_monotonic_ns + round(SELF_TEST_S * 1e9)
            self._newest.clear()

    def on_gap(self, gap: Gap) -> None:
        """Take a Gap: data of the device were dropped."""
        self._dropped[gap.unit] = self._dropped.get(gap.unit, 0) + gap.dropped

    def health(self, now_ns: int) -> DeviceHealth:
        """The health at `now_ns` (CLOCK_MONOTONIC). Takes some milliseconds, since the clock model is fitted."""
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
            return None  # sample counts that jump at random do not give a clock
        return ClockQuality(rate_hz=figures[0], u_rate_hz=figures[1], residual_sd_s=figures[2])
