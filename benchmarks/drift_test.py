"""The drift test: its false-alarm rate, and its delay compared with a CUSUM of the same false-alarm rate.

`python -m benchmarks.drift_test [MILLIONS]` prints the tables of docs/drift.md; 60 takes most of an hour.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from calib.drift.false_alarms import false_alarm_rate, false_alarm_threshold
from calib.drift.onsets import CLIP, FEWEST, SPAN, Onsets
from calib.model import PARAMETERS, Array

WINDOWS_A_YEAR = 8766.0
FALSE_ALARMS_A_YEAR = 0.1
RATE = FALSE_ALARMS_A_YEAR / (len(PARAMETERS) * WINDOWS_A_YEAR)  # false alarms per window and parameter
HOUR_S = 3600.0
QUIET, LONGEST = 300, 2500  # number of windows before the change, and largest number of windows after it
SERIES = 400
CHANGES: dict[str, Callable[[int], float]] = {
    "step of 30 sigma": lambda _: 30.0,
    "step of 3 sigma": lambda _: 3.0,
    "step of 1 sigma": lambda _: 1.0,
    "step of 0.25 sigma": lambda _: 0.25,
    "ramp of 0.05 sigma a window": lambda k: 0.05 * k,
    "ramp of 0.005 sigma a window": lambda k: 0.005 * k,
}


def false_alarms(threshold: float, windows: int, series: int = 1000) -> int:
    """Alarms in `windows` windows of white scores; after an alarm the test of that parameter starts again."""
    onsets, random, alarms = Onsets(series), np.random.default_rng(1), 0
    for k in range(windows // series):
        onsets.update(k * HOUR_S, random.normal(size=series), np.ones(series))
        beyond = onsets.strongest() > threshold
        alarms += int(np.count_nonzero(beyond))
        onsets.restart(beyond)
    return alarms


class Glr:
    """The test of calib.drift.onsets with the threshold for RATE, one false alarm in a million windows."""

    def __init__(self) -> None:
        self._onsets, self._k = Onsets(SERIES), 0
        self._threshold = false_alarm_threshold(RATE, FEWEST, SPAN)

    def alarms(self, score: Array) -> NDArray[np.bool_]:
        """Alarms (SERIES,) after one more window with scores `score` (SERIES,)."""
        self._onsets.update(self._k * HOUR_S, score, np.ones(SERIES))
        self._k += 1
        return self._onsets.strongest() > self._threshold


class Cusum:
    """Page's two-sided CUSUM, designed for one size of step; threshold from Siegmund (1985), equation 2.57."""

    def __init__(self, size: float) -> None:
        self._allowance = size / 2
        one_sided = 2.0 / RATE * size * self._allowance
        self._threshold = math.log(one_sided) / size - 1.166
        self._sums = np.zeros((2, SERIES))

    def alarms(self, score: Array) -> NDArray[np.bool_]:
        """Alarms (SERIES,) after one more window with scores `score` (SERIES,)."""
        cut = np.clip(score, -CLIP, CLIP)
        self._sums = np.maximum(self._sums + np.array([cut, -cut]) - self._allowance, 0.0)
        return np.asarray(self._sums.max(axis=0) > self._threshold)


def delays(test: Glr | Cusum, change: Callable[[int], float]) -> Array:
    """Number of windows (SERIES,) from the change to the alarm, the window of the alarm included.

    LONGEST + 1 where there was no alarm.
    """
    random, first = np.random.default_rng(2), np.full(SERIES, LONGEST + 1.0)
    for k in range(-QUIET, LONGEST):
        alarms = test.alarms(random.normal(size=SERIES) + (change(k) if k >= 0 else 0.0))
        if k >= 0:
            first = np.where(alarms, np.minimum(first, k + 1), first)
            if first.max() <= LONGEST:
                break
    return first


def main() -> None:
    """Print both tables."""
    millions = float(sys.argv[1]) if len(sys.argv) > 1 else 3.0
    print("| threshold | windows | false alarms | by the formula |\n| --- | --- | --- | --- |")
    for threshold, share in ((8.0, 0.02), (10.0, 0.1), (false_alarm_threshold(RATE, FEWEST, SPAN), 1.0)):
        windows = int(millions * 1e6 * share)
        expected = windows * false_alarm_rate(threshold, FEWEST, SPAN)
        print(f"| {threshold:.2f} | {windows:.3g} | {false_alarms(threshold, windows)} | {expected:.0f} |", flush=True)
    print("\n| change | this test | CUSUM for 1 sigma | CUSUM for 0.25 sigma |\n| --- | --- | --- | --- |")
    for name, change in CHANGES.items():
        means = [delays(test, change).mean() for test in (Glr(), Cusum(1.0), Cusum(0.25))]
        print(f"| {name} | {' | '.join(f'{mean:.1f}' for mean in means)} |", flush=True)


if __name__ == "__main__":
    main()
