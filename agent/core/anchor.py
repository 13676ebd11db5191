"""Limits on how far S and Q may move away from the calibration that an operator last accepted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.config.gate import GateSettings
from calib.estimate.axes import axis_warnings, sensitivity_reasons
from calib.model import PARAMETERS, Array, Calibration

COVERAGE_FACTOR = 2.0  # a limit is never narrower than U = 2 u of the anchor
MAIN = np.isin(np.arange(12), (0, 4, 8))
OFFSET = np.arange(12) >= 9
TRANSVERSE = ~MAIN & ~OFFSET


@dataclass(frozen=True, slots=True)
class AnchorDistance:
    """How far a calibration is from the anchor. `reason` names every limit that is exceeded; it is "" if none is."""

    reason: str
    numbers: dict[str, float]


class Anchor:
    """The calibration from which changes are counted, and the limits around it. Changes add up over all windows.

    An operator accepted this calibration: it comes from the certificate or the data sheet in the configuration, later
    from a command `accept` or `rollback`. If U of a parameter is larger than max_change (as in a data sheet), U is its
    limit. As soon as the data determine this parameter with U within max_change, their value becomes its anchor and
    max_change its limit. This happens once for each parameter.
    """

    def __init__(self, settings: GateSettings, calibration: Calibration) -> None:
        """Raises ValueError if S has no inverse, if a main sensitivity is 0, or if a value is not finite."""
        self._settings = settings
        self._value = _values(calibration)
        self._u = calibration.standard_uncertainty
        if wrong := _no_start(calibration):
            raise ValueError(wrong)
        self._fixed = self._expanded() <= self._max_change()

    @property
    def calibration(self) -> Calibration:
        """The anchor as a calibration. An Anchor that is made from it is equal to this one."""
        sensitivity, offset = self._value[:9].reshape(3, 3).copy(), self._value[9:].copy()
        return Calibration(sensitivity, offset, np.diag(self._u**2), self._fixed.copy(), np.inf, "accepted")

    @property
    def known(self) -> NDArray[np.bool_]:
        """(12,) True where the anchor is known to within max_change. False for an offset that has no limit."""
        return self._fixed & np.isfinite(self._max_change())

    def change(self, calibration: Calibration) -> AnchorDistance:
        """Compare the change from the anchor to this calibration with the limits."""
        value = _values(calibration)
        if not np.isfinite(value).all():
            return AnchorDistance("S or Q is not finite", {})
        moved, limits = np.abs(value - self._value), self.limits()
        numbers, reasons = dict[str, float](), list[str]()
        unit = np.where(MAIN, np.abs(self._value) / 100, np.where(TRANSVERSE, self._full_scale() / 100, 1.0))
        for name, kind in (("main_pct", MAIN), ("transverse_pct", TRANSVERSE), ("offset", OFFSET)):
            worst = int(np.argmax(np.where(kind, moved / limits, -1.0)))
            if np.isfinite(limits[worst]):
                numbers[f"change_{name}"] = float(moved[worst] / unit[worst])
                numbers[f"change_{name}_threshold"] = float(limits[worst] / unit[worst])
            reasons += [PARAMETERS[p] for p in np.flatnonzero(kind & ~(moved <= limits))]
        self._turned(calibration, numbers, reasons)
        self._off_sheet(value, numbers, reasons)
        return AnchorDistance(
            f"S or Q changed by more than max_change: {', '.join(reasons)}" if reasons else "", numbers
        )

    def refusal(self, calibration: Calibration) -> str:
        """Why a calibration must not be proposed to an operator: it is not usable, an output is dead, or axes are
        exchanged or inverted that were not so before; "" if it can be proposed."""
        found = sensitivity_reasons(calibration, COVERAGE_FACTOR, stated=True)
        if not found and not axis_warnings(self._value[:9].reshape(3, 3)):
            found = axis_warnings(calibration.sensitivity)
        return found[0] if found else _no_start(calibration)

    def limits(self) -> Array:
        """(12,) the largest allowed change of each parameter; inf for an offset that has no limit."""
        return np.where(self._fixed, self._max_change(), self._expanded())

    def learn(self, calibration: Calibration) -> None:
        """Take the values of a calibration that came into force as anchors, where only a data sheet was the anchor
        before and where U is now within max_change."""
        known = calibration.determined & (COVERAGE_FACTOR * calibration.standard_uncertainty <= self._max_change())
        fresh = known & ~self._fixed
        self._value = np.where(fresh, _values(calibration), self._value)
        self._u = np.where(fresh, calibration.standard_uncertainty, self._u)
        self._fixed = self._fixed | fresh

    def _full_scale(self) -> float:
        return float(np.abs(self._value[MAIN]).mean())

    def _expanded(self) -> Array:
        return COVERAGE_FACTOR * self._u

    def _max_change(self) -> Array:
        of = self._settings
        main = of.max_change_main_pct / 100.0 * np.abs(self._value)
        transverse = of.max_change_transverse_pct / 100.0 * self._full_scale()
        offset = np.inf if of.max_change_offset is None else of.max_change_offset
        return np.where(MAIN, main, np.where(TRANSVERSE, transverse, offset))

    def _turned(self, calibration: Calibration, numbers: dict[str, float], reasons: list[str]) -> None:
        if not self._fixed[:9].all():
            return  # a data sheet does not state the orientation of the sensor against the reference
        angle_deg = float(np.degrees(rotation_rad(calibration.sensitivity, self._value[:9].reshape(3, 3))))
        numbers["rotation_deg"] = angle_deg
        numbers["rotation_deg_threshold"] = self._settings.max_change_rotation_deg
        if not angle_deg <= self._settings.max_change_rotation_deg:
            reasons.append("common rotation")

    def _off_sheet(self, value: Array, numbers: dict[str, float], reasons: list[str]) -> None:
        largest = self._settings.largest_offset
        if largest is None:
            return
        numbers["offset"], numbers["offset_threshold"] = float(np.abs(value[OFFSET]).max()), largest
        reasons += [
            f"{PARAMETERS[p]} (beyond largest_offset)" for p in np.flatnonzero(OFFSET & (np.abs(value) > largest))
        ]

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {"value": self._value.copy(), "u": self._u.copy(), "fixed": self._fixed.copy()}

    def load(self, state: dict[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._value, self._u, self._fixed = state["value"].copy(), state["u"].copy(), state["fixed"].copy()


def rotation_rad(sensitivity: Array, before: Array) -> float:
    """Angle of the rotation in S S0^-1, by polar decomposition; pi if S S0^-1 contains a reflection."""
    left, _, right = np.linalg.svd(sensitivity @ np.linalg.inv(before))
    turn = left @ right
    if np.linalg.det(turn) < 0.0:
        return float(np.pi)
    skew = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return float(np.arctan2(np.linalg.norm(skew), np.trace(turn) - 1.0))


def _no_start(calibration: Calibration) -> str:
    """Why changes cannot be counted from a calibration; "" if they can."""
    usable = np.isfinite(_values(calibration)).all() and np.diag(calibration.sensitivity).all()
    if usable and np.linalg.matrix_rank(calibration.sensitivity) == 3:
        return ""
    return (
        "the calibration cannot be used as a start: S and Q must be finite, S must have an inverse, and no main "
        "sensitivity may be 0"
    )


def _values(calibration: Calibration) -> NDArray[np.float64]:
    return np.concatenate([calibration.sensitivity.ravel(), calibration.offset])
