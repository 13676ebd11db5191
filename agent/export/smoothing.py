"""S and Q smoothed over the past, for samples of recordings: a = S(t)^-1 (V - Q(t))."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from agent.core.kept import device_and_time
from agent.core.memory import Memory
from agent.core.past import KnownPast, PastError, past_of
from agent.engine import identity
from calib.model import Array

EQUATION = (
    "a = S(t)^-1 (V - Q(t)) in m/s2; between two epochs S and Q are on the line between their values, and held up to "
    "an hour before the first one and after the last one"
)
NUMBER = (
    "number of the calibration that was in force then, that of the result by which it came into force first; 0: none"
)


@dataclass(frozen=True, slots=True)
class Smoothed:
    """The pasts of the devices that were used under one sensor name, by device. `unknown`: why another has none."""

    by_device: Mapping[str, KnownPast]
    unknown: Mapping[str, str]

    def acceleration(self, device: str, values: Array, t_utc_ns: int, degc: float | None) -> tuple[Array | None, str]:
        """Accelerations (n, 3) in m/s2 of indications (n, 3) of a device at a time; or None, and why there are none."""
        known = self.by_device.get(device)
        if known is None:
            return None, self.unknown.get(device, f"no state is kept of the device {device or 'that is not named'}")
        day = known.day_of(t_utc_ns)
        if not known.past.knows(day):
            first, last = (date_of(known.utc_ns(of)) for of in (known.past.begin, float(known.past.days[-1])))
            return None, (
                f"they are more than an hour before the first window ({first}) or after the last one ({last}); with "
                "--data-dir later windows count too, and without --corrected one calibration is used for all"
            )
        calibration = known.past.at(day).at(np.nan if degc is None else degc)
        try:
            return np.asarray(np.linalg.solve(calibration.sensitivity, (values - calibration.offset).T).T), ""
        except np.linalg.LinAlgError:
            return None, "S has no inverse"

    @property
    def head(self) -> dict[str, str]:
        """What a file says of it."""
        found = {"correction": EQUATION, "calibration": NUMBER}
        return found | {f"smoothing of {known.identity}": smoothing(known) for known in self.by_device.values()}


def smoothed(memories: Iterable[Memory], sensor: str) -> Smoothed:
    """The pasts of all devices of a sensor, from its kept states."""
    by_device, unknown = dict[str, KnownPast](), dict[str, str]()
    for memory in memories:
        if memory.sensor == sensor:
            try:
                known = past_of(memory)
                by_device[known.device] = known
            except PastError as error:
                unknown[device_and_time(memory.state)[0]] = f"{memory.identity}: {error}"
    return Smoothed(by_device, unknown)


def smoothing(known: KnownPast) -> str:
    """What identifies a smoothing: the engine, the windows and the state."""
    last = date_of(known.last_window_utc_ns)
    return f"engine {identity.name()}, {known.windows} windows to {last}, state sha256 {known.sha256}"


def date_of(t_utc_ns: int) -> str:
    """UTC, to a second."""
    return dt.datetime.fromtimestamp(t_utc_ns // 10**9, dt.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
