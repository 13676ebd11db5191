"""A shift in time between a sensor and its reference: the search for the new lag, and what is told of it.

After some windows the state knows the lag well. When the time stamps of one device then shift, every window contradicts
the state, and its equations, which are of second order in the change of the lag, cannot lead to the new lag. So the lag
is looked for anew in all the range that is stated for it. How well the outputs fit the motion at any lag follows from
one cross-spectrum; only at a lag at which they fit better than now are windows made again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from agent.config import Channel
from agent.core.gate import Limit
from agent.core.windows import StretchWindows
from calib.estimate.nuisances import Priors
from calib.excitation.front_end import Aligned
from calib.excitation.lag_search import BASIN_RAD, largest_omega, longest_in_time, minima, misfit_by_lag, without_lag
from calib.model import Array, Pose, own_channels
from calib.signal.order_statistics import median
from calib.state.state import State
from calib.windows.record import Record

FOUND_WITHIN_U = 4.0  # stated standard uncertainties; one sound lag in 16,000 is beyond
# Beyond that range, a lag is looked for only to tell the operator: as far again, and at least as far as this.
LOOKED_WITHIN_S = 0.1
NEAR_RAD = 0.05  # of the motion's mean phase: so far the equations of a window are right to 2e-5 of the motion
TOLD_FROM_U = 4.0  # a change of the lag by so many of its standard uncertainties is told


@dataclass(frozen=True, slots=True, eq=False)
class Anew:
    """The result of a search: the windows from which `lag_s` was taken out, and the state `base` that can take them.

    `shifted`: the state explains the windows only with its lag set free. `beyond`: the reason why the windows must not
    be taken although this lag explains them; otherwise "".
    """

    found: StretchWindows
    lag_s: float
    base: State
    shifted: bool
    beyond: str = ""


@dataclass(slots=True)
class LagChange:
    """The lag may have changed and no window was taken since: the lag in s before, its u, and the devices concerned."""

    before_s: float
    u_before_s: float
    devices: list[str]

    def news(self, lag_s: float, u_lag_s: float, sensor: str, reference: str) -> str:
        """The news of the change for the operator; "" if the lag is as before."""
        change_s = lag_s - self.before_s
        if abs(change_s) <= TOLD_FROM_U * float(np.hypot(self.u_before_s, u_lag_s)):
            return ""
        sense = ("later", "earlier") if change_s > 0.0 else ("earlier", "later")
        restarted = f" (restarted: {', '.join(self.devices)})" if self.devices else ""
        return (
            f"the time between {sensor} and {reference} has shifted by {1e3 * change_s:+.3g} ms{restarted}: {sensor} "
            f"is stamped {sense[0]} than before, or {reference} {sense[1]}. The lag was {1e3 * self.before_s:.4g} ms, "
            f"now {1e3 * lag_s:.4g} ms are taken out; S and Q continue as they were"
        )


class LagWatch:
    """Watches the lag of one channel behind the reference at a place: searches it anew, sets it free after a restart,
    and tells when it has shifted."""

    def __init__(self, channel: Channel, place: int, limit: Limit) -> None:
        self._channel, self._place, self._limit = channel, place, limit
        self._priors = channel.priors(fixed_mount=channel.fixed_mount)
        self._line: LagChange | None = None
        self._excluded_s: float | None = None  # the lag at which the newest search failed
        self._unexplained = 0  # pieces since then whose outputs would fit best at that lag
        self.beyond = ""  # why the lag that explains the newest pieces must not be used

    def search(
        self,
        state: State,
        make: Callable[[float], StretchWindows],
        contradicting: StretchWindows,
        lag_s: float,
        pose: Pose,
        samples: Aligned,
        day: float,
    ) -> Anew | None:
        """See `search`; the lags that it tries are those of `likelier`.

        `contradicting` are the windows made before, from `samples` in this pose, with `lag_s` taken out. A search makes
        windows again, up to four times for each lag. A lag at which it failed is tried again only for the contradicting
        pieces number 2, 4, 8 and so on at this lag since the last window that was taken.
        """
        lags_s = likelier(state, self._priors, self._limit, pose, samples, lag_s)
        if not lags_s:
            self.beyond = ""
            return None
        near_s = BASIN_RAD / max(largest_omega(contradicting.windows), np.finfo(float).tiny)
        if self._excluded_s is None or abs(lags_s[0] - self._excluded_s) > near_s:
            self._excluded_s, self._unexplained = lags_s[0], 0
        self._unexplained += 1
        if self._unexplained & (self._unexplained - 1):
            return None
        anew = search(state, self._place, self._priors, self._limit, make, contradicting, lag_s, lags_s, day)
        self.beyond = "" if anew is None else anew.beyond
        return anew

    def part_in_time(self, state: State, pose: Pose, samples: Aligned, lag_s: float) -> tuple[float, float] | None:
        """The longest part of the samples, made with `lag_s` taken out, that has this lag, from one time in s to
        another; None where all of it has, or none."""
        mean_s, _, looked_s = _ranges(self._priors)
        least_fall = self._limit(1.0) / samples.independent
        furthest_s = looked_s + abs(lag_s - mean_s)
        expected = _expected(state, pose, samples)
        return longest_in_time(samples.points.V, expected, samples.points.time_s, furthest_s, least_fall)

    def began(self, state: State, device: str) -> None:
        """A device or its line began anew: it may be late by another time from now on, as far as stated."""
        if "lag" not in state.names(self._place):
            return
        if self._line is None:
            self.shifted(state)
            state.step(state.changes(np.zeros(12), place=self._place, line=True))
        if self._line is not None and device not in self._line.devices:
            self._line.devices.append(device)

    def shifted(self, state: State) -> None:
        """The lag is another now than in `state`."""
        self._line = self._line or LagChange(*state.quantity("lag", self._place), [])

    def forget(self) -> None:
        """Another reference has a lag of its own."""
        self._line, self._excluded_s, self._unexplained, self.beyond = None, None, 0, ""

    def taken(self, state: State) -> str:
        """`state` has taken a window: the news of a shift for the operator, or ""."""
        line = self._line
        self.forget()
        if line is None or self._channel.reference is None:
            return ""
        lag = state.quantity("lag", self._place)
        return line.news(*lag, self._channel.sensor, self._channel.reference)

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        line = None if self._line is None else asdict(self._line)
        return {
            "line": line, "excluded_s": self._excluded_s, "unexplained": self._unexplained, "beyond": self.beyond,
        }  # fmt: skip

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._line = None if state["line"] is None else LagChange(**state["line"])
        self._excluded_s, self._unexplained = state["excluded_s"], state["unexplained"]
        self.beyond = state["beyond"]


def likelier(state: State, priors: Priors, limit: Limit, pose: Pose, samples: Aligned, taken_s: float) -> list[float]:
    """The lags in s that may explain samples in this pose that contradict the state; none where no other lag brings
    outputs and motion together better than `taken_s`, by more than chance: then the contradiction is no lag.

    `samples` were made with `taken_s` taken out. First comes the likeliest lag within what is stated, then, if it is
    likelier, the likeliest one of those that are looked at beyond, to tell the operator.
    """
    V, time_s, expected = samples.points.V, samples.points.time_s, _expected(state, pose, samples)
    rate_hz = 1.0 / float(median(np.diff(time_s)))
    sample = np.rint((time_s - time_s[0]) * rate_hz).astype(np.int64)
    mean_s, within_s, looked_s = _ranges(priors)
    lags_s, misfit = misfit_by_lag(V, expected, sample, rate_hz, looked_s + abs(taken_s - mean_s))
    at_s, depth = minima(taken_s + lags_s, misfit)
    found, least, off_s = list[float](), float(misfit[len(misfit) // 2]), np.abs(at_s - mean_s)
    for low_s, high_s in ((-1.0, within_s), (within_s, looked_s)):
        likeliest = np.flatnonzero((off_s > low_s) & (off_s <= high_s))[:1]
        if len(likeliest) and depth[likeliest[0]] < least - limit(1.0) / samples.independent:
            found.append(float(at_s[likeliest[0]]))
            least = float(depth[likeliest[0]])
    return found


def _expected(state: State, pose: Pose, samples: Aligned) -> Array:
    """(n, 3) what the state expects of the outputs in this pose, but for a constant."""
    u = samples.points.u
    return np.asarray(u[:, : own_channels(u.shape[1])] @ (state.result().sensitivity @ pose.direction).T)


def search(
    state: State,
    place: int,
    priors: Priors,
    limit: Limit,
    make: Callable[[float], StretchWindows],
    contradicting: StretchWindows,
    taken_s: float,
    lags_s: Sequence[float],
    day: float,
) -> Anew | None:
    """Search the lag behind the reference at a place anew from `lags_s` on, one after the other; None if no lag
    explains the windows.

    `make(lag_s)` makes the windows again with this lag taken out; `contradicting` are those with `taken_s` taken out.
    Of a lag near `taken_s` they tell themselves that it does not explain them.
    """
    loose = state.copy()
    loose.step(loose.changes(np.zeros(12), place=place, line=True))
    mean_s, within_s, _ = _ranges(priors)

    def with_records(found: StretchWindows, lag_s: float) -> tuple[StretchWindows, list[Record]]:
        told = lag_s, found.temperature_degc, state.reference(place), state.motion_to_hz
        return found, [Record.of(window, day, *told) for window in found.used]

    def made(lag_s: float) -> tuple[StretchWindows, list[Record]]:
        return with_records(make(lag_s), lag_s)

    def lag_after(made: tuple[StretchWindows, list[Record]], _: float) -> float:
        return loose.lag_with(max(made[1], key=lambda record: record.count), place)

    before = with_records(contradicting, taken_s)[1]
    near_s = NEAR_RAD / max(largest_omega(contradicting.windows), np.finfo(float).tiny)
    for start_s in lags_s:
        if before and abs(start_s - taken_s) <= near_s and not _explains(loose, before, limit):
            continue
        (found, records), lag_s = without_lag(start_s, made, lambda made: made[0].used, lag_after)
        for base in (state, loose):
            if not _explains(base, records, limit):
                continue
            shifted = base is loose
            if shifted and not _decisive(state, loose, records[0], limit):
                break
            off_s = abs(lag_s - mean_s)
            return Anew(found, lag_s, base, shifted, "" if off_s <= within_s else _too_far(lag_s, mean_s, priors.lag_s))
    return None


def _ranges(priors: Priors) -> tuple[float, float, float]:
    """The lag as stated, how far from it a lag may be, and how far from it one is looked for, in s."""
    within_s = FOUND_WITHIN_U * priors.lag_s
    return priors.lag_at_s, within_s, max(2.0 * within_s, LOOKED_WITHIN_S)


def _explains(base: State, records: Sequence[Record], limit: Limit) -> bool:
    """Whether the windows, taken one after the other, are all consistent with the state; at least one is used."""
    trial = base
    for k, record in enumerate(records):
        told = trial.innovation(record, at_its_lag=k == 0)
        if told.statistic > limit(told.degrees_of_freedom):
            return False
        if k + 1 < len(records):
            trial = trial.with_window(record, at_its_lag=k == 0)[1]
    return bool(records)


def _decisive(state: State, loose: State, first: Record, limit: Limit) -> bool:
    """Whether the other lag alone makes the difference: chi-squared falls by more than one unknown does by chance."""
    tight = state.innovation(first, at_its_lag=True).statistic
    return tight - loose.innovation(first, at_its_lag=True).statistic > limit(1.0)


def _too_far(lag_s: float, mean_s: float, u_s: float) -> str:
    least_s = np.ceil(1e3 * abs(lag_s - mean_s) / FOUND_WITHIN_U) / 1e3
    return (
        f"a lag of {1e3 * lag_s:.4g} ms explains the window, but the lag is stated as {1e3 * mean_s + 0.0:g} ms with u "
        f"= {1e3 * u_s:g} ms, and {FOUND_WITHIN_U:g} u is the limit. If the time stamps may be so far apart, set "
        f"uncertainty.lag_s to {least_s:g} or more"
    )
