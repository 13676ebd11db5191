"""Writes the recording: MCAP files `fieldcal-<sequence>.mcap`, each standing alone, in order of events.

One thread owns a Recorder. Nothing here raises for a disk that is full or failing: the file is given up where it stood,
`recording` turns false, and `wants_rotation` asks for a new RunStart some time later.
"""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from agent.core.events import RESULTS, Event, Output, Pruned, RunStart
from agent.recording.files import RecordingFile, newest, recordings, sync_directory
from agent.recording.messages import EVENTS_TOPIC, encode, topic_of
from agent.recording.pruned_ranges import PRUNED_METADATA, Ranges, from_metadata, merged, to_metadata
from agent.recording.repair import close_torn
from agent.recording.retention import FOR_EVER, KeepFiles, delete, due, free_bytes
from agent.recording.scan import metadata_of
from agent.recording.signing import Signer

log = logging.getLogger(__name__)

MAX_BYTES = 64 << 20  # bytes on disk; about 2.5 hours of two devices at 1 kHz, copied and hashed in a second
MAX_AGE_S = 3600.0  # s of event time; what an audit loses when a file is damaged
# s of event time after a failed file, doubled with each that fails; a full disk is asked again, not hammered.
RETRY_S = 10.0
RETRY_MAX_NS = 320_000_000_000
# Bytes free that are left to the store: results are worth more than what they came from. A thousand of them, and the
# store's log. A file is begun only where there is twice as much: otherwise it would hold a snapshot and nothing else.
LEAST_ROOM = 4 << 20


class Ledger(Protocol):
    """What the store knows for the recording. Every method may raise StoreError, an Exception."""

    def published(self) -> int: ...
    def file_sequence(self) -> int: ...
    def mark_file(self, file_sequence: int) -> None: ...
    def first_waiting_recording(self) -> str: ...


