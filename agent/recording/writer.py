"""Writes the recording: MCAP files `fieldcal-<sequence>.mcap`, events in order. Each file can be read on its own.

Only one thread uses a Recorder. A disk that is full or failing raises no exception here: the file is left as it is,
`recording` becomes false, and some time later `wants_rotation` asks for a new RunStart, which begins a new file.
"""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from agent.core.events import RESULTS, Event, Output, Pruned, RunStart
from agent.recording.deleted_list import DeletedList
from agent.recording.files import RecordingFile, file_number, newest, recording_name, recordings, sync_directory
from agent.recording.head import HeadKeeper, Tell
from agent.recording.messages import EVENTS_TOPIC, topic_of
from agent.recording.pruned_ranges import (
    LIST,
    PRUNED_METADATA,
    Deleted,
    first_outside,
    from_metadata,
    merged,
    to_metadata,
)
from agent.recording.reading import first_event
from agent.recording.repair import close_torn
from agent.recording.result_signing import PUBLIC_KEY, ResultSigner
from agent.recording.results_chain import EPOCH, PREVIOUS_RESULTS
from agent.recording.retention import FOR_EVER, KeepFiles, Moment, Retention, delete, free_bytes
from agent.recording.scan import metadata_of
from agent.recording.set_aside import finish, highest_number, remove_statements, set_aside, statements
from agent.recording.signing import SIGNATURE_METADATA, Signer, signed_results

log = logging.getLogger(__name__)

MAX_BYTES = 64 << 20  # bytes of one file; about 2.5 hours of two devices at 1 kHz, copied and hashed in a second
MAX_AGE_S = 3600.0  # s of event time in one file; an audit loses at most this much where a file is damaged
# s of event time until the next attempt after a failed file. The time doubles with each failure, up to RETRY_MAX_NS.
RETRY_S = 10.0
RETRY_MAX_NS = 320_000_000_000
# Free bytes that the recording leaves to the store, since results matter more than raw data: enough for a thousand
# results and the store's log. A file is begun only where twice as much is free, so that it holds more than a snapshot.
LEAST_ROOM = 4 << 20


class Ledger(Protocol):
    """The methods of the store that the recording uses. Every method may raise StoreError, an Exception."""

    def published(self) -> int: ...
    def file_sequence(self) -> int: ...
    def mark_file(self, file_sequence: int) -> None: ...
    def first_waiting_recording(self) -> str: ...


