"""What the monitor keeps of sensors without a reference: the hours of 90 days, and each day of a site in binary.

Both are tables of the monitor's database (agent.monitor.database). An hour is kept in the transaction of its result.
A day of which hours came since it was last summed is stale; it is summed when the site has gone on to the next day,
and again when hours come late. Hours are removed when the newest day of their site is KEPT_DAYS later, one day of a
site in a step.
"""

from __future__ import annotations

import math
import sqlite3
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from agent.delivery.history import connect_read_only
from agent.monitor import summaries
from agent.monitor.engines import QueryRunner
from agent.monitor.summaries import unpacked
from agent.site_watch.day_sum import SHAPES, DaySum, Made, summed
from agent.site_watch.hour import TWICE, CalibrationLine, SelfTestLine, WatchHour, grid, places, wrong
from agent.site_watch.source import SiteSource, WatchError
from calib.model import Array
from calib.site_watch.day import HOURS

TABLES = [
    "CREATE TABLE IF NOT EXISTS watch_hour (sensor INTEGER, hour INTEGER, sequence BIGINT NOT NULL,"
    " payload {bytes} NOT NULL, PRIMARY KEY (sensor, hour))",
    # last: the last hour that has come of this day; stale: how many have come since the day was summed; hours: 1 while
    # they are kept
    "CREATE TABLE IF NOT EXISTS watch_day (site TEXT, day INTEGER, last INTEGER NOT NULL, stale INTEGER NOT NULL,"
    " hours INTEGER NOT NULL, payload {bytes}, PRIMARY KEY (site, day))",
    "CREATE INDEX IF NOT EXISTS watch_stale ON watch_day (stale, site, day)",
    # told: the object of docs/site-watch.md, with which the newest run over the site's days has ended
    "CREATE TABLE IF NOT EXISTS watch_site (site TEXT PRIMARY KEY, day INTEGER NOT NULL, told {bytes} NOT NULL)",
]
KEPT_DAYS = 90  # of hours
CLOSED_H = 6  # hours of the next day after which a day is summed: a late gateway may send its last hours until then
AHEAD_H = 24  # hours by which a result may be later than the clock of the monitor
SET_NS = 1_600_000_000_000_000_000  # a clock that says earlier is not set
MOST_SENSORS = 1000  # of a site
MOST_DAYS = 1100  # days of a site that are looked at, the newest
CALIBRATIONS = 10  # results in which the one is sought that a sensor had in force
SELF_TESTS = 100  # results in which that of a day is sought: one a day, and hours are kept for 90 days
SENT_DAYS = 120  # a sensor without an hour in the last so many days is no longer of the site
Kind = TypeVar("Kind", bound=msgspec.Struct)
PLACE, NO_PLACE = 1.0 / 25_000, -(1 << 15)  # 0.001 % of a frequency
SQLITE = b"SQLite format 3\0"  # how a database begins


class _Packed(msgspec.Struct, array_like=True):
    """An hour in binary: the numbers of WatchHour as little-endian float32, those of a list one after the other."""

    duration_s: float
    samples: int
    wrong: int
    made: Made
    bands: list[float]
    numbers: bytes  # temperature, noise 3, mean 3, u_main 3, then band_power and cross_power
    peaks: bytes = b""  # places of the peak frequencies as little-endian int16, PLACE of a third octave; NO_PLACE: none


_PACKED = msgspec.msgpack.Decoder(_Packed)
_SUM = msgspec.msgpack.Decoder(DaySum)


def packed(hour: WatchHour) -> bytes:
    """An hour in binary."""
    numbers = [hour.temperature_degc, *_three(hour.noise_psd), *_three(hour.mean_mps2), *_three(hour.u_main_pct),
               *hour.band_power, *hour.cross_power]  # fmt: skip
    told = np.array([math.nan if value is None else value for value in numbers], dtype="<f4").tobytes()
    at = np.array(places(hour), dtype=float) / PLACE
    peaks = np.where(np.isfinite(at), np.round(np.nan_to_num(at)), NO_PLACE).astype("<i2").tobytes()
    return msgspec.msgpack.encode(
        _Packed(hour.duration_s, hour.samples, hour.stuck + hour.clipped, hour.made, hour.band_hz, told, peaks)
    )


