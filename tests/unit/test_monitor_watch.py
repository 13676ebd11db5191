"""What the monitor keeps of sensors without a reference, and what it tells of their site."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner

from agent.cli.fleet import fleet as fleet_command
from agent.core.events import WatchReport
from agent.delivery.keys import Address
from agent.delivery.received import Received
from agent.monitor.database import Database
from agent.monitor.engines import DatabaseEngine, Sqlite
from agent.monitor.fleet import Fleet
from agent.monitor.site_watching import SiteWatching
from agent.monitor.watch_store import KEPT_DAYS, close_day, packed, source_of, unpacked_hour
from agent.site_watch.day_sum import DaySum, days_of, summed
from agent.site_watch.hour import TWICE, WatchHour, wrong
from tests.unit.postgres import postgres
from tests.unit.results import calibration, status
from tests.unit.test_fleet_watch import FIRST_H, HOUR_NS, lines, self_test
from tests.unit.test_monitor_database import engine_of

NOW_NS = (FIRST_H + 24 * 45) * HOUR_NS


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with postgres() as url:
        yield url


@pytest.fixture(params=["SQLite", pytest.param("PostgreSQL", marks=pytest.mark.slow)])
def engine(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[DatabaseEngine]:
    with closing(engine_of(request, tmp_path)) as found:
        yield found


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    return lines()


def received(row: dict[str, Any], site: str = "bridge", **more: Any) -> Received:
    report = WatchReport(
        run_id="run", sensor=row["sensor"], t_utc_ns=row["hour_utc_ns"] + HOUR_NS, sequence=row["sequence"] + 1,
        hour_utc_ns=row["hour_utc_ns"], duration_s=3600.0, samples=360_000, stuck=0, clipped=0, missing=0, segments=60,
        mean_mps2=[0.1, 0.2, 9.81], mean_scatter_mps2=[1e-4] * 3, temperature_degc=row["temperature_degc"],
        temperature_scatter_degc=0.1, noise_psd=row["noise_psd"], band_hz=row["band_hz"], band_power=row["band_power"],
        cross_power=row["cross_power"], calibration_run_id="run", calibration_sequence=3, u_main_pct=[0.2] * 3,
    )  # fmt: skip
    fields = msgspec.json.decode(msgspec.json.encode(report)) | more
    return Received("", Address(site, row["gateway"], row["sensor"], "watch"), report.sequence, fields, None)


def kept(engine: DatabaseEngine, rows: list[dict[str, Any]], now_ns: int = NOW_NS, site: str = "bridge") -> Database:
    database = Database(engine, now_ns=lambda: now_ns)
    for k in range(0, len(rows), 500):
        database.add([received(row, site) for row in rows[k : k + 500]])
    return database


def test_an_hour_comes_back_as_it_was_to_seven_digits(rows: list[dict[str, Any]]) -> None:
    hour = msgspec.convert(received(rows[7]).fields | {"temperature_degc": None}, WatchHour)
    again = unpacked_hour(hour.sensor, hour.hour, packed(hour))
    assert (again.made, again.hour_utc_ns, again.temperature_degc) == (hour.made, hour.hour_utc_ns, None)
    for name in ("band_power", "cross_power", "noise_psd", "mean_mps2", "u_main_pct", "band_hz"):
        assert getattr(again, name) == pytest.approx(getattr(hour, name), rel=1e-7), name
    assert len(packed(hour)) < 200 + 6 * 4 * (4 + 9)
    assert again.peak_frequency_hz == []
    with pytest.raises(ValueError, match="another length"):
        unpacked_hour("c", 1, msgspec.msgpack.encode([3600.0, 1, 0, ["", 0], [1.0], b"\0" * 8]))


def test_peak_frequencies_of_an_hour_are_kept_to_a_hundred_thousandth(rows: list[dict[str, Any]]) -> None:
    told = [hz * factor for factor in (0.8, 1.0, 1.25) for hz in rows[0]["band_hz"]]
    hour = msgspec.convert(received(rows[7], peak_frequency_hz=[None, *told[1:]]).fields, WatchHour)
    assert wrong(hour) == ""
    again = unpacked_hour(hour.sensor, hour.hour, packed(hour))
    assert again.peak_frequency_hz[0] is None
    assert again.peak_frequency_hz[1:] == pytest.approx(told[1:], rel=1e-5)
    assert len(packed(hour)) <= len(packed(msgspec.structs.replace(hour, peak_frequency_hz=[]))) + 2 * 12 + 2
    # A row of an earlier version ends before them.
    earlier = msgspec.msgpack.encode(msgspec.msgpack.decode(packed(hour))[:-1])
    assert unpacked_hour(hour.sensor, hour.hour, earlier).band_power == pytest.approx(hour.band_power, rel=1e-6)
    for peaks in (told[1:], [*told[1:], 3.0 * told[-1]], [*told[1:], 0.0]):
        assert "peak_frequency_hz are not" in wrong(msgspec.structs.replace(hour, peak_frequency_hz=peaks))


def test_the_frequency_of_a_day_is_in_its_sum_and_earlier_sums_have_none(rows: list[dict[str, Any]]) -> None:
    peaks = [1.02 * hz for hz in rows[0]["band_hz"]] * 3
    sums = []
    for told in (peaks, []):
        hours = [(0, msgspec.convert(received(row, peak_frequency_hz=told).fields, WatchHour)) for row in rows[:144:6]]
        one = summed(hours[0][1].day, hours, {}, {})
        sums.append(msgspec.msgpack.decode(msgspec.msgpack.encode(one), type=DaySum))
    days = [next(iter(days_of([one], [0], one.bands))).day for one in sums]
    assert days[0].frequency == pytest.approx(np.full((1, 4, 3), np.log(1.02)), abs=2e-3)
    assert days[1].frequency is not None
    assert np.isnan(days[1].frequency).all()
    assert len(sums[1].frequency) == 0
    assert days[0].contrast is not None
    assert len(sums[0].contrast) == 4 * 3
    assert len(sums[1].frequency_contrast) == 0


@pytest.mark.thorough
def test_the_monitor_says_what_the_files_say_and_what_it_said_lasts(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    file = tmp_path / "hours.jsonl"
    file.write_text("\n".join(map(json.dumps, rows)) + "\n")
    of_files = json.loads(CliRunner().invoke(fleet_command, ["watch", str(file), "--json", "-"]).stdout)
    fleet = Fleet(lambda: NOW_NS)
    with closing(Sqlite(tmp_path / "monitor.sqlite")) as engine:
        database = kept(engine, rows)
        for sensor in ("c", "d"):
            fleet.take("bridge", "middle", sensor, "status", msgspec.to_builtins(status(1)) | {"t_utc_ns": NOW_NS})
            told = msgspec.json.decode(msgspec.json.encode(calibration(2)))
            fleet.take("bridge", "middle", sensor, "calibration", told | {"t_utc_ns": NOW_NS})
        fleet.set_alive("bridge", "middle", True)
        fleet.alarms()
        watching = SiteWatching(database, fleet)
        watching.step()
        own = watching.told["bridge"]
        # While the monitor has it open.
        read = CliRunner().invoke(
            fleet_command, ["watch", str(tmp_path / "monitor.sqlite"), "--json", "-"], standalone_mode=False
        )
        assert read.return_value == 3, read.output
        for told, last in ((own, "2024-11-11"), (json.loads(read.stdout), of_files["until"])):
            assert told["until"] == last  # the day that is not closed is left out by the monitor
            for one, other in zip(told["sensors"], of_files["sensors"], strict=True):
                assert (one["sensor"], one["verdict"], one["what"]) == (
                    other["sensor"], other["verdict"], other["what"])  # fmt: skip
        sizes = [[one["size"] or 0.0 for one in told["sensors"]] for told in (json.loads(read.stdout), of_files)]
        assert sizes[0] == pytest.approx(sizes[1], rel=1e-4)
        [suspected] = [one["suspected"] for one in own["sensors"] if one["suspected"]]
        assert (suspected["gateway"], suspected["sensor"], suspected["axes"]) == ("middle", "c", "z")
        # Gravity is as it was, so a change of z by 3 % cannot be one of the sensor.
        assert [(one["name"], one["says"]) for one in suspected["witnesses"]] == [
            ("structure", "agrees"), ("gravity", "contradicts"), ("noise", "silent")]  # fmt: skip
        c, d = fleet.rows()
        assert (c["kind"], d["kind"], d["suspected"]) == ("suspected", "sound", None)
        U = 100.0 * np.sqrt(
            (c["u_pct"] / 100) ** 2 + 4 * suspected["size"] ** 2 + suspected["expanded_uncertainty"] ** 2
        )
        assert c["suspected"]["u_pct"] == pytest.approx(U, rel=1e-3)
        assert c["u_pct"] < 0.1 < 5.0 < c["suspected"]["u_pct"], "U in force stays as it is"
        [alarm] = fleet.alarms()
        assert alarm["text"].startswith("suspected: sensitivity of z has fallen by 2.9")
        later = Fleet(lambda: NOW_NS)
        assert SiteWatching(database, later).told == watching.told
        assert later.alarms() == []
        watching.step()
        assert fleet.alarms() == []


@pytest.mark.one_case
def test_self_tests_are_in_the_sum_of_their_day(engine: DatabaseEngine, rows: list[dict[str, Any]]) -> None:
    few = [row for row in rows if row["sequence"] < 24 * 3 and row["gateway"] == "north"]
    database = Database(engine, now_ns=lambda: NOW_NS)
    got = [received(row) for row in few]
    for row in few:
        if row["sequence"] in (3, 27) and row["sensor"] == "b":
            result = self_test(row, 1000 + row["sequence"])
            fields = msgspec.json.decode(msgspec.json.encode(result))
            got.append(Received("", Address("bridge", "north", "b", "self_test"), result.sequence, fields, None))
    database.add(got)
    while close_day(database.query):
        pass
    sums = list(source_of(database.query, "bridge", closed=True).sums())
    told = [one.array("self_test") for one in sums]
    assert [np.isfinite(each[:, 2]).tolist() for each in told] == [[False, True]] * 2
    y = [5.0 + 0.01 * (20_000 % 7), 5.0 + 0.01 * (20_001 % 7)]
    assert np.exp([each[1, 1] for each in told]) == pytest.approx(y)


def test_hostile_hours_are_counted_and_change_nothing(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    few = rows[: 6 * 24 * 3]
    with closing(Sqlite(tmp_path / "monitor.sqlite")) as engine:
        database = kept(engine, few)
        before = database.query("SELECT * FROM watch_hour ORDER BY sensor, hour")
        row, first = few[-1], few[0]
        hostile = [
            received({**row, "sequence": 9_001}, band_hz=[1.0] * 10_000, band_power=[1.0] * 30_000,
                     cross_power=[1.0] * 30_000),
            received({**row, "sequence": 9_002}, band_hz=[1.0, 1.1, 1.2, 1.3]),
            received({**row, "sequence": 9_003}, band_power=[1e300] * 12),
            received({**row, "sequence": 9_004}, hour_utc_ns=row["hour_utc_ns"] + 1),
            received({**row, "sequence": 9_005}, hour_utc_ns=NOW_NS + 48 * HOUR_NS),
            received({**row, "sequence": 9_006}, hour_utc_ns=row["hour_utc_ns"] - 24 * KEPT_DAYS * HOUR_NS),
            received({**row, "sequence": 9_007}, calibration_run_id="x" * 101),
            received({**row, "sequence": 9_008}, mean_mps2=[1e9, 0.0, 0.0]),
            received({**row, "sequence": 9_009}, band_hz=[None] * 4),
            received({**first, "sequence": -2}),
        ]  # fmt: skip
        database.add(hostile)
        assert database.query("SELECT * FROM watch_hour ORDER BY sensor, hour") == before
        assert sum(database.watch.left_out.values()) == len(hostile)
        assert database.watch.left_out[TWICE] == 1
        assert len(database.watch.left_out) == len(hostile) - 1, "of grids there are two"


@pytest.mark.one_case
def test_late_hours_make_their_day_anew(engine: DatabaseEngine, rows: list[dict[str, Any]]) -> None:
    few = rows[: 6 * 24 * 4]
    late = [row for row in few if row["sensor"] == "f" and row["sequence"] < 48]
    database = kept(engine, [row for row in few if row not in late])

    def days() -> list[list[int]]:
        while close_day(database.query) is not None:
            pass
        return [[int(one.number), *one.sensors] for one in source_of(database.query, "bridge", closed=True).sums()]

    first = FIRST_H // 24
    assert days() == [[first, 1, 2, 3, 4, 5], [first + 1, 1, 2, 3, 4, 5], [first + 2, 1, 2, 3, 4, 5, 6]]
    database.add([received(row) for row in late])
    assert days() == [[first + k, 1, 2, 3, 4, 5, 6] for k in range(3)]
    whole = source_of(database.query, "bridge", closed=False)
    assert [one.number for one in whole.sums()] == [first + k for k in range(4)]
    assert [sensor for _, sensor in whole.sensors] == list("abcdef")


@pytest.mark.one_case
def test_hours_are_kept_for_90_days_and_days_for_ever(engine: DatabaseEngine, rows: list[dict[str, Any]]) -> None:
    first = FIRST_H // 24
    now_ns = (FIRST_H + 24 * 200) * HOUR_NS
    database = kept(engine, [row for row in rows if row["sequence"] < 72 and row["sensor"] in "ab"], now_ns)
    assert not database.summarise()
    later = [{**row, "hour_utc_ns": row["hour_utc_ns"] + 24 * (KEPT_DAYS + 1) * HOUR_NS, "sequence": 5000 + k}
             for k, row in enumerate(rows[:1])]  # fmt: skip
    database.add([received(row) for row in later])
    while close_day(database.query) is not None:
        pass
    steps = 0
    while database.summarise():
        steps += 1
    assert steps == 2, "one day in a step"
    assert database.query("SELECT min(hour), count(*) FROM watch_hour WHERE hour < :h", h=FIRST_H + 96) == [
        (FIRST_H + 48, 48)]  # fmt: skip
    numbers = [one.number for one in source_of(database.query, "bridge", closed=True).sums()]
    assert numbers == [first, first + 1, first + 2]


def test_a_damaged_day_and_a_damaged_hour_are_left_out(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    with closing(Sqlite(tmp_path / "monitor.sqlite")) as engine:
        database = kept(engine, rows[: 6 * 24 * 4])
        database.query("UPDATE watch_hour SET payload = x'93ff' WHERE sensor = 2 AND hour < :h", h=FIRST_H + 24)
        while close_day(database.query) is not None:
            pass
        database.query("UPDATE watch_day SET payload = substr(payload, 1, 300) WHERE day = :d", d=FIRST_H // 24 + 1)
        found = list(source_of(database.query, "bridge", closed=True).sums())
        assert [one.number - FIRST_H // 24 for one in found] == [0, 2]
        assert [len(one.sensors) for one in found] == [5, 6]
        short = msgspec.msgpack.encode(msgspec.structs.replace(found[1], value=found[1].value[:-4]))
        database.query("UPDATE watch_day SET payload = :p WHERE day = :d", p=short, d=FIRST_H // 24 + 2)
        assert len(list(source_of(database.query, "bridge", closed=True).sums())) == 1


def test_what_a_database_is_not(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    file, other = tmp_path / "monitor.sqlite", tmp_path / "hours.jsonl"
    other.write_text(json.dumps(rows[0]) + "\n")

    def refused(*given: str) -> str:
        told = CliRunner().invoke(fleet_command, ["watch", *given], standalone_mode=False)
        assert told.return_value == 2 or told.exception is not None
        return told.stderr + str(told.exception or "")

    with closing(Sqlite(file)) as engine:
        database = kept(engine, rows[:12])
        assert "has no hourly results of castle; its sites: bridge" in refused(str(file), "--site", "castle")
        database.add([received(rows[0], "castle")])
        assert "choose one with --site" in refused(str(file))
        assert "is given alone" in refused(str(file), str(other))
        assert "files are one site" in refused(str(other), "--site", "bridge")
    file.write_bytes(b"SQLite format 3\0" + bytes(200))
    assert "no database of the monitor" in refused(str(file))


@pytest.mark.thorough
def test_a_change_is_not_told_before_its_day_has_closed(engine: DatabaseEngine, rows: list[dict[str, Any]]) -> None:
    """And a site rests after it was asked, so that a history that comes at once is not asked for each of its days."""
    clock = [0.0]
    until = 24 * 3 + 5
    database = kept(engine, [row for row in rows if row["sequence"] < until])
    watching = SiteWatching(database, Fleet(), lambda: clock[0])
    watching.step()
    assert watching.told["bridge"]["until"] == "2024-10-05"
    watching._rests["bridge"] = 100.0
    database.add([received(row) for row in rows if until <= row["sequence"] < until + 30])
    watching.step()
    assert watching.told["bridge"]["until"] == "2024-10-05"
    clock[0] = 100.0
    watching.step()
    assert watching.told["bridge"]["until"] == "2024-10-07"
    again = SiteWatching(database, Fleet())
    assert again.told == watching.told
