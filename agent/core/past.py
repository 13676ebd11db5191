"""S(t), Q(t) and U(t) of a sensor's past, and what makes U now, from its kept state."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.config import Channel
from agent.core.driver_filters import DriverFilters
from agent.core.estimation import DAY_S, Estimation
from agent.core.events import CalibrationUpdate
from agent.core.kept import MALFORMED, update_of
from agent.core.memory import Memory
from agent.core.snapshot import pack, unpack
from calib.state.dating import Date
from calib.state.past import Past
from calib.state.sources import Sources


class PastError(ValueError):
    """The past does not follow from a kept state. The message says why, and what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownPast:
    """The past of a sensor by all windows of its kept state.

    `identity`: of the device with its settings, `device`: without those of its filters. `sha256`: of the state from
    which it follows. `unit`: of the output, "" where no calibration is in force. S holds at `reference_frequency_hz`.
    `day` is the day of the state at `t_utc_ns`.
    """

    sensor: str
    identity: str
    device: str
    unit: str
    past: Past
    sha256: str
    reference_frequency_hz: float
    day: float
    t_utc_ns: int

    def utc_ns(self, day: float) -> int:
        """UTC of a day of the past, by the clock of the gateway when the state was kept."""
        return self.t_utc_ns - round((self.day - day) * DAY_S * 1e9)

    def day_of(self, t_utc_ns: int) -> float:
        """The day of the past at a time."""
        return self.day - (self.t_utc_ns - t_utc_ns) * 1e-9 / DAY_S

    @property
    def windows(self) -> int:
        """How many windows it follows from."""
        return sum(self.past.windows)

    @property
    def last_window_utc_ns(self) -> int:
        """When the newest one was taken."""
        return self.utc_ns(max(day for day, taken in zip(self.past.days, self.past.windows, strict=True) if taken))


def past_of(memory: Memory) -> KnownPast:
    """The past by all windows of a kept state. Raises PastError where it has none."""
    state, estimation = _taken_up(memory)
    if not estimation.state.windows:
        raise PastError("no window was taken yet; its past begins with the first one")
    try:
        in_force = update_of(state["in_force"])
        unit = "" if in_force is None else in_force.output_unit
        sha256 = hashlib.sha256(pack(state["estimation"]["state"])).hexdigest()
        own, days = estimation.state, (float(state["day"]), int(state["t_utc_ns"]))
        of = memory.sensor, memory.identity, state["device"], unit
        return KnownPast(*of, own.past(), sha256, own.reference_frequency_hz, *days)
    except MALFORMED as error:
        raise _unreadable(error) from None


def dates_of(known: KnownPast) -> list[Date]:
    """When the changes of a past came, in their order. Raises PastError."""
    try:
        return [change.dated() for change in known.past.changes]
    except MALFORMED as error:
        raise _unreadable(error) from None


def budget_in_force(update: CalibrationUpdate, memories: Iterable[Memory]) -> Sources:
    """What makes U of the calibration in force: as its result says, or by the kept state, which is solved anew.

    Raises PastError where neither tells it.
    """
    if update.budget:
        told = {source: np.array(u) for source, u in update.budget.items()}
        return Sources(told, np.array(update.degrees_of_freedom), update.coverage_factor)
    memory = next((m for m in memories if (m.sensor, m.identity) == (update.sensor, update.identity)), None)
    if memory is None:
        raise PastError("no state of its device is kept")
    state, estimation = _taken_up(memory)
    in_force = update_of(state["in_force"])
    if in_force is None or in_force.made != update.made or not estimation.follows_state():
        raise PastError("S and Q in force are not those of the newest windows")
    return estimation.state.budget()


def _taken_up(memory: Memory) -> tuple[dict[str, Any], Estimation]:
    """The content of a kept state, and its estimation. Raises PastError."""
    try:
        state = unpack(memory.state)
        held = state.get("estimation")
        if not isinstance(held, dict) or held.get("state") is None or "channel" not in state:
            raise PastError(
                "its state is of an earlier version, which kept no windows; the next windows make one that has them"
            )
        filters = DriverFilters(Channel.model_validate_json(state["channel"]))
        filters.load(state["filters"])
        estimation = Estimation(filters.channel, state["nominal"])
        estimation.load(held)
        return state, estimation
    except PastError:
        raise
    except MALFORMED as error:
        raise _unreadable(error) from None


def _unreadable(error: Exception) -> PastError:
    return PastError(f"its state cannot be read: {str(error) or type(error).__name__}".splitlines()[0])
