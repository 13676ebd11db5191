"""The store: history, calibration in force and outbox in one SQLite file, written by one agent at a time."""

from __future__ import annotations

import os
import sqlite3
import threading
import time
from collections.abc import Iterable
from pathlib import Path

from agent.core.memory import Memory
from agent.delivery.history import FILE_NAME, Record
from agent.delivery.opening import lock, open_or_set_aside
from agent.delivery.recovery import Recall, Recovered, no_memories, recover, recover_memories
from agent.delivery.retention import FOR_EVER, KeepResults, Sweep
from agent.delivery.schema import (
    DamagedRow,
    StoreError,
    create_tables,
    insert_results,
    read_marks,
    version_of,
    withdraw,
    write_latest,
    write_mark,
    write_memory,
)

# After a run that did not close well, numbers may be out in the world that no commit has kept; the next run counts on
# from beyond them. More than a week of one unkept result a second.
UNKEPT_MAX = 1_000_000
# Results that a failing disk refused wait in memory for the next commit; beyond this the oldest are given up.
WAITING_MAX = 1000


class Store:
    """Commits results durably (WAL, synchronous FULL) and remembers up to where they are published.

    May be called from any thread; reading is done by a `History` of one's own on `path`.
    Every page and row is checked at the start. `set_aside` names the damaged file that was found and renamed, None
    where there was none; `recovered` says what was found again in the recordings of `data_dir`: everything that they
    hold where the store is new, what the last moments before a crash left out where it is not. With results come the
    states of the estimation: `recall` tells which a recording leaves.
    A new store cannot know which numbers were used before it; it counts on from `count_from`, by default the UTC
    milliseconds, and from beyond what the recordings hold. They still fit a number of JavaScript.
    Raises StoreError where the directory cannot be written or another process has the store.
    """

    def __init__(
        self,
        data_dir: Path,
        count_from: int | None = None,
        keep: KeepResults = FOR_EVER,
        recall: Recall = no_memories,
    ) -> None:
        first = time.time_ns() // 1_000_000 if count_from is None else count_from
        self.path = data_dir / FILE_NAME
        self._mutex = threading.Lock()
        self._waiting: list[Record] = []
        self._memories: dict[tuple[str, str], Memory] = {}
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
        """The number after which this run may count."""
        return self._last

    def commit(self, records: Iterable[Record], memories: Iterable[Memory] = ()) -> None:
        """Keep the results and states in one transaction; when this returns they survive a power cut.

        Raises StoreError where they cannot be kept (they are tried again with the next commit) or are out of order.
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

    def published(self) -> int:
        """Results up to this number have been put on the network; those after it are the outbox."""
        return self._published

    def mark_published(self, sequence: int) -> None:
        """Results up to `sequence` are out. Kept with the next commit: after a crash a few go out twice."""
        self._published = max(self._published, sequence)

    def file_sequence(self) -> int:
        """The highest number that a recording here ever had, also one that is deleted."""
        return self._file_sequence

    def mark_file(self, file_sequence: int) -> None:
        """A recording of this number is there. Raises StoreError where that cannot be kept; the next commit tries."""
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

    def close(self) -> None:
        """Keep what is left and let go of the file. May be called twice."""
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

    def _enqueue(self, records: Iterable[Record]) -> None:
        for record in records:
            if record.sequence <= self._last:
                raise StoreError(f"{self.path}: result {record.sequence} does not come after {self._last}")
            self._waiting.append(record)
            self._last = record.sequence

    def _write(self, records: list[Record]) -> None:
        insert_results(self._connection, [record.row for record in records])
        for record in records:
            write_latest(self._connection, record.sensor, record.what, record.sequence, withdrawn=False)
            if record.is_withdrawal:
                withdraw(self._connection, record.sensor)
        for memory in self._memories.values():
            write_memory(self._connection, (memory.sensor, memory.identity, memory.sequence, memory.state))
        write_mark(self._connection, "published", self._published)
        write_mark(self._connection, "file", self._file_sequence)

    def _begin_run(self, first: int, recall: Recall) -> Recovered:
        """Read the marks; make the tables where the file is new; fetch from the recordings what is not here."""
        with self._connection:
            self._connection.execute("BEGIN IMMEDIATE")
            new = version_of(self._connection) == 0
            if new:
                create_tables(self._connection, {"floor": first, "published": first, "clean": 0, "file": 0})
            marks = read_marks(self._connection)
            directory = self.path.parent
            recovered = Recovered() if marks["clean"] else recover(self._connection, directory, everything=new)
            if new or recovered.results:
                recovered.memories = recover_memories(self._connection, directory, recall)
            (kept,) = self._connection.execute("SELECT coalesce(max(sequence), 0) FROM results").fetchone()
            self._last = max(kept, marks["floor"])
            if not marks["clean"] and not new:
                self._last += UNKEPT_MAX
            self._published = marks["published"]
            if new and recovered.results:
                self._last = max(first, kept + UNKEPT_MAX)
                self._published = recovered.published
            self._file_sequence = max(marks["file"], recovered.file_sequence)
            write_mark(self._connection, "floor", self._last)
            write_mark(self._connection, "published", self._published)
            write_mark(self._connection, "file", self._file_sequence)
            write_mark(self._connection, "clean", 0)
        return recovered
