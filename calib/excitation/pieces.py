"""The pieces into which a stretch of time in one position is cut; windows are made from each piece."""

from __future__ import annotations

from collections.abc import Iterator

ROUNDING_S = 1e-6  # rounding error of sums of times


def pieces_of(
    start_s: float, stop_s: float, window_s: float, guard_s: float, every_s: float = 0.0, after_s: float = -float("inf")
) -> Iterator[tuple[float, float]]:
    """(start, stop) in s of the pieces of the stretch from `start_s` to `stop_s`, in order; no end if `stop_s` is inf.

    `guard_s` is left out at both ends of the stretch, where the sensor is being turned. A piece is `window_s` long; the
    last piece may be shorter. A piece begins every `every_s`; 0 means that each begins where the one before ends.
    Pieces that begin before `after_s` are left out, because they were made already. All times in s.
    """
    first_s, last_s = start_s + guard_s, stop_s - guard_s
    apart_s = every_s or window_s
    k = max(0, int((after_s - first_s) // apart_s)) if after_s > first_s else 0
    end_s = first_s
    while end_s < last_s:
        begin_s = first_s + k * apart_s
        end_s, k = min(begin_s + window_s, last_s), k + 1
        if begin_s > after_s - ROUNDING_S and begin_s < end_s:
            yield begin_s, end_s
