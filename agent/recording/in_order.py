"""Several recordings that are read as one: of one gateway, each once, the oldest first."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from agent.core.events import RunStart
from agent.recording.reading import RecordingReader
from agent.recording.result_signing import PUBLIC_KEY
from agent.recording.results_chain import EPOCH, FILE_METADATA
from agent.recording.scan import metadata_of


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


def of_one_gateway(recordings: Sequence[tuple[Path, RunStart]]) -> list[Path]:
    """As `in_order`, after a look at whether two gateways have one name. Raises OrderError, OSError.

    A recording names the store of its gateway. A gateway that lost its store goes on with another one. Two stores that
    were in use at the same time, or that sign with two keys, are those of two gateways.
    """
    order = in_order(recordings)
    marks = {path: metadata_of(path).get(FILE_METADATA, {}) for path in order} if len(order) > 1 else {}
    stores = {path: mark[EPOCH] for path, mark in marks.items() if mark.get(EPOCH)}
    if len(set(stores.values())) < 2:
        return order
    starts = dict(recordings)
    by_time = sorted(stores, key=lambda path: starts[path].t_utc_ns)
    for before, after in pairwise(by_time):
        if stores[before] == stores[after]:
            continue
        keys = {marks[path].get(PUBLIC_KEY, "") for path in (before, after)} - {""}
        again = stores[before] in [stores[path] for path in by_time[by_time.index(after) :]]
        if again or len(keys) > 1 or _end_ns(before) > starts[after].t_utc_ns:
            why = "they sign with two keys" if len(keys) > 1 else "both recorded at the same time"
            name = f"{starts[after].site}/{starts[after].gateway}"
            raise OrderError(
                f"{after}: it is of another gateway than {before}, though both are called {name}: {why}; give the "
                "recordings of one, and let each gateway have a name of its own in [gateway]"
            )
    return order


def _end_ns(path: Path) -> int:
    """UTC of the last event that a recording has, ns."""
    return max(getattr(step.event, "t_utc_ns", 0) for step in RecordingReader(path).steps())
