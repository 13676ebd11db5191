"""The database of the monitor on SQLite and on PostgreSQL: order, repetition, hourly summaries, what stays."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import msgspec
import pytest

from agent.core.events import Result
from agent.delivery.keys import Address
from agent.delivery.received import Received
from agent.monitor.database import DAY_NS, HOUR_NS, Database
from agent.monitor.engines import DatabaseEngine, DatabaseError, Postgres, Sqlite
from agent.monitor.settings import load_settings
from agent.monitor.summaries import Summariser
from tests.unit.postgres import postgres
from tests.unit.results import calibration, clock, status, window
from tests.unit.zenoh_site import wait_for

PLACE = ("site", "gw", "mems")
START = 20_000 * DAY_NS
MINUTE = HOUR_NS // 60


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with postgres() as url:
        yield url


class Kept:
    """A database and the time that it sees."""

    def __init__(self, engine: DatabaseEngine, full_days: int = 2) -> None:
        self.now_ns, self.engine = START, engine
        self.database = Database(engine, full_days=full_days, now_ns=lambda: self.now_ns)

    def add(self, result: Result, t_utc_ns: int, epoch: str = "", **more: Any) -> dict[str, Any]:
        received = received_from(result, t_utc_ns, epoch, **more)
        self.database.add([received])
        return received.fields

    def rows(self, what: str, limit: int = 1000) -> list[dict[str, Any]]:
        return self.database.history(*PLACE, what, limit)

    def summarise(self) -> int:
        steps = 0
        while self.database.summarise():
            steps += 1
        return steps


def received_from(result: Result, t_utc_ns: int, epoch: str = "", **more: Any) -> Received:
    fields = msgspec.json.decode(msgspec.json.encode(result)) | {"t_utc_ns": t_utc_ns} | more
    address = Address(*PLACE[:2], result.sensor, result.what)
    return Received("", address, result.sequence, fields, None, epoch=epoch)


@pytest.fixture(params=["SQLite", pytest.param("PostgreSQL", marks=pytest.mark.thorough)])
def kept(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Kept]:
    with closing(engine_of(request, tmp_path)) as engine:
        yield Kept(engine)


def engine_of(request: pytest.FixtureRequest, directory: Path) -> DatabaseEngine:
    if request.param == "SQLite":
        return Sqlite(directory / "monitor.sqlite")
    engine = Postgres(request.getfixturevalue("server"))
    with engine.transaction() as run:
        run("DROP SCHEMA public CASCADE")
        run("CREATE SCHEMA public")
    return engine


@pytest.mark.slow
def test_results_come_back_whole_in_order_and_each_once(kept: Kept) -> None:
    whole = [kept.add(calibration(k, sxx=26000.0 + k), START + k * MINUTE) for k in (1, 2, 3)]
    kept.add(calibration(2, sxx=1.0), START + 2 * MINUTE)
    kept.add(window(4), START, signed_by="key")
    kept.add(window(5, used=False), START)
    assert kept.rows("calibration") == whole
    assert kept.rows("calibration", 2) == whole[1:]
    assert kept.database.history("site", "gw", "'; DROP TABLE result; --", "calibration", 5) == []
    assert [(what, fields["sequence"]) for *_, what, fields in kept.database.newest()] == [
        ("calibration", 3), ("window", 4), ("window", 5)]  # fmt: skip
    assert kept.database.newest()[1][4]["signed_by"] == "key"
    kept.add(status(1), START, epoch="ab")
    kept.add(status(0), START, epoch="ab")
    assert list(kept.database.last_sequence().items()) == [("site/gw", 5), ("site/gw/ab", 1)]


@pytest.mark.slow
def test_results_of_one_batch_are_kept_as_one_by_one(kept: Kept) -> None:
    batch = [received_from(calibration(k), START + k) for k in (1, 2, 2, 3)]
    batch += [received_from(window(4), START, epoch="ab"), received_from(calibration(5, qz_known=False), START + 5)]
    kept.database.add(batch)
    assert kept.rows("calibration") == [batch[k].fields for k in (0, 1, 3, 5)]
    with kept.engine.transaction() as run:
        assert run("SELECT count(detail) FROM result") == [(2,)]
    assert [fields["sequence"] for *_, fields in kept.database.newest()] == [4, 5]
    assert kept.database.last_sequence() == {"site/gw/ab": 4, "site/gw": 5}


@pytest.mark.slow
def test_a_clock_that_is_set_late_costs_no_result_that_lasts(kept: Kept) -> None:
    """A machine without a battery for its clock begins in 1970, the day that marks what lasts."""
    kept.now_ns = HOUR_NS
    lasting = kept.add(status(1), START)
    for number, t_utc_ns in enumerate((0, -5 * DAY_NS, START, START + 900 * DAY_NS), start=2):
        kept.add(calibration(number), t_utc_ns)
    kept.now_ns = START
    newest = kept.add(calibration(6), START)
    assert kept.summarise() > 0
    assert kept.rows("status") == [lasting]
    assert kept.rows("calibration")[-1] == newest


@pytest.mark.parametrize("broken", ["INSERT INTO result", "INSERT INTO newest", "INSERT INTO followed"])
def test_a_batch_that_fails_leaves_nothing_and_can_be_added_again(
    kept: Kept, broken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = [received_from(calibration(k), START + k) for k in (1, 2, 3)]
    transaction = kept.engine.transaction

    @contextmanager
    def failing() -> Iterator[Any]:
        with transaction() as run:
            seen: list[str] = []

            def query(sql: str, /, **values: object) -> Any:
                seen.append(sql)
                rows = run(sql, **values)
                if sum(sql.startswith(broken) for sql in seen) == (2 if "result" in broken else 1):
                    raise sqlite3.OperationalError("disk I/O error")
                return rows

            yield query

    monkeypatch.setattr(kept.engine, "transaction", failing)
    with pytest.raises(sqlite3.OperationalError):
        kept.database.add(batch)
    monkeypatch.setattr(kept.engine, "transaction", transaction)
    assert (kept.rows("calibration"), kept.database.last_sequence(), kept.database.newest()) == ([], {}, [])
    kept.database.add(batch)
    assert kept.rows("calibration") == [received.fields for received in batch]  # with their covariance
    assert kept.database.last_sequence() == {"site/gw": 3}


def test_a_covariance_is_kept_when_it_changed_and_read_with_every_result(kept: Kept) -> None:
    shared = {"reference": "R", "kinds": ["reference sensitivity"], "u_stated": [1e-3], "derivative": [[0.5] * 12],
              "own_derivative": [[1.0]]}  # fmt: skip
    whole = [kept.add(calibration(k), START + k, shared_errors=[shared]) for k in (1, 2, 3)]
    whole.append(kept.add(calibration(4, qz_known=False), START + 4, shared_errors=[shared]))
    with kept.engine.transaction() as run:
        assert run("SELECT count(detail) FROM result") == [(2,)]
    assert kept.rows("calibration") == whole
    assert kept.rows("calibration", 2) == whole[2:]
    (short,) = kept.database.spread(*PLACE, "calibration", 1)
    assert whole[3].items() > {k: v for k, v in short.items() if k != "shared_errors"}.items()
    assert short["shared_errors"] == [{k: v for k, v in shared.items() if "derivative" not in k}]


def test_older_results_become_hourly_summaries_and_what_needs_a_person_stays(kept: Kept) -> None:
    """Two sensors, three hours of one day with 3 calibrations, 2 windows used, 1 refused and a clock in each."""
    sequence, drift = 0, {"what": "drift", "parameter": "Sxx"}
    for hour in (0, 1, 5):
        for minute in (10, 20, 30):
            t = START + hour * HOUR_NS + minute * MINUTE
            kept.now_ns = t
            kept.add(calibration(sequence := sequence + 1, sxx=26000.0 + sequence), t)
            kept.add(window(sequence := sequence + 1, used=minute != 20), t)
        kept.add(clock(sequence := sequence + 1), t)
        kept.add(status(sequence := sequence + 1, "VALID" if hour < 5 else "HELD"), t, **drift)
    for late in (1, 2):
        kept.now_ns = START + late * DAY_NS
        kept.add(calibration(sequence := sequence + 1), kept.now_ns)
    assert kept.summarise() == 0  # two days are kept in full beside today
    before, newest = kept.rows("calibration"), kept.database.newest()
    kept.now_ns = START + 3 * DAY_NS
    assert kept.summarise() == 2  # the day of the sensor, then the day itself
    counted = [{k: v for k, v in row.items() if k not in ("t_utc_ns", "status")} for row in
               kept.database.summaries(*PLACE, 100)]  # fmt: skip
    assert counted == [
        {"calibrations": 3, "estimates": 0, "windows_used": 2, "windows_refused": 1, "clocks": 1}] * 3  # fmt: skip
    told = [(row["t_utc_ns"] - START, row["status"]) for row in kept.database.summaries(*PLACE, 2)]
    assert told == [(2 * HOUR_NS, "VALID"), (6 * HOUR_NS, "HELD")]
    after = kept.rows("calibration")
    # The first of the day, of each hour the last, then what is full.
    assert [row["sequence"] for row in after] == [1, 5, 13, 21, 25, 26]
    assert "covariance" not in after[0]
    assert after[4:] == before[-2:]
    assert after[1].items() < before[2].items()
    assert [row["sequence"] for row in kept.database.spread(*PLACE, "calibration", 100)] == [1, 5, 13, 21, 25, 26]
    first = kept.database.first_of_day(*PLACE, "calibration", START + 5 * HOUR_NS)
    assert first is not None
    assert first["sequence"] == 1
    assert len(kept.rows("status")) == 3
    assert kept.database.newest() == newest  # the windows too, which are older than what is kept in full
    assert kept.database.last_sequence() == {"site/gw": 26}
    with kept.engine.transaction() as run:
        assert run("SELECT count(*) FROM result WHERE what IN ('window', 'clock')") == [(3,)]
    kept.add(window(27), START + 20 * MINUTE)  # a gateway sends what is older after an outage: it is counted too
    kept.now_ns += 3 * DAY_NS
    kept.summarise()
    assert [row["windows_used"] for row in kept.database.summaries(*PLACE, 100)][:2] == [3, 2]


def test_the_newest_calibration_of_a_silent_sensor_keeps_its_covariance(kept: Kept) -> None:
    whole = [kept.add(calibration(k), START + k) for k in (1, 2)]
    kept.now_ns += 9 * DAY_NS
    kept.summarise()
    assert kept.rows("calibration")[1:] == whole[1:]  # the first of the day stays, without it


@pytest.mark.thorough
@pytest.mark.usefixtures("server")
def test_days_are_partitions_that_are_dropped(request: pytest.FixtureRequest, tmp_path: Path) -> None:
    request.param = "PostgreSQL"
    with closing(engine_of(request, tmp_path)) as engine:
        kept = Kept(engine)

        def partitions() -> set[str]:
            with engine.transaction() as run:
                return {name for (name,) in run("SELECT inhrelid::regclass\\:\\:text FROM pg_inherits WHERE inhparent ="
                                                " CAST('result' AS regclass)")}  # fmt: skip

        for day in range(5):
            kept.now_ns = START + day * DAY_NS
            kept.add(window(day + 1), kept.now_ns)
            kept.add(window(day + 101), 0)  # a wrong clock, and
            kept.add(window(day + 201), 2**62)  # a stranger, who make no partition of their own
            kept.summarise()
        assert partitions() == {"result_0", "result_20002", "result_20003", "result_20004"}


def test_two_monitors_on_one_database_lose_and_count_nothing_twice(
    server: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    request.param = "PostgreSQL"
    with closing(engine_of(request, tmp_path)) as engine, closing(Postgres(server)) as other:
        monitors = Kept(engine), Kept(other)

        def fill(kept: Kept, offset: int) -> None:
            for k in range(40):
                made = msgspec.structs.replace(window(2 * k + offset), sensor=f"s{k % 20}")
                kept.add(made, START + k)

        def both(work: Any) -> None:
            threads = [Thread(target=work, args=(kept, offset)) for offset, kept in enumerate(monitors)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()

        both(fill)
        for kept in monitors:
            kept.now_ns += 5 * DAY_NS
        both(lambda kept, _: kept.summarise())
        with engine.transaction() as run:
            assert run("SELECT count(*), sum(windows_used) FROM summary") == [(20, 80)]
            assert run("SELECT count(*) FROM day") == [(0,)]


def test_a_thread_summarises_and_a_fault_does_not_end_it() -> None:
    said: list[bool | Exception] = [True, sqlite3.OperationalError("database is locked")]
    summariser = Summariser(lambda: _next(said))
    wait_for(lambda: not said)
    summariser.close()


def _next(said: list[bool | Exception]) -> bool:
    one = said.pop(0)
    if isinstance(one, Exception):
        raise one
    return one


def test_a_database_that_cannot_be_used_is_told(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "monitor.sqlite")) as older:
        older.execute("CREATE TABLE result (site TEXT, payload BLOB)")
    with (
        closing(Sqlite(tmp_path / "monitor.sqlite")) as engine,
        pytest.raises(sqlite3.DatabaseError, match="earlier version"),
    ):
        Database(engine)
    pytest.importorskip("psycopg", reason="the extra fleet is not installed")
    with (
        closing(Postgres(f"postgresql://anna@/fleet?host={tmp_path}")) as nobody,
        pytest.raises(DatabaseError, match=r"PostgreSQL local/fleet: .*(No such file|failed)"),
    ):
        Database(nobody)


def test_the_configuration_of_the_database(tmp_path: Path) -> None:
    file = tmp_path / "monitor.toml"
    file.write_text('[database]\nurl = "postgresql://anna@db.example.org/fleet"\nfull_days = 30\n')
    assert load_settings(file).database.full_days == 30
    for url, told in (("postgresql://anna:SECRET@h/fleet", "PGPASSFILE"), ("mysql://h/fleet", "postgresql://USER")):
        file.write_text(f'[database]\nurl = "{url}"\n')
        with pytest.raises(Exception, match=told) as refused:
            load_settings(file)
        assert "SECRET" not in str(refused.value)


def test_the_plan_is_kept(kept: Kept) -> None:
    for extra in ("starlette", "argon2"):
        pytest.importorskip(extra, reason="the extra monitor is not installed")
    from starlette.requests import Request

    from agent.monitor.login import Access
    from agent.monitor.plan import Plans, Position

    first, asked = Plans(kept.engine, Access(None)), Request({"type": "http"})
    for data in (b"a picture", b"another one"):
        first.keep("image/png", data)
    for name, at in (("mems", (0.1, 0.2)), ("mems", (0.123456789, 0.75)), ("other", (0.0, 1.0)), ("other", None)):
        first.place(Position(f"site/gw/{name}", at))
    later = Plans(kept.engine, Access(None))
    told = msgspec.json.decode(bytes(later.positions(asked).body))
    assert told["positions"] == {"site/gw/mems": [0.123456789, 0.75]}
    assert bytes(later.picture(asked).body) == b"another one"
