"""The life of one gateway with known truth: windows, restarts with another configuration, other devices, an operator.

A restart keeps what the store of a gateway keeps, and nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.config import Config
from agent.core.events import (
    CalibrationUpdate,
    Command,
    DeviceChange,
    Estimate,
    Event,
    Result,
    StatusChange,
    WindowReport,
)
from agent.core.pipeline import Pipeline
from benchmarks.online.runner import EPOCH_NS, LATE_S, opened, tick, ticked
from calib.model import Array
from hw.virtual.building import Building

MAIN = [0, 4, 8]


@dataclass(frozen=True, slots=True)
class Told:
    """What a run told in the end, and the worst that it told at any time.

    `windows`: as the simulation made them; those neither `taken` nor `held` were refused, or never seen as a window.

    `errors` (12,): value minus true value over u, for the coverage factor 2; NaN where a parameter is not determined.
    `u_main_pct` (3,) of the main sensitivities, relative; `least_u_main_pct` (3,) the smallest at any time.
    `worst`: the largest of `errors` at any time with the status VALID.
    """

    windows: int
    taken: int
    held: int
    status: str
    errors: Array
    u_main_pct: Array
    least_u_main_pct: Array
    worst: float


class Gateway:
    """One sensor on a gateway. `feed` takes events; `truth` (12,) is S and Q, and may change between two events."""

    def __init__(self, config: Config, truth: Array) -> None:
        self.truth = truth
        self.status = ""
        self.reasons: list[str] = []  # of all statuses
        self.reports: list[WindowReport] = []
        self.estimate: Estimate | None = None  # the newest
        self.now_ns = 0
        self._sensor = config.channels[0].sensor
        self._kept: dict[str, bytes] = {}
        self._last_sequence = self._runs = 0
        self.in_force: CalibrationUpdate | None = None
        self._worst = 0.0
        self._least = np.full(3, np.inf)
        self.restart(config)

    def restart(self, config: Config) -> None:
        """End the program and start it anew, with another configuration where `config` differs."""
        self._runs += 1
        kept = {self._sensor: self._kept}
        self._pipeline = Pipeline.begin(config, f"run-{self._runs}", self.now_ns, self._last_sequence, kept)

    def feed(self, events: Iterable[Event]) -> None:
        """Step the pipeline, keep its states, and compare what is in force with the truth."""
        for event in events:
            self.now_ns = max(self.now_ns, event.t_monotonic_ns)
            results = self._pipeline.step(event)
            for memory in self._pipeline.memories(results):
                self._kept[memory.identity] = memory.state
            for result in results:
                if isinstance(result, WindowReport):
                    self.reports.append(result)
                elif isinstance(result, StatusChange):
                    self.status = result.status
                    self.reasons.append(result.reason)
                elif isinstance(result, Estimate):
                    self.estimate = result
                elif isinstance(result, CalibrationUpdate):
                    self.in_force = result
                    self._least = np.minimum(self._least, self._u_main_pct())
                if isinstance(result, Result):
                    self._last_sequence = result.sequence
            if self.status == "VALID" and any(isinstance(r, WindowReport | CalibrationUpdate) for r in results):
                self._worst = max(self._worst, float(np.nanmax(np.abs(self._errors()), initial=0.0)))

    def accept(self, estimate: Estimate) -> None:
        """An operator accepts this estimate."""
        arguments = json.dumps({"sequence": estimate.sequence})
        utc_ns = EPOCH_NS + self.now_ns
        self.feed(
            [
                Command(
                    sensor=self._sensor, verb="accept", t_monotonic_ns=self.now_ns, t_utc_ns=utc_ns,
                    arguments_json=arguments, key_id="operator",
                )
            ]
        )  # fmt: skip

    def told(self, windows: Sequence[Sequence[WindowReport]]) -> Told:
        """The result of the run so far. A window, as the simulation made it, has the reports on all its parts: it is
        taken if any part was, and refused if the gate saw none."""
        taken = sum(any(report.used for report in parts) for parts in windows)
        judged = sum(any("innovation_chi2" in report.numbers for report in parts) for parts in windows)
        return Told(
            windows=len(windows), taken=taken, held=judged - taken, status=self.status, errors=self._errors(),
            u_main_pct=self._u_main_pct(), least_u_main_pct=self._least, worst=self._worst,
        )  # fmt: skip

    def _errors(self) -> Array:
        update = self.in_force
        if update is None:
            return np.full(12, np.nan)
        value = np.append(np.ravel(update.sensitivity), update.offset)
        u = update.coverage_factor / 2.0 * np.array(update.standard_uncertainty)
        return np.where(update.determined, (value - self.truth) / u, np.nan)

    def _u_main_pct(self) -> Array:
        update = self.in_force
        if update is None:
            return np.full(3, np.nan)
        known = np.array(update.determined)[MAIN]
        u = np.array(update.standard_uncertainty)[MAIN] / np.abs(np.diag(update.sensitivity))
        return np.where(known, 100.0 * u, np.nan)


class House:
    """A gateway in a building. `building` may be replaced between two visits by one whose devices differ."""

    def __init__(self, building: Building, config: Config) -> None:
        self.building = building
        self.gateway = Gateway(config, true_values(building, 0.0))
        self._windows: list[list[WindowReport]] = []
        self._serial_number = "A"  # of the reference
        self._open()

    def restart(self, config: Config) -> None:
        """Restart the program before the next visit."""
        self.gateway.now_ns = self._next_ns()
        self.gateway.restart(config)
        self._open()

    def fit(self, building: Building, serial_number: str) -> None:
        """Put another reference in the place of the present one; `restart` or `plug` tells the program."""
        self.building, self._serial_number = building, serial_number

    def plug(self) -> None:
        """Open the reference anew while the program runs."""
        self.gateway.feed(self._openings()[1:])

    def visit(self, frame: Array | None = None) -> None:
        """The next window. `frame` (3, 3): by what the sensor's S is multiplied as it stands now."""
        visit, told = len(self._windows), len(self.gateway.reports)
        start_s, stop_s = self.building.span(visit)
        self.gateway.truth = true_values(self.building, (start_s + stop_s) / 2, frame)
        self.gateway.feed(ticked(self.building.visit(visit)))
        self.gateway.feed([tick(min(stop_s + LATE_S, self.building.span(visit + 1)[0]))])
        self._windows.append(self.gateway.reports[told:])

    def told(self) -> Told:
        """The result of the run so far."""
        return self.gateway.told(self._windows)

    def _next_ns(self) -> int:
        return round(self.building.span(len(self._windows))[0] * 1e9)

    def _openings(self) -> list[DeviceChange]:
        infos = self.building.infos()
        infos["reference"] = replace(infos["reference"], serial_number=self._serial_number)
        return list(opened(infos, self._next_ns()))

    def _open(self) -> None:
        self.gateway.feed(self._openings())


def true_values(building: Building, time_s: float, frame: Array | None = None) -> Array:
    """S row by row and Q (12,) of the sensor at `time_s`; `frame` (3, 3) as in `House.visit`."""
    truth = building.truth(time_s)
    S = truth.sensitivity if frame is None else truth.sensitivity @ frame
    return np.append(S.ravel(), truth.offset_at_mean)
