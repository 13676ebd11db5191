"""Opens the store's file: locks it against a second agent, checks it, renames a damaged one, migrates an older one."""

from __future__ import annotations

import fcntl
import os
import sqlite3
from contextlib import closing, suppress
from pathlib import Path

from agent.delivery.history import connect_read_only
from agent.delivery.schema import (
    SCHEMA_VERSION,
    DamagedRow,
    StoreError,
    bring_up_to_date,
    damage,
    known_version,
    version_of,
)

LOCK_NAME = "state.lock"
LOG_PAGES = 256  # pages of the write-ahead log, 1 MiB; the log needs disk space too
CACHE_KIB = 512  # KiB of pages in memory; SQLite's default of 2 MiB would fill over hours without use
# SQLite's error codes for faults of the machine (disk, rights, memory). Any other error means that the file is damaged.
_OF_THE_MACHINE = frozenset(
    {
        sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_FULL,
        sqlite3.SQLITE_NOMEM, sqlite3.SQLITE_PERM, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PROTOCOL,
    }
)  # fmt: skip


def lock(data_dir: Path) -> int:
    """Lock a data directory for this process; returns the descriptor that holds the lock. Raises StoreError."""
    try:
        data_dir.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(data_dir / LOCK_NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise StoreError(f"{data_dir}: cannot be written: {error.strerror}") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        remedy = "stop that process, or use another directory"
        raise StoreError(f"{data_dir}: another process is using it; {remedy}") from None
    return descriptor


def open_or_set_aside(path: Path) -> tuple[Path | None, sqlite3.Connection]:
    """Open the store; returns (new path of a damaged file or None, connection).

    The connection is to a store of this version, or to an empty file, which also replaces a damaged one. A damaged file
    is renamed to `<name>.corrupt-<n>`.
    Raises StoreError for a store of a later version, sqlite3.Error where the machine cannot open the file.
    """
    if not path.exists():
        return None, _open(path)
    _roll_back(path)
    if not _is_damaged(path):
        try:
            return None, _open(path)
        except (sqlite3.Error, DamagedRow) as error:
            if not _means_damage(error, path):
                raise
    number = 1
    while (aside := path.with_name(f"{path.name}.corrupt-{number}")).exists():
        number += 1
    for end in ("-wal", "-shm", "-journal", ""):
        source = path.with_name(path.name + end)
        if source.exists():
            source.rename(path.with_name(f"{source.name}.corrupt-{number}"))
    return aside, _open(path)


def _roll_back(path: Path) -> None:
    """Roll back a transaction that was interrupted before the file had a write-ahead log.

    A read-only connection, as `_is_damaged` uses, cannot roll back and would refuse to open the file.
    """
    if not path.with_name(path.name + "-journal").exists() or path.with_name(path.name + "-wal").exists():
        return
    with closing(sqlite3.connect(path, timeout=5.0)) as connection, suppress(sqlite3.Error):  # `_is_damaged` reports it
        version_of(connection)


def _is_damaged(path: Path) -> bool:
    # Read-only, since a connection that may write copies the log into the damaged file and deletes the log on closing.
    with closing(connect_read_only(path)) as connection:
        try:
            version = version_of(connection)
            if version in (0, SCHEMA_VERSION):
                return bool(version and damage(connection))
            if not known_version(version):
                return False  # `_open` refuses it
            return bool(connection.execute("PRAGMA integrity_check(1)").fetchone() != ("ok",))
        except (sqlite3.Error, UnicodeDecodeError) as error:
            if _means_damage(error, path):
                return True
            raise


def _means_damage(error: Exception, path: Path) -> bool:
    code = getattr(error, "sqlite_errorcode", None)
    if code is None:
        return True  # an error of Python, not of SQLite: text that cannot be decoded
    if code & 0xFF == sqlite3.SQLITE_READONLY:  # SQLite's code also for an invalid version of the file format
        return os.access(path, os.W_OK)
    return code & 0xFF not in _OF_THE_MACHINE


def _open(path: Path) -> sqlite3.Connection:
    # Another thread than this one commits, so check_same_thread is off; the Store's mutex guards the connection.
    connection = sqlite3.connect(path, timeout=5.0, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute(f"PRAGMA wal_autocheckpoint = {LOG_PAGES}")
        connection.execute(f"PRAGMA cache_size = -{CACHE_KIB}")
        version = version_of(connection)
        if not known_version(version) and version != 0:
            raise StoreError(
                f"{path}: written by a later version of fieldcal (store version {version}, this program writes "
                f"version {SCHEMA_VERSION}); run that version, or use another data directory"
            )
        if version == SCHEMA_VERSION:
            # This write fails if the file cannot be written. It also corrects a version number with a changed bit.
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        elif version != 0:
            bring_up_to_date(connection, version)
    except BaseException:
        connection.close()
        raise
    return connection
