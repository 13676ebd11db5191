"""S and Q of a sensor without a reference between two visits, for samples of recordings.

A visit, a bench or a certificate gives a calibration that holds on its date. Between two of them S and Q are a random
walk with known ends: its mean is on the line between both. Where the other sensors of the site have told a step in
between (its axes and date), the sensitivities of these axes change at this date instead.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.config import Channel
from agent.core.events import CalibrationUpdate
from agent.core.watched import walked
from agent.export.smoothing import NUMBER, date_of
from agent.site_watch.suspicion import Suspicion
from calib.model import Array

EQUATION = (
    "a = S(t)^-1 (V - Q(t)) in m/s2; each calibration holds on its date, and between two of them S and Q are on the "
    "line between their values"
)
GRID = 101  # times between two visits at which U is looked for
MAIN = [0, 4, 8]


def at_temperature(calibration: CalibrationUpdate, degc: float | None) -> tuple[Array, Array]:
    """S (3, 3) and Q (3,) at this temperature, which is only known where the device tells it."""
    S, Q = np.array(calibration.sensitivity), np.array(calibration.offset)
    if degc is not None and np.isfinite(calibration.reference_temperature_degc):
        above = degc - calibration.reference_temperature_degc
        for k, coefficient in enumerate(calibration.offset_temperature, start=1):
            Q = Q + np.array(coefficient) * above**k
        if calibration.sensitivity_per_k:
            S = S + np.array(calibration.sensitivity_per_k) * above
        if calibration.sensitivity_temperature:  # of an engine before 13
            S = S * (1.0 + np.array(calibration.sensitivity_temperature) * above)[:, None]
    return S, Q


def acceleration_of(S: Array, Q: Array, values: Array) -> Array | None:
    """a = S^-1 (V - Q) in m/s2; None where S has no inverse."""
    try:
        return np.asarray(np.linalg.solve(S, (values - Q).T).T)
    except np.linalg.LinAlgError:
        return None


@dataclass(frozen=True, slots=True)
class BetweenVisits:
    """The calibrations of a watched sensor, by date, each once. `channel`: how fast S and Q wander; `step`: what the
    site has told of the sensor, None where it has told nothing."""

    channel: Channel
    calibrations: Sequence[CalibrationUpdate]
    step: Suspicion | None = None

    def acceleration(self, device: str, values: Array, t_utc_ns: int, degc: float | None) -> tuple[Array | None, str]:
        """As Smoothed.acceleration. After the last visit its calibration is used."""
        k = sum(one.date_utc_ns <= t_utc_ns for one in self.calibrations) - 1
        if k < 0:
            return None, f"they are before the first calibration ({date_of(self.calibrations[0].date_utc_ns)})"
        ends = self.calibrations[k : k + 2]
        if strange := next((one for one in ends if _device_name(one.identity) != _device_name(device)), None):
            return None, f"the calibration of {date_of(strange.date_utc_ns)} is of {strange.identity}, they of {device}"
        S, Q = at_temperature(ends[0], degc)
        if len(ends) == 2:
            later_S, later_Q = at_temperature(ends[1], degc)
            weight = self._weight(ends[0], ends[1], t_utc_ns)
            S, Q = S + weight[:9].reshape(3, 3) * (later_S - S), Q + weight[9:] * (later_Q - Q)
        a = acceleration_of(S, Q, values)
        return a, "" if a is not None else "S has no inverse"

    def standard_uncertainty(self, t_utc_ns: int) -> Array:
        """(12,) of S row by row and Q at a time from the first calibration on.

        (1 - w) u1^2 + w u2^2 is at least what the mean with weight w has, whatever both visits share (their reference);
        then the walk between both ends; and of a step w (1 - w) times its square, since its date is not known exactly.
        """
        k = sum(one.date_utc_ns <= t_utc_ns for one in self.calibrations) - 1
        first, *later = self.calibrations[k : k + 2]
        since = walked(self.channel, first, t_utc_ns)
        variance = np.square(first.standard_uncertainty)
        if not later:
            return np.asarray(np.sqrt(variance + since))
        w = self._weight(first, later[0], t_utc_ns)
        until = walked(self.channel, first, first.date_utc_ns + later[0].date_utc_ns - t_utc_ns)
        variance = (1.0 - w) * variance + w * np.square(later[0].standard_uncertainty)
        variance += np.where(
            since + until > 0.0, since * until / np.where(since + until > 0.0, since + until, 1.0), 0.0
        )
        moved = np.append(np.ravel(later[0].sensitivity) - np.ravel(first.sensitivity), np.zeros(3))
        stepped = self._stepped(first, later[0])
        return np.asarray(np.sqrt(variance + np.where(stepped, w * (1.0 - w) * moved**2, 0.0)))

    @property
    def head(self) -> dict[str, str]:
        """What a file says of it."""
        found = {"correction": EQUATION, "calibration": NUMBER}
        for one in self.calibrations:
            U = _percent(one, np.array(one.standard_uncertainty))
            found[f"calibration of {date_of(one.date_utc_ns)}"] = f"number {one.made[1]} of run {one.made[0]}, U {U}"
        for first, later in zip(self.calibrations[:-1], self.calibrations[1:], strict=True):
            times = np.linspace(first.date_utc_ns, later.date_utc_ns - 1, GRID).astype(np.int64).tolist()
            most = np.max([self.standard_uncertainty(t) for t in times], axis=0)
            found[f"between {date_of(first.date_utc_ns)} and {date_of(later.date_utc_ns)}"] = (
                f"{self._course(first, later)}, U {_percent(later, most)} at most"
            )
        return found

    def _course(self, first: CalibrationUpdate, later: CalibrationUpdate) -> str:
        if self.step is None or not self._stepped(first, later).any():
            return "on a line"
        what = f"turn about {self.step.axes}" if self.step.turn else f"sensitivity of {self.step.axes}"
        return f"a step of the {what} between {self.step.earliest} and {self.step.latest}, the rest on a line"

    def _weight(self, first: CalibrationUpdate, later: CalibrationUpdate, t_utc_ns: int) -> Array:
        """(12,) weight of the later calibration for S row by row, and Q."""
        weight = np.full(12, (t_utc_ns - first.date_utc_ns) / (later.date_utc_ns - first.date_utc_ns))
        if self.step is not None:
            begin, end = self.step.span_utc_ns
            begin, end = max(begin, first.date_utc_ns), min(end, later.date_utc_ns)
            came = float(np.clip((t_utc_ns - begin) / max(end - begin, 1), 0.0, 1.0))
            weight[self._stepped(first, later)] = came
        return weight

    def _stepped(self, first: CalibrationUpdate, later: CalibrationUpdate) -> NDArray[np.bool_]:
        """(12,) which of S row by row and Q change at the step, if it came between both."""
        stepped = np.zeros((4, 3), dtype=bool)
        if self.step is None:
            return stepped.ravel()
        begin, end = self.step.span_utc_ns
        if begin < later.date_utc_ns and end > first.date_utc_ns:
            stepped[:3] = self.step.directions
        return stepped.ravel()


def between_visits(channel: Channel, updates: Iterable[CalibrationUpdate], step: Suspicion | None) -> BetweenVisits:
    """From all results that tell a calibration in force; the first of each is used, in which U has grown least."""
    once: dict[tuple[str, int], CalibrationUpdate] = {}
    for update in updates:
        known = once.setdefault(update.made, update)
        if update.t_utc_ns < known.t_utc_ns:
            once[update.made] = update
    by_date: Mapping[int, CalibrationUpdate] = {one.date_utc_ns: one for one in once.values()}
    return BetweenVisits(channel, [by_date[date] for date in sorted(by_date)], step)


def _device_name(identity: str) -> str:
    """Kind and serial number of an identity, without the digest of its settings."""
    return identity.rpartition(" ")[0]


def _percent(calibration: CalibrationUpdate, u: Array) -> str:
    """U of the main sensitivities of a calibration, by their standard uncertainties."""
    S = np.ravel(calibration.sensitivity)[MAIN]
    U = 100.0 * calibration.coverage_factor * u[MAIN] / np.where(S != 0.0, np.abs(S), np.nan)
    return ", ".join(f"{value:.2g} %" for value in U.tolist())
