"""Deletes old results from the store, so that it does not fill the disk: two at most for each new result."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from agent.delivery.history import StoredResult
from agent.delivery.schema import checked, row_crc

if TYPE_CHECKING:
    from agent.config.sinks import Results

DAY_NS = 86_400_000_000_000
# Results deleted at most for each new one. With 2, a store that is too large shrinks as fast as it otherwise grows.
# Where the clock jumps ahead by years, only few results are deleted before somebody corrects the clock.
FOR_EACH_NEW = 2


@dataclass(frozen=True, slots=True)
class KeepResults:
    """How long results are kept; None is for ever.

    `days`, `bytes`: limits for published results: their age by their UTC, and the size of the store's used pages.
    `waiting_days`: limit of age for results that were never published.
    Always kept: the newest result of each channel, and the newest calibration of each device that a sensor ever had.
    """

    days: float | None = None
    bytes: int | None = None
    waiting_days: float | None = None


FOR_EVER = KeepResults()


def keep_results(section: Results) -> KeepResults:
    """The limits that the section [results] of the configuration sets."""
    most = int(section.keep_bytes) if section.keep_bytes is not None else None
    return KeepResults(section.keep_days, most, section.waiting_days)


@dataclass(frozen=True, slots=True)
class _OldResult:
    sequence: int
    sensor: str
    what: str
    identity: str
    t_utc_ns: int


class Sweep:
    """Deletes old results in the transaction of each commit; counts them in the table `removed`."""

    def __init__(self, keep: KeepResults) -> None:
        self._keep = keep
        self._looked_at = 0  # up to this number only results that must be kept are left
        self._staying: list[_OldResult] = []  # old results kept because each was the newest of its channel or device

    def run(self, connection: sqlite3.Connection, new: Sequence[StoredResult], published: int) -> None:
        """Delete the oldest results, FOR_EACH_NEW at most for each of `new`. `published`: the last published result.

        Raises sqlite3.Error, DamagedRow.
        """
        if self._keep == FOR_EVER or not new:
            return
        self._staying = [result for result in self._staying if not _delete(connection, result)]
        now_ns, too_large = new[-1].t_utc_ns, self._too_large(connection)
        rows = connection.execute(
            "SELECT sequence, sensor, what, identity, t_utc_ns FROM results"
            " WHERE sequence > ? ORDER BY sequence LIMIT ?",
            (self._looked_at, FOR_EACH_NEW * len(new)),
        ).fetchall()
        for row in rows:
            result = _OldResult(*row)
            age_days = (now_ns - result.t_utc_ns) / DAY_NS
            done = result.sequence <= published and (too_large or _beyond(age_days, self._keep.days))
            if not done and not _beyond(age_days, self._keep.waiting_days):
                return
            if not _delete(connection, result):
                self._staying.append(result)
            # If the transaction fails, these results are examined again only after a restart.
            self._looked_at = result.sequence

    def _too_large(self, connection: sqlite3.Connection) -> bool:
        if self._keep.bytes is None:
            return False
        size, count, free = (
            connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_size", "page_count", "freelist_count")
        )
        return bool(size * (count - free) > self._keep.bytes)


def _beyond(age_days: float, limit_days: float | None) -> bool:
    return limit_days is not None and age_days > limit_days


def _delete(connection: sqlite3.Connection, result: _OldResult) -> bool:
    """Delete a result and return True; False where it must be kept.

    Kept are the newest result of each channel and the newest calibration of each device.
    """
    newer = "SELECT 1 FROM results WHERE sensor = ? AND what = ? AND sequence > ? LIMIT 1"
    values: tuple[object, ...] = (result.sensor, result.what, result.sequence)
    if result.what == "calibration":
        newer = (
            "SELECT 1 FROM results WHERE sensor = ? AND what = 'calibration' AND sequence > ? AND identity = ? LIMIT 1"
        )
        values = (result.sensor, result.sequence, result.identity)
    if connection.execute(newer, values).fetchone() is None:
        return False
    for table in ("results", "signed"):
        connection.execute(f"DELETE FROM {table} WHERE sequence = ?", (result.sequence,))
    _count(connection, result.sensor, result.what, result.sequence)
    return True


def _count(connection: sqlite3.Connection, sensor: str, what: str, sequence: int) -> None:
    where = "SELECT sensor, what, count, up_to, crc FROM removed WHERE sensor = ? AND what = ?"
    row = connection.execute(where, (sensor, what)).fetchone()
    _, _, count, up_to = checked(row) if row else ("", "", 0, 0)
    new = (sensor, what, count + 1, max(up_to, sequence))
    connection.execute(
        "INSERT OR REPLACE INTO removed (sensor, what, count, up_to, crc) VALUES (?, ?, ?, ?, ?)", (*new, row_crc(*new))
    )
