"""The results a gateway has kept: what a record is, and how it is read while the agent goes on writing."""

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

from agent.events import CalibrationUpdate, DriftReport, Estimate, Result, StatusChange, WindowReport

FILE_NAME = "state.sqlite"
SCHEMA_VERSION = 1
_TYPES: dict[str, type[Result]] = {
    "calibration": CalibrationUpdate,
    "window": WindowReport,
    "estimate": Estimate,
    "drift": DriftReport,
    "status": StatusChange,
}
_KINDS = {kind: what for what, kind in _TYPES.items()}
_COLUMNS = "sequence, run_id, sensor, what, payload, t_utc_ns, recorded, recording, identity"


class StoreError(Exception):
    """The store cannot be read or written. The message names the file and the reason."""


@dataclass(frozen=True, slots=True)
class Record:
    """A result as it is kept and published.

    `payload` is its JSON with the field `recorded` added: false where the recording failed, and the raw data behind
    the result are not kept. `sensor` is empty where the gateway itself speaks. `sequence` counts the results of a
    gateway over all its runs, with gaps.
    """

    sequence: int
    run_id: str
    sensor: str
    what: str
    payload: bytes
    t_utc_ns: int
    recorded: bool
    recording: str  # name of the file
    identity: str = ""  # of the device, where this is a calibration

    @staticmethod
    def of(result: Result, *, recorded: bool, recording: str) -> Record:
        """The record of a result; a number that is not finite becomes null."""
        fields = {**msgspec.structs.asdict(result), "recorded": recorded}
        identity = result.identity if isinstance(result, CalibrationUpdate) else ""
        return Record(
            result.sequence,
            result.run_id,
            result.sensor,
            _KINDS[type(result)],
            msgspec.json.encode(fields),
            result.t_utc_ns,
            recorded,
            recording,
            identity,
        )

    @property
    def fields(self) -> dict[str, Any]:
        """The payload decoded. Raises StoreError where it is not JSON."""
        try:
            return msgspec.json.decode(self.payload, type=dict[str, Any])
        except msgspec.DecodeError as error:
            raise StoreError(f"result {self.sequence} cannot be read: {error}") from None

    @property
    def result(self) -> Result:
        """The result again; null becomes NaN. Raises StoreError where the payload is not of this version."""
        try:
            return msgspec.convert(_null_to_nan(self.fields), _TYPES[self.what])
        except (KeyError, msgspec.ValidationError) as error:
            raise StoreError(f"result {self.sequence}, a {self.what}, cannot be read: {error}") from None


class History:
    """Reads the store through a connection of its own, also while the agent writes. Belongs to the thread that made it.

    Raises StoreError where there is no store, or it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.is_file():
            raise StoreError(f"{path}: there is no such file")
        self._connection = connect_read_only(path)
        version = self._rows("PRAGMA user_version")[0][0]
        if version != SCHEMA_VERSION:
            self.close()
            raise StoreError(f"{path}: written in version {version}, this program reads version {SCHEMA_VERSION}")

    def after(self, sequence: int, channels: Collection[tuple[str, str]] | None = None, *, limit: int) -> list[Record]:
        """The first `limit` results after `sequence`, in order; of the `channels` (sensor, what) if given."""
        where, values = "sequence > ?", [sequence]
        if channels is not None:
            rows = ", ".join(["(?, ?)"] * len(channels)) or "(NULL, NULL)"
            where += f" AND (sensor, what) IN (VALUES {rows})"
        names = [name for channel in channels or () for name in channel]
        return self._records(f"WHERE {where} ORDER BY sequence LIMIT ?", *values, *names, limit)

    def channels(self) -> list[tuple[str, str]]:
        """All (sensor, what) that ever gave a result."""
        return [(sensor, what) for sensor, what in self._rows("SELECT sensor, what FROM latest ORDER BY sensor, what")]

    def latest(self) -> list[Record]:
        """The newest result of every channel, in order; a calibration only where it is in force."""
        records = self._records("WHERE sequence IN (SELECT sequence FROM latest) ORDER BY sequence")
        return [r for r in records if r.what != "calibration" or not self._is_withdrawn(r)]

    def in_force(self, sensor: str) -> Record | None:
        """The newest calibration of a sensor; None if it has none, or its status was UNCALIBRATED since."""
        return next((r for r in self.latest() if r.sensor == sensor and r.what == "calibration"), None)

    def calibration_of(self, sensor: str, identity: str) -> Record | None:
        """The newest calibration that belongs to this very device and its settings: the one a start may restore."""
        where = "WHERE sensor = ? AND what = 'calibration' AND identity = ? ORDER BY sequence DESC LIMIT 1"
        return next(iter(self._records(where, sensor, identity)), None)

    def newest(self, sensor: str, what: str, *, limit: int) -> list[Record]:
        """The newest `limit` results of one channel, newest first."""
        return self._records("WHERE sensor = ? AND what = ? ORDER BY sequence DESC LIMIT ?", sensor, what, limit)

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _is_withdrawn(self, calibration: Record) -> bool:
        """Whether the status was UNCALIBRATED since: what came after it may be COLLECTING, but not with this one."""
        where = "WHERE sensor = ? AND what = 'status' AND sequence > ?"
        since = self._records(where, calibration.sensor, calibration.sequence)
        return any(record.fields.get("status") == "UNCALIBRATED" for record in since)

    def _records(self, clause: str, *values: object) -> list[Record]:
        rows = self._rows(f"SELECT {_COLUMNS} FROM results {clause}", *values)
        return [
            Record(sequence, run_id, sensor, what, payload, t_utc_ns, bool(recorded), recording, identity)
            for sequence, run_id, sensor, what, payload, t_utc_ns, recorded, recording, identity in rows
        ]

    def _rows(self, sql: str, *values: object) -> list[tuple[Any, ...]]:
        # A whole answer at once: a reader that stays in a transaction keeps the log from being folded in.
        try:
            with closing(self._connection.execute(sql, values)) as cursor:
                return cursor.fetchall()
        except sqlite3.Error as error:
            raise StoreError(f"{self._path}: {error}") from None


def _null_to_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _null_to_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_null_to_nan(item) for item in value]
    return math.nan if value is None else value


def connect_read_only(path: Path) -> sqlite3.Connection:
    """Open without leave to write. Raises sqlite3.Error only when something is read."""
    # Where nobody writes there is no log, and `immutable` alone opens a file in a directory that cannot be written.
    log = path.with_name(path.name + "-wal")
    idle = not log.exists() and not os.access(path.parent, os.W_OK)
    option = "immutable=1" if idle else "mode=ro"
    return sqlite3.connect(f"file:{quote(str(path))}?{option}", uri=True, timeout=5.0)
