"""The database of the monitor: every confirmed result of every gateway, the older ones as hourly summaries."""

from __future__ import annotations

import threading
import time
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from agent.delivery.received import Received
from agent.monitor.engines import LASTING, DatabaseEngine, QueryRunner, Rows
from agent.monitor.summaries import COUNTS, FULL_DAYS, SUMMARISED, merged, packed, split, summarise, unpacked
from agent.monitor.watch_store import TABLES, WatchStore, forget_hours
from agent.site_watch.hour import WatchHour
from calib.model import PARAMETERS

DAY_NS, HOUR_NS = 86_400_000_000_000, 3_600_000_000_000

_TABLES = [
    "CREATE TABLE IF NOT EXISTS sensor (id INTEGER PRIMARY KEY, site TEXT, gateway TEXT, sensor TEXT,"
    " UNIQUE (site, gateway, sensor))",
    # day: of its time, LASTING for rows that are never dropped; part: of a drift its parameter, of a window whether it
    # was used, so that the newest of each is found at once; detail: NULL if it is that of the calibration before
    "CREATE TABLE IF NOT EXISTS result (number {number}, day INTEGER NOT NULL, hour INTEGER NOT NULL,"
    " sensor INTEGER NOT NULL, epoch TEXT NOT NULL, sequence BIGINT NOT NULL, what TEXT NOT NULL, part TEXT NOT NULL,"
    " payload {bytes} NOT NULL, detail {bytes}, UNIQUE (sensor, day, epoch, sequence)) {partitioned}",
    "CREATE INDEX IF NOT EXISTS by_sensor ON result (sensor, what, number)",
    "CREATE TABLE IF NOT EXISTS newest (sensor INTEGER, what TEXT, part TEXT, number BIGINT,"
    " PRIMARY KEY (sensor, what, part))",
    "CREATE TABLE IF NOT EXISTS followed (site TEXT, gateway TEXT, epoch TEXT, sequence BIGINT, number BIGINT,"
    " PRIMARY KEY (site, gateway, epoch))",
    # done: the last sensor of which this day is summarised
    "CREATE TABLE IF NOT EXISTS day (day INTEGER PRIMARY KEY, done INTEGER NOT NULL)",
    "CREATE TABLE IF NOT EXISTS summary (sensor INTEGER, hour INTEGER, calibrations INTEGER, estimates INTEGER,"
    " windows_used INTEGER, windows_refused INTEGER, clocks INTEGER, PRIMARY KEY (sensor, hour))",
]
_OF = "(SELECT id FROM sensor WHERE site = :site AND gateway = :gateway AND sensor = :name)"


class _Row(NamedTuple):
    """A result as it is kept. `gateway`: site, gateway, epoch; `detail`: what is kept where it has changed; `watch`:
    the hour of a `watch` result, or why it has none."""

    gateway: tuple[str, str, str]
    sequence: int
    day: int
    hour: int
    sensor: int
    what: str
    part: str
    payload: bytes
    detail: bytes | None
    watch: WatchHour | str | None


