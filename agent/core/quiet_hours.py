"""How noisy a reference is at most: by the quietest of its windows in the last hours.

In a window in which a lorry or a train passes, motion of many frequencies looks like white noise of the reference, by
up to a hundred times. The noise itself does not change from one window to the next, so that no window has more of it
than the quietest one shows.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.excitation.detection import least_step
from calib.model import Array
from calib.signal.band import most_noise

HOURS = 24  # with windows: traffic and wind have an hour of rest in a day
HOURS_A_DAY = 24.0


class QuietHours:
    """Of each device and hour, the lowest density (m,) of its windows, in the unit of its values per root Hz."""

    def __init__(self) -> None:
        self._of: dict[str, dict[int, Array]] = {}

    def update(self, device: str, day: float, values: Array, rate_hz: float) -> None:
        """Take the values (n, m) of a window, one sample per row; missing ones are NaN."""
        density = most_noise(values, rate_hz)
        if not (np.isfinite(density) & (density > 0.0)).all():
            return
        # Rounding is noise as well, which a device that rests in one digit does not show.
        density = np.maximum(density, least_step(values) / np.sqrt(12.0) / np.sqrt(0.5 * rate_hz))
        hours, hour = self._of.setdefault(device, {}), int(np.floor(day * HOURS_A_DAY))
        hours[hour] = np.minimum(hours.pop(hour, density), density)  # the newest is the last, also if days begin anew
        while len(hours) > HOURS:
            del hours[next(iter(hours))]

    def most_noise(self, device: str) -> tuple[float, ...]:
        """The lowest density of each channel in the last hours; () where no window told one."""
        hours = self._of.get(device)
        return tuple(np.min(list(hours.values()), axis=0).tolist()) if hours else ()

    def forget(self, device: str) -> None:
        """Another device has this name now."""
        self._of.pop(device, None)

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            device: {"hours": np.array(list(hours)), "density": np.array(list(hours.values()))}
            for device, hours in self._of.items()
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._of = {
            device: dict(zip(own["hours"].tolist(), own["density"], strict=True)) for device, own in state.items()
        }
