"""Results of a simulated sensor, as a pipeline would give them: S and Q with U, windows, drift verdicts, status.

The numbers are drawn, so nothing is calibrated here; kinds, fields and sizes are those of real results.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from agent.core.events import (
    CalibrationUpdate,
    DriftReport,
    Result,
    StatusChange,
    WindowReport,
)

Behaviour = Literal["sound", "drifting", "silent", "wrong", "hostile"]
Status = Literal["VALID", "HELD", "INVALID"]
NOMINAL = 26154.0  # counts per m/s2, as an ADXL355 in its range of 2 g
U_MAIN, U_TRANSVERSE = 5e-4, 1e-3  # standard uncertainties, relative to NOMINAL
U_OFFSET = 130.0  # counts, 5 mm/s2
DRIFT_IN_U = 0.2  # change of Sxx in each round, in units of U
TELLS_IN_U = 1.0  # change at which a drift is told
WRONG_FROM = 3  # round from which a wrong sensor's windows contradict its calibration, and a silent one is silent
THRESHOLD = 32.9  # of the window's test statistic, as refused windows state it
TEMPERATURE_DEGC = 20.0


class SimulatedSensor:
    """One sensor. `seed`: two sensors of the same seed and behaviour give the same results."""

    def __init__(self, name: str, behaviour: Behaviour, seed: list[int]) -> None:
        self.name, self.behaviour = name, behaviour
        self._random = np.random.default_rng(seed)
        main, other = 0.01 * self._random.normal(size=3), 0.005 * self._random.normal(size=(3, 3))
        self._S = NOMINAL * (np.eye(3) + np.where(np.eye(3) > 0, np.diag(main), other))
        self._Q = NOMINAL * 0.1 * self._random.normal(size=3)
        self._status: Status | Literal[""] = ""
        self._begun_utc_ns = 0

    def results(self, number: int, t_utc_ns: int, first_sequence: int) -> list[Result]:
        """The results of round `number` (from 0), numbered from `first_sequence`."""
        self._begun_utc_ns = self._begun_utc_ns or t_utc_ns
        self._common: dict[str, Any] = {"run_id": "simulated", "sensor": self.name, "t_utc_ns": t_utc_ns}
        self._sequence = first_sequence
        odd = number >= WRONG_FROM
        if self.behaviour == "silent" and odd:
            return self._changed("INVALID", f"no block of {self.name} for more than 5 s")
        if self.behaviour == "wrong" and odd:
            return [self._window(number, used=False), *self._changed("HELD", self._contradicts())]
        if self.behaviour == "hostile" and odd:
            return self._changed("HELD", f"<img src=x onerror=alert({number})>\x1b[2J\u202e'; DROP TABLE result; --")
        change = DRIFT_IN_U * number if self.behaviour == "drifting" else 0.0
        found = [self._window(number, used=True), self._calibration(number, change * 2 * U_MAIN * NOMINAL)]
        if change < TELLS_IN_U:
            return [*found, *self._changed("VALID", f"{number + 1} windows")]
        return [*found, self._drift(number, change), *self._changed("HELD", f"Sxx drifts, {change:.1f} U so far")]

    def _next(self) -> dict[str, Any]:
        self._sequence += 1
        return {**self._common, "sequence": self._sequence - 1}

    def _changed(self, status: Status, reason: str) -> list[Result]:
        before, self._status = self._status, status
        return [StatusChange(**self._next(), status=status, before=before, reason=reason)] if before != status else []

    def _contradicts(self) -> str:
        return f"the window contradicts the calibration: statistic 812.4 above {THRESHOLD}; Syy may have moved by 3.1 %"

    def _window(self, number: int, *, used: bool) -> WindowReport:
        statistic = float(self._random.chisquare(12)) if used else 812.4
        return WindowReport(
            **self._next(), start_s=60.0 * number, stop_s=60.0 * (number + 1), position="30 deg", used=used,
            reason="" if used else self._contradicts(), points=60_000, left_out=0,
            numbers={"statistic": statistic, "statistic_threshold": THRESHOLD, "coherence": 0.998},
        )  # fmt: skip

    def _calibration(self, number: int, change: float) -> CalibrationUpdate:
        narrow = 1.0 / np.sqrt(1.0 + min(number, 20))  # what is known grows with the windows
        u = np.append(np.where(np.eye(3) > 0, U_MAIN, U_TRANSVERSE).ravel() * NOMINAL, np.full(3, U_OFFSET))
        told = np.append(self._S.ravel(), self._Q) + 0.3 * narrow * u * self._random.normal(size=12)
        told[0] += change
        return CalibrationUpdate(
            **self._next(), sensitivity=told[:9].reshape(3, 3).tolist(), offset=told[9:].tolist(),
            standard_uncertainty=u.tolist(), covariance=np.diag(u**2).tolist(), coverage_factor=2.0,
            determined=[True] * 12, method="simulated", uncertainty_kind="simulated", windows=number + 1,
            residual_sd=[40.0] * 3, output_unit="count", identity=f"simulated {self.name}",
            reference_temperature_degc=TEMPERATURE_DEGC, temperature_low_degc=15.0, temperature_high_degc=25.0,
            references=["simulated reference"], reference_frequency_hz=8.0, valid_band_hz=[1.0, 40.0],
        )  # fmt: skip

    def _drift(self, number: int, change_in_u: float) -> DriftReport:
        change = change_in_u * 2 * U_MAIN * NOMINAL
        days = max((self._common["t_utc_ns"] - self._begun_utc_ns) / 86400e9, 1e-6)
        return DriftReport(
            **self._next(), parameter="Sxx", verdict="drifting", change=change, u_change=U_MAIN * NOMINAL,
            rate=change / days, u_rate=U_MAIN * NOMINAL / days, onset_utc_ns=self._begun_utc_ns,
            statistic=10.0 + number, threshold=9.2, false_alarms_a_year=0.1,
            reason="the sensor or the reference changes steadily; compare with another reference",
        )  # fmt: skip
