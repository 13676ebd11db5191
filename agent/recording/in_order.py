"""Several recordings that are read as one: of one gateway, each once, the oldest first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from agent.core.events import RunStart


class OrderError(Exception):
    """The recordings are not those of one gateway, or one is there twice. The message names them."""


def in_order(recordings: Sequence[tuple[Path, RunStart]]) -> list[Path]:
    """The recordings with their first events, the oldest first. Raises OrderError.

    The number of a recording tells its place, whatever the clock showed; where two have the same number, as after a
    data directory was lost, the time does.
    """
    gateways = sorted({f"{start.site}/{start.gateway}" for _, start in recordings})
    if len(gateways) > 1:
        raise OrderError(
            f"{recordings[0][0]}: the recordings are of several gateways, {', '.join(gateways)}; give those of one"
        )
    there: dict[tuple[str, int, int], Path] = {}
    for path, start in recordings:
        key = start.run_id, start.file_sequence, start.t_utc_ns
        if key in there:
            raise OrderError(f"{there[key]}: {path} is the same recording; give it once")
        there[key] = path
    numbered = len({start.file_sequence for _, start in recordings}) == len(recordings)
    oldest_first = sorted(recordings, key=lambda one: one[1].file_sequence if numbered else one[1].t_utc_ns)
    return [path for path, _ in oldest_first]
