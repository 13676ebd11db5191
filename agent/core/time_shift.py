"""A shift in time between a sensor and its reference: the search for the new lag, and what is told of it.

After some windows the state knows the lag well. When the time stamps of one device then shift, every window contradicts
the state, and its equations, which are of second order in the change of the lag, cannot lead to the new lag. So the lag
is searched anew in all the range that is stated for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from agent.config import Channel
from agent.core.gate import Limit
from agent.core.windows import Found
from calib.estimate.lag_search import starts, without_lag
from calib.estimate.nuisances import Priors
from calib.estimate.record import Record
from calib.estimate.state import State
from calib.model import Window

FOUND_WITHIN_U = 4.0  # stated standard uncertainties; one sound lag in 16,000 is beyond
# Beyond that range, a lag is looked for only to tell the operator: as far again, and at least as far as this.
LOOKED_WITHIN_S = 0.1
TOLD_FROM_U = 4.0  # a change of the lag by so many of its standard uncertainties is told


@dataclass(frozen=True, slots=True, eq=False)
class Anew:
    """The result of a search: the windows from which `lag_s` was taken out, and the state `base` that can take them.

    `shifted`: the state explains the windows only with its lag set free. `beyond`: the reason why the windows must not
    be taken although this lag explains them; otherwise "".
    """

    found: Found
    lag_s: float
    base: State
    shifted: bool
    beyond: str = ""


@dataclass(slots=True)
class Line:
    """The lag may have changed and no window was taken since: the lag in s before, its u, and the devices concerned."""

    before_s: float
    u_before_s: float
    devices: list[str]

    def told(self, lag_s: float, u_lag_s: float, sensor: str, reference: str) -> str:
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
    """Watches the lag of one channel: searches it anew, sets it free after a restart, and tells when it has shifted."""

    def __init__(self, channel: Channel, limit: Limit) -> None:
        self._channel, self._limit = channel, limit
        self._priors = channel.priors(fixed_mount=channel.fixed_mount)
        self._line: Line | None = None
        self._unexplained = 0  # pieces in a row that contradict the state at every lag that was tried
        self.beyond = ""  # why the lag that explains the newest pieces must not be used

    def search(
        self, state: State, make: Callable[[float], Found], contradicting: Sequence[Window], day: float
    ) -> Anew | None:
        """See `search`. It costs as much as some ten windows: if it fails, it is made again only for the contradicting
        pieces number 1, 2, 4, 8 and so on since the last window that was taken."""
        self._unexplained += 1
        if self._unexplained & (self._unexplained - 1):
            return None
        anew = search(state, self._priors, self._limit, make, contradicting, day)
        self.beyond = "" if anew is None else anew.beyond
        return anew

    def began(self, state: State, device: str) -> None:
        """A device or its line began anew: it may be late by another time from now on, as far as stated."""
        if "lag" not in state.names:
            return
        if self._line is None:
            self.shifted(state)
            state.step(state.changes(np.zeros(12), line=True))
        if self._line is not None and device not in self._line.devices:
            self._line.devices.append(device)

    def shifted(self, state: State) -> None:
        """The lag is another now than in `state`."""
        self._line = self._line or Line(*state.quantity("lag"), [])

    def forget(self) -> None:
        """Another reference has a lag of its own."""
        self._line, self._unexplained, self.beyond = None, 0, ""

    def taken(self, state: State) -> str:
        """`state` has taken a window: the news of a shift for the operator, or ""."""
        line = self._line
        self.forget()
        if line is None or self._channel.reference is None:
            return ""
        return line.told(*state.quantity("lag"), self._channel.sensor, self._channel.reference)

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        line = None if self._line is None else asdict(self._line)
        return {"line": line, "unexplained": self._unexplained, "beyond": self.beyond}

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._line = None if state["line"] is None else Line(**state["line"])
        self._unexplained, self.beyond = state["unexplained"], state["beyond"]


def search(
    state: State,
    priors: Priors,
    limit: Limit,
    make: Callable[[float], Found],
    contradicting: Sequence[Window],
    day: float,
) -> Anew | None:
    """Search the lag anew over the range that is stated for it; None if no lag explains the windows.

    `make(lag_s)` makes the windows again with this lag taken out; `contradicting` are those made before.
    """
    loose = state.copy()
    loose.step(loose.changes(np.zeros(12), line=True))
    mean_s, within_s = priors.lag_at_s, FOUND_WITHIN_U * priors.lag_s
    looked_s = max(2.0 * within_s, LOOKED_WITHIN_S)
    stated = starts(mean_s - within_s, mean_s + within_s, contradicting)
    beyond = starts(mean_s - looked_s, mean_s - within_s, contradicting)
    beyond += starts(mean_s + within_s, mean_s + looked_s, contradicting)
    for lags_s in (stated, beyond):
        found, lag_s = _best(loose, make, lags_s, day)
        for base in (state, loose):
            if not _explains(base, found, lag_s, day, limit):
                continue
            shifted = base is loose
            if shifted and not _decisive(state, loose, found, lag_s, day, limit):
                break
            off_s = abs(lag_s - mean_s)
            return Anew(found, lag_s, base, shifted, "" if off_s <= within_s else _too_far(lag_s, mean_s, priors.lag_s))
    return None


def _best(loose: State, make: Callable[[float], Found], lags_s: Sequence[float], day: float) -> tuple[Found, float]:
    """The windows and the lag to which the best of the starts `lags_s` leads."""

    def misfit(lag_s: float) -> tuple[int, float]:
        told = [loose.innovation(s, at_its_lag=True) for s in _records(make(lag_s), day, lag_s, loose)]
        return -len(told), sum(t.statistic for t in told)

    def lag_after(found: Found, lag_s: float) -> float:
        first, *others = _records(found, day, lag_s, loose)
        trial = loose.with_window(first, at_its_lag=True)[1]
        for record in others:
            trial = trial.with_window(record)[1]
        return trial.lag_s

    return without_lag(min(lags_s, key=misfit), make, lambda found: found.used, lag_after)


def _explains(base: State, found: Found, lag_s: float, day: float, limit: Limit) -> bool:
    """Whether the windows, taken one after the other, are all consistent with the state; at least one is used."""
    trial, records = base, _records(found, day, lag_s, base)
    for k, record in enumerate(records):
        told, trial = trial.with_window(record, at_its_lag=k == 0)
        if told.statistic > limit(told.degrees_of_freedom):
            return False
    return bool(records)


def _decisive(state: State, loose: State, found: Found, lag_s: float, day: float, limit: Limit) -> bool:
    """Whether the other lag alone makes the difference: chi-squared falls by more than one unknown does by chance."""
    first = _records(found, day, lag_s, loose)[0]
    tight = state.innovation(first, at_its_lag=True).statistic
    return tight - loose.innovation(first, at_its_lag=True).statistic > limit(1.0)


def _records(found: Found, day: float, lag_s: float, state: State) -> list[Record]:
    told = lag_s, found.temperature_degc, state.reference, state.motion_to_hz
    return [Record.of(window, day, *told) for window in found.used]


def _too_far(lag_s: float, mean_s: float, u_s: float) -> str:
    least_s = np.ceil(1e3 * abs(lag_s - mean_s) / FOUND_WITHIN_U) / 1e3
    return (
        f"a lag of {1e3 * lag_s:.4g} ms explains the window, but the lag is stated as {1e3 * mean_s + 0.0:g} ms with u "
        f"= {1e3 * u_s:g} ms, and {FOUND_WITHIN_U:g} u is the limit. If the time stamps may be so far apart, set "
        f"uncertainty.lag_s to {least_s:g} or more"
    )
