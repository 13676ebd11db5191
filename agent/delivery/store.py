"""The store: history, calibration in force and outbox in one SQLite file, written by one agent at a time."""

from __future__ import annotations

import fcntl
import os
import sqlite3
import threading
import time
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

from agent.delivery.history import FILE_NAME, SCHEMA_VERSION, Record, StoreError, connect_read_only

LOCK_NAME = "state.lock"
# After a run that did not close well, numbers may be out in the world that no commit has kept; the next run counts on
# from beyond them. More than a week of one unkept result a second.
UNKEPT_MAX = 1_000_000
# Results that a failing disk refused wait in memory for the next commit; beyond this the oldest are given up.
WAITING_MAX = 1000
_CORRUPT = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_SCHEMA = """
BEGIN;
CREATE TABLE results (
    sequence INTEGER PRIMARY KEY, run_id TEXT NOT NULL, sensor TEXT NOT NULL, what TEXT NOT NULL,
    payload BLOB NOT NULL, t_utc_ns INTEGER NOT NULL, recorded INTEGER NOT NULL, recording TEXT NOT NULL,
    identity TEXT NOT NULL) STRICT;
CREATE INDEX results_of_channel ON results (sensor, what, sequence);
CREATE TABLE latest (
    sensor TEXT NOT NULL, what TEXT NOT NULL, sequence INTEGER NOT NULL, PRIMARY KEY (sensor, what)) STRICT;
CREATE TABLE marks (name TEXT PRIMARY KEY, value INTEGER NOT NULL) STRICT;
INSERT INTO marks VALUES ('floor', {first}), ('published', {first}), ('clean', 1);
PRAGMA user_version = {version};
COMMIT;
"""


class Store:
    """Commits results durably (WAL, synchronous FULL) and remembers up to where they are published.

    May be called from any thread; reading is done by a `History` of one's own on `path`.
    `set_aside` names the corrupt file that was found and renamed, None where there was none.
    A new store cannot know which numbers were used before it, by a store that is corrupt or was deleted; it counts on
    from `count_from`, by default the UTC milliseconds, which lie beyond them and still fit a number of JavaScript.
    Raises StoreError where the directory cannot be written or another process has the store.
    """

    def __init__(self, data_dir: Path, count_from: int | None = None) -> None:
        first = time.time_ns() // 1_000_000 if count_from is None else count_from
        self.path = data_dir / FILE_NAME
        self._mutex = threading.Lock()
        self._waiting: list[Record] = []
        self._lock = _lock(data_dir)
        try:
            self.set_aside, self._connection = _open_or_set_aside(self.path, first)
            self._last, self._published = self._begin_run()
        except sqlite3.Error as error:
            os.close(self._lock)
            raise StoreError(f"{self.path}: {error}") from None
        except StoreError:
            os.close(self._lock)
            raise

    def last_sequence(self) -> int:
        """The number after which this run may count."""
        return self._last

    def commit(self, records: Iterable[Record]) -> None:
        """Keep the results in one transaction; when this returns they survive a power cut.

        Raises StoreError where they cannot be kept (they are tried again with the next commit) or are out of order.
        """
        with self._mutex:
            self._enqueue(records)
            try:
                with self._connection:
                    self._connection.execute("BEGIN IMMEDIATE")
                    self._write(self._waiting)
            except sqlite3.Error as error:
                del self._waiting[:-WAITING_MAX]
                raise StoreError(f"{self.path}: {error}") from None
            self._waiting.clear()

    def published(self) -> int:
        """Results up to this number have been put on the network; those after it are the outbox."""
        return self._published

    def mark_published(self, sequence: int) -> None:
        """Results up to `sequence` are out. Kept with the next commit: after a crash a few go out twice."""
        self._published = max(self._published, sequence)

    def close(self) -> None:
        """Keep what is left and let go of the file. May be called twice."""
        with self._mutex:
            if self._lock < 0:
                return
            try:
                with self._connection:
                    self._connection.execute("BEGIN IMMEDIATE")
                    self._write(self._waiting)
                    self._mark("clean", 1)
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
        self._connection.executemany(
            "INSERT INTO results (sequence, run_id, sensor, what, payload, t_utc_ns, recorded, recording, identity)"
            " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            [
                (r.sequence, r.run_id, r.sensor, r.what, r.payload, r.t_utc_ns, r.recorded, r.recording, r.identity)
                for r in records
            ],
        )
        self._connection.executemany(
            "INSERT OR REPLACE INTO latest (sensor, what, sequence) VALUES (?, ?, ?)",
            [(r.sensor, r.what, r.sequence) for r in records],
        )
        self._mark("published", self._published)

    def _mark(self, name: str, value: int) -> None:
        self._connection.execute("UPDATE marks SET value = ? WHERE name = ?", (value, name))

    def _begin_run(self) -> tuple[int, int]:
        marks = dict(self._connection.execute("SELECT name, value FROM marks").fetchall())
        (kept,) = self._connection.execute("SELECT coalesce(max(sequence), 0) FROM results").fetchone()
        last = max(kept, marks["floor"])
        if not marks["clean"]:
            last += UNKEPT_MAX
        with self._connection:
            self._mark("floor", last)
            self._mark("clean", 0)
        return last, marks["published"]


def _lock(data_dir: Path) -> int:
    try:
        data_dir.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(data_dir / LOCK_NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise StoreError(f"{data_dir}: cannot be written: {error.strerror}") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise StoreError(f"{data_dir}: another process is using it") from None
    return descriptor


def _open_or_set_aside(path: Path, first: int) -> tuple[Path | None, sqlite3.Connection]:
    if not path.exists() or not _is_corrupt(path):
        return None, _open(path, first)
    number = 1
    while (aside := path.with_name(f"{path.name}.corrupt-{number}")).exists():
        number += 1
    for end in ("-wal", "-shm", ""):
        source = path.with_name(path.name + end)
        if source.exists():
            source.rename(path.with_name(f"{source.name}.corrupt-{number}"))
    return aside, _open(path, first)


def _is_corrupt(path: Path) -> bool:
    # Read-only: a connection that may write would fold the log into the broken file and delete it when it closes.
    with closing(connect_read_only(path)) as connection:
        try:
            return bool(connection.execute("PRAGMA quick_check(1)").fetchone() != ("ok",))
        except sqlite3.DatabaseError as error:
            if error.sqlite_errorcode in _CORRUPT:
                return True
            raise


def _open(path: Path, first: int) -> sqlite3.Connection:
    # Any thread: a mutex guards the connection, and the thread that opens is not the one that commits.
    connection = sqlite3.connect(path, timeout=5.0, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if version == 0:
            connection.executescript(_SCHEMA.format(version=SCHEMA_VERSION, first=first))
        elif version != SCHEMA_VERSION:
            raise StoreError(f"{path}: written in version {version}, this program writes version {SCHEMA_VERSION}")
    except BaseException:
        connection.close()
        raise
    return connection
