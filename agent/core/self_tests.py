"""What the self-test of a sensor shows: the change of each output by it, with its scatter.

Phases without and with the self-test take turns, and begin and end with one without. The difference of each phase with
it from the mean of its two neighbours takes slow motion of the structure out; what is left scatters.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from agent.core.events import SelfTestReport, SelfTestRun
from agent.core.outcome import ResultSource
from calib.model import Array

LONGEST_S = 60.0  # from `begun` to the first block after it: 13 phases of 1.1 s, and the device is opened twice
FEWEST_PAIRS = 2  # for a scatter
UNKNOWN = [float("nan")] * 3


class SelfTestWatch:
    """Until when a sensor sends nothing because it tests itself."""

    def __init__(self) -> None:
        self.until_s = 0.0  # since the run's origin

    def update(self, run: SelfTestRun, now_s: float) -> None:
        """Take an event of the sensor."""
        self.until_s = now_s + LONGEST_S if run.state == "begun" else now_s

    def snapshot(self) -> dict[str, Any]:
        """State for `load`."""
        return {"self_test_until_s": self.until_s}

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave; earlier states have none."""
        self.until_s = state.get("self_test_until_s", 0.0)


def self_test_report(source: ResultSource, run: SelfTestRun, u_supply_pct: float) -> SelfTestReport:
    """The result of a self-test that has ended or did not begin. `u_supply_pct`: of the supply voltage."""
    off, on = np.reshape(run.off_mps2, (-1, 3)), np.reshape(run.on_mps2, (-1, 3))
    done = run.state == "done" and len(on) >= FEWEST_PAIRS and len(off) == len(on) + 1
    response, u = _response(off, on) if done else (np.full(3, np.nan), np.full(3, np.nan))
    return SelfTestReport(
        run_id="", sequence=0, sensor=source.sensor, t_utc_ns=source.t_utc_ns,
        reason="" if done else run.message or "too few phases", response_mps2=response.tolist(),
        u_response_mps2=u.tolist(), u_supply_pct=[u_supply_pct * power for power in run.supply_exponent] or UNKNOWN,
        pairs=len(on) if done else 0, motion_mps2=list(run.motion_mps2) or UNKNOWN,
        temperature_degc=run.temperature_degc, faults=_faults(run, response) if done else [],
    )  # fmt: skip


def _response(off: Array, on: Array) -> tuple[Array, Array]:
    """Response (3,) and its standard uncertainty from N + 1 phases without and N with the self-test.

    d_k = on_k - (off_k + off_(k+1)) / 2. Where phases scatter by s independently, the variance of d_k is 3/2 s^2 and
    its covariance with the next one s^2 / 4. So the sample variance of d has the mean (3/2 - 1/(2 N)) s^2, and the mean
    of d the variance (2 - 1/(2 N)) s^2 / N.
    """
    n = len(on)
    d = on - (off[:-1] + off[1:]) / 2.0
    variance = d.var(axis=0, ddof=1) / (1.5 - 0.5 / n)
    return d.mean(axis=0), np.sqrt((2.0 - 0.5 / n) * variance / n)


def _faults(run: SelfTestRun, response: Array) -> list[str]:
    """What is beyond the limits of the maker."""
    rows = zip("xyz", response.tolist(), run.low_mps2, run.high_mps2, strict=False)
    return [
        f"{axis} changes by {change:.2f} m/s2, the limits are {low:.2f} to {high:.2f} m/s2"
        for axis, change, low, high in rows
        if not low <= change <= high
    ]