def unpacked_hour(sensor: str, hour: int, data: bytes) -> WatchHour:
    """The hour again. Raises ValueError where it is damaged."""
    told = _PACKED.decode(data)
    numbers: list[Any] = [
        value if math.isfinite(value) else None for value in np.frombuffer(told.numbers, "<f4").tolist()
    ]
    b, at = len(told.bands), np.frombuffer(told.peaks, "<i2")
    if len(numbers) != 10 + 6 * b or len(at) not in (0, 3 * b):
        raise ValueError("an hour of another length")
    hz = 10.0 ** (0.1 * (np.array(grid(told.bands) * 3)[: len(at)] + PLACE * at))
    return WatchHour(
        sensor=sensor, hour_utc_ns=hour * 3600 * 10**9, duration_s=told.duration_s, samples=told.samples,
        clipped=told.wrong, temperature_degc=numbers[0], noise_psd=numbers[1:4], mean_mps2=numbers[4:7],
        u_main_pct=numbers[7:10], band_hz=told.bands, band_power=numbers[10 : 10 + 3 * b],
        cross_power=numbers[10 + 3 * b :], calibration_run_id=told.made[0], calibration_sequence=told.made[1],
        peak_frequency_hz=[f if place != NO_PLACE else None for f, place in zip(hz.tolist(), at.tolist(), strict=True)],
    )  # fmt: skip


def _three(values: list[float | None]) -> list[float | None]:
    return values if len(values) == 3 else [None] * 3


class WatchStore:
    """Keeps hours and days. `left_out`: hourly results that were not kept, by reason."""

    def __init__(self, now_ns: Callable[[], int] = time.time_ns) -> None:
        self.left_out: Counter[str] = Counter()
        self._now_ns = now_ns
        self._newest: dict[str, int] = {}  # day of each site
        self._sensors: dict[str, set[int]] = {}  # of each site

    def hour_of(self, fields: dict[str, Any]) -> WatchHour | str:
        """The hour of a `watch` result, or why it is not kept."""
        try:
            hour = msgspec.convert(fields, WatchHour)
        except msgspec.ValidationError:
            return "not an hourly result of a sensor"
        now_ns = self._now_ns()
        if now_ns > SET_NS and hour.hour_utc_ns > now_ns + AHEAD_H * 3600 * 10**9:
            return "an hour that has not come yet, by the clock of the monitor"
        return wrong(hour) or hour

    def keep(self, run: QueryRunner, site: str, sensor: int, hour: WatchHour) -> str:
        """Keep an hour within a transaction; returns why it is not kept, or what else is to be counted."""
        newest, known = self._of_site(run, site)
        if hour.day <= newest - KEPT_DAYS:
            return f"more than {KEPT_DAYS} days older than the newest hour of the site"
        if sensor not in known and len(known) >= MOST_SENSORS:
            return f"more than {MOST_SENSORS} sensors at one site"
        before = run(
            "SELECT sequence FROM watch_hour WHERE sensor = :sensor AND hour = :hour", sensor=sensor, hour=hour.hour
        )
        if before and before[0][0] > hour.sequence:
            return TWICE
        run(
            "INSERT INTO watch_hour VALUES (:sensor, :hour, :sequence, :payload) ON CONFLICT (sensor, hour)"
            " DO UPDATE SET sequence = excluded.sequence, payload = excluded.payload",
            sensor=sensor, hour=hour.hour, sequence=hour.sequence, payload=packed(hour),
        )  # fmt: skip
        run(
            "INSERT INTO watch_day VALUES (:site, :day, :last, 1, 1, NULL) ON CONFLICT (site, day) DO UPDATE SET"
            " stale = watch_day.stale + 1, last = CASE WHEN excluded.last > watch_day.last THEN excluded.last"
            " ELSE watch_day.last END",
            site=site, day=hour.day, last=hour.hour,
        )  # fmt: skip
        known.add(sensor)
        self._newest[site] = max(newest, hour.day)
        return TWICE if before else ""

    def _of_site(self, run: QueryRunner, site: str) -> tuple[int, set[int]]:
        if site not in self._newest:
            ((newest,),) = run("SELECT coalesce(max(day), 0) FROM watch_day WHERE site = :site", site=site)
            rows = run(
                "SELECT id FROM sensor WHERE site = :site AND EXISTS"
                " (SELECT 1 FROM watch_hour WHERE watch_hour.sensor = sensor.id)",
                site=site,
            )
            self._newest[site], self._sensors[site] = newest, {row[0] for row in rows}
        return self._newest[site], self._sensors[site]


