"""What a window must keep to be used, and the verdict that says so with its numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.model import WindowSums


@dataclass(frozen=True, slots=True)
class Limits:
    """What a window must keep to be used. Every default says why."""

    least_points: int = 30  # four unknowns an axis and a residual to judge them by
    segment_s: float = 0.5  # five correlation times of AR(1) 0.99 at 1 kHz; the sums can be pooled to longer ones
    longest_s: float = 60.0  # the clock model's horizon; an offset may creep within a longer one
    most_restless: float = 4.0  # SD at rest over that of the other rests; a hand or a machine is ten times above it
    least_level: float = 3.0  # motion over the reference's noise, in band: 10 % of attenuation is then the worst
    least_coherence: float = 0.5  # in band, part of the sensor's power; a working pair shows above 0.95
    most_left_out_pct: float = 5.0  # knocks of 20 ms twice a second; more is no knock
    # Of a segment, in a window beyond the limit above: more, and the whole segment is left out. Where 8 % are knocked
    # out here and there, one segment in 500 of 25 points has as many.
    most_left_out_of_segment_pct: float = 25.0
    most_drift_mps2: float = 0.2  # of the mean within a window: offsets creep by 0.05, a turned clamp by metres
    most_drift_pct: float = 10.0  # or of the motion's own size, where that is more


DEFAULT_LIMITS = Limits()


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a window is used, why not, and the statistics behind it."""

    used: bool
    reason: str
    numbers: Mapping[str, float]


def judge(sums: WindowSums, struck: NDArray[np.bool_], numbers: Mapping[str, float], limits: Limits) -> Verdict:
    """Verdict on a window of these sums, of which the points `struck` were left out.

    `numbers`: for motion reference_rms_mps2, reference_noise_mps2, coherence, drift_mps2, stuck_axes and
    clipped_points; for a rest sd_over_floor where other rests are known. The verdict carries each with its threshold
    (`<name>_threshold`).
    """
    points = float(sums.count.sum())
    left_out = 100.0 * float(struck.mean()) if len(struck) else 0.0
    numbers = {"points": points, "left_out_pct": left_out, **numbers}
    numbers |= {f"{name}_threshold": limit for name, limit in _thresholds(numbers, limits).items()}
    return Verdict(not (reason := _reason(numbers)), reason, numbers)


def _thresholds(n: Mapping[str, float], limits: Limits) -> dict[str, float]:
    """What each number is held against; recorded with it, so that who checks can tell a close decision."""
    limit = {"points": float(limits.least_points), "left_out_pct": limits.most_left_out_pct}
    if "reference_rms_mps2" in n:
        limit["reference_rms_mps2"] = limits.least_level * n["reference_noise_mps2"]
        limit["clipped_points"] = 0.0
        limit["stuck_axes"] = 0.0
        limit["coherence"] = limits.least_coherence
        limit["drift_mps2"] = max(limits.most_drift_mps2, limits.most_drift_pct / 100.0 * n["reference_rms_mps2"])
    if "sd_over_floor" in n:
        limit["sd_over_floor"] = limits.most_restless
    return limit


def _reason(n: Mapping[str, float]) -> str:
    """The first thing that is wrong with a window of these numbers, "" where nothing is."""
    limit = {name: n[f"{name}_threshold"] for name in n if f"{name}_threshold" in n}
    if n["points"] < limit["points"]:
        return f"too few points: {n['points']:.0f}, {limit['points']:.0f} needed"
    if "reference_rms_mps2" in n:
        if n["reference_rms_mps2"] <= limit["reference_rms_mps2"]:
            return (
                f"the reference is silent: {n['reference_rms_mps2']:.3g} m/s2 in band, "
                f"its noise is {n['reference_noise_mps2']:.3g} m/s2"
            )
        if n["stuck_axes"] > limit["stuck_axes"]:
            return f"dead: {n['stuck_axes']:.0f} of the sensor's axes do not change at all"
        if n["clipped_points"] > limit["clipped_points"]:
            return f"clipped: {n['clipped_points']:.0f} points at the end of the sensor's range"
        if n["coherence"] < limit["coherence"]:
            return f"the sensor does not follow the reference: coherence {n['coherence']:.3f}"
        if n["drift_mps2"] > limit["drift_mps2"]:
            return (
                f"the sensor's mean moves by {n['drift_mps2']:.3g} m/s2 within the window, "
                f"{limit['drift_mps2']:.3g} at most"
            )
    if "sd_over_floor" in n and n["sd_over_floor"] > limit["sd_over_floor"]:
        return f"the sensor is not at rest: {n['sd_over_floor']:.1f} times the noise it has in other positions"
    if n["left_out_pct"] > limit["left_out_pct"]:
        return f"{n['left_out_pct']:.1f} % of the points are knocked out, {limit['left_out_pct']:g} % at most"
    return ""
