"""Where the database of the monitor lies: a SQLite file, or PostgreSQL. Both run the same queries.

A query is a text with `:name` for each value. SQLite runs it by itself, so that a small monitor loads no other library;
PostgreSQL runs it through SQLAlchemy (extra `fleet`).
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

Rows = list[tuple[Any, ...]]
LASTING = 0  # in place of a day: rows that are never dropped
BUSY_S = 1.0  # s to wait for another program that has locked the file; the questions of the page wait meanwhile
_LOCK = 7_160_001  # key of the lock under which PostgreSQL makes tables and partitions, and adds results


class DatabaseError(ConnectionError):
    """PostgreSQL cannot be used. The message says why; it holds no password."""


class QueryRunner(Protocol):
    """Runs a query with its values by name; returns its rows."""

    def __call__(self, sql: str, /, **values: object) -> Rows: ...


class DatabaseEngine(Protocol):
    """What differs between the two."""

    NUMBER: str  # column type that numbers rows in the order of their arrival
    BYTES: str
    PARTITIONED: str

    @contextmanager
    def transaction(self) -> Iterator[QueryRunner]:
        """All queries within it take effect, or none. May be used by several threads."""

    def make_tables(self, run: QueryRunner, statements: list[str]) -> None:
        """Make the tables that are not there yet."""

    def make_day(self, run: QueryRunner, day: int) -> None:
        """Before the first result of a day."""

    def writes(self, run: QueryRunner) -> None:
        """Before a transaction adds results: several monitors on one database add theirs one after the other."""

    def forget(self, run: QueryRunner, day: int, sensor: int) -> None:
        """The results of a sensor on this day are summarised."""

    def drop_day(self, run: QueryRunner, day: int) -> None:
        """The results of all sensors on this day are summarised."""

    def close(self) -> None:
        """End the connections."""


class Sqlite:
    """One file. Raises sqlite3.Error where it cannot be used."""

    NUMBER, BYTES, PARTITIONED = "INTEGER PRIMARY KEY", "BLOB", ""

    def __init__(self, path: Path) -> None:
        self._connection = sqlite3.connect(path, BUSY_S, check_same_thread=False, isolation_level=None)
        self._mutex = threading.Lock()
        self._connection.execute("PRAGMA journal_mode = WAL")
        # A power cut may undo the last results; `last_sequence` then asks the gateways for them again.
        self._connection.execute("PRAGMA synchronous = NORMAL")

    @contextmanager
    def transaction(self) -> Iterator[QueryRunner]:
        with self._mutex, self._connection:
            self._connection.execute("BEGIN")
            yield self._run

    def make_tables(self, run: QueryRunner, statements: list[str]) -> None:
        columns = [row[1] for row in run("PRAGMA table_info(result)")]
        if columns and "day" not in columns:
            raise sqlite3.DatabaseError(
                "made by an earlier version of this program; move it away, then the monitor makes a new one and gets "
                "the values in force from the gateways"
            )
        for statement in statements:
            run(statement)

    def make_day(self, run: QueryRunner, day: int) -> None:
        pass

    def writes(self, run: QueryRunner) -> None:
        pass  # one monitor has the file

    def forget(self, run: QueryRunner, day: int, sensor: int) -> None:
        run("DELETE FROM result WHERE sensor = :sensor AND day = :day", sensor=sensor, day=day)

    def drop_day(self, run: QueryRunner, day: int) -> None:
        pass

    def close(self) -> None:
        with self._mutex:
            self._connection.close()

    def _run(self, sql: str, /, **values: object) -> Rows:
        return self._connection.execute(sql, values).fetchall()


class Postgres:
    """A database of PostgreSQL 15 or later. Raises DatabaseError where it cannot be used.

    `url`: postgresql://USER@HOST/NAME. The password comes from libpq's environment (PGPASSWORD, PGPASSFILE).
    """

    NUMBER, BYTES = "BIGINT NOT NULL DEFAULT nextval('result_number')", "BYTEA"
    PARTITIONED = "PARTITION BY RANGE (day)"

    def __init__(self, url: str) -> None:
        try:
            import sqlalchemy
        except ImportError:
            raise DatabaseError("PostgreSQL needs the extra fleet: fieldcal extras --install fleet") from None
        self._sqlalchemy = sqlalchemy
        # As with SQLite, a power cut may undo the last results.
        options = {"options": "-c synchronous_commit=off", "connect_timeout": 10}
        address = sqlalchemy.make_url(url).set(drivername="postgresql+psycopg")
        self._where = f"{address.host or 'local'}/{address.database}"
        try:
            self._engine = sqlalchemy.create_engine(address, pool_pre_ping=True, connect_args=options)
        except ImportError:
            raise DatabaseError("PostgreSQL needs the extra fleet: fieldcal extras --install fleet") from None

    @contextmanager
    def transaction(self) -> Iterator[QueryRunner]:
        try:
            with self._engine.begin() as connection:

                def run(sql: str, /, **values: object) -> Rows:
                    result = connection.execute(self._sqlalchemy.text(sql), values)
                    return [tuple(row) for row in result] if result.returns_rows else []

                yield run
        except self._sqlalchemy.exc.SQLAlchemyError as error:
            cause = str(getattr(error, "orig", None) or error).strip().splitlines()
            raise DatabaseError(f"PostgreSQL {self._where}: {cause[0] if cause else type(error).__name__}") from None

    def make_tables(self, run: QueryRunner, statements: list[str]) -> None:
        self._lock(run)  # several monitors may begin at once
        run("CREATE SEQUENCE IF NOT EXISTS result_number")
        for statement in statements:
            run(statement)
        self._partition(run, LASTING)

    def make_day(self, run: QueryRunner, day: int) -> None:
        self._lock(run)
        self._partition(run, day)

    def writes(self, run: QueryRunner) -> None:
        self._lock(run)  # transactions that change the same rows in another order would wait for each other

    def forget(self, run: QueryRunner, day: int, sensor: int) -> None:
        pass  # with the partition

    def drop_day(self, run: QueryRunner, day: int) -> None:
        run(f"DROP TABLE IF EXISTS result_{day:d}")

    def close(self) -> None:
        self._engine.dispose()

    @staticmethod
    def _lock(run: QueryRunner) -> None:
        run("SELECT pg_advisory_xact_lock(:key)", key=_LOCK)

    @staticmethod
    def _partition(run: QueryRunner, day: int) -> None:
        run(f"CREATE TABLE IF NOT EXISTS result_{day:d} PARTITION OF result FOR VALUES FROM ({day:d}) TO ({day + 1:d})")


def open_engine(data_dir: Path, url: str | None) -> DatabaseEngine:
    """PostgreSQL at `url`, else the file `monitor.sqlite` in a directory. Raises sqlite3.Error or DatabaseError."""
    return Sqlite(data_dir / "monitor.sqlite") if url is None else Postgres(url)