class Database:
    """Results by sensor, in the order of their arrival. May be used by several threads.

    `watch`: what is kept of sensors without a reference. `damaged`: the numbers of rows that were to be read and are
    not as they were written; they are left out.
    `now_ns`: the present, UTC; a result that says to be of a later day is filed under today. Raises sqlite3.Error or
    DatabaseError where the engine cannot be used.
    """

    def __init__(
        self, engine: DatabaseEngine, *, full_days: int = FULL_DAYS, now_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._engine, self._full_days, self._now_ns = engine, full_days, now_ns
        self.damaged: set[int] = set()
        self.watch = WatchStore(now_ns)
        self._mutex = threading.Lock()
        self._sensors: dict[tuple[str, str, str], int] = {}
        self._days: set[int] = set()
        self._details: dict[tuple[int, str], tuple[int, bytes]] = {}  # the last one of each sensor, with its day
        columns = {"number": engine.NUMBER, "bytes": engine.BYTES, "partitioned": engine.PARTITIONED}
        with engine.transaction() as run:
            engine.make_tables(run, [statement.format(**columns) for statement in _TABLES + TABLES])

    def add(self, results: Sequence[Received]) -> None:
        """Keep results, all of them or none, in one transaction. One that is there already stays as it is."""
        with self._mutex:  # numbers rise in the order in which they are committed
            rows = [self._row(result) for result in results]
            with self._engine.transaction() as run:
                self._engine.writes(run)
                details, left_out = self._insert(run, rows)
            self._details |= details
            self.watch.left_out += left_out

    def _row(self, result: Received) -> _Row:
        a, fields, now_ns = result.address, result.fields, self._now_ns()
        parameter = fields.get("parameter")
        part = {
            "drift": parameter if parameter in PARAMETERS else "",  # others would be without end
            "window": "used" if fields.get("used") else "refused",
        }
        t_utc_ns = fields.get("t_utc_ns")
        t_utc_ns = t_utc_ns if isinstance(t_utc_ns, int) else now_ns
        short, detail = split(a.what, fields)
        return _Row(
            gateway=(a.site, a.gateway, result.epoch), sequence=result.sequence,
            day=self._day(t_utc_ns) if a.what in SUMMARISED else LASTING, hour=min(t_utc_ns, now_ns) // HOUR_NS,
            sensor=self._sensor(a.site, a.gateway, a.sensor), what=a.what, part=part.get(a.what, ""),
            payload=packed(short), detail=detail, watch=self.watch.hour_of(fields) if a.what == "watch" else None,
        )  # fmt: skip

    def _insert(
        self, run: QueryRunner, rows: Sequence[_Row]
    ) -> tuple[dict[tuple[int, str], tuple[int, bytes]], Counter[str]]:
        """Write the rows, and what is the newest after them; returns the last detail of each sensor, with its day, and
        which hours were left out."""
        details: dict[tuple[int, str], tuple[int, bytes]] = {}
        newest: dict[tuple[int, str, str], int] = {}
        followed: dict[tuple[str, str, str], tuple[int, int]] = {}
        left_out: Counter[str] = Counter()
        for row in rows:
            place = row.sensor, row.what
            same = row.detail is not None and details.get(place, self._details.get(place)) == (row.day, row.detail)
            added = run(
                "INSERT INTO result (day, hour, sensor, epoch, sequence, what, part, payload, detail) VALUES (:day,"
                " :hour, :sensor, :epoch, :sequence, :what, :part, :payload, :detail) ON CONFLICT DO NOTHING"
                " RETURNING number",
                day=row.day, hour=row.hour, sensor=row.sensor, epoch=row.gateway[2], sequence=row.sequence,
                what=row.what, part=row.part, payload=row.payload, detail=None if same else row.detail,
            )  # fmt: skip
            if not added:
                continue
            ((number,),) = added
            if row.detail is not None:
                details[place] = row.day, row.detail
            if row.watch is not None:
                hour = row.watch
                told = hour if isinstance(hour, str) else self.watch.keep(run, row.gateway[0], row.sensor, hour)
                left_out.update([told] if told else [])
            newest[row.sensor, row.what, row.part] = number
            followed[row.gateway] = max(row.sequence, followed.get(row.gateway, (0, 0))[0]), number
        for (sensor, what, part), number in newest.items():
            run(
                "INSERT INTO newest VALUES (:sensor, :what, :part, :number) ON CONFLICT (sensor, what, part)"
                " DO UPDATE SET number = excluded.number",
                sensor=sensor, what=what, part=part, number=number,
            )  # fmt: skip
        for (site, gateway, epoch), (sequence, number) in followed.items():
            run(
                "INSERT INTO followed VALUES (:site, :gateway, :epoch, :sequence, :number) ON CONFLICT"
                " (site, gateway, epoch) DO UPDATE SET number = excluded.number, sequence ="
                " CASE WHEN excluded.sequence > followed.sequence THEN excluded.sequence"
                " ELSE followed.sequence END",
                site=site, gateway=gateway, epoch=epoch, sequence=sequence, number=number,
            )  # fmt: skip
        return details, left_out

    def last_sequence(self) -> dict[str, int]:
        """The last result of each gateway and epoch, as Consumer takes it: of one gateway the newest epoch last."""
        with self._engine.transaction() as run:
            rows = run("SELECT site, gateway, epoch, sequence FROM followed ORDER BY number")
        return {"/".join(filter(None, (site, gateway, epoch))): number for site, gateway, epoch, number in rows}

    def newest(self) -> list[tuple[str, str, str, str, dict[str, Any]]]:
        """(site, gateway, sensor, what, fields) of the newest result of each kind and part, oldest first.

        Without what summaries leave out.
        """
        with self._engine.transaction() as run:
            rows = run(
                "SELECT s.site, s.gateway, s.sensor, r.what, r.number, r.payload FROM newest n"
                " JOIN sensor s ON s.id = n.sensor"
                " JOIN result r ON r.sensor = n.sensor AND r.what = n.what AND r.number = n.number ORDER BY r.number"
            )
        read = [(row, self._read(row[3], *row[4:])) for row in rows]
        return [(*row[:4], fields) for row, fields in read if fields is not None]

    def history(self, site: str, gateway: str, sensor: str, what: str, limit: int) -> list[dict[str, Any]]:
        """The newest `limit` results of one kind of a sensor, oldest first; of the older ones the last of each hour."""
        with self._engine.transaction() as run:
            rows = run(
                f"SELECT r.payload, r.detail, r.day, r.number, r.sensor FROM result r WHERE r.sensor = {_OF}"
                " AND r.what = :what ORDER BY r.number DESC LIMIT :limit",
                site=site, gateway=gateway, name=sensor, what=what, limit=limit,
            )[::-1]  # fmt: skip
            held = _detail_before(run, what, *rows[0][2:]) if rows and rows[0][1] is None else None
        found, day = [], rows[0][2] if rows else LASTING
        for payload, detail, at, number, _ in rows:
            held = detail if detail is not None or at != day or at == LASTING else held
            day = at
            if (fields := self._read(what, number, payload, held)) is not None:
                found.append(fields)
        return found

    def spread(self, site: str, gateway: str, sensor: str, what: str, most: int) -> list[dict[str, Any]]:
        """At most `most` results of one kind of a sensor, evenly from all that are kept, the newest among them.

        Without what summaries leave out.
        """
        with self._engine.transaction() as run:
            rows = run(
                "SELECT r.number, r.payload FROM result r WHERE r.number IN"
                " (SELECT max(number) FROM (SELECT number, ntile(:most)"
                f" OVER (ORDER BY number) AS tile FROM result WHERE sensor = {_OF} AND what = :what) t GROUP BY tile)"
                f" AND r.sensor = {_OF} AND r.what = :what ORDER BY r.number",
                most=most, site=site, gateway=gateway, name=sensor, what=what,
            )  # fmt: skip
        read = (self._read(what, *row) for row in rows)
        return [fields for fields in read if fields is not None]

    def _read(self, what: str, number: int, payload: bytes, detail: bytes | None = None) -> dict[str, Any] | None:
        """The fields of a row, with its detail; None where the row is damaged."""
        try:
            return merged(what, unpacked(payload), detail)
        except (zlib.error, ValueError, KeyError, TypeError):  # ValueError: no JSON, or shared errors of another length
            self.damaged.add(number)
            return None

    def first_of_day(self, site: str, gateway: str, sensor: str, what: str, t_utc_ns: int) -> dict[str, Any] | None:
        """The first result of one kind on the day of `t_utc_ns`, which summaries keep; None where there is none.

        Without what summaries leave out.
        """
        first = t_utc_ns // DAY_NS * (DAY_NS // HOUR_NS)
        with self._engine.transaction() as run:
            rows = run(
                f"SELECT payload FROM result WHERE sensor = {_OF} AND what = :what AND hour >= :first AND hour < :next"
                " ORDER BY number LIMIT 1",
                site=site, gateway=gateway, name=sensor, what=what, first=first, next=first + DAY_NS // HOUR_NS,
            )  # fmt: skip
        return unpacked(rows[0][0]) if rows else None

    def summaries(self, site: str, gateway: str, sensor: str, limit: int) -> list[dict[str, Any]]:
        """The newest `limit` hours that are summarised, oldest first: `t_utc_ns` of its end, last status, counts."""
        with self._engine.transaction() as run:
            rows = run(
                f"SELECT hour, {', '.join(COUNTS)} FROM summary WHERE sensor = {_OF} ORDER BY hour DESC LIMIT :limit",
                site=site, gateway=gateway, name=sensor, limit=limit,
            )[::-1]  # fmt: skip
            known = run(
                f"SELECT hour, payload FROM result WHERE sensor = {_OF} AND what = 'status' ORDER BY number",
                site=site, gateway=gateway, name=sensor,
            )  # fmt: skip
        hours = [hour for hour, _ in known]
        found = []
        for hour, *counts in rows:
            k = bisect_right(hours, hour)
            status = unpacked(known[k - 1][1])["status"] if k else ""
            found.append({"t_utc_ns": (hour + 1) * HOUR_NS, "status": status} | dict(zip(COUNTS, counts, strict=True)))
        return found

    def query(self, sql: str, /, **values: object) -> Rows:
        """Run one query by itself."""
        with self._engine.transaction() as run:
            return run(sql, **values)

    def summarise(self) -> bool:
        """Summarise one day of one sensor, or drop a day of which all are summarised, or hours of the watch that are
        old; False where there is none."""
        with self._engine.transaction() as run:
            if forget_hours(run):
                return True
            first = self._now_ns() // DAY_NS - self._full_days
            rows = run("SELECT day, done FROM day WHERE day < :first ORDER BY day LIMIT 1", first=first)
            if not rows:
                return False
            day, done = rows[0]
            ((sensor,),) = run("SELECT min(id) FROM sensor WHERE id > :done", done=done)
            if sensor is None:
                run("DELETE FROM day WHERE day = :day", day=day)
                self._engine.drop_day(run, day)
            # Another monitor on the same database may be at the same sensor; then it has changed `done`.
            elif run(
                "UPDATE day SET done = :sensor WHERE day = :day AND done = :done RETURNING day",
                sensor=sensor, day=day, done=done,
            ):  # fmt: skip
                summarise(run, day, sensor)
                self._engine.forget(run, day, sensor)
        return True

    def close(self) -> None:
        """Close the file, or the connections."""
        self._engine.close()

    def _day(self, t_utc_ns: int) -> int:
        """The day under which a result is filed; one that comes late is not summarised before its day is full."""
        first = LASTING + 1  # a clock that is not set yet begins in 1970
        today = max(self._now_ns() // DAY_NS, first)
        day = min(max(t_utc_ns // DAY_NS, today - self._full_days, first), today)
        if day not in self._days:
            with self._engine.transaction() as run:
                run("INSERT INTO day VALUES (:day, 0) ON CONFLICT DO NOTHING", day=day)
                self._engine.make_day(run, day)
            self._days = {known for known in self._days if known >= today - self._full_days} | {day}
        return day

    def _sensor(self, site: str, gateway: str, sensor: str) -> int:
        place = site, gateway, sensor
        while place not in self._sensors:  # another monitor may have taken the same id
            with self._engine.transaction() as run:
                run(
                    "INSERT INTO sensor SELECT coalesce(max(id), 0) + 1, :site, :gateway, :name FROM sensor"
                    " WHERE true ON CONFLICT DO NOTHING",
                    site=site, gateway=gateway, name=sensor,
                )  # fmt: skip
                ((found,),) = run(f"SELECT {_OF}", site=site, gateway=gateway, name=sensor)
            if found is not None:
                self._sensors[place] = found
        return self._sensors[place]


def _detail_before(run: QueryRunner, what: str, day: int, number: int, sensor: int) -> bytes | None:
    """The detail of a calibration that says the same as the ones before it on this day."""
    if day == LASTING:
        return None
    rows = run(
        "SELECT detail FROM result WHERE sensor = :sensor AND what = :what AND day = :day AND number < :number"
        " AND detail IS NOT NULL ORDER BY number DESC LIMIT 1",
        sensor=sensor, what=what, day=day, number=number,
    )  # fmt: skip
    return rows[0][0] if rows else None
