"""Gates, calibrations and evidence as a gate gets them, and max_change computed anew, element by element."""

from __future__ import annotations

from itertools import product

import numpy as np

from agent.config.gate import GateSettings
from agent.core.gate import Decision, Evidence, Gate
from calib.model import Array, Calibration

NOMINAL = np.array([[2.0, 0.01, 0.0], [0.0, 1.9, -0.02], [0.01, 0.0, 2.1]])
DOF = 9.0
LIMIT_AT_1E_4 = 33.72  # chi-squared, 9 degrees of freedom (tables: 33.720)
SETTINGS = GateSettings()


def calibration(
    sensitivity: Array = NOMINAL, offset: float = 0.3, u_pct: float = 0.5, determined: int = 12
) -> Calibration:
    """S, Q the same on all axes, u in % of 2 (the output per m/s2), the first `determined` parameters determined."""
    u = np.full(12, 0.02 * u_pct)
    return Calibration(sensitivity, np.full(3, offset), np.diag(u**2), np.arange(12) < determined, np.inf, "test")


def scaled(factor: float) -> Calibration:
    """All of S so much larger."""
    return calibration(NOMINAL * factor)


def changed(row: int, column: int, by: float) -> Calibration:
    """One element of S off by so much."""
    S = NOMINAL.copy()
    S[row, column] += by
    return calibration(S)


def turned(angle_deg: float) -> Calibration:
    """The axes turned together about z."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return calibration(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ NOMINAL)


def consistent(t_s: float = 0.0) -> Evidence:
    """As white noise would have it."""
    return Evidence(t_s, DOF, DOF)


def jumped(t_s: float = 0.0) -> Evidence:
    """Far from what the state expected."""
    return Evidence(t_s, 1000.0, DOF)


def within_max_change(now: Calibration, anchor: Calibration, main_pct: float, transverse_pct: float) -> bool:
    """The rule as docs/gate.md states it, written plainly."""
    S, S0 = now.sensitivity, anchor.sensitivity
    full_scale = (abs(S0[0, 0]) + abs(S0[1, 1]) + abs(S0[2, 2])) / 3
    for i, j in product(range(3), range(3)):
        limit = main_pct / 100 * abs(S0[i, i]) if i == j else transverse_pct / 100 * full_scale
        if not abs(S[i, j] - S0[i, j]) <= limit * (1 + 1e-9):  # 1e-9: the last digits are computed otherwise there
            return False
    return True


FAR, NEAR = scaled(1.06), scaled(1.01)


def gate(**changes: object) -> Gate:
    """With a certificate, and nothing in force yet."""
    return Gate(GateSettings(**changes), calibration())  # type: ignore[arg-type]


def valid(**changes: object) -> Gate:
    """With the certificate in force."""
    return Gate(GateSettings(**changes), calibration(), calibration())  # type: ignore[arg-type]


def held(confirmed: Calibration | None, gate: Gate, windows: int = SETTINGS.confirm_windows) -> Decision:
    """The last of so many windows that contradict what is in force; `confirmed` by them once there are enough."""
    for k in range(windows):
        decision = gate.judge(jumped(), scaled(1.3), confirmed if k + 1 >= SETTINGS.confirm_windows else None)
    return decision
