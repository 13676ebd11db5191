"""Windows out of the streams of one channel, by the front end that files use as well."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from agent.config import Channel
from agent.core.schedule import PosePiece
from agent.core.stream import DeviceStream
from calib.excitation.front_end import (
    LEAST_MARGIN_S,
    Aligned,
    Settings,
    Unusable,
    aligned,
    margin_s,
    nothing_in,
    windows_of,
)
from calib.excitation.window_verdict import DEFAULT_LIMITS, Limits
from calib.model import Window
from calib.signal.response import FLAT, Response
from calib.signal.samples import Samples
from calib.windows.bands import ABOVE, HIGHEST, motion_band_hz, share_above

# Share of the motion's power above the band that may stay where a response is taken out: what that makes of the rest of
# a shock is none of the instruments, and S would be fitted to it.
ABOVE_RESPONSE = 0.1 * ABOVE


@dataclass(frozen=True, slots=True, eq=False)
class StretchWindows:
    """The windows of a stretch, in seconds since the sensor's first sample; its temperature, NaN where none is told."""

    windows: list[Window]
    temperature_degc: float = float("nan")

    @property
    def used(self) -> list[Window]:
        """Those of the windows that are used."""
        return [window for window in self.windows if window.used]

    def because(self, why: str) -> StretchWindows:
        """The same with `why` added to the reasons of the windows that are not used; "" adds nothing."""
        if not why:
            return self
        return replace(self, windows=[w if w.used else replace(w, reason=f"{w.reason}; {why}") for w in self.windows])

    def refused(self, reason: str) -> StretchWindows:
        """The same, none of the windows used for this reason."""
        return replace(self, windows=[replace(w, used=False, reason=w.reason or reason) for w in self.windows])

    def with_numbers(self, numbers: Mapping[str, float]) -> StretchWindows:
        """The same with numbers more in each window."""
        return replace(self, windows=[replace(w, numbers={**w.numbers, **numbers}) for w in self.windows])


def windows_in(
    piece: PosePiece,
    first_s: float,
    channel: Channel,
    streams: dict[str, DeviceStream],
    lag_s: float,
    response: Response = FLAT,
    to_hz: float = np.inf,
    limits: Limits = DEFAULT_LIMITS,
    most_noise: tuple[float, ...] = (),
) -> StretchWindows:
    """The windows of a stretch in one pose, each with its verdict; one unused window where there is nothing to judge.

    `first_s` is the time of the sensor's first sample; the windows' times count from it. The sensor's indications are
    taken to come late by `lag_s`, and to be what `response` makes of the motion. Motion above `to_hz` is filtered out.
    `limits` as `limits_of` gives them, `most_noise` as in calib.excitation.front_end.Settings.
    """
    span_s = first_s + piece.start_s, first_s + piece.stop_s

    def made(limit_hz: float | None) -> list[Window]:
        settings = Settings(limits, bands=True, to_hz=limit_hz, most_noise=most_noise)
        return windows_of(
            piece.pose, sensor, reference, channel.instrument, span_s, lag_s, settings, response=response
        )  # fmt: skip

    try:
        sensor, reference = _cut(span_s, channel, streams)
        found = made(None)
        most = ABOVE if response.is_flat else ABOVE_RESPONSE
        if any(share_above(window.bands, HIGHEST * to_hz) > most for window in found):
            motion_hz = motion_band_hz(found, lasting=True)
            found = [replace(window, motion_hz=motion_hz) for window in made(to_hz)]
    except Unusable as error:
        return StretchWindows([refused(piece, str(error))])
    if not found:
        return StretchWindows([refused(piece, "the samples of sensor and reference do not overlap in time")])
    found = [replace(w, start_s=w.start_s - first_s, stop_s=w.stop_s - first_s) for w in found]
    return StretchWindows(found, sensor.temperature_degc)


def aligned_in(
    piece: PosePiece,
    first_s: float,
    channel: Channel,
    streams: dict[str, DeviceStream],
    lag_s: float,
    response: Response = FLAT,
    to_hz: float = np.inf,
) -> Aligned | None:
    """The samples of a stretch from which `windows_in` makes its windows, with the same parameters; None where there
    is no reference beside them."""
    span_s = first_s + piece.start_s, first_s + piece.stop_s
    settings = Settings(to_hz=to_hz if np.isfinite(to_hz) else None)
    try:
        sensor, reference = _cut(span_s, channel, streams)
    except Unusable:
        return None
    if reference is None:
        return None
    return aligned(sensor, reference, channel.instrument, span_s, lag_s, settings, response)


def _cut(
    span_s: tuple[float, float], channel: Channel, streams: dict[str, DeviceStream]
) -> tuple[Samples, Samples | None]:
    """The samples of sensor and reference between two times and around. Raises Unusable where there are none."""
    around_s = margin_of(channel, streams)
    sensor = streams[channel.sensor].cut(span_s[0] - 0.5 * around_s, span_s[1] + 0.5 * around_s)
    if sensor is None:
        raise Unusable(f"no samples of {channel.sensor}")
    if channel.reference is None:
        return sensor, None
    reference = streams[channel.reference].cut(span_s[0] - around_s, span_s[1] + around_s)
    if reference is None:
        raise Unusable(f"no samples of the reference {channel.reference}")
    return sensor, reference


def limits_of(channel: Channel) -> Limits:
    """What the windows of a channel must keep to be used."""
    known = channel.priors(fixed_mount=channel.fixed_mount)
    return Limits.of(known.offset_mps2, known.angle_rad, channel.window_s)


def margin_of(channel: Channel, streams: Mapping[str, DeviceStream]) -> float:
    """How many seconds beyond both ends of a piece its windows need."""
    rate_hz = streams[channel.reference].nominal_rate_hz if channel.reference is not None else None
    return LEAST_MARGIN_S if rate_hz is None else margin_s(channel.instrument, rate_hz)


def refused(piece: PosePiece, reason: str) -> Window:
    """The window of a piece in which there is nothing to judge."""
    return nothing_in(piece.pose, piece.start_s, piece.stop_s, reason)
