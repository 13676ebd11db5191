"""The limits that a window must meet to be used, and the verdict with its statistics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from operator import gt, le, lt

import numpy as np
from numpy.typing import NDArray

from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import WindowSums

LEAST_STEP_MPS2 = 0.02  # 2 mg: a smaller change of the mean is possible whatever is stated
NONLINEAR_SD = 4.0  # a difference by so many standard uncertainties, of few blocks, may be noise
# The means of a window's segments by so many of their standard uncertainties may be noise, in some hundred of them.
DRIFT_SD = 5.0
STEP_SD = 5.0  # a step of the mean by so many of its standard uncertainties may be noise, wherever it is searched


# Why a window is refused: a statistic, how it breaks its limit, and the sentence; the first that breaks it is told.
RULES: tuple[tuple[str, Callable[[float, float], bool], str], ...] = (
    ("points", lt, "too few points: {points:.0f}, {points_threshold:.0f} needed"),
    ("reference_rms_mps2", le, "the reference is silent: {reference_rms_mps2:.3g} m/s2 rms in band, "
     "{reference_rms_mps2_threshold:.3g} m/s2 needed (its noise is {reference_noise_mps2:.3g} m/s2)"),
    ("stuck_axes", gt, "dead: the output of {stuck_axes:.0f} of the sensor's axes does not change at all"),
    ("clipped_points", gt, "clipped: {clipped_points:.0f} points at the end of the sensor's range"),
    ("coherence", lt, "the sensor does not follow the reference: coherence {coherence:.3f}, "
     "{coherence_threshold:g} needed"),
    ("drift_mps2", gt, "the sensor's mean changes by {drift_mps2:.3g} m/s2 within the window, "
     "{drift_mps2_threshold:.3g} m/s2 at most"),
    ("step_mps2", gt, "the sensor's mean changes by {step_mps2:.3g} m/s2 from one part of the window to the other, "
     "{step_mps2_threshold:.3g} m/s2 at most by the stated uncertainties of angle and offset"),
    ("nonlinearity_pct", gt, "the output is not proportional to the motion: where the motion is strongest, the "
     "sensitivity differs by {nonlinearity_pct:.1f} %, {nonlinearity_pct_threshold:.1f} % at most (a mount that slips "
     "or rattles?)"),
    ("sd_over_floor", gt, "the sensor is not at rest: its noise is {sd_over_floor:.1f} times that in other positions, "
     "{sd_over_floor_threshold:g} times at most"),
    ("left_out_pct", gt, "{left_out_pct:.1f} % of the points are knocks, {left_out_pct_threshold:g} % at most"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits that a window must meet to be used; the comment beside each default gives its reason."""

    least_points: int = 30  # four unknowns per axis, and enough residuals to estimate the noise
    segment_s: float = 0.5  # five correlation times of AR(1) noise with 0.99 at 1 kHz; segments can be merged
    longest_s: float = 60.0  # the horizon of the clock model; in a longer window an offset may drift
    most_restless: float = 4.0  # SD at rest over that of the other rests; hands or machines cause ten times as much
    least_level: float = 3.0  # reference's motion over its noise, in band: the noise then reduces S by 10 % at most
    least_coherence: float = 0.5  # part of the sensor's power that the reference explains, in band; 0.95 is usual
    most_left_out_pct: float = 5.0  # two knocks of 20 ms per second leave out 4 %
    # Of a segment, in a window beyond the limit above: with more, the whole segment is left out. If 8 % of the points
    # are knocks at random places, one segment in 500 of 25 points has as many.
    most_left_out_of_segment_pct: float = 25.0
    most_drift_mps2: float = 0.2  # of the mean within a window: offsets drift by 0.05
    most_drift_pct: float = 10.0  # the same relative to the motion's rms; the larger limit counts
    # Of the strongest tenth of the motion, beyond its noise; S is then off by a few tenths. Instruments stay below 1 %.
    most_nonlinearity_pct: float = 2.0
    most_step_mps2: float = 0.12  # of the mean within a window, beyond its noise: `of` a stated 0.05 m/s2 and 0.2 deg

    @classmethod
    def of(cls, offset_mps2: float, angle_rad: float, longest_s: float = 60.0) -> Limits:
        """The limits for stated standard uncertainties of the offset and of a position's angle.

        A mean that changes by twice what is stated is one standard uncertainty off in the middle of the change.
        """
        stated = float(np.hypot(offset_mps2, STANDARD_GRAVITY_MPS2 * angle_rad))
        return cls(longest_s=longest_s, most_step_mps2=max(2.0 * stated, LEAST_STEP_MPS2))

    @property
    def unsteady(self) -> Limits:
        """The same without limits of how the mean may change."""
        return replace(self, most_drift_mps2=np.inf, most_step_mps2=np.inf)

    @property
    def of_any_response(self) -> Limits:
        """The same without limits that a window may miss because the sensor responds in another way."""
        return replace(self.unsteady, least_coherence=0.0, most_left_out_pct=100.0, most_nonlinearity_pct=np.inf)


