"""When a device tests itself: once a day after a stated time of UTC, as soon as little moves."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from math import nan
from typing import Any, Literal, Protocol, TypeVar

import numpy as np

from agent.config.channel import SelfTestPlan
from calib.model import Array
from hw.block import SampleBlock
from hw.self_test import SelfTestingSensor, SelfTestPhase
from hw.units import STANDARD_GRAVITY_MPS2

PAIRS = 6  # of phases without and with the self-test
LOOK_S = 10.0  # of samples that show how much moves
WITHIN = timedelta(hours=1)  # after the stated time, in which a moment with little motion is waited for

T = TypeVar("T")
Answer = Literal["wait", "test", "skip"]


class Caller(Protocol):
    """Calls a method of a driver."""

    def __call__(self, method: Callable[..., T], **arguments: Any) -> T:
        """What the method returns."""


class SelfTesting:
    """Takes the blocks of a device, and says whether its self-test is due.

    `now_utc` tells the time. The first stated time is the next one, so a run that begins anew tests nothing twice.
    """

    def __init__(self, plan: SelfTestPlan, now_utc: Callable[[], datetime] = lambda: datetime.now(UTC)) -> None:
        self._plan = plan
        self._now_utc = now_utc
        self._due = self._next()
        self._seen: list[Array] = []  # samples since it is due, m/s2
        self._looked = False  # whether it was due and too much moved
        self.motion_mps2 = np.full(3, np.nan)  # (3,) standard deviation of the LOOK_S of samples that were seen last

    def update(self, block: SampleBlock, nominal_sensitivity: float) -> Answer:
        """Take a block. "skip" and "test" are said once for each stated time."""
        now = self._now_utc()
        if now < self._due:
            if self._due - now > timedelta(days=1, hours=1):  # the clock was set back
                self._due = self._next()
            return "wait"
        if now >= self._due + WITHIN:
            looked, self._seen, self._looked = self._looked, [], False
            self._due = self._next()
            return "skip" if looked else "wait"  # nothing was seen: no samples came, or the clock was set forward
        self._seen.append(np.asarray(block.indications, dtype=float) / nominal_sensitivity)
        if sum(map(len, self._seen)) < LOOK_S * block.nominal_rate_hz:
            return "wait"
        self.motion_mps2 = np.vstack(self._seen).std(axis=0)
        quiet = bool(self.motion_mps2.max() <= self._plan.most_motion_mps2)
        self._seen, self._looked = [], not quiet
        if not quiet:
            return "wait"
        self._due = self._next()
        return "test"

    @property
    def too_much(self) -> str:
        """Why the self-test was skipped."""
        worst = int(np.argmax(self.motion_mps2))
        return (
            f"skipped: within an hour after {self._plan.at:%H:%M} UTC no {LOOK_S:g} s had less motion than "
            f"most_motion_mps2 {self._plan.most_motion_mps2:g}; last {'xyz'[worst]} had {self.motion_mps2[worst]:.2g}"
        )

    def _next(self) -> datetime:
        now = self._now_utc()
        today = datetime.combine(now.date(), self._plan.at, UTC)
        return today if today > now else today + timedelta(days=1)


def shown_by(sensor: SelfTestingSensor, call: Caller, stopped: Callable[[], bool]) -> dict[str, Any]:
    """What the self-test of an open device shows, as fields of SelfTestRun; nothing where `stopped` says so meanwhile.

    Raises what the driver raises. The device has to be opened again.
    """
    test = call(sensor.begin_self_test)
    phases: list[SelfTestPhase] = []
    for number in range(2 * PAIRS + 1):
        if stopped():
            return {}
        phases.append(call(sensor.self_test_phase, on=number % 2 == 1))
    call(sensor.take_drops)  # nothing that lacks in the phases is a sample
    means = STANDARD_GRAVITY_MPS2 * np.array([phase.mean_g for phase in phases])
    degrees = [phase.temperature_degc for phase in phases if phase.temperature_degc is not None]
    return {
        "off_mps2": means[::2].ravel().tolist(), "on_mps2": means[1::2].ravel().tolist(),
        "low_mps2": [STANDARD_GRAVITY_MPS2 * g for g in test.low_g],
        "high_mps2": [STANDARD_GRAVITY_MPS2 * g for g in test.high_g],
        "supply_exponent": list(test.supply_exponent),
        "temperature_degc": float(np.mean(degrees)) if degrees else nan,
    }  # fmt: skip
