"""The results of a fleet's recordings in a directory: one file for each recording, complete or not there at all."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from agent.config.files import read_file
from agent.fleet.exporting import Exported, stem
from agent.fleet.task import UNCHANGED, RecordingTask
from agent.fleet.workers import DaskWorkers, LocalWorkers

LARGEST_RESULT = 1 << 30  # bytes of a result that is read again; a larger one is computed anew
SHOWN = ("sensor", "sequence", "windows", "sensitivity", "offset", "standard_uncertainty", "coverage_factor",
         "output_unit")  # fmt: skip


class Summary(msgspec.Struct, kw_only=True):
    """What is said of one recording. `reasons`: why it is refused, empty where it is not.

    `unchanged`: the result was there already. `calibrations`: the last one of each sensor, without its covariance.
    `exported`: files of samples.
    """

    place: str
    sha256: str = ""
    reasons: list[str] = []
    unchanged: bool = False
    events: int = 0
    results: int = 0
    windows: int = 0
    calibrations: list[dict[str, Any]] = []
    exported: list[Exported] = []


class _FileResultRead(msgspec.Struct):
    """A FileResult as JSON gives it: a number that is not known is null there."""

    place: str
    sha256: str
    made_by: str
    reasons: list[str]
    replayed: dict[str, Any] | None
    calibrations: list[dict[str, Any]]
    windows: list[dict[str, Any]]
    exported: list[Exported] = []


def results_of(
    places: Iterable[str], settings: Sequence[str], workers: LocalWorkers | DaskWorkers, directory: Path | None,
    *, audit: bool, export: str = "",
) -> Iterator[Summary]:  # fmt: skip
    """Compute each recording that has no valid result in `directory`, and write its result there. In any order.

    `export`: write samples with this ending into `directory` instead of replaying.
    Raises OSError where a result cannot be written.
    """
    known: dict[str, Summary] = {}  # of the tasks that are given out

    def tasks() -> Iterator[RecordingTask]:
        for place in places:
            before = _read(directory, place) if directory is not None else None
            if before is not None and before.reasons and export:  # a library may be there now that was missing
                before = None
            if before is not None:
                known[place] = _summary(before)
            made = (before.sha256, before.made_by) if before is not None else ("", "")
            yield RecordingTask(
                place=place, settings=tuple(settings), audit=audit, known=made, export=export,
                directory=str(directory) if export else "",
            )  # fmt: skip

    for task, result in workers.run(tasks()):
        before = known.pop(task.place, None)
        if isinstance(result, str):
            yield Summary(place=task.place, reasons=[result])
        elif result == UNCHANGED and before is not None:
            before.unchanged = True
            yield before
        else:
            read = msgspec.json.decode(result, type=_FileResultRead)
            if directory is not None and read.sha256:  # of a recording that could not be read there is nothing to keep
                _write(result_path(directory, task.place), result)
            yield _summary(read)


def result_path(directory: Path, place: str) -> Path:
    """The file of the result of the recording at `place`: its name, and a digest of its whole path."""
    return directory / f"{stem(place)}.json"


def _read(directory: Path, place: str) -> _FileResultRead | None:
    """The result that is there; None where there is none, or none that can be read."""
    try:
        found = msgspec.json.decode(read_file(result_path(directory, place), LARGEST_RESULT), type=_FileResultRead)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
    whole = all(_size(directory / one.file) == one.bytes for one in found.exported)
    return found if found.place == place and whole else None


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return -1


def _write(path: Path, result: bytes) -> None:
    """Write the result under a temporary name, bring it to the disk and rename it. Raises OSError."""
    new = path.with_name(path.name + ".new")
    with open(new, "wb") as file:
        file.write(result)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)


def _summary(read: _FileResultRead) -> Summary:
    last = {str(update.get("sensor")): update for update in read.calibrations}
    replayed = read.replayed or {}
    return Summary(
        place=read.place,
        sha256=read.sha256,
        reasons=read.reasons,
        events=replayed.get("events", 0),
        results=replayed.get("results", 0),
        windows=len(read.windows),
        exported=read.exported,
        calibrations=[{name: update.get(name) for name in SHOWN} for update in last.values()],
    )
