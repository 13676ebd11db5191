"""The tables of the store, the migration of older stores, and the check for damage.

SQLite detects a broken page, but not a changed digit within a value. So each row has a column with the CRC-32 of its
other columns, which is checked whenever the row is read.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from agent.core.memory import MOST_MEMORIES, Memory

SCHEMA_VERSION = 5
# `epoch` names the numbering of the results. Version 2 had the same tables without this mark; a start adds it.
EPOCH = "epoch"
MARKS = frozenset({"floor", "published", "clean", "file", EPOCH})
LARGEST_MARK = 2**53  # above it, JavaScript's numbers are not exact
RESULT_COLUMNS = "sequence, run_id, sensor, what, payload, t_utc_ns, recorded, recording, identity"
_RESULTS = """CREATE TABLE results (
    sequence INTEGER PRIMARY KEY, run_id TEXT NOT NULL, sensor TEXT NOT NULL, what TEXT NOT NULL,
    payload BLOB NOT NULL, t_utc_ns INTEGER NOT NULL, recorded INTEGER NOT NULL, recording TEXT NOT NULL,
    identity TEXT NOT NULL, crc INTEGER NOT NULL) STRICT"""
# `withdrawn`: the calibration is no longer in force, since a later status was UNCALIBRATED.
_LATEST = """CREATE TABLE latest (
    sensor TEXT NOT NULL, what TEXT NOT NULL, sequence INTEGER NOT NULL, withdrawn INTEGER NOT NULL,
    crc INTEGER NOT NULL, PRIMARY KEY (sensor, what)) STRICT"""
_MARKS = "CREATE TABLE marks (name TEXT PRIMARY KEY, value INTEGER NOT NULL, crc INTEGER NOT NULL) STRICT"
# The results as their gateway signed them (agent.recording.result_signing), where it has a key.
_SIGNED = "CREATE TABLE signed (sequence INTEGER PRIMARY KEY, data BLOB NOT NULL, signed_crc INTEGER NOT NULL) STRICT"
# What retention deleted, by channel: the number of results, and the sequence number of the last of them.
_REMOVED = """CREATE TABLE removed (
    sensor TEXT NOT NULL, what TEXT NOT NULL, count INTEGER NOT NULL, up_to INTEGER NOT NULL, crc INTEGER NOT NULL,
    PRIMARY KEY (sensor, what)) STRICT"""
# The state of the estimation that is kept between runs: the newest one of each device, as bytes not interpreted here.
_MEMORY = """CREATE TABLE memory (
    sensor TEXT NOT NULL, identity TEXT NOT NULL, sequence INTEGER NOT NULL, state BLOB NOT NULL, crc INTEGER NOT NULL,
    PRIMARY KEY (sensor, identity)) STRICT"""
# The signed list of the rows of `memory` (agent.delivery.signed_states); empty where the gateway has no key.
_STATES = """CREATE TABLE states (
    one INTEGER PRIMARY KEY CHECK (one = 1), signed BLOB NOT NULL, crc INTEGER NOT NULL) STRICT"""
_INDEXES = (
    "CREATE INDEX results_of_channel ON results (sensor, what, sequence)",
    "CREATE INDEX calibrations_of_device ON results (sensor, identity, sequence) WHERE what = 'calibration'",
)
_STATEMENTS = (_RESULTS, _LATEST, _MARKS, _REMOVED, _MEMORY, _SIGNED, _STATES, *_INDEXES)


class StoreError(Exception):
    """The store cannot be read or written. The message names the file and the reason."""


class DamagedRow(StoreError):  # noqa: N818 - names the row that was read
    """A row of the store differs from what was written."""


def row_crc(*columns: object) -> int:
    """CRC-32 of the columns of a row, in their order."""
    return zlib.crc32(msgspec.msgpack.encode(columns))


def checked(row: tuple[Any, ...]) -> tuple[Any, ...]:
    """The columns of a row without the last one, the CRC. Raises DamagedRow where the CRC does not fit the others."""
    *columns, crc = row
    try:
        fits = row_crc(*columns) == crc
    except (OverflowError, UnicodeEncodeError):
        fits = False
    if not fits:
        raise DamagedRow(f"a row that begins with {columns[0]!r:.40} is damaged: its CRC does not fit it")
    return tuple(columns)


def write_mark(connection: sqlite3.Connection, name: str, value: int) -> None:
    """Set one of the numbers named in MARKS."""
    row = (name, value, row_crc(name, value))
    connection.execute("INSERT OR REPLACE INTO marks (name, value, crc) VALUES (?, ?, ?)", row)


def read_marks(connection: sqlite3.Connection) -> dict[str, int]:
    """Read all numbers named in MARKS; `epoch` may be missing. Raises DamagedRow or sqlite3.Error."""
    rows = connection.execute("SELECT name, value, crc FROM marks").fetchall()
    marks = {str(name): value for name, value in map(checked, rows) if isinstance(value, int)}
    if marks.keys() | {EPOCH} != MARKS:
        raise DamagedRow(f"the table marks has {', '.join(sorted(marks))} instead of {', '.join(sorted(MARKS))}")
    if beyond := sorted(name for name, value in marks.items() if name != EPOCH and not 0 <= value <= LARGEST_MARK):
        raise DamagedRow(f"the table marks has a number for {beyond[0]} that is not from 0 to {LARGEST_MARK}")
    return marks


def write_latest(connection: sqlite3.Connection, sensor: str, what: str, sequence: int, *, withdrawn: bool) -> None:
    """Set the newest result of a channel in the table `latest`."""
    row = (sensor, what, sequence, int(withdrawn))
    connection.execute(
        "INSERT OR REPLACE INTO latest (sensor, what, sequence, withdrawn, crc) VALUES (?, ?, ?, ?, ?)",
        (*row, row_crc(*row)),
    )


def withdraw(connection: sqlite3.Connection, sensor: str) -> None:
    """Mark the newest calibration of a sensor, if there is one, as no longer in force."""
    where = "SELECT sequence FROM latest WHERE sensor = ? AND what = 'calibration'"
    for (sequence,) in connection.execute(where, (sensor,)).fetchall():
        write_latest(connection, sensor, "calibration", sequence, withdrawn=True)


def insert_results(connection: sqlite3.Connection, rows: Iterable[tuple[object, ...]]) -> None:
    """Insert rows of RESULT_COLUMNS and CRC. Raises sqlite3.IntegrityError where a sequence number exists already."""
    places = ", ".join("?" * 10)
    connection.executemany(f"INSERT INTO results ({RESULT_COLUMNS}, crc) VALUES ({places})", rows)


def insert_signed(connection: sqlite3.Connection, rows: Iterable[tuple[int, bytes]]) -> None:
    """Insert signed results: (sequence, data)."""
    with_crc = [(*row, row_crc(*row)) for row in rows]
    connection.executemany("INSERT INTO signed (sequence, data, signed_crc) VALUES (?, ?, ?)", with_crc)


def write_memory(connection: sqlite3.Connection, memory: Memory) -> None:
    """Write the state of the estimation of a device.

    It replaces the device's previous state. For each sensor, only the MOST_MEMORIES newest devices are kept.
    """
    row = (memory.sensor, memory.identity, memory.sequence, memory.state)
    connection.execute(
        "INSERT OR REPLACE INTO memory (sensor, identity, sequence, state, crc) VALUES (?, ?, ?, ?, ?)",
        (*row, row_crc(*row)),
    )
    newest = "SELECT identity FROM memory WHERE sensor = ? ORDER BY sequence DESC, rowid DESC LIMIT ?"
    connection.execute(
        f"DELETE FROM memory WHERE sensor = ? AND identity NOT IN ({newest})",
        (memory.sensor, memory.sensor, MOST_MEMORIES),
    )


def read_memories(connection: sqlite3.Connection) -> list[Memory]:
    """All states of the estimation, those of a sensor oldest first. Raises DamagedRow, sqlite3.Error."""
    sql = "SELECT sensor, identity, sequence, state, crc FROM memory ORDER BY sensor, sequence, rowid"
    return [Memory(*checked(row)) for row in connection.execute(sql).fetchall()]


def write_states(connection: sqlite3.Connection, signed: bytes) -> None:
    """Replace the signed list of the states."""
    row = (1, signed)
    connection.execute("INSERT OR REPLACE INTO states (one, signed, crc) VALUES (?, ?, ?)", (*row, row_crc(*row)))


def read_states(connection: sqlite3.Connection) -> bytes:
    """The signed list of the states; empty where there is none. Raises DamagedRow, sqlite3.Error."""
    rows = connection.execute("SELECT one, signed, crc FROM states").fetchall()
    return bytes(checked(rows[0])[1]) if rows else b""


def create_tables(connection: sqlite3.Connection, marks: dict[str, int]) -> None:
    """Make an empty store, within the caller's transaction."""
    for statement in _STATEMENTS:
        connection.execute(statement)
    for name, value in marks.items():
        write_mark(connection, name, value)
    connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


