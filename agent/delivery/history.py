"""Reads the results that a gateway has stored, also while the agent writes."""

from __future__ import annotations

import math
import os
import sqlite3
from collections.abc import Collection
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

import msgspec

from agent.core.events import RESULTS, CalibrationUpdate, Result
from agent.core.memory import Memory
from agent.delivery.schema import (
    RESULT_COLUMNS,
    SCHEMA_VERSION,
    DamagedRow,
    StoreError,
    checked,
    damage,
    known_version,
    row_crc,
    version_of,
)

__all__ = ["FILE_NAME", "History", "Record", "Removed", "StoreError", "connect_read_only"]

FILE_NAME = "state.sqlite"


@dataclass(frozen=True, slots=True)
class Record:
    """A result as it is stored and published.

    `payload`: its JSON with two added fields: `recorded`, which is false where the result and its raw data are in no
    recording, and `epoch`, which names the numbering that `sequence` belongs to. `sensor`: empty for a result of the
    gateway itself. `sequence`: rises over all runs of a gateway, with gaps. `signed`: the result as its gateway signed
    it (agent.recording.result_signing), without `recorded`; empty where the gateway has no key.
    """

    sequence: int
    run_id: str
    sensor: str
    what: str
    payload: bytes
    t_utc_ns: int
    recorded: bool
    recording: str  # name of the recording's file; "" where the result is in none
    identity: str = ""  # for a calibration, the identity of the device
    signed: bytes = b""

    @staticmethod
    def of(result: Result, *, recorded: bool, recording: str, epoch: str = "", signed: bytes = b"") -> Record:
        """Make the record of a result."""
        identity = result.identity if isinstance(result, CalibrationUpdate) else ""
        return Record(
            result.sequence,
            result.run_id,
            result.sensor,
            result.what,
            payload_of(result, recorded=recorded, epoch=epoch),
            result.t_utc_ns,
            recorded,
            recording,
            identity,
            signed,
        )

    @staticmethod
    def of_row(row: tuple[Any, ...], signed: bytes = b"") -> Record:
        """Make the record from a row: RESULT_COLUMNS and their CRC. Raises DamagedRow."""
        sequence, run_id, sensor, what, payload, t_utc_ns, recorded, recording, identity = checked(row)
        return Record(sequence, run_id, sensor, what, payload, t_utc_ns, bool(recorded), recording, identity, signed)

    @property
    def row(self) -> tuple[Any, ...]:
        """The columns of RESULT_COLUMNS and their CRC."""
        columns: tuple[Any, ...] = (self.sequence, self.run_id, self.sensor, self.what, self.payload, self.t_utc_ns)
        columns += (int(self.recorded), self.recording, self.identity)
        return (*columns, row_crc(*columns))

    @property
    def is_withdrawal(self) -> bool:
        """Whether this status (UNCALIBRATED) ends the time in force of the sensor's calibration."""
        return self.what == "status" and self.fields.get("status") == "UNCALIBRATED"

    @property
    def fields(self) -> dict[str, Any]:
        """The payload, decoded from JSON. Raises StoreError where it is not JSON."""
        try:
            return msgspec.json.decode(self.payload, type=dict[str, Any])
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise StoreError(f"result {self.sequence} cannot be read: {error}") from None

    @property
    def result(self) -> Result:
        """The result, decoded; null becomes NaN. Raises StoreError where this version cannot decode the payload."""
        try:
            return msgspec.convert(_null_to_nan(self.fields), RESULTS[self.what])
        except (KeyError, msgspec.ValidationError) as error:
            raise StoreError(f"result {self.sequence}, a {self.what}, cannot be read: {error}") from None


@dataclass(frozen=True, slots=True)
class Removed:
    """What retention deleted of a channel: `count` results; the last of them had the sequence number `up_to`."""

    sensor: str
    what: str
    count: int
    up_to: int


