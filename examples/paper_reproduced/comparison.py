"""The three methods applied to one recording of the bench, with Appendix A for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.estimate.nuisances import Priors
from calib.model import Array, Window, WindowSums
from calib.paper import method1, method2, method3, method3_budget
from calib.paper.amplitudes import AmplitudeCalibration, SineRun
from calib.paper.propagation import MethodUncertainty
from calib.paper.sine_fit import cycle_edges, four_parameter
from calib.paper.statistics import differences_pct, rel_s_pct, repeatability
from calib.windows.sums import window_sums
from paper_reproduced.bench import Device

MAIN = np.array([0, 4, 8])
METHODS = (1, 2, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Results of the three methods, {method: ...}. S (3, 3) has NaN where a method gives no value; U has its own k."""

    device: Device
    frequency_hz: float
    amplitude_mps2: float
    one: AmplitudeCalibration
    two: AmplitudeCalibration
    three: method3.Fit
    windows: Sequence[Window]  # of Method 3; each cycle is a segment
    statements: dict[int, MethodUncertainty]
    sensitivity: dict[int, Array]
    offset: Array  # of Method 3
    s_rel_pct: dict[int, Array]  # (3,) of the main sensitivities, the largest value of the repetitions

    @property
    def main(self) -> dict[int, Array]:
        """{method: (3,) main sensitivities}."""
        return {m: np.diag(S) for m, S in self.sensitivity.items()}

    @property
    def differences_pct(self) -> dict[tuple[int, int], Array]:
        """Differences in % for each pair of methods, like a row of Table 3 or 4."""
        return differences_pct(self.main)

    @property
    def expanded_pct(self) -> dict[int, Array]:
        """{method: (3,) U of the main sensitivities in % of their values, k = 2}."""
        return {
            m: 2 * np.sqrt(np.diag(s.covariance)[MAIN]) / np.abs(self.main[m]) * 100 for m, s in self.statements.items()
        }

    @property
    def rel_s_pct(self) -> dict[int, Array]:
        """{1 and 3: (3, 3) relative transverse sensitivities}."""
        return {m: rel_s_pct(self.sensitivity[m]) for m in (1, 3)}


def compare(device: Device, runs: Sequence[SineRun], priors: Priors) -> Comparison:
    """Apply Methods 1 and 2 to amplitudes and Method 3 as printed, each with its uncertainty budget."""
    by_method = {m: [r for r in runs if _method(r) == m] for m in METHODS}
    one = method1.solve(by_method[1], priors)
    two = method2.solve(by_method[2], priors, device.transverse_limit_pct)
    windows = [window(run) for run in by_method[3]]
    three = method3.fit(windows)
    return Comparison(
        device=device,
        frequency_hz=one.frequency_hz,
        amplitude_mps2=float(np.mean([r.acceleration_mps2.mean() for r in one.ratios])),
        one=one,
        two=two,
        three=three,
        windows=windows,
        statements={1: one.statement, 2: two.statement, 3: method3_budget.statement(three, windows, priors)},
        sensitivity={
            1: one.calibration.sensitivity,
            2: two.calibration.sensitivity,
            3: three.calibration.sensitivity,
        },
        offset=three.calibration.offset,
        s_rel_pct={1: _worst(one), 2: _worst(two), 3: _worst_by_cycle(windows, len(device.alphas_deg))},
    )


def window(run: SineRun) -> Window:
    """A run as a window of Method 3, each cycle a segment; a_ref(t) is the sine fit of the LDV's velocity (Eq. 12)."""
    fit = four_parameter(run.time_s, run.reference)
    u, du = fit.derivative(run.time_s, 1), fit.derivative(run.time_s, 2)
    edges = cycle_edges(run.time_s, fit.frequency_hz)
    sums = window_sums(u, du, run.indications, edges)
    points = int(sums.count.sum())
    return Window(float(run.time_s[0]), float(run.time_s[-1]), run.pose, sums, True, "", points, 0)


def _method(run: SineRun) -> int:
    return 1 if run.pose.position.startswith("axis") else int(run.pose.position.split()[1].rstrip(","))


def _worst(result: AmplitudeCalibration) -> Array:
    return np.array([max(r.s_rel_pct for r in result.repeatability[i, i]) for i in range(3)])


def _worst_by_cycle(windows: Sequence[Window], positions: int) -> Array:
    """s_rel of Method 3 over the cycles of a repetition: Method 3 is solved once for each cycle."""
    worst = np.zeros(3)
    for first in range(0, len(windows), positions):
        repetition = windows[first : first + positions]
        cycles = min(len(w.sums.count) for w in repetition)
        main = [np.diag(method3.solve([_cycle(w, k) for w in repetition]).sensitivity) for k in range(cycles)]
        worst = np.maximum(worst, repeatability(main).s_rel_pct)
    return worst


def _cycle(w: Window, k: int) -> Window:
    part = slice(k, k + 1)
    sums = WindowSums(w.sums.reference_channels, w.sums.count[part], w.sums.mean[part], w.sums.scatter[part])
    return Window(w.start_s, w.stop_s, w.pose, sums, True, "", int(sums.count[0]), 0)


def joint_difference(comparison: Comparison, joint: NDArray[np.float64]) -> tuple[Array, Array]:
    """d (12,): S_2 - S_1 (main sensitivities), then S_3 - S_1 (all nine); and its covariance (12, 12).

    `joint` (36, 36) is the joint covariance of the three methods.
    """
    S = comparison.sensitivity
    rows = np.zeros((12, 36))
    for row, parameter in enumerate(MAIN):
        rows[row, parameter], rows[row, 12 + parameter] = -1.0, 1.0
    for row in range(9):
        rows[3 + row, row], rows[3 + row, 24 + row] = -1.0, 1.0
    difference = np.append(np.diag(S[2]) - np.diag(S[1]), (S[3] - S[1]).ravel())
    return difference, rows @ np.nan_to_num(joint) @ rows.T
