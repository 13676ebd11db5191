"""Reads the results that a gateway has stored, also while the agent writes."""

from __future__ import annotations

import os
import sqlite3
from bisect import bisect_right
from collections.abc import Collection, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import quote

from agent.core.memory import Memory
from agent.delivery.record import JOINED, StoredResult
from agent.delivery.schema import (
    SCHEMA_VERSION,
    DamagedRow,
    StoreError,
    checked,
    damage,
    known_version,
    read_memories,
    read_states,
    version_of,
)

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys

__all__ = ["FILE_NAME", "History", "Removed", "StoreError", "StoredResult", "connect_read_only"]

FILE_NAME = "state.sqlite"
_SAYS = "iif(json_valid(CAST(payload AS TEXT)), json_extract(CAST(payload AS TEXT), '$.status'), NULL)"
_IN_FORCE = f"""
SELECT t_utc_ns, sequence, what = 'calibration' FROM results
WHERE sensor = ? AND (what = 'calibration' OR (what = 'status' AND {_SAYS} = 'UNCALIBRATED')) ORDER BY 1, 2"""
_EPOCH_OF = "ifnull(iif(json_valid(CAST(payload AS TEXT)), json_extract(CAST(payload AS TEXT), '$.epoch'), NULL), '')"


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

    What is signed is given as it was signed, whatever its row says. With `keys` (those of the gateway), a result that
    none of them signed is left out; without, one whose signature is not valid. `refused`: why, by sequence number, also
    of rows that said something else than was signed. Results without any signature are given, unless `signed_only`:
    `StoredResult.signed` is empty.
    """

    def __init__(self, path: Path, keys: KnownKeys | None = None, *, signed_only: bool = False) -> None:
        self._path = path
        self._signed_only = signed_only
        self._keys = keys
        self.refused: dict[int, str] = {}
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
    ) -> list[StoredResult]:
        """The first `limit` results after number `sequence`, in order.

        Only of `channels` (sensor, what) and of one `epoch` ("" for results of older versions) where these are given.
        """
        where = "sequence > ?"
        if channels is not None:
            places = ", ".join(["(?, ?)"] * len(channels)) or "(NULL, NULL)"
            where += f" AND (sensor, what) IN (VALUES {places})"
        names = [name for channel in channels or () for name in channel]
        if epoch is not None:
            where += f" AND {_EPOCH_OF} = ?"
            names.append(epoch)
        while rows := self._joined(f"WHERE {where} ORDER BY sequence LIMIT ?", sequence, *names, limit):
            if records := self._proven(rows):
                return records
            sequence = rows[-1][0]  # all of them are refused
        return []

    def count_after(self, sequence: int) -> int:
        """The number of results after `sequence`. For the last published number this is the size of the outbox."""
        # This join uses the index of the channels; otherwise SQLite would read the whole table with all payloads.
        counted = "SELECT count(*) FROM latest AS l CROSS JOIN results AS r USING (sensor, what) WHERE r.sequence > ?"
        return int(self._rows(counted, sequence)[0][0])

    def channels(self) -> list[tuple[str, str]]:
        """All channels (sensor, what) that have ever had a result."""
        return sorted((sensor, what) for sensor, what, _, _ in self._latest())

    def latest(self) -> list[StoredResult]:
        """The newest result of every channel, in order of sequence; a calibration only while it is in force.

        With `keys`, the newest one that they signed, once the gateway has signed any.
        """
        found = [
            self._result(sequence) or self._signed_before(sensor, what, sequence)
            for sensor, what, sequence, withdrawn in self._latest()
            if not withdrawn
        ]
        return sorted((record for records in found for record in records), key=lambda record: record.sequence)

    def in_force(self, sensor: str) -> StoredResult | None:
        """The calibration in force of a sensor; None if it has none, or if a later status was UNCALIBRATED."""
        return next((r for r in self.latest() if r.sensor == sensor and r.what == "calibration"), None)

    def in_force_at(self, sensor: str, times_utc_ns: Sequence[int]) -> list[StoredResult | None]:
        """The calibration that was in force at each time, as far as results of that time are kept."""
        rows = self._rows(_IN_FORCE, sensor)
        starts, found = [row[0] for row in rows], dict[int, StoredResult | None]({-1: None})
        ends = [bisect_right(starts, t) - 1 for t in times_utc_ns]
        for k in set(ends) - {-1}:
            _, sequence, calibrates = rows[k]
            records = self.after(sequence - 1, [(sensor, "calibration")], limit=1) if calibrates else []
            found[k] = next((record for record in records if record.sequence == sequence), None)
        return [found[k] for k in ends]

    def memories(self) -> list[Memory]:
        """The states of the estimation that are kept, those of a sensor oldest first. With `keys`, `refused` gets the
        reason, by their number, where none of these keys signed all of them."""
        try:
            memories, signed = read_memories(self._connection), read_states(self._connection)
        except (sqlite3.Error, DamagedRow, UnicodeDecodeError) as error:
            raise StoreError(f"{self._path}: {error}") from None
        if self._keys is None or not (fault := _state_fault(signed, memories, self._keys)):
            return memories
        self.refused |= dict.fromkeys([memory.sequence for memory in memories], f"the kept states: {fault}")
        return []

    def calibrations(self, sensor: str) -> dict[str, StoredResult]:
        """The newest calibration of each device that a sensor ever had, by identity (kind, serial number, settings)."""
        rows = self._rows(
            "SELECT max(sequence) FROM results WHERE sensor = ? AND what = 'calibration' GROUP BY identity", sensor
        )
        return {record.identity: record for (sequence,) in rows for record in self._result(sequence)}

    def file_sequence(self) -> int:
        """The highest file number of all recordings, deleted ones included."""
        rows = self._checked("SELECT name, value, crc FROM marks WHERE name = 'file'")
        return int(rows[0][1]) if rows else 0

    def newest(self, sensor: str, what: str, *, limit: int, run_id: str = "") -> list[StoredResult]:
        """The newest `limit` results of one channel, of one run if it is named, newest first."""
        of_run, named = (" AND run_id = ?", [run_id]) if run_id else ("", [])
        where = f"WHERE sensor = ? AND what = ?{of_run} ORDER BY sequence DESC LIMIT ?"
        return self._proven(self._joined(where, sensor, what, *named, limit))

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

    def _result(self, sequence: int) -> list[StoredResult]:
        """The result with this number; none where it is refused."""
        rows = self._joined("WHERE sequence = ?", sequence)
        if not rows:
            raise StoreError(f"{self._path}: damaged: result {sequence} is missing")
        return self._proven(rows, put_forward=True)

    def _signed_before(self, sensor: str, what: str, sequence: int) -> list[StoredResult]:
        """The newest result of a channel before one that is refused, which may be put forward; none where none may."""
        clause = "WHERE sensor = ? AND what = ? AND sequence < ? ORDER BY sequence DESC LIMIT 1"
        while rows := self._joined(clause, sensor, what, sequence):
            if records := self._proven(rows, put_forward=True):
                return records
            sequence = rows[0][0]
        return []

    def _must_be_signed(self) -> bool:
        """Whether the gateway has a key and has used it: then a result without a signature is not put forward."""
        return self._keys is not None and bool(self._rows("SELECT 1 FROM signed LIMIT 1"))

    def _joined(self, clause: str, *values: object) -> list[tuple[Any, ...]]:
        return self._rows(f"{JOINED} {clause}", *values)

    def _proven(self, rows: list[tuple[Any, ...]], *, put_forward: bool = False) -> list[StoredResult]:
        """The results in rows of `_joined`, as they were signed; without those that are refused."""
        try:
            stored = [StoredResult.of_joined(row) for row in rows]
        except DamagedRow as error:
            raise StoreError(f"{self._path}: {error}") from None
        must_be = self._signed_only or (put_forward and self._must_be_signed())
        unsigned = "it is not signed" if must_be else ""
        found = []
        for record in stored:
            true, refused = self._as_signed(record) if record.signed else (record, unsigned)
            if refused:
                self.refused[record.sequence] = refused
            if true is not None and (record.signed or not refused):
                found.append(true)
        return found

    def _as_signed(self, record: StoredResult) -> tuple[StoredResult | None, str]:
        """The result as it was signed, or None; and why its row is refused."""
        from agent.delivery.proof import UnprovenError, proven

        try:
            return proven(record, self._keys)
        except UnprovenError as error:
            return None, str(error)

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


def _state_fault(signed: bytes, memories: Sequence[Memory], keys: KnownKeys) -> str:
    """Why these are not the states that one of the keys signed; "" where they are."""
    from agent.delivery.signed_states import StateList, gateway_of
    from agent.recording.signed_text import SignedTextError

    try:
        return StateList.read(signed, gateway_of(signed), keys).fault(memories)
    except SignedTextError as error:
        return str(error)


def connect_read_only(path: Path) -> sqlite3.Connection:
    """Open the store for reading only. A missing or damaged file raises sqlite3.Error only when something is read."""
    # Without a writer there is no log. In a directory without write permission only `immutable` can then open the file.
    log = path.with_name(path.name + "-wal")
    idle = not log.exists() and not os.access(path.parent, os.W_OK)
    option = "immutable=1" if idle else "mode=ro"
    return sqlite3.connect(f"file:{quote(str(path))}?{option}", uri=True, timeout=5.0)
