"""Decides which recording is deleted next, and deletes it: one at a time, the one with the lowest number first.

The limits of the user (age, bytes of all recordings) hold at once. For free space nothing is lost in haste, because
other programs fill disks and empty them again: the lack must last, deleting must be able to end it, and the status and
the log say it first. A recording that is open for reading, or that holds a result not published yet, is kept.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from agent.core.events import Pruned
from agent.recording.files import ACTIVE_SUFFIX, file_number, recordings, sync_directory
from agent.recording.results_chain import EPOCH, FILE_METADATA
from agent.recording.scan import metadata_of

if TYPE_CHECKING:
    from agent.config.sinks import Recording

PIN_SUFFIX = ".lock"  # a file `fieldcal-000007.mcap.lock`, of any content, keeps the recording beside it
DAY_NS = 86_400_000_000_000
# Free bytes for the agent's own next writes: a file of the default size, or a part of it, and the store. Below this the
# oldest recording goes in any case: a gateway that neither records nor stores results is worth less.
OWN_ROOM_BYTES = 64 << 20
SHORT_S = 300.0  # s of event time that a lack of free space must last, longer than most programs hold a temporary file
SAID_S = 30.0  # s of event time from the saying to the first loss; the status is published several times meanwhile
# s of event time between two deletions for free space. A file system may show the space of a deleted file only after
# its next commit, by default each 5 s (Linux, Documentation/admin-guide/ext4.rst) or 30 s (Linux,
# Documentation/filesystems/btrfs.txt). Where it does not show it after 10 s, the next deletion waits SHORT_S.
PACE_S = 10.0

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class KeepFiles:
    """How many recordings are kept: at most `days` days and `bytes` bytes; None is no limit.

    `least_free_bytes`: free space to keep in the file system, by deleting recordings if need be; 0: none is deleted for
    free space. `at_least_days`: younger recordings are not deleted for `least_free_bytes`.
    """

    days: float | None = None
    bytes: int | None = None
    least_free_bytes: int = 0
    at_least_days: float = 0.0


FOR_EVER = KeepFiles()


def keep_files(section: Recording) -> KeepFiles:
    """The limits that the section [recording] of the configuration sets."""
    most = int(section.keep_bytes) if section.keep_bytes is not None else None
    return KeepFiles(section.keep_days, most, int(section.least_free_bytes), section.keep_at_least_days)


@dataclass(frozen=True, slots=True)
class Moment:
    """When and in which state it is asked what is due. `now_ns`, `utc_ns`: event time, CLOCK_MONOTONIC and UTC.

    `active`: the file being written, which is kept; None while nothing is recorded. `waiting`: name of the recording
    with the first result that is not published; this recording and all later ones are kept. `by_age`: whether a file
    may be deleted for its age. `quota`: whether the last write failed because the user's quota is used up.
    """

    now_ns: int
    utc_ns: int
    active: Path | None = None
    waiting: str = ""
    by_age: bool = True
    quota: bool = False


@dataclass(frozen=True, slots=True)
class _File:
    number: int
    path: Path
    size: int
    closed_ns: int


class Retention:
    """Watches the limits of a directory of recordings. Time is event time, so the same events give the same deletions.

    `notice`: what is said of the lack of free space; "" where there is none.
    """

    def __init__(self, directory: Path, keep: KeepFiles) -> None:
        self._directory, self._keep = directory, keep
        self.notice = ""
        self._said_ns = 0  # when `notice` was last changed
        self._short_ns: int | None = None  # since when less than least_free_bytes is free
        self._urgent_ns: int | None = None  # since when less than the agent's own room is free
        self._deleted_ns: int | None = None  # when a file was last named for free space
        self._expected = 0  # bytes that must be free after that, if deleting helps

    def due(self, at: Moment) -> Pruned | None:
        """The next file to delete, as an event; None where none is due. Raises OSError."""
        if self._keep == FOR_EVER:
            return None
        files = [_File(n, path, (s := path.stat()).st_size, s.st_mtime_ns) for n, path in recordings(self._directory)]
        candidates = _candidates(files, at)
        chosen = self._over_limit(files, candidates, at) or self._for_space(candidates, at)
        return None if chosen is None else _event(chosen, at)

    def _over_limit(self, files: Sequence[_File], candidates: Sequence[_File], at: Moment) -> _File | None:
        keep = self._keep
        if keep.bytes is not None and sum(file.size for file in files) > keep.bytes:
            return next(_free(candidates), None)
        if keep.days is not None and at.by_age:
            return next(_free(file for file in candidates if _age_days(file, at) > keep.days), None)
        return None

    def _for_space(self, candidates: Sequence[_File], at: Moment) -> _File | None:
        keep, free = self._keep, free_bytes(self._directory)
        urgent, short = self._lack(free, at)
        deletable = list(_free(candidates)) if short else []
        old = [file for file in deletable if _age_days(file, at) > keep.at_least_days]
        helps = free + sum(file.size for file in old) >= keep.least_free_bytes
        self._say(self._words(urgent=urgent, helps=helps, quota=at.quota) if short else "", at.now_ns)
        choice = deletable if urgent else old if helps else []
        if not choice or at.now_ns < self._earliest_ns(free):
            return None
        chosen = choice[0]
        if chosen not in old:
            days = f"recording.keep_at_least_days ({keep.at_least_days:g})"
            _log.warning("%s is deleted though it is younger than %s: the disk is almost full", chosen.path, days)
        self._deleted_ns, self._expected = at.now_ns, free + chosen.size // 2
        return chosen

    def _lack(self, free: int, at: Moment) -> tuple[bool, bool]:
        """Whether the agent's own room is lacking, and whether free space is; and since when."""
        least = self._keep.least_free_bytes
        urgent = bool(least) and (at.quota or free < min(OWN_ROOM_BYTES, least))
        short = urgent or free < least
        self._short_ns = _since(self._short_ns, at.now_ns) if short else None
        self._urgent_ns = _since(self._urgent_ns, at.now_ns) if urgent else None
        return urgent, short

    def _earliest_ns(self, free: int) -> int:
        """Event time before which nothing is deleted for free space."""
        waits = [(self._said_ns, SAID_S)]
        if self._urgent_ns is not None:
            waits.append((self._urgent_ns, SAID_S))
        elif self._short_ns is not None:
            waits.append((self._short_ns, SHORT_S))
        if self._deleted_ns is not None:  # where deleting did not help, a snapshot or another program takes the space
            waits.append((self._deleted_ns, PACE_S if free >= self._expected else SHORT_S))
        return max(begin + int(wait_s * 1e9) for begin, wait_s in waits)

    def _words(self, *, urgent: bool, helps: bool, quota: bool) -> str:
        if urgent:
            least = min(OWN_ROOM_BYTES, self._keep.least_free_bytes) / 1e6
            lack = "the disk quota of the agent is used up" if quota else f"less than {least:.3g} MB are free"
            return (
                f"{lack}: after {SAID_S:g} s the oldest recordings are deleted, one at a time, so that the agent can "
                "go on; free some space"
            )
        lack = f"less than recording.least_free_bytes ({self._keep.least_free_bytes / 1e6:.3g} MB) are free"
        if helps:
            return f"{lack}: if this lasts {SHORT_S:g} s, the oldest recordings are deleted, one at a time"
        return (
            f"{lack}, and deleting all recordings that may be deleted would not give as much: nothing is deleted "
            f"before less than {OWN_ROOM_BYTES / 1e6:.3g} MB are free; free some space"
        )

    def _say(self, notice: str, now_ns: int) -> None:
        if notice != self.notice:
            self.notice, self._said_ns = notice, now_ns
            _log.warning("%s", notice) if notice else _log.info("enough space is free again")