def bring_up_to_date(connection: sqlite3.Connection, version: int) -> None:
    """Migrate a store of an older version in one transaction: a crash leaves it complete, in the old or new version."""
    connection.execute("BEGIN IMMEDIATE")
    with connection:
        for older in range(version, SCHEMA_VERSION):
            _MIGRATIONS[older](connection)
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


def known_version(version: int) -> bool:
    """Whether this program can use a store of a version, itself or after a migration."""
    return version == SCHEMA_VERSION or version in _MIGRATIONS


def _add_crcs(connection: sqlite3.Connection) -> None:
    """Version 1 to 2 adds CRCs, the column `withdrawn`, and the marks of retention and of file numbers."""
    withdrawn = {sensor for (sensor,) in connection.execute(_WITHDRAWN)}
    newest = connection.execute("SELECT sensor, what, sequence FROM latest").fetchall()
    marks = dict(connection.execute("SELECT name, value FROM marks").fetchall())
    connection.create_function("row_crc", 9, row_crc, deterministic=True)
    connection.execute("ALTER TABLE results RENAME TO results_1")
    connection.execute("DROP TABLE latest")
    connection.execute("DROP TABLE marks")
    for statement in (_RESULTS, _LATEST, _MARKS, _REMOVED, _MEMORY):
        connection.execute(statement)
    connection.execute(
        f"INSERT INTO results ({RESULT_COLUMNS}, crc) SELECT {RESULT_COLUMNS}, row_crc({RESULT_COLUMNS}) FROM results_1"
    )
    connection.execute("DROP TABLE results_1")
    for statement in _INDEXES:
        connection.execute(statement)
    for sensor, what, sequence in newest:
        write_latest(connection, sensor, what, sequence, withdrawn=what == "calibration" and sensor in withdrawn)
    for name, value in (marks | {"file": 0}).items():
        write_mark(connection, name, value)


