"""Fewer, longer segments for the windows of a long recording: their sums then need no more memory for a day than for
some hours."""

from __future__ import annotations

import itertools

from calib.model import WindowSums
from calib.windows.sums import merge, pool

MOST_SEGMENTS = 1 << 15  # of a recording; half a second each, they are four and a half hours


def segments_joined(length_s: float, segment_s: float) -> int:
    """How many neighbouring segments of `segment_s` are joined where all windows together may have `length_s`."""
    return max(1, -(-int(length_s / segment_s) // MOST_SEGMENTS))


def with_joined(sums: WindowSums, size: int) -> WindowSums:
    """The same sums with `size` neighbouring segments joined to one; what is left over goes into the last one.

    Nothing is lost but the scatter between the segments that are joined, of which a long recording has plenty.
    """
    count = len(sums.count)
    if size == 1 or count < 2:
        return sums
    edges = [*(size * k for k in range(max(count // size, 1))), count]
    return merge([
        pool(WindowSums(sums.reference_channels, sums.count[a:b], sums.mean[a:b], sums.scatter[a:b]))
        for a, b in itertools.pairwise(edges)
    ])  # fmt: skip
