"""Decides which recordings are deleted, and deletes them.

The recording with the lowest number goes first. A recording that is open for reading, or that holds a result not
published yet, is kept.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import logging
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from agent.core.events import Pruned
from agent.recording.files import file_number, recordings, sync_directory

if TYPE_CHECKING:
    from agent.config.sinks import Recording

PIN_SUFFIX = ".lock"  # a file `fieldcal-000007.mcap.lock`, of any content, keeps the recording beside it
DAY_NS = 86_400_000_000_000

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class KeepFiles:
    """How many recordings are kept: at most `days` days and `bytes` bytes; None is no limit.

    `least_free_bytes`: free space to keep in the file system, by deleting recordings if need be.
    """

    days: float | None = None
    bytes: int | None = None
    least_free_bytes: int = 0


FOR_EVER = KeepFiles()


def keep_files(section: Recording) -> KeepFiles:
    """The limits that the section [recording] of the configuration sets."""
    most = int(section.keep_bytes) if section.keep_bytes is not None else None
    return KeepFiles(section.keep_days, most, int(section.least_free_bytes))


def due(directory: Path, keep: KeepFiles, active: Path | None, waiting: str, *, by_age: bool = True) -> Pruned | None:
    """The next files to delete, consecutive by number, as an event; None where none is due. Raises OSError.

    `active`: the file being written, which is kept. `waiting`: name of the recording with the first result that is not
    published; this recording and all later ones are kept. For its age only one file is deleted per call, and only with
    `by_age`.
    """
    if keep == FOR_EVER:
        return None
    files = [(number, path, path.stat()) for number, path in recordings(directory)]
    excess = _excess(directory, keep, sum(status.st_size for _, _, status in files))
    oldest_ns = time.time_ns() - int(keep.days * DAY_NS) if keep.days is not None and by_age else None
    limit = file_number(waiting)
    chosen: list[tuple[int, Path]] = []
    freed = 0
    for number, path, status in files:
        old = oldest_ns is not None and status.st_mtime_ns < oldest_ns and not chosen
        if path == active or (limit is not None and number >= limit) or not (freed < excess or old):
            break
        if is_kept(path) or (chosen and chosen[-1][0] + 1 != number):
            if chosen:
                break
            continue
        chosen.append((number, path))
        freed += status.st_size
    if not chosen:
        return None
    with open(chosen[-1][1], "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return Pruned(
        t_monotonic_ns=time.monotonic_ns(),
        t_utc_ns=time.time_ns(),
        first_file=chosen[0][0],
        last_file=chosen[-1][0],
        last_sha256=digest,
        bytes=freed,
    )


def delete(directory: Path, pruned: Pruned) -> None:
    """Delete the files of a range, except those that a reader has opened since `due` named them. Raises OSError."""
    for number, path in recordings(directory):
        if pruned.first_file <= number <= pruned.last_file and not is_kept(path):
            path.unlink(missing_ok=True)
    sync_directory(directory)
    _log.info("recordings %d to %d deleted", pruned.first_file, pruned.last_file)


def free_bytes(directory: Path) -> int:
    """Bytes in the file system that this user may still write. Raises OSError."""
    space = os.statvfs(directory)
    return space.f_bavail * space.f_frsize


def _excess(directory: Path, keep: KeepFiles, total: int) -> int:
    """Bytes of recordings that must be deleted."""
    excess = keep.least_free_bytes - free_bytes(directory)
    return max(excess, total - keep.bytes) if keep.bytes is not None else excess


def is_kept(path: Path) -> bool:
    """Whether a recording is pinned, or open in a program that reads it."""
    import fcntl  # only the agent deletes recordings; `fieldcal audit` imports this module where there is no fcntl

    if path.with_name(path.name + PIN_SUFFIX).exists():
        return True
    with contextlib.suppress(FileNotFoundError), open(path, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            return error.errno in (errno.EWOULDBLOCK, errno.EACCES)  # any other error: the file system has no locks
    return False