_WITHDRAWN = """
SELECT DISTINCT status.sensor FROM results AS status JOIN latest ON latest.sensor = status.sensor
WHERE latest.what = 'calibration' AND status.what = 'status' AND status.sequence > latest.sequence
AND json_extract(CAST(status.payload AS TEXT), '$.status') = 'UNCALIBRATED'"""
_MIGRATIONS: dict[int, Callable[[sqlite3.Connection], object]] = {
    1: _add_crcs,
    2: lambda _: None,
    3: lambda connection: connection.execute(_SIGNED),
    4: lambda connection: connection.execute(_STATES),
}


def damage(connection: sqlite3.Connection) -> str:
    """Check every page and row of a store of this version; returns what is damaged, or "".

    Raises sqlite3.Error. The caller decides which of these errors also mean damage.
    """
    (said,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    if said != "ok":
        return str(said)
    if not _is_ours(connection):
        return "its tables are not those of this version"
    newest = "SELECT sensor, what, max(sequence) FROM results GROUP BY sensor, what"
    beyond = "SELECT 1 FROM results WHERE sequence > ? LIMIT 1"
    if connection.execute(beyond, (LARGEST_MARK,)).fetchone() is not None:
        return f"a result has a number above {LARGEST_MARK}"
    try:
        read_marks(connection)
        _check_rows(connection.execute(f"SELECT {RESULT_COLUMNS}, crc FROM results"))
        _check_rows(connection.execute("SELECT sequence, data, signed_crc FROM signed"))
        _check_rows(connection.execute("SELECT sensor, what, count, up_to, crc FROM removed"))
        read_memories(connection)
        read_states(connection)
        latest = [checked(row) for row in connection.execute("SELECT * FROM latest")]
    except DamagedRow as error:
        return str(error)
    if {row[:3] for row in latest} != set(connection.execute(newest)):
        return "the table latest does not name the newest results"
    in_force = {row[0] for row in latest if row[1] == "calibration" and not row[3]}
    if not in_force.isdisjoint(sensor for (sensor,) in connection.execute(_WITHDRAWN)):
        return "the table latest names a calibration that is no longer in force"
    return ""


def version_of(connection: sqlite3.Connection) -> int:
    """The version of a store; 0 where it is empty.

    Where the version number and the tables do not belong together, `damage` says so.
    """
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    # A later version would have other tables. Where the tables are of this version, the number itself is damaged.
    return SCHEMA_VERSION if version != SCHEMA_VERSION and _is_ours(connection) else int(version)


def _is_ours(connection: sqlite3.Connection) -> bool:
    rows = connection.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
    return sorted(sql for (sql,) in rows) == sorted(_STATEMENTS)


def _check_rows(rows: Iterable[tuple[object, ...]]) -> None:
    for row in rows:
        checked(row)