class Recorder:
    """The recording of a gateway: takes events with their results, in order, and writes and deletes the files.

    `directory`: of the recordings; it must exist.
    `devices`, `sensors`: their channels are declared at the start of each file, others with their first message.
    `max_bytes`, `max_age_s`: size in bytes and age in seconds of event time from which a new file is wanted.
    `retry_s`: seconds of event time until the first attempt after a failure; the time doubles with each failure.
    `keep`: limits beyond which old recordings are deleted.
    `ledger`: the store, which remembers the highest file number also when all files are deleted; without it the numbers
    go on from the files in the directory. `signer`: signs each result, each file and the head; None:
    nothing is signed. `tell_head`: gets each new head (agent.recording.head), to publish it. `epoch`: of the store;
    each file names it. `results`: gives the signed results, also those that could not be recorded.
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
        tell_head: Tell = lambda _: None,
        epoch: str = "",
    ) -> None:
        self._directory = directory
        results = [f"/{sensor}/{what}" for sensor in sensors for what in RESULTS]
        self._topics = [EVENTS_TOPIC, *(f"/{device}/raw" for device in devices), *results]
        self._max_bytes = max_bytes
        self._max_age_ns = int(max_age_s * 1e9)
        self._retry_ns = int(retry_s * 1e9)
        self._retention = Retention(directory, keep)
        self._ledger = ledger
        self._signer = signer
        self._head = HeadKeeper(directory, signer, tell_head) if signer is not None else None
        self._epoch = epoch
        self.results = ResultSigner(epoch, signer)
        self._file: RecordingFile | None = None
        self._failures = 0  # since the last file that was written without a failure
        self._utc_minus_monotonic_ns = 0
        self._now_ns = self._since_ns = 0  # event time of the last event; event time when the file began or failed
        self._numbered = ledger.file_sequence() if ledger is not None else 0
        self._pruned, named = _pruned_before(directory)
        self._of_this_version = bool(named)  # whether a version that keeps the list wrote the newest recording
        self._list = DeletedList(directory, named)
        self.pruning: Pruned | None = None  # the event to record next; its file is due to be deleted
        self._timed = False  # whether an event with both clocks has come
        self._quota = False  # whether the last failure was that the user's quota is used up
        # For its age, one file is deleted for each file that begins. Where the clock jumps ahead by years, only as many
        # recordings are lost as begin before the clock is corrected.
        self._may_age = True
        self.fault = ""  # why nothing is recorded; "" where there is no fault

    @property
    def recording(self) -> bool:
        """Whether a file is open, so that events given to `record` are written."""
        return self._file is not None

    @property
    def path(self) -> Path | None:
        """The file being written."""
        return self._file.path if self._file else None

    @property
    def size_bytes(self) -> int:
        """Bytes written to the current file; 0 where there is none."""
        file = self._file
        return file.size if file is not None else 0

    @property
    def next_file_sequence(self) -> int:
        """The number for the next file: one above all numbers used so far, also by unfinished and deleted files."""
        there = [number for number, _ in recordings(self._directory)]
        return max(self._numbered, highest_number(self._directory), *there) + 1

    @property
    def wants_rotation(self) -> bool:
        """Whether the next event should be a RunStart: the file is full or old, or another attempt is due."""
        file = self._file  # read once: another thread may ask
        age_ns = self._now_ns - self._since_ns
        if file is None:
            return age_ns >= min(self._retry_ns << min(max(0, self._failures - 1), 20), RETRY_MAX_NS)
        return age_ns >= self._max_age_ns or file.size >= self._max_bytes or file.full

    @property
    def space(self) -> str:
        """What the lack of free space means for older recordings; "" where none lacks."""
        return self._retention.notice

    def close_torn(self) -> None:
        """Close the files that a crash left open. Call it before `next_file_sequence` is first used. Raises OSError."""
        finish(self._directory)
        close_torn(self._directory, self._signer)

    def look_for_pruning(self) -> None:
        """Check whether a file is due to be deleted; `pruning` then tells which. It may read this file."""
        if self.pruning is not None or not self._timed:
            return
        try:
            waiting = self._ledger.first_waiting_recording() if self._ledger is not None else ""
            at = Moment(self._now_ns, self._utc_ns, self.path, waiting, self._may_age, self._quota)
            self.pruning = self._retention.due(at)
        except Exception as error:  # the next write to the failing disk or store reports the failure
            log.info("cannot determine which recordings to delete: %s", error)

    def record(self, event_sequence: int, event: Event, results: Sequence[Output]) -> bool:
        """Write an event and its results. With results, and for a RunStart or a Pruned, wait until they are on disk.

        A RunStart finishes the current file and begins the next one. The file that a Pruned names is deleted after the
        event is on disk; while nothing is recorded, a statement takes its place.
        Returns whether the event is in a file. If so, and if there are results, the event, its results and all events
        before it survive a power cut.
        """
        times = self._stamp(event)
        try:
            messages = [(topic_of(item), self.results.encode(event_sequence, item)) for item in (event, *results)]
            if isinstance(event, RunStart):
                self._begin(event)
            if self._file is not None:
                self._append(self._file, event_sequence, event, messages, times)
            if isinstance(event, RunStart):
                self._begun(event)
            if isinstance(event, Pruned):
                self._prune(event)
        except OSError as error:
            where = error.filename or self.path or self._directory
            if isinstance(event, RunStart) and self._file is not None:
                self._file.discard()
                self._file = None
            self._quota = error.errno == errno.EDQUOT
            self._fail(f"{error.strerror or error} ({where})")
        except (ValueError, TypeError) as error:
            # The event cannot be encoded. The file ends before it; the next file begins with a snapshot taken after it.
            self.close()
            self._fail(f"event {event_sequence} cannot be recorded: {error}")
        return self.recording

    def _append(
        self, file: RecordingFile, event_sequence: int, event: Event, messages: Sequence[tuple[str, bytes]],
        times: tuple[int, int],
    ) -> None:  # fmt: skip
        """Append an event and its results; what must be on the disk before the run goes on is there at the return."""
        if isinstance(event, Pruned):
            self._repeat([Deleted.of(event)])
        for topic, data in messages:
            file.append(topic, data, *times, event_sequence)
        if isinstance(event, Pruned):
            file.note(PRUNED_METADATA, to_metadata(self._pruned, self._list.text))
        if len(messages) > 1 or isinstance(event, RunStart | Pruned):
            file.sync()

    def sync(self) -> None:
        """Write all recorded events to the disk; fast where none waits."""
        try:
            if self._file is not None:
                self._file.sync()
                if self._head is not None:
                    self._head.go_on(self._file, self._now_ns, self._utc_ns)
                if self._now_ns - self._since_ns > RETRY_MAX_NS:
                    self._failures = 0
                if free_bytes(self._directory) < LEAST_ROOM:
                    self.close()
                    self._fail(f"{os.strerror(errno.ENOSPC)} ({self._directory})")
        except OSError as error:
            self._quota = error.errno == errno.EDQUOT
            self._fail(f"{error.strerror or error} ({self.path})")

    def close(self) -> None:
        """Finish the current file, if there is one."""
        if self._file is None:
            return
        try:
            self._file.finish()
        except OSError as error:
            self._fail(f"{error.strerror or error} ({self.path})")
        else:
            if self._head is not None:
                self._head.end(self._file, self._now_ns, self._utc_ns)
            self._failures = 0
            self._file = None

    def _begin(self, start: RunStart) -> None:
        self.close()
        if free_bytes(self._directory) < 2 * LEAST_ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._directory))
        if self._failures:
            # The failed file is closed, so that the next one can name its SHA-256.
            close_torn(self._directory, self._signer, own=True)
        self._repeat(self._set_aside())
        name, digest = newest(self._directory)
        if self._pruned and self._pruned[-1].last > (file_number(name) or 0):  # the newest one was deleted
            name, digest = recording_name(self._pruned[-1].last), self._pruned[-1].sha256
        origin = {"previous_file": name, "previous_sha256": digest} | ({EPOCH: self._epoch} if self._epoch else {})
        if self._ledger is not None:
            origin["published"] = str(self._ledger.published())
        if self._signer is not None:
            origin[PUBLIC_KEY] = self._signer.public_base64
            origin |= {PREVIOUS_RESULTS: _signed_results(self._directory / name)} if name else {}
        self._since_ns = self._now_ns
        self._file = RecordingFile(self._directory, start, self._topics, origin, self._signer)
        # Before the RunStart: whatever a crash leaves of a recording that is not removed, it says what was deleted.
        self._file.note(PRUNED_METADATA, to_metadata(self._pruned, self._list.text))
        sync_directory(self._directory)
        self.fault, self._quota = "", False

    def _set_aside(self) -> Sequence[Deleted]:
        """The recordings that were deleted while nothing could be recorded.

        Statements of version 1 count only where an older version wrote the newest recording: nobody else makes them.
        """
        keys = self._signer.known if self._signer else None
        found = statements(self._directory, self.results.gateway, keys, self._pruned)
        for fault in found.faults:
            log.warning("%s", fault)
        return [*found.deleted, *(() if self._of_this_version else found.of_version_1)]

    def _repeat(self, deleted: Sequence[Deleted]) -> None:
        """From now on every recording says that these were deleted."""
        deleted = [one for one in deleted if first_outside(self._pruned, one.first, one.last) is not None]
        self._pruned = merged([*self._pruned, *deleted])
        try:
            self._list.add(deleted)
        except OSError as error:
            log.warning("deleted recordings cannot be added to %s: %s", error.filename, error.strerror)

    def _begun(self, start: RunStart) -> None:
        """The RunStart is on the disk. A crash before that leaves no file, and its number is used again."""
        self._number(start.file_sequence)
        self._may_age = self._of_this_version = True
        try:
            remove_statements(self._directory, self._pruned)
        except OSError as error:  # they stay until the next file begins
            log.info("%s cannot be deleted: %s", error.filename, error.strerror)
        if self._head is not None and self._file is not None:
            self._head.begin(self._file, self._now_ns, self._utc_ns)
        self.look_for_pruning()

    @property
    def _utc_ns(self) -> int:
        return self._now_ns + self._utc_minus_monotonic_ns

    def _number(self, file_sequence: int) -> None:
        self._numbered = file_sequence
        if self._ledger is not None:
            try:
                self._ledger.mark_file(file_sequence)
            except Exception as error:  # the store tries again with its next commit
                log.warning(
                    "the store cannot write the number of recording %d yet, and tries again: %s", file_sequence, error
                )

    def _prune(self, pruned: Pruned) -> None:
        """Delete the file, or replace it by a statement where nothing is recorded; check whether more are due."""
        try:
            if self._file is not None:
                delete(self._directory, pruned)
            else:
                set_aside(self._directory, Deleted.of(pruned), self.results.gateway, self._signer)
                self._failures, self._since_ns = 1, self._now_ns - self._retry_ns  # there may be space now
        except OSError as error:
            log.warning("recording %d cannot be deleted: %s", pruned.last_file, error)
            self.pruning = None
        else:
            self.pruning, self._may_age = None, False
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
        """(UTC, monotonic) in ns, the log time and the publish time of MCAP.

        For an event without UTC it follows from the difference of the clocks at the last event that had both.
        """
        monotonic_ns = event.t_monotonic_ns
        utc_ns = getattr(event, "t_utc_ns", None)
        if utc_ns is None:
            utc_ns = monotonic_ns + self._utc_minus_monotonic_ns
        else:
            self._utc_minus_monotonic_ns = utc_ns - monotonic_ns
            self._now_ns, self._timed = monotonic_ns, True
        return max(utc_ns, 0), max(monotonic_ns, 0)


def _signed_results(path: Path) -> str:
    """The chain of results at the end of a recording; "" where its signature names none. Raises OSError."""
    return signed_results(metadata_of(path).get(SIGNATURE_METADATA)) or "" if path.exists() else ""


def _pruned_before(directory: Path) -> tuple[tuple[Deleted, ...], str]:
    """The recordings that were deleted before this run, and the bytes and SHA-256 of the list of all of them, as the
    newest readable recording says; "" where an older version wrote it.
    """
    try:
        for _, path in reversed(recordings(directory)):
            metadata = metadata_of(path)
            if PRUNED_METADATA in metadata or first_event(path) is not None:  # otherwise a crash left it, to be removed
                pruned = metadata.get(PRUNED_METADATA, {})
                return from_metadata(pruned), pruned.get(LIST, "")
    except OSError as error:  # the next write to the failing disk reports the failure
        log.info("cannot read which recordings were deleted before this run: %s", error)
    return (), ""
