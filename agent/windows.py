"""Windows out of streams, and their state for a snapshot."""

from __future__ import annotations

from typing import Any

import numpy as np

from agent.config import Channel
from agent.schedule import Piece
from agent.stream import DeviceStream
from calib.model import Pose, Window, WindowSums
from calib.sums import window_sums

MARGIN_S = 0.5


def make_window(piece: Piece, first_s: float, channel: Channel, streams: dict[str, DeviceStream]) -> Window:
    start_s, stop_s = first_s + piece.start_s, first_s + piece.stop_s
    cut = streams[channel.sensor].cut(start_s, stop_s)
    m = piece.pose.direction.shape[1]
    u = np.zeros((len(cut.time_s), m))
    if m:
        ref = streams[channel.reference].cut(start_s - MARGIN_S, stop_s + MARGIN_S)
        u = np.interp(cut.time_s, ref.time_s, ref.indications[:, 0])[:, None]
    sums = window_sums(u, np.zeros_like(u), cut.indications, [0, len(u)])
    return Window(piece.start_s, piece.stop_s, piece.pose, sums, True, "", len(u), 0)


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