class History:
    """Reads the store through a connection of its own, also while the agent writes.

    Only the thread that made it may use it. Every method raises StoreError where the store is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.is_file():
            raise StoreError(f"{path}: there is no such file; `fieldcal run` makes it in its data directory")
        self._connection = connect_read_only(path)
        try:
            version = version_of(self._connection)
        except sqlite3.Error as error:
            self.close()
            raise StoreError(f"{path}: {error}") from None
        if version != SCHEMA_VERSION:
            self.close()
            hint = "; `fieldcal run` brings it up to date" if known_version(version) else ""
            raise StoreError(
                f"{path}: the store has version {version}, but this program reads version {SCHEMA_VERSION}{hint}"
            )

    def check(self) -> None:
        """Check every page and row, as the agent does at its start; takes 6 s per GB. Raises StoreError on damage."""
        try:
            found = damage(self._connection)
        except (sqlite3.Error, UnicodeDecodeError) as error:
            found = str(error)
        if found:
            raise StoreError(f"{self._path}: damaged: {found}")

    def after(
        self,
        sequence: int,
        channels: Collection[tuple[str, str]] | None = None,
        *,
        limit: int,
        epoch: str | None = None,
    ) -> list[Record]:
        """The first `limit` results after number `sequence`, in order.

        Only of `channels` (sensor, what) and of one `epoch` ("" for results of older versions) where these are given.
        """
        where, values = "sequence > ?", [sequence]
        if channels is not None:
            rows = ", ".join(["(?, ?)"] * len(channels)) or "(NULL, NULL)"
            where += f" AND (sensor, what) IN (VALUES {rows})"
        names = [name for channel in channels or () for name in channel]
        if epoch is not None:
            where += " AND ifnull(json_extract(CAST(payload AS TEXT), '$.epoch'), '') = ?"
            names.append(epoch)
        return self._records(f"WHERE {where} ORDER BY sequence LIMIT ?", *values, *names, limit)

    def count_after(self, sequence: int) -> int:
        """The number of results after `sequence`. For the last published number this is the size of the outbox."""
        # This join uses the index of the channels; otherwise SQLite would read the whole table with all payloads.
        counted = "SELECT count(*) FROM latest AS l CROSS JOIN results AS r USING (sensor, what) WHERE r.sequence > ?"
        return int(self._rows(counted, sequence)[0][0])

    def channels(self) -> list[tuple[str, str]]:
        """All channels (sensor, what) that have ever had a result."""
        return sorted((sensor, what) for sensor, what, _, _ in self._latest())

    def latest(self) -> list[Record]:
        """The newest result of every channel, in order of sequence; a calibration only while it is in force."""
        return sorted(
            (self._record(sequence) for _, _, sequence, withdrawn in self._latest() if not withdrawn),
            key=lambda record: record.sequence,
        )

    def in_force(self, sensor: str) -> Record | None:
        """The calibration in force of a sensor; None if it has none, or if a later status was UNCALIBRATED."""
        return next((r for r in self.latest() if r.sensor == sensor and r.what == "calibration"), None)

    def calibrations(self, sensor: str) -> dict[str, Record]:
        """The newest calibration of each device that a sensor ever had, by identity (kind, serial number, settings)."""
        rows = self._rows(
            "SELECT max(sequence) FROM results WHERE sensor = ? AND what = 'calibration' GROUP BY identity", sensor
        )
        records = [self._record(sequence) for (sequence,) in rows]
        return {record.identity: record for record in records}

    def memories(self, sensor: str) -> dict[str, Memory]:
        """The newest state of the estimation of each of this sensor's last devices, by identity, oldest first."""
        rows = self._rows(
            "SELECT sensor, identity, sequence, state, crc FROM memory WHERE sensor = ? ORDER BY sequence", sensor
        )
        try:
            return {row[1]: Memory(*checked(row)) for row in rows}
        except DamagedRow as error:
            raise StoreError(f"{self._path}: {error}") from None

    def file_sequence(self) -> int:
        """The highest file number of all recordings, deleted ones included."""
        rows = self._checked("SELECT name, value, crc FROM marks WHERE name = 'file'")
        return int(rows[0][1]) if rows else 0

    def newest(self, sensor: str, what: str, *, limit: int, run_id: str = "") -> list[Record]:
        """The newest `limit` results of one channel, of one run if it is named, newest first."""
        of_run, named = (" AND run_id = ?", [run_id]) if run_id else ("", [])
        where = f"WHERE sensor = ? AND what = ?{of_run} ORDER BY sequence DESC LIMIT ?"
        return self._records(where, sensor, what, *named, limit)

    def removed(self) -> list[Removed]:
        """What retention deleted, by channel."""
        rows = self._checked("SELECT sensor, what, count, up_to, crc FROM removed ORDER BY sensor, what")
        return [Removed(*row) for row in rows]

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _latest(self) -> list[tuple[Any, ...]]:
        return self._checked("SELECT sensor, what, sequence, withdrawn, crc FROM latest")

    def _record(self, sequence: int) -> Record:
        found = self._records("WHERE sequence = ?", sequence)
        if not found:
            raise StoreError(f"{self._path}: damaged: result {sequence} is missing")
        return found[0]

    def _records(self, clause: str, *values: object) -> list[Record]:
        columns = f"{RESULT_COLUMNS}, crc, data, signed_crc"
        rows = self._rows(f"SELECT {columns} FROM results LEFT JOIN signed USING (sequence) {clause}", *values)
        try:
            return [Record.of_row(row[:-2], _signed(row)) for row in rows]
        except DamagedRow as error:
            raise StoreError(f"{self._path}: {error}") from None

    def _checked(self, sql: str) -> list[tuple[Any, ...]]:
        try:
            return [checked(row) for row in self._rows(sql)]
        except DamagedRow as error:
            raise StoreError(f"{self._path}: {error}") from None

    def _rows(self, sql: str, *values: object) -> list[tuple[Any, ...]]:
        # All rows at once: while a reader stays in a transaction, SQLite cannot copy the log into the file.
        try:
            with closing(self._connection.execute(sql, values)) as cursor:
                return cursor.fetchall()
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise StoreError(f"{self._path}: {error}") from None


def payload_of(result: Result, *, recorded: bool, epoch: str) -> bytes:
    """The JSON of a result, as it is stored and published. A number that is not finite becomes null."""
    fields = {**msgspec.structs.asdict(result), "recorded": recorded} | ({"epoch": epoch} if epoch else {})
    return msgspec.json.encode(fields)


def _signed(row: tuple[Any, ...]) -> bytes:
    """The signed result at the end of a row; empty where it has none. Raises DamagedRow."""
    data = row[-2]
    return bytes(checked((row[0], *row[-2:]))[1]) if data is not None else b""


def result_of(what: str, fields: dict[str, Any]) -> Result | None:
    """The result whose fields these are; None where this version knows no such kind. Raises msgspec.ValidationError."""
    return msgspec.convert(_null_to_nan(fields), RESULTS[what]) if what in RESULTS else None


def _null_to_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _null_to_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_null_to_nan(item) for item in value]
    return math.nan if value is None else value


def connect_read_only(path: Path) -> sqlite3.Connection:
    """Open the store for reading only. A missing or damaged file raises sqlite3.Error only when something is read."""
    # Without a writer there is no log. In a directory without write permission only `immutable` can then open the file.
    log = path.with_name(path.name + "-wal")
    idle = not log.exists() and not os.access(path.parent, os.W_OK)
    option = "immutable=1" if idle else "mode=ro"
    return sqlite3.connect(f"file:{quote(str(path))}?{option}", uri=True, timeout=5.0)
