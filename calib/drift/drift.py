"""Sequential test for drift: whether a parameter has stepped or is drifting, by how much, and since when.

Each window gives a score for each parameter (the normalised innovation, docs/drift.md). The test is a generalised
likelihood ratio over all onsets (calib.drift.onsets); its threshold follows from the stated number of false alarms
per year (calib.drift.false_alarms). It finds what changes faster than the estimate follows; calib.drift.net_changes
finds slow drifts. A change of the sensor and a change of the reference give the same scores; the reason of every
verdict of this test other than "stable" says so.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calib.drift.false_alarms import false_alarm_threshold
from calib.drift.onsets import FEWEST, LEAST_THRESHOLD, SPAN, FittedChange, Onsets
from calib.model import PARAMETERS, Array

DAY_S = 86400.0
YEAR_S = 365.25 * DAY_S
SHORTEST_S = 1.0  # least time span of all windows, so that the number of windows per year stays finite
NAN = float("nan")
OFFSETS = PARAMETERS[9:]
# Natural logarithm of the likelihood ratio at which "stepped" becomes "drifting" or the reverse: 20 to 1.
OTHER_SHAPE = 3.0
QUIET = 0.5  # of the threshold: below it a parameter becomes "stable" again


@dataclass(frozen=True, slots=True)
class DriftSettings:
    """`own_false_alarms_a_year`: of this test alone, for all 12 parameters of a sensor together. `windows_a_year`: None
    means that the number follows from the times of the windows. The test of net changes has a number of its own.
    """

    own_false_alarms_a_year: float = 0.05
    windows_a_year: float | None = None


@dataclass(frozen=True, slots=True)
class DriftVerdict:
    """The verdict of one of the two tests on one parameter of calib.model.PARAMETERS.

    `statistic` and `threshold` are those of the test. `reason` is empty if the parameter is stable. A value that does
    not apply is NaN. Changes are in the parameter's unit, rates in this unit a day. The other fields mean:

    - by the drift test: `change`: the size of a step, or how far a drift has come since its onset; `u_change` its
      standard uncertainty; `rate`, `u_rate`: the rate of a drift and its standard uncertainty. All are the part that
      the state has not followed yet. `onset_s`: when the step or the drift began, by the fit.
    - by the test of net changes, which is always "drifting": `change`: by how much the estimate has changed in a span
      that ends now; `rate`: that over the length of the span. Their uncertainty is not known: the errors of two
      estimates are correlated. `reason` has the standard deviation of such a change by what is stated. `onset_s`: the
      begin of the span, which is a day that is kept, not a fitted onset.
    """

    parameter: str
    verdict: Literal["stable", "drifting", "stepped"] = "stable"
    change: float = NAN
    u_change: float = NAN
    rate: float = NAN
    u_rate: float = NAN
    onset_s: float = NAN
    statistic: float = 0.0
    threshold: float = NAN
    reason: str = ""


class DriftTest:
    """The test on the windows of one sensor: `update` takes a window, `result` gives the verdicts."""

    def __init__(self, settings: DriftSettings | None = None) -> None:
        self._settings = settings or DriftSettings()
        self._onsets = Onsets(len(PARAMETERS))
        self._windows = 0
        self._first_s = self._newest_s = 0.0
        self._verdicts = tuple(DriftVerdict(parameter) for parameter in PARAMETERS)

    def update(self, t_s: float, score: Array, information: Array) -> list[DriftVerdict]:
        """Take the scores of a window. Returns the verdicts whose kind has changed.

        `score` (12,) is standard normal and independent between windows as long as nothing changes; it is NaN if the
        window has no information on the parameter. A change d of a parameter changes the mean of its score by
        d sqrt(information); `information` (12,). `t_s` is the time of the window in s; it must rise.
        """
        self._first_s = t_s if self._windows == 0 else self._first_s
        self._windows, self._newest_s = self._windows + 1, t_s
        self._onsets.update(t_s, score, information)
        threshold, strongest = self.threshold(), self._onsets.strongest()
        before = self._verdicts
        self._verdicts = tuple(self._judged(p, float(strongest[p]), threshold) for p in range(len(PARAMETERS)))
        self._onsets.restart(np.array([_calmed(a, b) for a, b in zip(before, self._verdicts, strict=True)]))
        return [new for old, new in zip(before, self._verdicts, strict=True) if new.verdict != old.verdict]

    def result(self) -> tuple[DriftVerdict, ...]:
        """The present verdicts on the 12 parameters."""
        return self._verdicts

    def restart(self, parameters: NDArray[np.bool_]) -> None:
        """Forget the evidence on the flagged parameters (12,), because their values in the state were replaced.

        A verdict other than "stable" stays until `FEWEST` new windows have shown no change.
        """
        self._onsets.restart(parameters)

    def threshold(self) -> float:
        """The threshold of the statistic, for the number of windows per year so far."""
        pace = self._settings.windows_a_year
        if pace is None:
            pace = self._windows * YEAR_S / max(self._newest_s - self._first_s, SHORTEST_S)
        rate = self._settings.own_false_alarms_a_year / (len(PARAMETERS) * pace)
        return max(false_alarm_threshold(rate, FEWEST, SPAN), LEAST_THRESHOLD)

    def _judged(self, p: int, statistic: float, threshold: float) -> DriftVerdict:
        before = self._verdicts[p]
        held = replace(before, statistic=statistic, threshold=threshold)
        if before.verdict == "stable":
            if statistic <= threshold:
                return held
        elif statistic < QUIET * threshold:
            fresh = self._onsets.windows()[p] < FEWEST
            return held if fresh else DriftVerdict(held.parameter, statistic=statistic, threshold=threshold)
        step, ramp = self._onsets.best_step(p), self._onsets.best_ramp(p)
        for_ramp = (ramp.gain - step.gain) / min(step.scatter, ramp.scatter)
        margin = {"stable": 0.0, "stepped": OTHER_SHAPE, "drifting": -OTHER_SHAPE}[before.verdict]
        self._onsets.pin(p, ramp.onset if for_ramp > margin else step.onset)
        base = DriftVerdict(held.parameter, statistic=statistic, threshold=threshold)
        return _drifting(base, ramp, self._newest_s) if for_ramp > margin else _stepped(base, step, self._newest_s)

    def snapshot(self) -> dict[str, Any]:
        """The complete state, for `load`; bit for bit."""
        return {
            "onsets": self._onsets.snapshot(),
            "windows": self._windows,
            "first_s": self._first_s,
            "newest_s": self._newest_s,
            "verdicts": [asdict(verdict) for verdict in self._verdicts],
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue from the state that `snapshot` returned."""
        self._onsets.load(state["onsets"])
        self._windows = state["windows"]
        self._first_s, self._newest_s = state["first_s"], state["newest_s"]
        self._verdicts = tuple(DriftVerdict(**verdict) for verdict in state["verdicts"])