def delete(directory: Path, pruned: Pruned) -> None:
    """Delete the file that an event names, except where a reader has opened it since. Raises OSError."""
    for number, path in recordings(directory):
        if pruned.first_file <= number <= pruned.last_file and not is_kept(path):
            path.unlink(missing_ok=True)
            _log.info("recording %d deleted", number)
    sync_directory(directory)


def free_bytes(directory: Path) -> int:
    """Bytes in the file system that this user may still write. Raises OSError."""
    space = os.statvfs(directory)
    return space.f_bavail * space.f_frsize


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


def _candidates(files: Sequence[_File], at: Moment) -> list[_File]:
    """The files that may be deleted, oldest first, where nobody keeps them."""
    limit = file_number(at.waiting)
    found = []
    for file in files:
        if file.path == at.active or (limit is not None and file.number >= limit):
            break
        unfinished = at.active is None and file.path.name.endswith(ACTIVE_SUFFIX)  # the next start closes it
        if not unfinished:
            found.append(file)
    return found


def _free(files: Iterable[_File]) -> Iterator[_File]:
    """Those of the files that nobody keeps. To find out, each is opened; so this is lazy."""
    return (file for file in files if not is_kept(file.path))


def _age_days(file: _File, at: Moment) -> float:
    return (at.utc_ns - file.closed_ns) / DAY_NS


def _since(before_ns: int | None, now_ns: int) -> int:
    return now_ns if before_ns is None else before_ns


def _event(file: _File, at: Moment) -> Pruned:
    origin = metadata_of(file.path).get(FILE_METADATA, {})
    with open(file.path, "rb") as data:
        digest = hashlib.file_digest(data, "sha256").hexdigest()
    return Pruned(
        t_monotonic_ns=at.now_ns,
        t_utc_ns=at.utc_ns,
        first_file=file.number,
        last_file=file.number,
        last_sha256=digest,
        bytes=file.size,
        epoch=origin.get(EPOCH, ""),
        previous_sha256=origin.get("previous_sha256", ""),
    )