class Recorder:
    """The recording of a gateway: takes events with their results in order, and keeps the files.

    `directory` must exist. `devices`, `sensors` name the channels that each file declares at its start (others are
    declared when they come). A file wants to be followed by the next beyond `max_bytes` or `max_age_s` of event time.
    The `ledger` remembers file numbers over the deletion of files; without one the directory alone tells.
    """

    def __init__(
        self,
        directory: Path,
        devices: Sequence[str],
        sensors: Sequence[str],
        *,
        max_bytes: int = MAX_BYTES,
        max_age_s: float = MAX_AGE_S,
        retry_s: float = RETRY_S,
        keep: KeepFiles = FOR_EVER,
        ledger: Ledger | None = None,
        signer: Signer | None = None,
    ) -> None:
        self._directory = directory
        results = [f"/{sensor}/{what}" for sensor in sensors for what in RESULTS]
        self._topics = [EVENTS_TOPIC, *(f"/{device}/raw" for device in devices), *results]
        self._max_bytes = max_bytes
        self._max_age_ns = int(max_age_s * 1e9)
        self._retry_ns = int(retry_s * 1e9)
        self._keep = keep
        self._ledger = ledger
        self._signer = signer
        self._file: RecordingFile | None = None
        self._failures = 0  # since a file lasted
        self._utc_minus_monotonic_ns = 0
        self._now_ns = self._since_ns = 0  # event time now; and when the file began, or failed
        self._numbered = ledger.file_sequence() if ledger is not None else 0
        self._pruned = _pruned_before(directory)
        self._due: Pruned | None = None  # files that may go
        self._unsaid = False  # they went while nothing was recorded
        # By age one file goes for each that begins: a clock that jumped ahead by years costs only as many recordings as
        # begin before it is set right.
        self._may_age = True
        self.fault = ""  # why nothing is recorded

    @property
    def recording(self) -> bool:
        """Whether what is given to `record` reaches a file."""
        return self._file is not None

    @property
    def path(self) -> Path | None:
        """The file being written."""
        return self._file.path if self._file else None

    @property
    def size_bytes(self) -> int:
        """Bytes of the file being written that are on disk."""
        file = self._file
        return file.size if file is not None else 0

    @property
    def next_file_sequence(self) -> int:
        """The number for the next RunStart: one above all that files here ever had, finished, not, or deleted."""
        return max([self._numbered, *(number for number, _ in recordings(self._directory))]) + 1

    @property
    def wants_rotation(self) -> bool:
        """Whether the next event should be a RunStart: the file is full or old, or it is time to try again."""
        file = self._file  # once: another thread may ask
        age_ns = self._now_ns - self._since_ns
        if file is None:
            return age_ns >= min(self._retry_ns << min(max(0, self._failures - 1), 20), RETRY_MAX_NS)
        return age_ns >= self._max_age_ns or file.size >= self._max_bytes

    @property
    def pruning(self) -> Pruned | None:
        """The next event, where there is one: its files are due to be deleted, or were, while nothing was recorded."""
        return self._due if self.recording or not self._unsaid else None

    def close_torn(self) -> None:
        """Close what a crash left open. To be called before the first RunStart is numbered. Raises OSError."""
        close_torn(self._directory, self._signer)

    def look_for_pruning(self) -> None:
        """See whether files are due to be deleted; `pruning` says so then. Cheap, but it asks the disk."""
        if self._due is not None:
            return
        try:
            waiting = self._ledger.first_waiting_recording() if self._ledger is not None else ""
            self._due = due(self._directory, self._keep, self.path, waiting, by_age=self._may_age)
        except Exception as error:  # a disk or a store that fails is told by whoever writes to it
            log.info("whether recordings are to be deleted cannot be seen: %s", error)

    def record(self, event_sequence: int, event: Event, results: Sequence[Output]) -> bool:
        """Write an event and what came of it; with results, or for a RunStart, wait for the disk.

        A RunStart finishes the file before and begins the next; the files of a Pruned are deleted once it is on disk.
        Returns whether it is in a file; where that is so and there are results, all of them and every event before them
        survive a power cut.
        """
        log_time, publish_time = self._stamp(event)
        try:
            messages = [(topic_of(item), encode(event_sequence, item)) for item in (event, *results)]
            if isinstance(event, RunStart):
                self._begin(event)
            if self._file is not None:
                for topic, data in messages:
                    self._file.append(topic, data, log_time, publish_time, event_sequence)
                if isinstance(event, Pruned):
                    self._pruned = merged([*self._pruned, (event.first_file, event.last_file)])
                if isinstance(event, RunStart | Pruned) and self._pruned:
                    self._file.note(PRUNED_METADATA, to_metadata(self._pruned))
                if results or isinstance(event, RunStart | Pruned):
                    self._file.sync()
            if isinstance(event, RunStart):
                self._number(event.file_sequence)
                self._may_age = True
                self.look_for_pruning()
            if isinstance(event, Pruned):
                self._prune(event)
        except OSError as error:
            where = error.filename or self.path or self._directory
            if isinstance(event, RunStart) and self._file is not None:
                self._file.discard()
                self._file = None
            self._fail(f"{error.strerror or error} ({where})")
        except (ValueError, TypeError) as error:
            # This event has no form in a recording: the file ends before it, the next begins with a snapshot after it.
            self.close()
            self._fail(f"event {event_sequence} cannot be recorded: {error}")
        return self.recording

    def sync(self) -> None:
        """Bring what was recorded to the disk; cheap where nothing waits."""
        try:
            if self._file is not None:
                self._file.sync()
                if self._now_ns - self._since_ns > RETRY_MAX_NS:
                    self._failures = 0
                if free_bytes(self._directory) < LEAST_ROOM:
                    self.close()
                    self._fail(f"{os.strerror(errno.ENOSPC)} ({self._directory})")
        except OSError as error:
            self._fail(f"{error.strerror or error} ({self.path})")

    def close(self) -> None:
        """Finish the file, if there is one."""
        if self._file is None:
            return
        try:
            self._file.finish()
        except OSError as error:
            self._fail(f"{error.strerror or error} ({self.path})")
        else:
            self._failures = 0
            self._file = None

    def _begin(self, start: RunStart) -> None:
        self.close()
        if free_bytes(self._directory) < 2 * LEAST_ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._directory))
        if self._failures:
            close_torn(self._directory, self._signer)  # the file that was given up: the next one names its SHA-256
        name, digest = newest(self._directory)
        origin = {"previous_file": name, "previous_sha256": digest}
        if self._ledger is not None:
            origin["published"] = str(self._ledger.published())
        self._since_ns = self._now_ns
        self._file = RecordingFile(self._directory, start, self._topics, origin, self._signer)
        sync_directory(self._directory)
        self.fault = ""

    def _number(self, file_sequence: int) -> None:
        # Once its RunStart is on disk: until then a crash leaves no file, and the number is used again.
        self._numbered = file_sequence
        if self._ledger is not None:
            try:
                self._ledger.mark_file(file_sequence)
            except Exception as error:  # the next commit keeps it
                log.warning("the number of the recording cannot be kept: %s", error)

    def _prune(self, pruned: Pruned) -> None:
        """Delete, and look again. Where nothing is recorded the room is needed first; the next file says it then."""
        try:
            delete(self._directory, pruned)
        except OSError as error:
            log.warning("recordings that are due cannot be deleted: %s", error)
        if self._file is None:
            self._unsaid = True
            self._failures, self._since_ns = 1, self._now_ns - self._retry_ns
        else:
            self._unsaid, self._due, self._may_age = False, None, False
            self.look_for_pruning()

    def _fail(self, fault: str) -> None:
        if self._file is not None:
            self._file.abandon()
        self._file = None
        self._failures += 1
        self._since_ns = self._now_ns
        if fault != self.fault:
            log.error("not recording: %s", fault)
        self.fault = fault
        self.look_for_pruning()

    def _stamp(self, event: Event) -> tuple[int, int]:
        """(UTC, monotonic) in ns for MCAP; without UTC, from the clocks of the last event that had both."""
        monotonic_ns = event.t_monotonic_ns
        utc_ns = getattr(event, "t_utc_ns", None)
        if utc_ns is None:
            utc_ns = monotonic_ns + self._utc_minus_monotonic_ns
        else:
            self._utc_minus_monotonic_ns = utc_ns - monotonic_ns
            self._now_ns = monotonic_ns
        return max(utc_ns, 0), max(monotonic_ns, 0)


def _pruned_before(directory: Path) -> Ranges:
    """What retention deleted before this run, as the newest recording that can be read says."""
    try:
        for _, path in reversed(recordings(directory)):
            if metadata := metadata_of(path):
                return from_metadata(metadata.get(PRUNED_METADATA))
    except OSError as error:  # whoever writes to this disk will tell it
        log.info("what was deleted before cannot be read: %s", error)
    return ()
