"""Windows out of streams, and their state for a snapshot."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from agent.config import Channel
from agent.schedule import Piece
from agent.stream import Cut, DeviceStream
from calib.excitation import Points, motion_windows, rest_window
from calib.model import Pose, Window, WindowSums
from calib.resampling import differentiate, resample

# Reference samples beyond a window's ends: half the taps of resampling, and of differentiating at 100 Hz and above.
MARGIN_S = 0.5


def windows_in(piece: Piece, first_s: float, channel: Channel, streams: dict[str, DeviceStream]) -> list[Window]:
    """The windows of a stretch in one pose, each with its verdict; one unused window where there is nothing to judge.

    `first_s` is the time of the sensor's first sample; the windows' times count from it.
    """
    start_s, stop_s = first_s + piece.start_s, first_s + piece.stop_s
    cut = streams[channel.sensor].cut(start_s, stop_s)
    if cut is None:
        return [_refused(piece, f"no samples of {channel.sensor}")]
    if fault := _fault(channel.sensor, cut, axes=3):
        return [_refused(piece, fault)]
    if channel.reference is None:
        found = _rest(piece, cut)
    else:
        reference = streams[channel.reference].cut(start_s - MARGIN_S, stop_s + MARGIN_S)
        if reference is None:
            return [_refused(piece, f"no samples of the reference {channel.reference}")]
        if fault := _fault(f"the reference {channel.reference}", reference, axes=piece.pose.direction.shape[1]):
            return [_refused(piece, fault)]
        found = _motion(piece, cut, reference, channel)
    if not found:
        return [_refused(piece, "the samples of sensor and reference do not meet")]
    if cut.saturated:
        found = [replace(w, used=False, reason=w.reason or "the sensor was at the end of its range") for w in found]
    return [replace(w, start_s=w.start_s - first_s, stop_s=w.stop_s - first_s) for w in found]


def _fault(device: str, cut: Cut, axes: int) -> str:
    """Why a device cannot take part in a pose that needs this many axes of it; "" where it can."""
    if cut.axes != axes:
        return f"{device} has {cut.axes} {'axis' if cut.axes == 1 else 'axes'}, this pose needs {axes}"
    return "" if cut.in_time else f"{device}: its sample numbers and arrivals do not make a clock"


def _rest(piece: Piece, cut: Cut) -> list[Window]:
    whole = np.isfinite(cut.indications).all(axis=1)
    if whole.sum() < 2:
        return []
    return [rest_window(piece.pose, cut.time_s[whole], cut.indications[whole], leave_out=False)]


def motion_points(cut: Cut, reference: Cut, channel: Channel) -> Points | None:
    """Samples of the sensor that have a reference, with it in m/s2 at their times; None where there are not two."""
    u, margin = reference.indications / channel.reference_sensitivity, 0
    if channel.reference_quantity == "velocity":
        u, margin = differentiate(u, reference.clock.rate_hz)
    time_s = cut.time_s
    at = resample(u, reference.clock, time_s, reference.first_index, margin)
    usable = at.usable & np.isfinite(at.u).all(axis=1) & np.isfinite(cut.indications).all(axis=1)
    if usable.sum() < 2:
        return None
    return Points(time_s[usable], cut.indications[usable], at.u[usable], at.du[usable])


def _motion(piece: Piece, cut: Cut, reference: Cut, channel: Channel) -> list[Window]:
    points = motion_points(cut, reference, channel)
    # Method 3 as printed takes all points of a window.
    return [] if points is None else motion_windows(piece.pose, points, leave_out=False)


def _refused(piece: Piece, reason: str) -> Window:
    m = piece.pose.direction.shape[1]
    nothing = WindowSums(m, np.zeros(0), np.zeros((0, 2 * m + 3)), np.zeros((0, 2 * m + 3, 2 * m + 3)))
    return Window(piece.start_s, piece.stop_s, piece.pose, nothing, False, reason, 0, 0)


def window_state(window: Window) -> dict[str, Any]:
    """A window as plain values."""
    pose, sums = window.pose, window.sums
    return {
        "start_s": window.start_s,
        "stop_s": window.stop_s,
        "used": window.used,
        "reason": window.reason,
        "points": window.points,
        "left_out": window.left_out,
        "kind": window.kind,
        "numbers": dict(window.numbers),
        "pose": {name: getattr(pose, name) for name in Pose.__slots__},
        "sums": {name: getattr(sums, name) for name in WindowSums.__slots__},
    }


def window_of(state: dict[str, Any]) -> Window:
    """The window that `window_state` took apart."""
    return Window(**(state | {"pose": Pose(**state["pose"]), "sums": WindowSums(**state["sums"])}))
