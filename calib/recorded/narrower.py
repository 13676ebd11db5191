"""Narrower bands of frequency for motion that reaches into a filter's edge, a resonance or a corner.

V = S a + Q holds for filtered signals as well, if both pass the same filter. What lies outside the band is then lost,
and with it what no smooth response over frequency explains.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.model import Array, Window
from calib.windows.bands import below_gap_hz, motion_band_hz

Band = tuple[float, float]  # in Hz; an end of 0 limits nothing
# Octaves cut off the motion's band at its lower and at its upper end, from wide to narrow. The list is fixed
# beforehand: the first band that fits is used, and its limit is the narrower the more were tried.
CUTS = (
    (0.0, 0.5), (0.0, 1.0), (1.0, 0.0), (0.0, 1.5), (1.0, 1.0), (2.0, 0.0), (0.0, 2.0), (1.0, 2.0), (2.0, 1.0),
)  # fmt: skip
LEAST_OCTAVES = 1.0  # that are left
LEAST_POWER = 0.5  # of the motion


def narrower_bands(windows: Sequence[Window], stated_hz: float) -> tuple[Band, ...]:
    """The bands of CUTS that keep an octave and half of the power of these windows' motion, from wide to narrow.

    Bands without the frequency at which S is to hold, `stated_hz`, are left out; 0 where nobody stated it.
    """
    whole = motion_band_hz(windows)
    if whole is None:
        return ()
    found = [(whole[0] * 2.0**below, whole[1] * 2.0**-above) for below, above in CUTS]
    kept = [
        (low_hz if below else 0.0, high_hz)
        for (low_hz, high_hz), (below, _) in zip(found, CUTS, strict=True)
        if high_hz >= 2.0**LEAST_OCTAVES * low_hz
        and (not stated_hz or low_hz <= stated_hz <= high_hz)
        and _share(windows, low_hz if below else 0.0, high_hz) >= LEAST_POWER
    ]
    return tuple(kept)


def band_below_gap(windows: Sequence[Window], stated_hz: float) -> tuple[Band, ...]:
    """The band of the motion below a gap of two octaves, as between waves and an engine: no smooth response is told
    across it. Empty where there is no such gap, or where S is to hold above it, at `stated_hz`."""
    end_hz = below_gap_hz(windows)
    return () if end_hz is None or stated_hz > end_hz else ((0.0, end_hz),)


def _share(windows: Sequence[Window], low_hz: float, high_hz: float) -> float:
    """The share of the motion's power in a band of frequency; that of a window's band is taken to be even over it."""
    parts: list[Array] = []
    for bands in (w.bands for w in windows if w.bands is not None):
        power = np.trace(bands.products[:, : bands.reference_channels, : bands.reference_channels], axis1=1, axis2=2)
        width = np.minimum(bands.high_hz, high_hz) - np.maximum(bands.low_hz, low_hz)
        inside = np.maximum(width, 0.0) / (bands.high_hz - bands.low_hz)
        parts.append(np.array([power @ inside, power.sum()]))
    kept, total = np.sum(parts, axis=0).tolist()
    return kept / total if total > 0.0 else 0.0
