"""The mean of a sensor without a reference beside what it was when its calibration came into force."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from agent.core.watch import Hour
from calib.drift.mean_change import mean_change
from calib.estimate.correction import Law, between
from calib.model import Array

WEEK, DAY = 168, 24  # hours: in the first ones the mean is learnt; the mean of the newest ones is compared with it
ALIKE = 24  # neighbouring hours count as one: temperature, wind and load last for up to a day
MINUTES = 30  # used in an hour, for its mean to count


class MeanWatch:
    """The hourly means (n, 4) of x, y, z and the temperature: the first WEEK with a calibration, and the newest DAY."""

    def __init__(self) -> None:
        self._of: tuple[str, int] = ("", 0)
        self._first, self._newest = np.zeros((0, 4)), np.zeros((0, 4))

    def update(self, hour: Hour, made: tuple[str, int], law: Law) -> str:
        """Take an hour under the calibration that `made` names; what a change of the mean may be, "" if there is none.

        The scatter of the first hours is that of later ones; `law` says how far the temperature may have moved Q and S.
        """
        if made != self._of:
            self.__init__()  # type: ignore[misc]
            self._of = made
        row = np.append(hour.mean, hour.temperature_degc[0])
        if hour.segments < MINUTES or not np.isfinite(row[:3]).all():
            return ""
        if len(self._first) < WEEK:
            self._first = np.vstack([self._first, row])
            return ""
        self._newest = np.vstack([self._newest, row])[-DAY:]
        if len(self._newest) < DAY:
            return ""
        before, now = self._first.mean(axis=0), self._newest.mean(axis=0)
        covariance: Array = np.cov(self._first[:, :3].T) * ALIKE * (1.0 / WEEK + 1.0 / DAY)
        covariance = covariance + between(law, before[3], now[3], before[:3])
        found = mean_change(now[:3] - before[:3], covariance, before[:3], law.mean[:9].reshape(3, 3))
        return "" if found is None else found.sentence

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {"of": list(self._of), "first": self._first.copy(), "newest": self._newest.copy()}

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        run_id, sequence = state["of"]
        self._of = run_id, sequence
        self._first, self._newest = np.array(state["first"]), np.array(state["newest"])