def close_day(query: QueryRunner) -> str | None:
    """Sum one stale day of a site that has gone on; the site, or None where there is no such day.

    Each query is a transaction of its own, so results are kept meanwhile. A day of which hours come while it is summed
    stays as it is, and is summed again.
    """
    rows = query(
        "SELECT d.site, d.day, d.stale FROM watch_day d WHERE d.stale > 0 AND EXISTS (SELECT 1 FROM watch_day l"
        f" WHERE l.site = d.site AND l.last >= (d.day + 1) * {HOURS} + {CLOSED_H}) ORDER BY d.site, d.day LIMIT 1"
    )
    if not rows:
        return None
    site, day, stale = rows[0]
    query(
        "UPDATE watch_day SET stale = 0, payload = :payload WHERE site = :site AND day = :day AND stale = :stale",
        site=site, day=day, stale=stale, payload=msgspec.msgpack.encode(_summed(query, site, day)),
    )  # fmt: skip
    return str(site)


def forget_hours(run: QueryRunner) -> bool:
    """Within a transaction, remove the hours of one day of a site that has gone on by KEPT_DAYS; False where there is
    none."""
    rows = run(
        "SELECT d.site, d.day FROM watch_day d WHERE d.hours = 1 AND d.stale = 0 AND d.day <="
        f" (SELECT max(day) FROM watch_day newest WHERE newest.site = d.site) - {KEPT_DAYS} ORDER BY d.day LIMIT 1"
    )
    if not rows:
        return False
    site, day = rows[0]
    run(
        "DELETE FROM watch_hour WHERE sensor IN (SELECT id FROM sensor WHERE site = :site)"
        " AND hour >= :first AND hour < :next",
        site=site, first=day * HOURS, next=(day + 1) * HOURS,
    )  # fmt: skip
    run("UPDATE watch_day SET hours = 0 WHERE site = :site AND day = :day", site=site, day=day)
    return True


def _summed(query: QueryRunner, site: str, day: int) -> DaySum:
    """The sum of a day from its hours."""
    rows = query(
        "SELECT h.sensor, s.sensor, h.hour, h.payload FROM watch_hour h JOIN sensor s ON s.id = h.sensor"
        " WHERE s.site = :site AND h.hour >= :first AND h.hour < :next ORDER BY h.sensor, h.hour",
        site=site, first=day * HOURS, next=(day + 1) * HOURS,
    )  # fmt: skip
    hours = []
    for sensor, name, hour, payload in rows:
        try:
            hours.append((sensor, unpacked_hour(name, hour, payload)))
        except (ValueError, msgspec.DecodeError):  # damaged on the disk
            continue
    made = {sensor: hour.made for sensor, hour in hours}
    mains = {(sensor, one): _main(query, sensor, one) for sensor, one in made.items()}
    tests = {sensor: test for sensor in made if (test := _self_test(query, sensor, day)) is not None}
    return summed(day, hours, mains, tests)


def _main(query: QueryRunner, sensor: int, made: Made) -> Array:
    """Main sensitivities (3,) of a calibration of a sensor; NaN where its result is not among the newest ones."""
    found = _newest(query, sensor, "calibration", CalibrationLine, CALIBRATIONS)
    return next((told.main for told in found if told.made == made), np.full(3, np.nan))


def _self_test(query: QueryRunner, sensor: int, day: int) -> SelfTestLine | None:
    """The self-test of a sensor on a day; None where its result is not among the newest ones."""
    found = _newest(query, sensor, "self_test", SelfTestLine, SELF_TESTS)
    return next((told for told in found if told.day == day), None)


def _newest(query: QueryRunner, sensor: int, what: str, kind: type[Kind], most: int) -> Iterator[Kind]:
    """The newest results of a kind, the newest first."""
    rows = query(
        "SELECT payload FROM result WHERE sensor = :sensor AND what = :what ORDER BY number DESC"
        f" LIMIT {most}",
        sensor=sensor, what=what,
    )  # fmt: skip
    for (payload,) in rows:
        try:
            yield msgspec.convert(unpacked(payload), kind)
        except (zlib.error, ValueError):
            continue


