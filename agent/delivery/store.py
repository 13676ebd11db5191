"""The store: history, calibration in force and outbox in one SQLite file, written by one agent at a time."""

from __future__ import annotations

import logging
import os
import secrets
import sqlite3
import threading
import time
from collections.abc import Collection, Iterable
from pathlib import Path

from agent.core.memory import Memory
from agent.delivery.gateway_key import GatewayKey
from agent.delivery.history import FILE_NAME, History
from agent.delivery.opening import lock, open_or_set_aside
from agent.delivery.record import StoredResult
from agent.delivery.recovery import Recovered, check_newest, check_row, name_latest, recover
from agent.delivery.retention import FOR_EVER, KeepResults, Sweep
from agent.delivery.schema import (
    EPOCH,
    DamagedRow,
    StoreError,
    create_tables,
    insert_results,
    insert_signed,
    read_marks,
    version_of,
    withdraw,
    write_latest,
    write_mark,
    write_memory,
    write_states,
)
from agent.delivery.signed_states import Digests, StateList, digest_of
from agent.delivery.states import Completeness, Recall, no_memories, states_at_start
from agent.recording.continuation import UNKEPT_MAX
from agent.recording.files import recordings

# Results that a failing disk refused wait in memory for the next commit; beyond this number the oldest are dropped.
WAITING_MAX = 1000
FAULTS_MAX = 20  # of a run that the status of the gateway names

_log = logging.getLogger(__name__)