DEFAULT_LIMITS = Limits()


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a window is used, the reason if it is not, and the statistics, each with its unit in its name."""

    used: bool
    reason: str
    numbers: Mapping[str, float]


def judge(sums: WindowSums, struck: NDArray[np.bool_], numbers: Mapping[str, float], limits: Limits) -> Verdict:
    """The verdict on a window with these sums.

    `struck` (n,) flags the points that were found to be knocks. `numbers` are the statistics: for motion
    reference_rms_mps2, reference_noise_mps2, coherence, drift_mps2, stuck_axes, clipped_points and those of
    `steadiness.nonlinearity`, and u_drift_mps2 where it matters; for a rest sd_over_floor, if there are other rests to
    compare with; for both step_mps2 and u_step_mps2. The verdict's numbers hold the limit of each statistic beside it,
    as `<name>_threshold`.
    """
    points = float(sums.count.sum())
    left_out = 100.0 * float(struck.mean()) if len(struck) else 0.0
    numbers = {"points": points, "left_out_pct": left_out, **numbers}
    numbers |= {f"{name}_threshold": limit for name, limit in _thresholds(numbers, limits).items()}
    return Verdict(not (reason := _reason(numbers)), reason, numbers)


def disproportionate(n: Mapping[str, float]) -> bool:
    """Whether the output of a window with these numbers is not proportional to the motion."""
    return "nonlinearity_pct" in n and n["nonlinearity_pct"] > n["nonlinearity_pct_threshold"]


def _thresholds(n: Mapping[str, float], limits: Limits) -> dict[str, float]:
    """The limit of each statistic. It is recorded beside the statistic: a reader sees how close a decision was."""
    limit = {"points": float(limits.least_points), "left_out_pct": limits.most_left_out_pct}
    if "reference_rms_mps2" in n:
        limit["reference_rms_mps2"] = limits.least_level * n["reference_noise_mps2"]
        limit["clipped_points"] = 0.0
        limit["stuck_axes"] = 0.0
        limit["coherence"] = limits.least_coherence
        steady = max(limits.most_drift_mps2, limits.most_drift_pct / 100.0 * n["reference_rms_mps2"])
        limit["drift_mps2"] = max(steady, DRIFT_SD * n.get("u_drift_mps2", 0.0))
    if "nonlinearity_pct" in n:
        # Of a reference with noise, the strongest values are those to which the noise adds, and the sensor shows less
        # there: by 60 % of noise over motion for a sine, 150 % for a square wave, nothing for Gaussian motion.
        noise_pct = 100.0 * n["reference_noise_mps2"] / max(n["reference_rms_mps2"], np.finfo(float).tiny)
        beyond = float(np.hypot(limits.most_nonlinearity_pct, NONLINEAR_SD * n["u_nonlinearity_pct"]))
        limit["nonlinearity_pct"] = beyond + noise_pct * max(0.0, (3.0 - n["motion_kurtosis"]) / 1.5) ** 2
    if "step_mps2" in n:
        limit["step_mps2"] = float(np.hypot(limits.most_step_mps2, STEP_SD * n["u_step_mps2"]))
    if "sd_over_floor" in n:
        limit["sd_over_floor"] = limits.most_restless
    return limit


def _reason(n: Mapping[str, float]) -> str:
    """The first limit that these numbers do not meet, as a sentence; "" if they meet all limits."""
    for name, broken, sentence in RULES:
        if f"{name}_threshold" in n and broken(n[name], n[f"{name}_threshold"]):
            return sentence.format_map(n)
    return ""
