"""What the page says of a sensor: its kind, since when it drifts and how much, and the U of a change."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pytest

from agent.core.events import DriftReport, Estimate
from agent.delivery.keys import Address
from agent.delivery.received import Received
from agent.monitor.database import DAY_NS, Database
from agent.monitor.engines import Sqlite
from agent.monitor.fleet import Fleet, dated
from agent.monitor.onset import since
from agent.monitor.trends import Shape, Trends, change_in, change_of
from calib.state.state import DATED
from tests.unit.results import calibration, status, window

PLACE = ("site", "gw", "mems")
NOW_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000


def fields_of(result: Any, **more: Any) -> dict[str, Any]:
    found: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(result))
    return found | more


def verdict(**more: Any) -> dict[str, Any]:
    made = DriftReport(run_id="r", sequence=9, sensor="mems", t_utc_ns=NOW_NS, parameter="Sxx", verdict="drifting",
                       change=100.0, u_change=5.0, rate=1.0, u_rate=0.1, onset_utc_ns=NOW_NS - 100 * DAY_NS,
                       statistic=20.0, threshold=15.0, false_alarms_a_year=0.1, reason="r")  # fmt: skip
    return fields_of(made, **more)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["drifting", "stepped"])
@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_the_interval_of_an_onset_has_it(shape: Literal["drifting", "stepped"], correlation: float) -> None:
    """Of 200 histories of a year, U of onset, size and rate has the truth in at least 90 %, and is not generous."""
    random, inside, u_days = np.random.default_rng(3), [], []
    for _ in range(200):
        count = int(random.integers(40, 300))
        days, white = np.sort(random.uniform(0.0, 365.0, count)), random.normal(size=count)
        noise = white.copy()
        for k in range(1, count):
            noise[k] = correlation * noise[k - 1] + white[k] * np.sqrt(1.0 - correlation**2)
        onset, size = random.uniform(60.0, 300.0), random.choice([-1.0, 1.0]) * random.uniform(5.0, 20.0)
        reach = days[-1] - onset if shape == "drifting" else 1.0
        bent = np.maximum(days - onset, 0.0) / reach if shape == "drifting" else (days >= onset).astype(float)
        found = since(days, noise + size * bent, shape)
        if found is None:
            continue
        rate = size / reach if shape == "drifting" else 0.0
        inside.append([abs(found.day - onset) <= 2 * found.u_day, abs(found.size - size) <= 2 * found.u_size,
                       abs(found.rate - rate) <= 2 * found.u_rate])  # fmt: skip
        u_days.append(found.u_day)
    assert len(inside) > 195
    assert np.min(np.mean(inside, axis=0)) >= 0.9
    assert np.median(u_days) < (15.0 if shape == "drifting" else 3.0)


def test_a_step_is_told_from_a_drift_and_a_verdict_that_the_history_does_not_show_stands() -> None:
    random, days = np.random.default_rng(6), np.arange(100.0)
    noise = random.normal(size=100)
    for told in ("drifting", "stepped"):
        shape, found = change_in(days, noise + 20.0 * (days > 60.0), {"verdict": told, "change": 20.0})
        assert (shape, found is not None and abs(found.size - 20.0) < 1.0) == ("stepped", True)
        # As where windows are held: what is in force does not follow, and a slight rise in it is no explanation.
        assert change_in(days, noise + 0.02 * days, {"verdict": told, "change": 100.0})[0] == told


def test_a_sound_history_shows_no_change() -> None:
    random, days = np.random.default_rng(4), np.arange(100.0)
    shapes: tuple[Shape, ...] = ("drifting", "stepped")
    found = [since(days, random.normal(size=100), shape) for _ in range(100) for shape in shapes]
    assert sum(each is not None for each in found) <= 4
    assert since(days[:7], days[:7], "drifting") is None  # too few
    assert since(days, np.ones(100), "drifting") is None


def test_the_error_of_the_one_reference_cancels_in_a_change() -> None:
    shared = [{"certificate_sha256": "a"}]
    budget = {"reference sensitivity": [5.9] + [0.0] * 11, "type A": [1.0] * 12}
    first = fields_of(calibration(1), references=["B12"], shared_errors=shared, budget=budget)
    last = fields_of(calibration(2, sxx=26164.0), references=["B12"], shared_errors=shared, budget=budget)
    assert change_of(first, last, 0) == {"change": 10.0, "U": pytest.approx(2 * np.sqrt(2 * (36 - 5.9**2)))}
    other = last | {"shared_errors": [{"certificate_sha256": "b"}]}  # another certificate, so another error
    assert change_of(first, other, 0)["U"] == pytest.approx(2 * np.sqrt(72))
    assert change_of(first, last | {"budget": {}}, 0)["U"] == pytest.approx(2 * np.sqrt(72))


class Clock:
    """The present of a fleet."""

    def __init__(self) -> None:
        self.ns = NOW_NS

    def __call__(self) -> int:
        return self.ns


def kind(fleet: Fleet) -> str:
    (row,) = fleet.rows()
    return str(row["kind"])


def test_colours_come_from_verdicts_and_hearing_alone() -> None:
    now = Clock()
    fleet = Fleet(now)
    fleet.set_alive("site", "gw", True)
    fleet.take(*PLACE, "calibration", fields_of(calibration(1)))
    fleet.take(*PLACE, "status", fields_of(status(2)))
    assert kind(fleet) == "sound"
    fleet.take(*PLACE, "calibration", fields_of(calibration(3, sxx=30000.0)))  # however large a change is
    assert kind(fleet) == "sound"
    fleet.take(*PLACE, "status", fields_of(status(4, "HELD")))
    assert kind(fleet) == "held"
    fleet.take(*PLACE, "drift", verdict())
    assert kind(fleet) == "drifting"
    fleet.set_alive("site", "gw", False)
    assert kind(fleet) == "silent"  # VALID or not: nobody knows
    fleet.set_alive("site", "gw", True)
    fleet.take(*PLACE, "drift", verdict(verdict="stable"))
    fleet.take(*PLACE, "status", fields_of(status(5, "INVALID")))
    assert kind(fleet) == "no data"


def test_a_sensor_that_is_held_and_has_stepped_is_held() -> None:
    now = Clock()
    fleet = Fleet(now)
    fleet.set_alive("site", "gw", True)
    fleet.take(*PLACE, "status", fields_of(status(1, "HELD")))
    fleet.take(*PLACE, "drift", verdict(verdict="stepped"))
    assert kind(fleet) == "held"
    (row,) = fleet.rows()
    assert [v["verdict"] for v in row["verdicts"]] == ["stepped"]  # with its step
    fleet.take(*PLACE, "status", fields_of(status(2, "VALID")))
    assert kind(fleet) == "changed"  # an adopted step needs a person too, and does not drift
    fleet.set_doubled({"site/gw": ("a1", "b2")}, {})
    assert kind(fleet) == "doubled"  # of two gateways with one name nobody knows whose results these are
    now.ns += SECOND_NS
    fleet.set_doubled({}, {"site/gw": ("a1", "b2")})  # one of them has left, and comes back in turns
    assert kind(fleet) == "doubled"
    (row,) = fleet.gateways({})
    assert (row["mixed_utc_ns"], row["why"].split(" have")[0]) == (NOW_NS, "runs a1, b2")
    fleet.set_doubled({}, {})
    assert kind(fleet) == "changed"


def test_a_step_that_is_told_of_a_drift_does_not_end_it_also_after_a_restart() -> None:
    told = [verdict(verdict=each, t_utc_ns=NOW_NS + day * DAY_NS)
            for day, each in enumerate(["drifting", "stable", "stepped", "drifting", "stepped"])]  # fmt: skip
    for count, expected in ((3, "changed"), (4, "drifting"), (5, "drifting")):
        rows = []
        for restarted in (False, True):
            fleet = Fleet(Clock())
            fleet.set_alive("site", "gw", True)
            fleet.take(*PLACE, "status", fields_of(status(1)))
            if restarted:
                fleet.recall(PLACE, [*told[:count], verdict(parameter="invented")])
            for each in told[count - 1 : count] if restarted else told[:count]:
                fleet.take(*PLACE, "drift", each)
            rows += [[(row["kind"], row["verdicts"][0]["first_utc_ns"]) for row in fleet.rows()]]
        assert rows == 2 * [[(expected, NOW_NS + 2 * DAY_NS)]]


def test_a_gateway_that_catches_up_needs_no_person() -> None:
    fleet = Fleet(Clock())
    fleet.set_alive("site", "gw", True)
    whys = []
    for state in ("running", "catching up", "degraded"):
        fleet.set_gateway_status(
            "site", "gw", msgspec.json.encode({"state": state, "reasons": ["a reason"], "t_utc_ns": 1})
        )
        whys += [row["why"] for row in fleet.gateways({})]
    assert whys == ["", "", "degraded: a reason"]


def test_the_date_of_a_certificate_is_read_from_the_identity_of_the_reference() -> None:
    day_ns = 1_772_323_200_000_000_000  # 2026-03-01, midnight UTC
    assert dated(f"B12 4711 3c9fa15d91c5{DATED}2026-03-01") == ("B12 4711 3c9fa15d91c5", day_ns)
    for other in ("B12 4711", f"B12{DATED}2026-02-30", f"B12{DATED}soon", ""):
        assert dated(other) == (other, None)


def test_a_sensor_that_misses_three_intervals_is_not_heard() -> None:
    now = Clock()
    fleet = Fleet(now)
    fleet.set_alive("site", "gw", True)
    for number in range(4):
        now.ns += 200 * SECOND_NS
        fleet.take(*PLACE, "status", fields_of(status(number + 1)))
    heard, version = now.ns, fleet.version
    now.ns += 599 * SECOND_NS
    fleet.look()
    assert (kind(fleet), fleet.version) == ("sound", version)
    now.ns += 2 * SECOND_NS
    fleet.look()
    assert kind(fleet) == "silent"
    (row,) = fleet.rows(version)  # the page is told of it
    assert row["heard_utc_ns"] == heard
    fleet.take(*PLACE, "status", fields_of(status(9)))
    assert kind(fleet) == "sound"
    fleet.take(*PLACE, "status", fields_of(status(10, "INVALID")))
    now.ns += 10_000 * SECOND_NS
    fleet.look()
    assert kind(fleet) == "no data"  # a lost sensor has no results, and its gateway is heard
    fleet.set_alive("site", "gw", False)
    assert kind(fleet) == "silent"


def test_rows_that_have_not_changed_are_not_sent_again_and_events_are_told_once() -> None:
    fleet = Fleet()
    for name in ("a", "b"):
        fleet.take("site", "gw", name, "status", fields_of(status(1), sensor=name))
    version = fleet.version
    fleet.take("site", "gw", "b", "drift", verdict(sensor="b"))
    fleet.take("site", "gw", "b", "drift", verdict(sensor="b", reason="r"))
    assert [row["sensor"] for row in fleet.rows(version)] == ["b"]
    assert [(event["sensor"], event["count"]) for event in fleet.events()] == [("b", 2), ("b", 1), ("a", 1)]


@pytest.mark.parametrize("told", ["drifting", "stepped"])
def test_what_a_history_tells_of_a_drift(tmp_path: Path, told: str) -> None:
    """A year, each fifth day a calibration; Sxx rises from day 200 on, after an operator accepted that of day 100.

    It is a drift also where the newest verdict is that a part of it was a step.
    """
    fleet, database = Fleet(), Database(Sqlite(tmp_path / "monitor.sqlite"), full_days=1000)
    begin, random = NOW_NS - 365 * DAY_NS, np.random.default_rng(5)

    def take(what: str, number: int, t_utc_ns: int, fields: dict[str, Any]) -> None:
        fields |= {"t_utc_ns": t_utc_ns, "sequence": number}
        database.add([Received("", Address(*PLACE, what), number, fields, None)])
        fleet.take(*PLACE, what, fields)

    for k in range(74):
        rise = 2.615 * max(0, 5 * k - 200) + random.normal()  # 0.01 % a day
        take("calibration", 10 * k + 1, begin + 5 * k * DAY_NS, fields_of(calibration(1, sxx=26154.0 + rise)))
        if k == 20:
            accepted = status(1, reason="estimate 7 accepted by anna")
            take("status", 10 * k + 2, begin + 5 * k * DAY_NS - 1, fields_of(accepted))
    take("drift", 999, NOW_NS, verdict(verdict=told))
    found = Trends(database, fleet).of(PLACE)
    database.close()
    assert (found["accepted"], found["accepted_utc_ns"]) == (True, begin + 100 * DAY_NS)
    assert len(found["t_utc_ns"]) == 60
    assert found["main_pct"][0][-1] == pytest.approx(1.65, abs=0.05)
    change = found["found"]["Sxx"]["change"]
    assert change["shape"] == "drifting"
    assert abs(change["onset_utc_ns"] / DAY_NS - begin / DAY_NS - 200) < 2 * change["u_onset_days"] < 5
    assert abs(change["rate"] - 2.615) < 2 * change["u_rate"]
    assert abs(change["size"] - 2.615 * 165) < 3 * change["u_size"]
    # The smooth line alone has u of 0.5; that of the change from the first to the last value is the larger part.
    assert change["u_size"] == pytest.approx(0.5 * found["changes"][0]["U"], rel=0.02)
    assert change["u_rate"] == pytest.approx(change["u_size"] / 165, rel=0.05)
    assert found["found"]["Sxx"]["scale"] == pytest.approx(26154 + 431, abs=5)


def test_what_is_held_is_told_beyond_the_calibration_in_force_and_at_once(tmp_path: Path) -> None:
    """Ten sound days, then ten in which windows are held; from the fifth of them on with an estimate."""
    fleet, database = Fleet(), Database(Sqlite(tmp_path / "monitor.sqlite"), full_days=1000)
    trends, begin = Trends(database, fleet), NOW_NS - 20 * DAY_NS

    def take(result: Any, number: int, day: int, **more: Any) -> None:
        fields, t_utc_ns = fields_of(result), begin + day * DAY_NS
        fields |= {"t_utc_ns": t_utc_ns, "sequence": number} | more
        if "calibration" in fields:
            fields["calibration"]["t_utc_ns"] = t_utc_ns
        database.add([Received("", Address(*PLACE, result.what), number, fields, None)])
        fleet.take(*PLACE, result.what, fields)

    take(status(1), 1, 0)
    for day in range(10):
        take(window(1), 10 * day + 2, day)
        take(calibration(1), 10 * day + 3, day)
    assert "estimates" not in trends.of(PLACE)
    for day in range(10, 20):
        take(window(1, used=False, reason="held"), 10 * day + 2, day)
        take(status(1, "HELD"), 10 * day + 3, day)
        if day > 13:
            made = Estimate(run_id="r", sequence=1, sensor="mems", t_utc_ns=1, reason="r",
                            calibration=calibration(1, sxx=0.9 * 26154.0))  # fmt: skip
            take(made, 10 * day + 4, day)
    found = trends.of(PLACE)  # although what was found of the sound sensor is kept for a minute
    database.close()
    days = [begin + day * DAY_NS for day in range(20)]
    assert (found["held_utc_ns"], found["refused_utc_ns"]) == (days[10], days[10:])
    assert [e["t_utc_ns"] for e in found["estimates"]] == days[14:]
    assert found["estimates"][0]["main_pct"] == [-10.0, 0.0, 0.0]
    assert [found["estimates"][0][name][0] for name in ("values", "u")] == [0.9 * 26154.0, 6.0]
    assert found["t_utc_ns"][-1] == days[9]


def test_when_a_jump_came_into_force(tmp_path: Path) -> None:
    fleet, database = Fleet(), Database(Sqlite(tmp_path / "monitor.sqlite"), full_days=1000)
    kept = [calibration(1), *(status(k, "RECALIBRATING") for k in (2, 3)), status(4, reason="estimate 7 accepted by a")]
    trends = Trends(database, fleet)
    for number, (result, before) in enumerate(zip(kept, ("", "HELD", "RECALIBRATING", "HELD"), strict=True), start=1):
        fields = fields_of(result, before=before)
        database.add([Received("", Address(*PLACE, result.what), number, fields, None)])
        fleet.take(*PLACE, result.what, fields)
        if number == 3:
            assert trends.of(PLACE)["adopted_utc_ns"] == kept[1].t_utc_ns
    assert trends.of(PLACE)["adopted_utc_ns"] is None  # changes count from what was accepted later
    database.close()


def test_a_step_began_after_the_last_window_without_it_also_where_it_was_adopted_later(tmp_path: Path) -> None:
    """Windows ten days apart: eight sound ones, a step, and three windows later S and Q in force follow it."""
    fleet, database = Fleet(), Database(Sqlite(tmp_path / "monitor.sqlite"), full_days=1000)
    days = [NOW_NS - (15 - k) * 10 * DAY_NS for k in range(15)]

    def take(result: Any, t_utc_ns: int, number: int, **more: Any) -> None:
        fields = fields_of(result, t_utc_ns=t_utc_ns, sequence=number, **more)
        database.add([Received("", Address(*PLACE, fields["what"]), number, fields, None)])
        fleet.take(*PLACE, fields["what"], fields)

    for k, t_utc_ns in enumerate(days):
        adopted = k > 10
        take(window(1, used=k < 8 or adopted), t_utc_ns, 10 * k + 1, what="window")
        if k < 8 or adopted:
            calibrated = calibration(1, sxx=26154.0 - 800.0 * adopted + k % 2)
            take(calibrated, t_utc_ns, 10 * k + 2, what="calibration")
    take(status(1), days[-1], 150, what="status")
    stepped = verdict(verdict="stepped", change=-800.0, onset_utc_ns=days[8] + 1, t_utc_ns=days[11])
    fleet.take(*PLACE, "drift", stepped)
    found = Trends(database, fleet).of(PLACE)["found"]["Sxx"]
    database.close()
    assert found["change"]["onset_utc_ns"] == days[8] + 1  # the history alone has it 30 days later
    assert list(found["began_utc_ns"]) == [days[7], days[8] + 1]


def test_a_witness_is_heard_in_the_name_of_one_gateway_and_was_compared_since_then() -> None:
    now = Clock()
    fleet, since_utc_ns = Fleet(now), NOW_NS - 5 * DAY_NS
    windows_utc_ns = {"own": NOW_NS, "steady": NOW_NS, "held": NOW_NS, "on-hold": NOW_NS, "drifts": NOW_NS,
                      "early": NOW_NS - 6 * DAY_NS, "away": NOW_NS, "doubled": NOW_NS, "silent": NOW_NS}  # fmt: skip
    reasons = {"held": ("HELD", "it contradicts"), "on-hold": ("HELD", "put on hold by anna")}
    for gateway, t_utc_ns in windows_utc_ns.items():
        place = "site", gateway, "mems"
        fleet.set_alive("site", gateway, gateway != "away")
        fleet.take(*place, "calibration", fields_of(calibration(1), references=["B12"]))
        fleet.take(*place, "window", fields_of(window(1), t_utc_ns=t_utc_ns))
        fleet.take(*place, "status", fields_of(status(1, *reasons.get(gateway, ("VALID", "8 windows")))))
    fleet.take("site", "drifts", "mems", "drift", verdict())
    fleet.set_alive("site", "away", False)
    fleet.set_doubled({"site/doubled": ("a", "b")}, {})
    for k in range(10):
        now.ns += 100 * SECOND_NS
        for gateway in windows_utc_ns.keys() - ({"silent"} if k > 2 else set()):
            fleet.take("site", gateway, "mems", "clock", {"t_utc_ns": now.ns})
        fleet.look()
    own = "site", "own", "mems"
    assert fleet.beside(own, since_utc_ns) == {"count": 3, "changed": 2}  # steady, held, drifts
    assert fleet.beside(own, NOW_NS - 7 * DAY_NS) == {"count": 4, "changed": 2}  # early too
    assert fleet.beside(own, NOW_NS) == {"count": 0, "changed": 0}


def test_what_was_taken_down_is_not_silent_and_as_any_other_when_it_is_heard_again() -> None:
    fleet = Fleet(Clock(), retired=["site/old", "site/gw/mems"])
    places = [PLACE, ("site", "gw", "other"), ("site", "old", "mems")]
    for number, place in enumerate(places, start=1):
        fleet.take(*place, "calibration", fields_of(calibration(number)))
        fleet.take(*place, "status", fields_of(status(number)))
    assert [row["kind"] for row in fleet.rows()] == ["retired", "silent", "retired"]
    assert [(row["gateway"], row["why"], row["retired"]) for row in fleet.gateways({})] == [
        ("gw", "the gateway is not on the bus", False), ("old", "", True),
    ]  # fmt: skip
    for gateway in ("gw", "old"):
        fleet.set_alive("site", gateway, True)
    assert [row["kind"] for row in fleet.rows()] == ["sound", "sound", "sound"]
