"""Sequential test for drift: has a parameter stepped, is it drifting, and since when?

Each window gives a score for each parameter (the normalised innovation, docs/online.md). The test is a generalised
likelihood ratio over all onsets (onsets.py); its threshold follows from a false-alarm rate stated for a year
(false_alarms.py). A change of the sensor and one of the reference give the same scores: every verdict that is not
"stable" says so.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calib.estimate.false_alarms import false_alarm_threshold
from calib.estimate.onsets import FEWEST, LEAST_THRESHOLD, SPAN, Change, Onsets
from calib.model import PARAMETERS, Array

YEAR_S = 365.25 * 86400.0
SHORTEST_S = 1.0  # of all windows together: a pace must not be infinite
NAN = float("nan")
# A verdict "stepped" becomes "drifting", or back, where the other fits better by 20 to 1.
OTHER_SHAPE = 3.0
QUIET = 0.5  # of the threshold: below, what was not stable is stable again


@dataclass(frozen=True, slots=True)
class DriftSettings:
    """`false_alarms_a_year` of one sensor, its 12 parameters together; `windows_a_year` None: as they have come."""

    false_alarms_a_year: float = 0.1
    windows_a_year: float | None = None


@dataclass(frozen=True, slots=True)
class DriftVerdict:
    """What is said of one parameter of calib.model.PARAMETERS.

    `change`, `u_change` where it stepped, in the parameter's unit; `rate`, `u_rate` a day where it drifts; `onset_s` of
    either; NaN where they do not apply. They are what the state of the recursion has not followed yet. `reason` is
    empty where it is stable.
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
    """The test on the windows of one sensor; `update` changes, `result` reads."""

    def __init__(self, settings: DriftSettings | None = None) -> None:
        self._settings = settings or DriftSettings()
        self._onsets = Onsets(len(PARAMETERS))
        self._windows = 0
        self._first_s = self._newest_s = 0.0
        self._verdicts = tuple(DriftVerdict(parameter) for parameter in PARAMETERS)

    def update(self, t_s: float, score: Array, information: Array) -> list[DriftVerdict]:
        """Take a window's scores; the verdicts that are now another kind than before.

        `score` (12,): standard normal and independent from window to window while nothing changes, NaN where the window
        tells nothing of the parameter; a change d moves it by d sqrt(information). `t_s` grows.
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
        """The 12 verdicts as they stand."""
        return self._verdicts

    def restart(self, parameters: NDArray[np.bool_]) -> None:
        """Forget the evidence on these (12,) flags: what the state held of them was replaced.

        A verdict that is not stable stands until `FEWEST` new windows found nothing.
        """
        self._onsets.restart(parameters)

    def threshold(self) -> float:
        """What the statistic is held against, at the pace of the windows so far."""
        pace = self._settings.windows_a_year
        if pace is None:
            pace = self._windows * YEAR_S / max(self._newest_s - self._first_s, SHORTEST_S)
        rate = self._settings.false_alarms_a_year / (len(PARAMETERS) * pace)
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
        return _drifting(base, ramp) if for_ramp > margin else _stepped(base, step)

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            "onsets": self._onsets.snapshot(),
            "windows": self._windows,
            "first_s": self._first_s,
            "newest_s": self._newest_s,
            "verdicts": [asdict(verdict) for verdict in self._verdicts],
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._onsets.load(state["onsets"])
        self._windows = state["windows"]
        self._first_s, self._newest_s = state["first_s"], state["newest_s"]
        self._verdicts = tuple(DriftVerdict(**verdict) for verdict in state["verdicts"])


def _calmed(before: DriftVerdict, now: DriftVerdict) -> bool:
    return before.verdict != "stable" and now.verdict == "stable"


def _stepped(base: DriftVerdict, step: Change) -> DriftVerdict:
    text = f"{base.parameter} stepped by {step.size:+.3g} (u {step.u_size:.2g}) at {step.onset_s:.0f} s"
    return replace(
        base,
        verdict="stepped",
        change=step.size,
        u_change=step.u_size,
        onset_s=step.onset_s,
        reason=_reason(text, base),
    )


def _drifting(base: DriftVerdict, ramp: Change) -> DriftVerdict:
    text = f"{base.parameter} drifts by {ramp.size:+.3g} (u {ramp.u_size:.2g}) a day since {ramp.onset_s:.0f} s"
    return replace(
        base, verdict="drifting", rate=ramp.size, u_rate=ramp.u_size, onset_s=ramp.onset_s, reason=_reason(text, base)
    )


def _reason(text: str, base: DriftVerdict) -> str:
    return f"{text}; statistic {base.statistic:.1f} beyond {base.threshold:.1f}; sensor or reference, data cannot tell"
