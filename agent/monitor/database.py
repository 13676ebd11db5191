"""The database of the monitor: every confirmed result of every gateway, in one SQLite file."""

from __future__ import annotations

import sqlite3
import threading
from pathlib import Path
from typing import Any

import msgspec

from agent.delivery.received import Received

_SCHEMA = """
CREATE TABLE IF NOT EXISTS result (
    site TEXT, gateway TEXT, epoch TEXT, sequence INTEGER, sensor TEXT, what TEXT,
    part TEXT,  -- of a drift its parameter, of a window whether it was used; so the newest of each is found at once
    payload BLOB,
    UNIQUE (site, gateway, epoch, sequence));
CREATE INDEX IF NOT EXISTS by_sensor ON result (site, gateway, sensor, what, part);
"""


class Database:
    """Results by sensor, in the order of their arrival. May be used by several threads.

    Raises sqlite3.Error where the file at `path` cannot be used.
    """

    def __init__(self, path: Path) -> None:
        self._connection = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
        self._mutex = threading.Lock()
        self._connection.execute("PRAGMA journal_mode = WAL")
        # A power cut may undo the last results; `last_sequence` then asks the gateways for them again.
        self._connection.execute("PRAGMA synchronous = NORMAL")
        self._connection.executescript(_SCHEMA)

    def add(self, result: Received) -> None:
        """Keep a result. One that is there already stays as it is."""
        a, fields = result.address, result.fields
        part = {"drift": fields.get("parameter", ""), "window": "used" if fields.get("used") else "refused"}
        row = (a.site, a.gateway, result.epoch, result.sequence, a.sensor, a.what, part.get(a.what, ""))
        self._rows("INSERT OR IGNORE INTO result VALUES (?, ?, ?, ?, ?, ?, ?, ?)", *row, msgspec.json.encode(fields))

    def last_sequence(self) -> dict[str, int]:
        """The last result of each gateway and epoch, as Consumer takes it: of one gateway the newest epoch last."""
        rows = self._rows(
            "SELECT site, gateway, epoch, max(sequence) FROM result GROUP BY site, gateway, epoch ORDER BY max(rowid)"
        )
        return {"/".join(filter(None, (site, gateway, epoch))): number for site, gateway, epoch, number in rows}

    def newest(self) -> list[tuple[str, str, str, str, dict[str, Any]]]:
        """(site, gateway, sensor, what, fields) of the newest result of each kind and part, oldest first."""
        rows = self._rows(
            "SELECT site, gateway, sensor, what, payload FROM result WHERE rowid IN"
            " (SELECT max(rowid) FROM result GROUP BY site, gateway, sensor, what, part) ORDER BY rowid"
        )
        return [(*row[:4], msgspec.json.decode(row[4])) for row in rows]

    def history(self, site: str, gateway: str, sensor: str, what: str, limit: int) -> list[dict[str, Any]]:
        """The newest `limit` results of one kind of a sensor, oldest first."""
        rows = self._rows(
            "SELECT payload FROM result WHERE site = ? AND gateway = ? AND sensor = ? AND what = ?"
            " ORDER BY rowid DESC LIMIT ?",
            *(site, gateway, sensor, what, limit),
        )
        return [msgspec.json.decode(payload) for (payload,) in reversed(rows)]

    def spread(self, site: str, gateway: str, sensor: str, what: str, most: int) -> list[dict[str, Any]]:
        """At most `most` results of one kind of a sensor, evenly from its whole history, the newest among them."""
        rows = self._rows(
            "SELECT payload FROM result WHERE rowid IN (SELECT max(rowid) FROM (SELECT rowid, ntile(?) OVER"
            " (ORDER BY rowid) AS tile FROM result WHERE site = ? AND gateway = ? AND sensor = ? AND what = ?)"
            " GROUP BY tile) ORDER BY rowid",
            *(most, site, gateway, sensor, what),
        )
        return [msgspec.json.decode(payload) for (payload,) in rows]

    def close(self) -> None:
        """Close the file."""
        with self._mutex:
            self._connection.close()

    def _rows(self, sql: str, *values: object) -> list[tuple[Any, ...]]:
        with self._mutex:
            return self._connection.execute(sql, values).fetchall()
