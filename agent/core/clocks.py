"""How the clocks of the devices of a channel run: one result for each device in each minute of the run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from agent.core.estimation import Estimation
from agent.core.events import ClockReport, Result
from agent.core.outcome import ResultSource
from agent.core.stream import DeviceStream
from calib.model import Array
from calib.signal.order_statistics import median
from calib.signal.timing import ClockFit

EVERY_S = 60.0
MAD_TO_SD = 1.4826  # of a normal distribution
MEDIAN_TO_MEAN = np.sqrt(np.pi / 2)  # standard uncertainty of a median over that of a mean, normal distribution
UNKNOWN = (float("nan"), float("nan"))


class Clocks:
    """Reports the clocks of one channel, once a minute."""

    def __init__(self) -> None:
        # Time of the next report in s since the run's origin. None: the version of the program that began the run had
        # no clock results.
        self._due_s: float | None = EVERY_S

    def reports(
        self, source: ResultSource, now_s: float, streams: Mapping[str, DeviceStream], estimation: Estimation | None
    ) -> list[Result]:
        """At the first event of each minute since the run's origin: a report of each device that sent data
        since the last report.

        `streams` are those of the sensor and of its reference, by name. The sensor's report comes last: a consumer that
        asks for the newest one gets it.
        """
        if self._due_s is None or now_s < self._due_s:
            return []
        since_s = self._due_s - EVERY_S
        self._due_s = (now_s // EVERY_S + 1.0) * EVERY_S
        lag = UNKNOWN if len(streams) == 1 else _lag(estimation)
        found: list[Result] = []
        for name in sorted(streams, key=lambda name: name == source.sensor):
            newest_s, nominal_rate_hz = streams[name].newest_arrival_s, streams[name].nominal_rate_hz
            if newest_s is None or newest_s < since_s or nominal_rate_hz is None:
                continue  # silent, or another device is there now, and has sent nothing yet
            if (known := streams[name].clock()) is None:
                continue  # sample numbers that jump at will make no clock, and there is nothing to report
            lag_s = lag if name == source.sensor else UNKNOWN
            found.append(_report(source, name, nominal_rate_hz, *known, lag_s))
        return found

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {} if self._due_s is None else {"clock_due_s": self._due_s}

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave. If the state is of a run without clock results, no reports follow."""
        self._due_s = state.get("clock_due_s")


def _lag(estimation: Estimation | None) -> tuple[float, float]:
    if estimation is None or "lag" not in estimation.state.names():
        return UNKNOWN
    return estimation.state.quantity("lag")


def _report(
    source: ResultSource,
    device: str,
    nominal_rate_hz: float,
    clock: ClockFit,
    lateness_s: Array,
    lag_s: tuple[float, float],
) -> ClockReport:
    """`lateness_s` (B,) of the bursts behind the clock; `lag_s` is the value and its standard uncertainty."""
    offset_s = float(median(lateness_s))
    jitter_s = MAD_TO_SD * float(median(np.abs(lateness_s - offset_s)))
    u_median_s = MEDIAN_TO_MEAN * jitter_s / np.sqrt(len(lateness_s))
    return ClockReport(
        run_id="", sequence=0, sensor=source.sensor, t_utc_ns=source.t_utc_ns,
        device=device, role="sensor" if device == source.sensor else "reference",
        nominal_rate_hz=nominal_rate_hz, rate_hz=clock.rate_hz, u_rate_hz=clock.u_rate_hz,
        offset_s=offset_s, u_offset_s=float(np.hypot(clock.u_offset_s, u_median_s)), jitter_s=jitter_s,
        lag_s=lag_s[0], u_lag_s=lag_s[1], arrivals=len(lateness_s),
    )  # fmt: skip
