"""`fieldcal fleet watch`: files of hourly results, whatever is in them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner, Result

from agent.cli.fleet import fleet
from agent.core.events import RunStart, SelfTestReport, Tick, WatchReport
from agent.recording.writer import Recorder
from agent.site_watch.day_sum import days_of
from agent.site_watch.files import from_files
from agent.site_watch.hour import TWICE
from tests.unit.mounted_site import site_config

HOUR_NS = 3_600_000_000_000
FIRST_H = 24 * 20_000
BANDS_HZ = [1.0, 1.259, 1.585, 1.995]
DAYS, CHANGED = 40, 28
SENSORS = [("north", "a"), ("north", "b"), ("middle", "c"), ("middle", "d"), ("south", "e"), ("south", "f")]


def lines() -> list[dict[str, Any]]:
    """Six sensors of three gateways; from day CHANGED on, z of sensor c indicates 3 % less."""
    random, made = np.random.default_rng(1), []
    shape = random.normal(0.0, 0.3, (len(SENSORS), 3, 4))
    for hour in range(24 * DAYS):
        level, degc = random.normal(0.0, 0.3, (3, 4)), 10.0 + 5.0 * np.sin(hour / 200.0)
        for i, (gateway, sensor) in enumerate(SENSORS):
            a = shape[i] + level + random.normal(0.0, 0.01, (3, 4))
            rho = 0.2 + random.normal(0.0, 0.01, (3, 4))
            if i == 2 and hour >= 24 * CHANGED:
                a[2] += np.log(0.97)
            cross = rho * np.exp(a[[0, 0, 1]] + a[[1, 2, 2]])
            made.append({
                "gateway": gateway, "sensor": sensor, "hour_utc_ns": (FIRST_H + hour) * HOUR_NS, "duration_s": 3600.0,
                "samples": 360_000, "sequence": hour, "noise_psd": [1e-6] * 3, "band_hz": BANDS_HZ,
                "band_power": (np.exp(2.0 * a) + 1e-6).ravel().tolist(), "cross_power": cross.ravel().tolist(),
                "temperature_degc": float(degc), "calibration_run_id": "run", "calibration_sequence": 3,
                "u_main_pct": [0.2] * 3,
            })  # fmt: skip
    return made


def z_scaled(row: dict[str, Any], factor: float) -> None:
    """Another sensitivity of z: its power, and the cross powers xz and yz."""
    row["band_power"] = [*row["band_power"][:8], *(value * factor**2 for value in row["band_power"][8:])]
    row["cross_power"] = [*row["cross_power"][:4], *(value * factor for value in row["cross_power"][4:])]


@pytest.fixture(scope="module")
def clean() -> list[dict[str, Any]]:
    return lines()


def run(directory: Path, rows: list[Any], *options: str) -> Result:
    file = directory / "hours.jsonl"
    file.write_text("\n".join(row if isinstance(row, str) else json.dumps(row) for row in rows) + "\n")
    return CliRunner().invoke(fleet, ["watch", str(file), *options], standalone_mode=False)


@pytest.mark.thorough
def test_the_sensor_is_named_and_hostile_lines_change_nothing(tmp_path: Path, clean: list[dict[str, Any]]) -> None:
    told = run(tmp_path, clean, "--json", "-")
    assert told.exception is None
    assert told.return_value == 3
    found = json.loads(told.stdout)
    changed = [one for one in found["sensors"] if one["verdict"] != "none"]
    assert [(one["gateway"], one["sensor"], one["verdict"], one["what"]) for one in changed] == [
        ("middle", "c", "sensitivity", "sensitivity of z")
    ]
    assert abs(changed[0]["size"] + 3.0) < changed[0]["expanded_uncertainty"] + 0.05 < 1.0
    assert changed[0]["earliest"] <= "2024-11-01" <= changed[0]["latest"]  # day 20,028
    assert found["visit_order"][0] == "middle/c"
    assert found["left_out"] == {}

    hostile: list[Any] = [dict(row) for row in clean]
    np.random.default_rng(2).shuffle(hostile)  # type: ignore[arg-type]
    first = clean[0]
    hostile[100:100] = [
        "no JSON", "[1, 2]", '{"sensor": 3}', '{"a":' * 5000, "\x00\xff",
        {**first, "hour_utc_ns": first["hour_utc_ns"] + 1},  # a clock that jumps
        {**first, "hour_utc_ns": 10 * HOUR_NS},
        {**first, "band_power": first["band_power"][:5]},
        {**first, "band_hz": [1.0, 1.1, 1.2, 1.3]},
        {**first, "band_hz": [1.0, 1.0, 1.259, 1.585]},
        {**first, "band_power": [1e300] * 12},
        {**first, "temperature_degc": 1e9},
        {**first, "duration_s": 60.0},
        {**first, "stuck": 300_000},
        {**first, "sequence": -1, "band_power": [5.0] * 12},  # an older result for the same hour
    ]  # fmt: skip
    again = run(tmp_path, hostile, "--json", "-")
    assert again.exception is None
    after = json.loads(again.stdout)
    assert sum(after["left_out"].values()) == 15
    assert after["left_out"][TWICE] == 1, "all others are refused by themselves"
    assert after["lines"] == len(hostile)
    by_name = {one["sensor"]: one for one in after["sensors"]}
    for one in found["sensors"]:
        other = by_name[one["sensor"]]
        assert (other["verdict"], other["since"]) == (one["verdict"], one["since"])
        assert np.allclose(other["least_detectable_pct"], one["least_detectable_pct"], rtol=1e-9)


@pytest.mark.thorough
def test_of_two_sensors_both_are_suspected(tmp_path: Path, clean: list[dict[str, Any]]) -> None:
    """z of sensor c indicates 6 % less; U of both must hold it, since nobody knows which one has changed."""
    two = [dict(row) for row in clean if row["sensor"] in "cd"]
    for row in two:
        if row["sensor"] == "c" and row["sequence"] >= 24 * CHANGED:
            z_scaled(row, 0.97)
    found = json.loads(run(tmp_path, two, "--json", "-").stdout)
    c, d = found["sensors"]
    assert {one["verdict"] for one in (c, d)} == {"one of two"}
    assert abs(c["size"] + 5.9) < c["expanded_uncertainty"] < 3.0
    assert [one["suspected"]["size"] for one in (c, d)] == pytest.approx([-0.059, 0.063], abs=0.015)
    assert c["suspected"]["one_of_two"]
    assert c["suspected"]["text"].startswith("sensitivity of z has fallen by ")
    assert "or that of the other of two sensors against it: which one is not seen" in d["suspected"]["text"]
    assert "Of two sensors that differ it is not seen which one changed, unless a witness says so." in found["not_seen"]
    assert found["site"]["verdict"] == "none"


@pytest.mark.slow
def test_a_gateway_whose_clock_is_an_hour_off_is_named(tmp_path: Path, clean: list[dict[str, Any]]) -> None:
    few = [dict(row) for row in clean if row["sequence"] < 24 * 5]
    for row in few:
        row["hour_utc_ns"] += HOUR_NS if row["gateway"] == "north" else 0
    told = run(tmp_path, few, "--json", "-")
    assert told.return_value == 3
    found = json.loads(told.stdout)["sensors"]
    assert {one["sensor"]: one["verdict"] for one in found} == dict.fromkeys("ab", "clock") | dict.fromkeys(
        "cdef", "learning"
    )
    late = [one for one in found if one["verdict"] == "clock"]
    assert {one["what"] for one in late} == {"its hours come 1 h late against those of the other sensors"}
    assert {(one["size"], one["since"], one["suspected"]) for one in late} == {(None, None, None)}
    assert "set the clock of its gateway" in run(tmp_path, few).output


@pytest.mark.slow
def test_nulls_other_grids_and_sensors_that_come_and_go(tmp_path: Path, clean: list[dict[str, Any]]) -> None:
    rows = [dict(row) for row in clean if row["sequence"] < 24 * CHANGED]
    rows = [row for row in rows if row["sensor"] != "f" or row["sequence"] > 24 * 20]
    for k, row in enumerate(rows):
        if row["sensor"] == "a":
            row["band_power"] = [None] * 4 + row["band_power"][4:]  # x is dead
        if k % 7 == 0:
            row["temperature_degc"] = None
        if row["sensor"] == "b":  # without the last band
            row["band_hz"] = BANDS_HZ[:3]
            for name in ("band_power", "cross_power"):
                row[name] = np.array(row[name]).reshape(3, 4)[:, :3].ravel().tolist()
    told = run(tmp_path, rows)
    assert told.exception is None
    assert told.return_value == 0, told.output
    assert "north/a" in told.output
    assert "learning" in next(line for line in told.output.splitlines() if line.startswith("south/f"))
    assert "no sensor stands beside a reference" in told.output


@pytest.mark.thorough
def test_another_calibration_begins_the_norm_anew(tmp_path: Path, clean: list[dict[str, Any]]) -> None:
    rows = [dict(row) for row in clean]
    for row in rows:
        if row["sensor"] == "c" and row["sequence"] >= 24 * CHANGED + 9:
            row["calibration_sequence"] = 4
    told = run(tmp_path, rows)
    assert told.return_value == 0, told.output
    assert "learning" in next(line for line in told.output.splitlines() if line.startswith("middle/c"))


@pytest.mark.thorough
def test_what_users_meet(tmp_path: Path, clean: list[dict[str, Any]]) -> None:
    """From some day on at one sensor: x and y exchanged, twice the sensitivity, dead outputs; wrong units at a gateway;
    lines of another site among the others."""

    def told(change: Callable[[dict[str, Any]], object], late: bool = True) -> dict[str, Any]:
        rows = [dict(row) for row in clean]
        for row in rows:
            if row["sensor"] == "c" and row["sequence"] >= 24 * CHANGED:  # as if it had not changed
                z_scaled(row, 1.0 / 0.97)
            if not late or row["sequence"] >= 24 * CHANGED:
                change(row)
        found: dict[str, Any] = json.loads(run(tmp_path, rows, "--json", "-").stdout)
        return found

    def scaled(row: dict[str, Any], factor: float) -> None:
        for name in ("band_power", "cross_power", "noise_psd"):
            row[name] = [factor**2 * value for value in row[name]]

    def exchanged(row: dict[str, Any]) -> None:
        p, c = row["band_power"], row["cross_power"]
        if row["sensor"] == "c":
            row["band_power"], row["cross_power"] = [*p[4:8], *p[:4], *p[8:]], [*c[:4], *c[8:], *c[4:8]]

    def one(found: dict[str, Any], sensor: str = "c") -> dict[str, Any]:
        return next(each for each in found["sensors"] if each["sensor"] == sensor)

    assert one(told(exchanged))["verdict"] == "sensor or structure"
    doubled = one(told(lambda row: scaled(row, 2.0) if row["sensor"] == "c" else None))
    assert (doubled["verdict"], doubled["what"]) == ("sensitivity", "sensitivity of x, y and z")
    assert doubled["size"] == pytest.approx(100.0, abs=1.0), "in %, not its logarithm"
    assert one(told(lambda _: None))["verdict"] == "none"
    dead = told(lambda row: scaled(row, 0.0) if row["sensor"] == "c" else None)
    assert one(dead)["last_day"] == "2024-10-31"
    assert any("for 3 days or more by middle/c: silent, dead" in line for line in dead["not_seen"])
    units = told(lambda row: scaled(row, 9.80665) if row["gateway"] == "north" else None)
    north = units["gateways"]["north"]
    assert north["size"] == pytest.approx(880.7, abs=north["expanded_uncertainty"])
    mixed = told(lambda row: row.update(site="castle" if row["sensor"] == "f" else "bridge"), late=False)
    assert list(mixed["left_out"]) == ["of another site than the first line that names one; give the files of one site"]
    assert [each["sensor"] for each in mixed["sensors"]] == list("abcde")


@pytest.mark.thorough
def test_a_visit_says_what_it_found_where_the_calibrations_are_told(
    tmp_path: Path, clean: list[dict[str, Any]]
) -> None:
    """The visit finds what was suspected: z is 3 % less. The corrected values are then as before."""
    visited, rows = 24 * (CHANGED + 8), [dict(row) for row in clean]
    for row in rows:
        if row["sensor"] == "c" and row["sequence"] >= visited:
            row["calibration_sequence"] = 4
            z_scaled(row, 1.0 / 0.97)
    made: list[dict[str, Any]]
    made = [{"key": f"fieldcal/v1/bridge/middle/c/{what}", "sensor": "c", "run_id": "run", "sequence": sequence,
             "sensitivity": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, zz]]}
            for what, sequence, zz in (("calibration", 3, 2.0), ("calibration", 4, 1.94))]  # fmt: skip
    told = json.loads(run(tmp_path, [*made, *rows], "--json", "-").stdout)
    assert told["lines"] == len(rows)
    [visit] = told["visits"]
    assert (visit["sensor"], visit["date"], visit["suspicion"]) == ("middle/c", "2024-11-09", "confirmed")
    assert visit["found_pct"] == pytest.approx(-3.0, abs=1e-4)
    assert visit["suspected_pct"] == pytest.approx(-3.0, abs=1.0)
    assert told["common"]["size"] == pytest.approx(0.0, abs=told["common"]["expanded_uncertainty"])
    [c] = [one for one in told["sensors"] if one["sensor"] == "c"]
    assert (c["verdict"], c["suspected"]) == ("learning", None)
    made[1]["sensitivity"][2] = [0.0, 0.0, 2.0]
    refuted = json.loads(run(tmp_path, [*made, *rows], "--json", "-").stdout)
    assert [one["suspicion"] for one in refuted["visits"]] == ["refuted"]
    assert refuted["sensors"][5]["least_detectable_pct"][0] > 1.2 * told["sensors"][5]["least_detectable_pct"][0]


def self_test(row: dict[str, Any], sequence: int) -> SelfTestReport:
    """A self-test in the middle of the hour of a row; x fails, and y changes with the day."""
    y = 5.0 + 0.01 * (row["hour_utc_ns"] // (24 * HOUR_NS) % 7)
    return SelfTestReport(
        run_id="run", sequence=sequence, sensor=row["sensor"], t_utc_ns=row["hour_utc_ns"] + HOUR_NS // 2, reason="",
        response_mps2=[float("nan"), -y, 12.0], u_response_mps2=[float("nan"), 0.005, 0.012], u_supply_pct=[2.0] * 3,
        pairs=6, motion_mps2=[0.03] * 3, temperature_degc=row["temperature_degc"], faults=[],
    )  # fmt: skip


def test_self_tests_of_a_day(tmp_path: Path, clean: list[dict[str, Any]]) -> None:
    few = [row for row in clean if row["sequence"] < 48]
    night = [row for row in few if row["sequence"] == 27 and row["sensor"] in "ad"]
    tests = [as_line(self_test(row, 300), row["gateway"]) for row in night]
    tests[1]["temperature_degc"] = None
    earlier = tests[0] | {"sequence": 299, "response_mps2": [1.0] * 3}
    wrong: list[dict[str, Any]] = [{"response_mps2": one} for one in ([], [1e9, 0.0, None])]
    wrong.append({"temperature_degc": 1e3})
    hostile = [tests[1] | {"sequence": 301 + k, "sensor": "b", "gateway": "north"} | one for k, one in enumerate(wrong)]
    file = tmp_path / "hours.jsonl"
    file.write_text("\n".join(map(json.dumps, [*tests, *few, earlier, *hostile])))
    source = from_files([file])
    assert (source.lines, source.left_out) == (len(few), {})
    none, told = source.sums()
    assert none.self_test == b""
    at = [told.sensors.index(i) for i, who in zip(source.numbers, source.sensors, strict=True) if who[1] in "ad"]
    response = told.array("self_test")
    assert np.flatnonzero(np.isfinite(response).any(axis=1)).tolist() == sorted(at)
    y = 5.0 + 0.01 * (20_001 % 7)
    assert response[at[0]] == pytest.approx([np.nan, np.log(y), np.log(12.0)], nan_ok=True)
    assert told.array("self_test_u")[at[0]] == pytest.approx([np.nan, 0.005 / y, 0.001], nan_ok=True)
    assert told.array("self_test_supply")[at[0]] == pytest.approx([0.02] * 3)
    degc = told.array("self_test_degc")[at]
    assert degc == pytest.approx([night[0]["temperature_degc"], np.nan], nan_ok=True)
    *_, day = days_of(source.sums(), source.numbers, source.bands)
    assert day.day.self_tests is not None
    assert np.array_equal(
        np.isfinite(day.day.self_tests.log_response[:, 1]), [who[1] in "ad" for who in source.sensors]
    )


def as_line(result: SelfTestReport, gateway: str) -> dict[str, Any]:
    """The result as a line of JSON has it."""
    return dict(msgspec.json.decode(msgspec.json.encode(result)) | {"gateway": gateway})


@pytest.mark.thorough
def test_recordings_say_the_same_as_lines(tmp_path: Path, clean: list[dict[str, Any]]) -> None:
    few = [row for row in clean if row["sequence"] < 24 * 3]
    tests = [as_line(self_test(row, row["sequence"]), row["gateway"]) for row in few if row["sequence"] % 24 == 3]
    lines_said = json.loads(run(tmp_path, few + tests, "--json", "-").stdout)
    of_lines = list(from_files([tmp_path / "hours.jsonl"]).sums())
    paths = []
    for gateway in ("north", "middle", "south"):
        recorder = Recorder(tmp_path / gateway, [], [])
        (tmp_path / gateway).mkdir()
        start = RunStart(
            run_id="run", site="bridge", gateway=gateway, boot_id="boot", t_monotonic_ns=0, t_utc_ns=FIRST_H * HOUR_NS,
            config_json=site_config().model_dump_json(), versions={}, fingerprint={}, snapshot=b"", file_sequence=1,
            event_sequence=0,
        )  # fmt: skip
        recorder.record(0, start, [])
        for number, row in enumerate((row for row in few if row["gateway"] == gateway), start=1):
            t_utc_ns = row["hour_utc_ns"] + HOUR_NS
            results = [report(row, number), *([self_test(row, number)] if row["sequence"] % 24 == 3 else [])]
            assert recorder.record(number, Tick(t_monotonic_ns=number, t_utc_ns=t_utc_ns), results)
        assert recorder.path is not None
        path = recorder.path
        recorder.close()
        paths.append(str(path).removesuffix(".active"))
    told = CliRunner().invoke(fleet, ["watch", *paths, "--json", "-"], standalone_mode=False)
    assert told.exception is None, told.output
    found = json.loads(told.stdout)
    assert found == lines_said | {"sensors": found["sensors"]}
    assert {one["sensor"] for one in found["sensors"]} == set("abcdef")
    assert [one["days"] for one in found["sensors"]] == [3] * 6
    for one, other in zip(from_files([Path(path) for path in paths]).sums(), of_lines, strict=True):
        assert np.isfinite(one.array("self_test")[:, 1]).all()
        # The response of y follows the day alone, so it is one for all sensors, in whatever order they stand.
        assert np.array_equal(one.array("self_test"), other.array("self_test"), equal_nan=True)
    torn = Path(paths[0]).read_bytes()
    Path(paths[0]).write_bytes(torn[: len(torn) // 2])
    again = CliRunner().invoke(fleet, ["watch", *paths], standalone_mode=False)
    assert "the recording ends early" in again.stderr


def report(row: dict[str, Any], sequence: int) -> WatchReport:
    """The result of a row."""
    own = {name: row[name] for name in WatchReport.__struct_fields__ if name in row}
    return WatchReport(
        **own | {"sequence": sequence}, run_id="run",
        t_utc_ns=row["hour_utc_ns"] + HOUR_NS, stuck=0, clipped=0, missing=0, segments=60, mean_mps2=[float("nan")] * 3,
        mean_scatter_mps2=[float("nan")] * 3, temperature_scatter_degc=0.1,
    )  # fmt: skip


def test_bad_files_and_options(tmp_path: Path, clean: list[dict[str, Any]]) -> None:
    told = run(tmp_path, ["", "nothing"])
    assert told.return_value == 2
    assert "no line is an hourly result" in told.stderr
    missing = CliRunner().invoke(fleet, ["watch", str(tmp_path / "absent")], standalone_mode=False)
    assert missing.return_value == 2
    assert "absent" in missing.stderr
    few = clean[: 6 * 24]
    unknown = run(tmp_path, few, "--beside-reference", "north/z")
    assert "no sensor of the files" in str(unknown.exception)
    known = run(tmp_path, few, "--beside-reference", "north/a")
    assert known.return_value == 0
    assert "learning" in known.output


@pytest.mark.slow
def test_a_reference_shows_what_all_others_share(tmp_path: Path, clean: list[dict[str, Any]]) -> None:
    rows = [dict(row) for row in clean if row["sensor"] != "c"]
    for row in rows:
        if row["sensor"] != "a" and row["sequence"] >= 24 * CHANGED:
            row["band_power"] = [1.02**2 * value for value in row["band_power"]]
            row["cross_power"] = [1.02**2 * value for value in row["cross_power"]]
    told = json.loads(run(tmp_path, rows, "--beside-reference", "north/a", "--json", "-").stdout)
    assert told["common"]["size"] == pytest.approx(2.0, abs=told["common"]["expanded_uncertainty"])
    assert told["common"]["expanded_uncertainty"] < 1.0