def _calmed(before: DriftVerdict, now: DriftVerdict) -> bool:
    return before.verdict != "stable" and now.verdict == "stable"


def _stepped(base: DriftVerdict, step: FittedChange, t_s: float) -> DriftVerdict:
    days = (t_s - step.onset_s) / DAY_S
    text = f"{base.parameter} stepped by {step.size:+.3g} (u {step.u_size:.2g}) {days:.1f} days ago"
    return replace(
        base,
        verdict="stepped",
        change=step.size,
        u_change=step.u_size,
        onset_s=step.onset_s,
        reason=_reason(text, base),
    )


def _drifting(base: DriftVerdict, ramp: FittedChange, t_s: float) -> DriftVerdict:
    days = (t_s - ramp.onset_s) / DAY_S
    change, u_change = ramp.size * days, ramp.u_size * days
    text = (
        f"{base.parameter} drifts by {ramp.size:+.3g} (u {ramp.u_size:.2g}) a day; in the last {days:.1f} days "
        f"it has drifted by {change:+.3g}"
    )
    return replace(
        base,
        verdict="drifting",
        change=change,
        u_change=u_change,
        rate=ramp.size,
        u_rate=ramp.u_size,
        onset_s=ramp.onset_s,
        reason=_reason(text, base),
    )


def _reason(text: str, base: DriftVerdict) -> str:
    statistic = f"the statistic {base.statistic:.1f} is above its threshold {base.threshold:.1f}"
    cause = (
        "offset of sensor or reference, or lean of the mount" if base.parameter in OFFSETS else "sensor or reference"
    )
    return f"{text}; {statistic}; cause: {cause} (the data cannot tell which)"