def sites_of(query: QueryRunner) -> list[str]:
    """The sites that have hours or days."""
    return [site for (site,) in query("SELECT DISTINCT site FROM watch_day ORDER BY site")]


def source_of(query: QueryRunner, site: str, *, closed: bool, turn: Callable[[], object] = lambda: None) -> SiteSource:
    """A site as it is kept: the newest MOST_DAYS days, with the sensors that have sent something lately.

    `closed`: without days that are not summed yet. `turn` is called before each day is read; it may raise.
    """
    condition = " AND payload IS NOT NULL" if closed else ""
    days = query(
        f"SELECT day FROM watch_day WHERE site = :site{condition} ORDER BY day DESC LIMIT {MOST_DAYS}", site=site
    )
    numbers = sorted(day for (day,) in days)

    def sums(since: int = 0) -> Iterator[DaySum]:
        for day in numbers:
            if day >= since:
                turn()
                if (one := _sum(query, site, day, closed=closed)) is not None:
                    yield one

    names = {i: (gateway, name) for i, gateway, name in
             query("SELECT id, gateway, sensor FROM sensor WHERE site = :site", site=site)}  # fmt: skip
    found, bands = set[int](), set[int]()
    for one in sums(numbers[-1] - SENT_DAYS if numbers else 0):
        found.update(one.sensors)
        bands.update(one.bands)
    used = sorted(i for i in found if i in names)[:MOST_SENSORS]
    ((lines,),) = query(
        "SELECT count(*) FROM watch_hour WHERE sensor IN (SELECT id FROM sensor WHERE site = :site)", site=site
    )
    return SiteSource([names[i] for i in used], used, sorted(bands), sums, lines)


def _sum(query: QueryRunner, site: str, day: int, *, closed: bool) -> DaySum | None:
    """A day; unless `closed`, from its hours where some have come since it was summed. None where it is damaged."""
    rows = query("SELECT stale, payload FROM watch_day WHERE site = :site AND day = :day", site=site, day=day)
    if not rows:
        return None
    stale, payload = rows[0]
    if payload is None or (stale and not closed):
        return _summed(query, site, day)
    try:
        one = _SUM.decode(bytes(payload))
        for name in SHAPES:
            one.array(name)
    except (ValueError, msgspec.DecodeError):
        return None
    return one if len(one.made) == len(one.sensors) else None


def is_database(path: Path) -> bool:
    """Whether a file begins as a database of SQLite."""
    try:
        with path.open("rb") as file:
            return file.read(len(SQLITE)) == SQLITE
    except OSError:
        return False


@contextmanager
def from_database(path: Path, site: str | None) -> Iterator[SiteSource]:
    """A site in the database of a monitor, which may run meanwhile; it can be read until the end of the context.

    Raises WatchError.
    """
    try:
        with closing(connect_read_only(path)) as connection:

            def run(sql: str, /, **values: object) -> list[tuple[Any, ...]]:
                return connection.execute(sql, values).fetchall()

            sites = sites_of(run)
            if not sites or (site is not None and site not in sites):
                which = ", ".join(sites) or "none"
                raise WatchError(f"{path}: has no hourly results of {site or 'any site'}; its sites: {which}")
            if site is None and len(sites) > 1:
                raise WatchError(f"{path}: has the sites {', '.join(sites)}; choose one with --site")
            yield source_of(run, site or sites[0], closed=False)
    except sqlite3.Error as error:
        raise WatchError(f"{path}: no database of the monitor: {error}") from None


def verdicts_of_sites(query: QueryRunner) -> dict[str, dict[str, Any]]:
    """What was told last of each site: the object of docs/site-watch.md. One that is damaged is left out."""
    found = {}
    for site, told in query("SELECT site, told FROM watch_site"):
        try:
            found[site] = unpacked(told)
        except (zlib.error, ValueError):
            continue
    return found


def keep_verdict(query: QueryRunner, site: str, day: int, told: dict[str, Any]) -> None:
    """Keep what is told of a site, in the place of what was told before."""
    query(
        "INSERT INTO watch_site VALUES (:site, :day, :told) ON CONFLICT (site) DO UPDATE SET day = excluded.day,"
        " told = excluded.told",
        site=site, day=day, told=summaries.packed(told),
    )  # fmt: skip
