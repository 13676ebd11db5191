"""From a recording to S and Q, with the adjustment's steps (clock, windows, solve, shift, repeat) and without."""

from __future__ import annotations

import numpy as np

from calib.adjustment.adjustment import Adjustment, adjust
from calib.estimate.nuisances import Applied, Priors
from calib.excitation.windows import Points, judged
from calib.geometry import clamp
from calib.model import Pose, Window, WindowSums
from calib.paper.method3 import fit
from calib.signal.corner import integral, with_integral, without_corner
from calib.signal.resampling import differentiate, resample
from calib.signal.stamps import clock_from_stamps
from calib.windows.sums import window_sums
from hw.virtual.bench import BenchRecording
from hw.virtual.schedule import PoseInterval

LAG_LEFT_S = 2e-5  # a smaller lag changes S by less than (omega tau)^2 / 2 = 3e-7 at 6 Hz
CORNER_LEFT_HZ = 1e-3  # a smaller corner changes S by less than (c / omega)^2 / 2 = 2e-6 at 0.5 Hz
PASSES = 4


def adjusted(recording: BenchRecording, priors: Priors, velocity: bool) -> Adjustment:
    """Solve, correct for the lag and the corner that were found, and repeat until they are negligible."""
    sensor = clock_from_stamps(recording.sensor_stamp_s)
    reference = clock_from_stamps(recording.reference_stamp_s)
    times = np.asarray(sensor.time_of(np.arange(len(recording.v))))
    x, margin = recording.reference, 0
    if velocity:
        x, margin = differentiate(x, reference.rate_hz)
    coupled = priors.reference_corner_at_hz > 0.0
    applied = Applied(reference_corner_hz=priors.reference_corner_at_hz)
    for _ in range(PASSES):
        whole = without_corner(x, reference.rate_hz, applied.reference_corner_hz)
        if coupled:
            whole = np.hstack([whole, integral(x, reference.rate_hz)])
        moved = resample(whole, reference, times - applied.lag_s, margin=margin)
        windows = []
        for interval in recording.poses:
            inside = np.flatnonzero((times >= interval.start_s) & (times < interval.stop_s) & moved.usable)
            t = times[inside]
            points = Points(t, recording.v[inside], moved.u[inside], moved.du[inside])
            windows += judged("motion", with_integral(_pose(interval)) if coupled else _pose(interval), points)
        found = adjust(windows, priors, applied)
        totals = {n.name: n.value for n in found.nuisances}
        before = applied
        applied = Applied(totals["lag"], totals.get("reference_corner", before.reference_corner_hz))
        corner_left = abs(applied.reference_corner_hz - before.reference_corner_hz)
        if abs(applied.lag_s - before.lag_s) < LAG_LEFT_S and corner_left < CORNER_LEFT_HZ:
            break
    return found


def plain(recording: BenchRecording, velocity: bool) -> np.ndarray:
    """Method 3 as printed, with the stamps as they are: no clock model, no lag, all points."""
    reference = recording.reference
    if velocity:
        reference = np.gradient(reference, recording.reference_stamp_s, axis=0)
    windows = []
    for interval in recording.poses:
        inside = (recording.sensor_stamp_s >= interval.start_s) & (recording.sensor_stamp_s < interval.stop_s)
        u = np.interp(recording.sensor_stamp_s[inside], recording.reference_stamp_s, reference[:, 0])[:, None]
        sums: WindowSums = window_sums(u, np.zeros_like(u), recording.v[inside], [0, len(u)])
        windows.append(Window(interval.start_s, interval.stop_s, _pose(interval), sums, True, "", len(u), 0))
    calibration = fit(windows).calibration
    return np.concatenate([calibration.sensitivity.ravel(), calibration.offset])


def _pose(interval: PoseInterval) -> Pose:
    if interval.theta_deg is None or interval.alpha_deg is None:
        raise ValueError(f"position {interval.position} is not on the clamp")
    return clamp(np.deg2rad(interval.theta_deg), np.deg2rad(interval.alpha_deg), position=interval.position)