class Store:
    """Keeps results durably (WAL, synchronous FULL) and the number up to which they are published.

    All methods may be called from any thread. To read, open a `History` on `path` in the reading thread.
    Opening checks every page and row. `set_aside`: new path of a damaged file, which is renamed; None where the file
    was good. `recovered`: what was restored from the recordings in `data_dir`: everything where the store is new; after
    a crash the results that were recorded but not committed.

    `epoch`: names the numbering of the results of this store. A store that is made anew has another one, so that a
    consumer does not take its results for old ones where its numbers are lower.
    `count_from`: a new store does not know which sequence numbers were used before. It begins after this number, by
    default the UTC in milliseconds (small enough for JavaScript's numbers), and after all numbers in the recordings.
    `keep`: limits beyond which old results are deleted.
    `recall`: gives the states of the estimation at the end of a recording, to restore them with the results.
    `key`: of the gateway. With it, what the store holds counts only as far as this key signed it, and the store keeps a
    signed list of its states. `states`: the states of the estimation with which the run begins. `faults`: what in the
    store was not what the key signed, and what was done.
    Raises StoreError where the directory cannot be written or another process uses the store.
    """

    def __init__(
        self,
        data_dir: Path,
        count_from: int | None = None,
        keep: KeepResults = FOR_EVER,
        recall: Recall = no_memories,
        key: GatewayKey | None = None,
    ) -> None:
        first = time.time_ns() // 1_000_000 if count_from is None else count_from
        self.path = data_dir / FILE_NAME
        self._mutex = threading.Lock()
        self._waiting: list[StoredResult] = []
        self._memories: dict[tuple[str, str], Memory] = {}
        self._key = key
        self._digests: Digests = {}
        self.states: list[Memory] = []
        self.faults: list[str] = []
        self._last = self._published = self._file_sequence = 0
        self._sweep = Sweep(keep)
        self._lock = lock(data_dir)
        try:
            self.set_aside, self._connection = open_or_set_aside(self.path)
            self.recovered = self._begin_run(first, recall)
        except (sqlite3.Error, DamagedRow, OSError) as error:
            os.close(self._lock)
            raise StoreError(f"{self.path}: {error}") from None
        except StoreError:
            os.close(self._lock)
            raise

    def last_sequence(self) -> int:
        """The highest sequence number used; the next result must have a higher one."""
        return self._last

    def commit(self, records: Iterable[StoredResult], memories: Iterable[Memory] = ()) -> None:
        """Write results and states in one transaction; when this returns they survive a power cut.

        Raises StoreError where they cannot be written (the next commit tries again), or where a result's number is not
        above the one before.
        """
        with self._mutex:
            self._enqueue(records)
            self._memories |= {(memory.sensor, memory.identity): memory for memory in memories}
            try:
                with self._connection:
                    self._connection.execute("BEGIN IMMEDIATE")
                    self._write(self._waiting)
                    self._sweep.run(self._connection, self._waiting, self._published)
            except (sqlite3.Error, DamagedRow) as error:
                del self._waiting[:-WAITING_MAX]
                raise StoreError(f"{self.path}: {error}") from None
            self._waiting.clear()
            self._memories.clear()

    def history(self) -> History:
        """Open a reader that gives only what the gateway's key signed. Use it in one thread. Raises StoreError."""
        return History(self.path, self._key.known_keys if self._key is not None else None)

    def find(self, sensor: str, what: str, sequence: int) -> StoredResult | None:
        """A result that is to come into force, as the gateway's key signed it; None where there is none.

        Raises StoreError where it is not what the key signed, or cannot be read. If the recordings have it, its row is
        made anew from them, and the next call gives it.
        """
        with self.history() as history:
            found = history.after(sequence - 1, [(sensor, what)], limit=1)
            reason = history.refused.get(sequence, "")
        record = found[0] if found and found[0].sequence == sequence else None
        if self._key is None or (record is None and not reason) or (record and record.signed and not reason):
            return record
        try:
            with self._mutex, self._connection:
                self._connection.execute("BEGIN IMMEDIATE")
                fault = check_row(self._connection, self.path.parent, sequence, self._key)
        except (sqlite3.Error, DamagedRow, OSError) as error:
            raise StoreError(f"{self.path}: {error}") from None
        if not fault:
            return record
        raise StoreError(self._tell(fault))

    def _tell(self, fault: str) -> str:
        """Log a fault, and keep it for the status of the gateway."""
        _log.warning("%s", fault)
        if fault not in self.faults and len(self.faults) < FAULTS_MAX:
            self.faults.append(fault)
        return fault

    def published(self) -> int:
        """The last published result. The results after it are the outbox: they still wait for a router."""
        return self._published

    def mark_published(self, sequence: int) -> None:
        """Note that results up to `sequence` are published.

        The next commit writes it; after a crash, a few results are therefore published twice.
        """
        self._published = max(self._published, sequence)

    def file_sequence(self) -> int:
        """The highest file number of all recordings, deleted ones included."""
        return self._file_sequence

    def mark_file(self, file_sequence: int) -> None:
        """Note that a recording of this number exists. Raises StoreError on failure; the next commit tries again."""
        self._file_sequence = max(self._file_sequence, file_sequence)
        self.commit([])

    def first_waiting_recording(self) -> str:
        """Name of the recording with the first result that is not published; "" where there is none."""
        with self._mutex:
            sql = "SELECT recording FROM results WHERE sequence > ? AND recorded = 1 ORDER BY sequence LIMIT 1"
            try:
                row = self._connection.execute(sql, (self._published,)).fetchone()
            except sqlite3.Error as error:
                raise StoreError(f"{self.path}: {error}") from None
            return str(row[0]) if row else ""

    def end(self, sensors: Collection[str], memories: Iterable[Memory]) -> None:
        """Replace the states of these sensors by those after the last event, all of which is recorded.

        Raises StoreError.
        """
        with self._mutex:
            try:
                with self._connection:
                    self._connection.execute("BEGIN IMMEDIATE")
                    self._write(self._waiting)
                    for sensor in sensors:
                        self._connection.execute("DELETE FROM memory WHERE sensor = ?", (sensor,))
                    self._write_memories(memories)
                    self._sign_states(self._last)
            except (sqlite3.Error, DamagedRow) as error:
                raise StoreError(f"{self.path}: {error}") from None
            self._waiting.clear()
            self._memories.clear()

    def close(self) -> None:
        """Write what still waits and close the file. May be called twice. Raises StoreError."""
        with self._mutex:
            if self._lock < 0:
                return
            try:
                with self._connection:
                    self._connection.execute("BEGIN IMMEDIATE")
                    self._write(self._waiting)
                    write_mark(self._connection, "clean", 1)
            except sqlite3.Error as error:
                raise StoreError(f"{self.path}: {error}") from None
            finally:
                self._connection.close()
                os.close(self._lock)
                self._lock = -1

    def _enqueue(self, records: Iterable[StoredResult]) -> None:
        for record in records:
            if record.sequence <= self._last:
                raise StoreError(f"{self.path}: result {record.sequence} does not come after result {self._last}")
            self._waiting.append(record)
            self._last = record.sequence

    def _write(self, records: list[StoredResult]) -> None:
        insert_results(self._connection, [record.row for record in records])
        insert_signed(self._connection, [(record.sequence, record.signed) for record in records if record.signed])
        for record in records:
            write_latest(self._connection, record.sensor, record.what, record.sequence, withdrawn=False)
            if record.is_withdrawal:
                withdraw(self._connection, record.sensor)
        if self._memories:
            self._write_memories(self._memories.values())
            self._sign_states(self._last)
        write_mark(self._connection, "published", self._published)
        write_mark(self._connection, "file", self._file_sequence)

    def _recover(self, *, everything: bool) -> Recovered:
        keys = self._key.known_keys if self._key is not None else None
        return recover(self._connection, self.path.parent, keys, everything=everything)

    def _write_memories(self, memories: Iterable[Memory]) -> None:
        for memory in memories:
            write_memory(self._connection, memory)
            self._digests[memory.sensor, memory.identity] = digest_of(memory)

    def _sign_states(self, sequence: int) -> None:
        """Sign which states there are after the result with the number `sequence`."""
        if self._key is None:
            return
        there = set(self._connection.execute("SELECT sensor, identity FROM memory"))
        self._digests = {device: digest for device, digest in self._digests.items() if device in there}
        listed = StateList(self._key.gateway, self.epoch, self._file_sequence, sequence, self._digests)
        write_states(self._connection, self._key.signer.sign(listed.text).json)

    def _begin_run(self, first: int, recall: Recall) -> Recovered:
        """Read the marks, make the tables where the file is new, and restore missing results from the recordings."""
        with self._connection:
            self._connection.execute("BEGIN IMMEDIATE")
            new = version_of(self._connection) == 0
            if new:
                create_tables(self._connection, {"floor": first, "published": first, "clean": 0, "file": 0})
            marks = read_marks(self._connection)
            # By chance: a clock that was set back, or an older copy of the disk, must not repeat it.
            epoch = marks.get(EPOCH, secrets.randbits(63))
            self.epoch = f"{epoch:016x}"
            directory = self.path.parent
            # An older copy of the store, put back beside the recordings, was closed well too, and lacks their results.
            # Where there is a key, the signed list of the states tells it (`found.late`).
            newest = max((number for number, _ in recordings(directory)), default=0)
            older = self._key is None and newest > marks["file"]
            clean = bool(marks["clean"]) and not older
            recovered = Recovered() if clean else self._recover(everything=new)
            complete = clean and not recovered.results
            store_is: Completeness = "new" if new else "complete" if complete else "behind"
            found = states_at_start(self._connection, directory, recall, self._key, self.epoch, store_is)
            if found.late and clean:
                recovered = self._recover(everything=False)
            recovered.memories = found.replayed
            name_latest(self._connection)
            if self._key is not None:
                found.faults += check_newest(self._connection, directory, self._key)
            for fault in found.faults:
                self._tell(fault)
            (kept,) = self._connection.execute("SELECT coalesce(max(sequence), 0) FROM results").fetchone()
            self._last = max(kept, marks["floor"], found.sequence)
            if not clean and not new:
                self._last += UNKEPT_MAX
            self._published = marks["published"]
            if new and recovered.results:
                self._last = max(first, found.sequence, kept + UNKEPT_MAX)
                self._published = recovered.published
            self._published = min(self._published, self._last)
            self._file_sequence = max(marks["file"], recovered.file_sequence, found.recording)
            self._connection.execute("DELETE FROM memory")
            self._write_memories(found.memories)
            self._sign_states(found.sequence)
            self.states = found.memories
            write_mark(self._connection, "floor", self._last)
            write_mark(self._connection, "published", self._published)
            write_mark(self._connection, "file", self._file_sequence)
            write_mark(self._connection, EPOCH, epoch)
            write_mark(self._connection, "clean", 0)
        return recovered
