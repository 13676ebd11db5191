"""`fieldcal export --corrected` of a sensor without a reference: between two visits, with the date of a step."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.core.events import CalibrationUpdate, DeviceChange
from agent.export.between_visits import BetweenVisits, between_visits
from agent.site_watch.suspicion import Suspicion
from hw.block import DeviceInfo
from tests.clamp_windows import Q_TRUE
from tests.unit.mounted_site import EPOCH_NS, SECOND
from tests.unit.recorded_bench import record_events
from tests.unit.results import calibration
from tests.unit.test_suspicion import suspicion, verdicts
from tests.unit.test_watched import PRIOR, World, watched_config

DAY_NS = 86_400 * SECOND
FIRST_NS = 1_700_000_000 // 86_400 * 86_400 * SECOND  # 2023-11-14, midnight
CHANNEL = watched_config().channels[0]
LAST_DAY = 100
DEVICE = "ADXL355 7 abc"


def visit(day: int, size: float, Q: float, u_pct: float = 0.1, **more: Any) -> CalibrationUpdate:
    u = [*([u_pct / 100.0] * 9), *([0.01] * 3)]
    told = {
        "sensitivity": (size * np.eye(3)).tolist(), "offset": [Q] * 3, "standard_uncertainty": u,
        "covariance": np.diag(np.square(u)).tolist(), "t_utc_ns": FIRST_NS + day * DAY_NS, "run_id": "run",
        "identity": DEVICE, "sequence": 10 + day, "made_run_id": "", "made_sequence": 0, "made_utc_ns": 0,
        "offset_temperature": [[0.1] * 3], "reference_temperature_degc": 20.0,
    }  # fmt: skip
    return msgspec.structs.replace(calibration(1), **told | more)


def told_step(**more: Any) -> Suspicion:
    """z of the sensor has changed on one of the days 40 to 43."""
    days = {"since": "2023-12-25", "earliest": "2023-12-24", "latest": "2023-12-27"}
    return suspicion(sensor="s", size=-0.02, **days | more)


def between(step: Suspicion | None = None, **more: Any) -> BetweenVisits:
    return between_visits(CHANNEL, [visit(0, 1.0, 0.0), visit(LAST_DAY, 0.98, 1.0, **more)], step)


def a_of(past: BetweenVisits, day: float, degc: float | None = None) -> np.ndarray:
    a, why = past.acceleration(DEVICE, np.array([[1.0, 2.0, 3.0]]), FIRST_NS + round(day * DAY_NS), degc)
    assert (a is None) == bool(why)
    assert a is not None
    return a[0]


def test_between_two_visits_s_and_q_are_on_a_line() -> None:
    past, V = between(), np.array([1.0, 2.0, 3.0])
    for day, size, Q in ((0.0, 1.0, 0.0), (25.0, 0.995, 0.25), (100.0, 0.98, 1.0), (300.0, 0.98, 1.0)):
        np.testing.assert_allclose(a_of(past, day), (V - Q) / size, rtol=1e-12)
        np.testing.assert_allclose(a_of(past, day, 25.0), (V - Q - 0.5) / size, rtol=1e-12)
    a, why = past.acceleration(DEVICE, np.zeros((1, 3)), FIRST_NS - 1, None)
    assert (a, why) == (None, "they are before the first calibration (2023-11-14T00:00:00Z)")
    a, why = past.acceleration("ADXL355 8 abc", np.zeros((1, 3)), FIRST_NS + 1, None)
    assert a is None
    assert "is of ADXL355 7 abc, they of ADXL355 8 abc" in why
    a, why = between(sensitivity=np.zeros((3, 3)).tolist()).acceleration(DEVICE, np.zeros((1, 3)), 2 * FIRST_NS, None)
    assert (a, why) == (None, "S has no inverse")


@pytest.mark.parametrize(
    ("axes", "turn", "columns"), [("z", False, [2]), ("xyz", False, [0, 1, 2]), ("z", True, [0, 1])]
)
def test_a_step_that_the_site_has_told_comes_at_its_date(axes: str, turn: bool, columns: list[int]) -> None:
    """S row by row: 0.9 becomes 1.1 in all places, so that each column is seen by itself."""
    ends = [np.full((3, 3), value) + np.eye(3) for value in (0.9, 1.1)]
    past = BetweenVisits(
        CHANNEL,
        [visit(day, 1.0, 0.0, sensitivity=S.tolist()) for day, S in zip((0, LAST_DAY), ends, strict=True)],
        told_step(axes=axes, turn=turn),
    )
    for day, came in ((39.9, 0.0), (41.0, 0.25), (42.0, 0.5), (44.0, 1.0), (99.9, 1.0)):
        S = ends[0] + 0.2 * day / LAST_DAY
        S[:, columns] = ends[0][:, columns] + 0.2 * came
        np.testing.assert_allclose(a_of(past, day), np.linalg.solve(S, [1.0, 2.0, 3.0]), rtol=1e-9)


def test_a_step_before_or_after_both_visits_moves_nothing() -> None:
    for dates in (("2023-11-01", "2023-11-13"), ("2024-03-01", "2024-03-05")):
        step = told_step(since=dates[0], earliest=dates[0], latest=dates[1])
        assert a_of(between(step), 25.0) == pytest.approx(a_of(between(), 25.0), rel=1e-14)
        assert all("on a line" in text for name, text in between(step).head.items() if name.startswith("between"))


def test_u_holds_visits_walk_and_the_date_of_the_step() -> None:
    def u(past: BetweenVisits, day: float) -> np.ndarray:
        return past.standard_uncertainty(FIRST_NS + round(day * DAY_NS))

    line, stepped = between(u_pct=0.3), between(told_step(), u_pct=0.3)
    walk = 1e-3 * np.sqrt(50.0 * 50.0 / 100.0)  # of S, in the middle; test_watched.WALK a day
    assert u(line, 0.0)[0] == pytest.approx(1e-3)
    assert u(line, 50.0)[0] == pytest.approx(np.sqrt(0.5 * 1e-6 + 0.5 * 9e-6 + walk**2))
    assert u(line, 100.0)[0] == pytest.approx(3e-3)
    assert u(line, 150.0)[0] == pytest.approx(np.hypot(3e-3, 0.98 * 1e-3 * np.sqrt(50.0)))
    assert u(stepped, 42.0)[8] ** 2 - u(line, 42.0)[8] ** 2 == pytest.approx(0.25 * 0.02**2 + 0.08 * 8e-6, rel=1e-6)
    assert u(stepped, 30.0)[8] < u(line, 30.0)[8]
    assert u(stepped, 42.0)[0] == u(line, 42.0)[0]


def test_the_line_holds_the_truth_in_95_percent() -> None:
    """5,000 walks of S seen at both ends with errors that are half shared: U in the middle holds 95 % at least (99.9 %
    lower bound of a binomial), and is not twice too wide (it would hold 99.99 %)."""
    random, n = np.random.default_rng(2), 5000
    walk = 1e-3 * np.sqrt(np.array([50.0, 50.0]))
    steps = random.normal(0.0, 1.0, (n, 2)) * walk
    shared = random.normal(0.0, 1e-3 * np.sqrt(0.5), n)
    first, last = (shared + random.normal(0.0, 1e-3 * np.sqrt(0.5), n) for _ in range(2))
    middle = 1.0 + steps[:, 0]
    told = 0.5 * (1.0 + first) + 0.5 * (1.0 + steps.sum(axis=1) + last)
    past = between_visits(CHANNEL, [visit(0, 1.0, 0.0), visit(LAST_DAY, 1.0, 0.0)], None)
    U = 2.0 * past.standard_uncertainty(FIRST_NS + 50 * DAY_NS)[0]
    inside = np.mean(np.abs(told - middle) <= U)
    assert 0.95 - 3.1 * np.sqrt(0.05 * 0.95 / n) <= inside < 0.999


def test_of_results_that_tell_a_calibration_again_the_first_is_used() -> None:
    first = visit(0, 1.0, 0.0)
    grown = visit(30, 1.0, 0.0, u_pct=1.0, made_run_id="run", made_sequence=10, made_utc_ns=FIRST_NS)
    past = between_visits(CHANNEL, [grown, visit(LAST_DAY, 0.98, 1.0), first, grown], None)
    assert [one.t_utc_ns for one in past.calibrations] == [FIRST_NS, FIRST_NS + LAST_DAY * DAY_NS]
    told = past.head
    assert told["calibration of 2023-11-14T00:00:00Z"] == "number 10 of run run, U 0.2 %, 0.2 %, 0.2 %"
    assert told["between 2023-11-14T00:00:00Z and 2024-02-22T00:00:00Z"].startswith("on a line, U 1")


@pytest.mark.slow
def test_the_export_of_a_watched_sensor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two configurations state the calibrations of two visits; the data directory has both."""
    S = np.array(PRIOR["sensitivity"]).reshape(3, 3)
    later = {**PRIOR, "sensitivity": (0.98 * S).ravel().tolist(), "calibrated": "2026-09-25"}
    world = World()
    blocks = [world.block() for _ in range(6)]
    for name, prior, hour in (("first", PRIOR, 0), ("second", later, 1)):  # one gateway, which lost its store
        config, begun_ns = watched_config(prior=prior), EPOCH_NS + hour * 3600 * SECOND
        record_events(tmp_path / name, config, [opening(), *blocks], name, begun_ns=begun_ns)
    recordings = sorted(str(path) for path in tmp_path.glob("*/*.mcap"))
    day = EPOCH_NS // DAY_NS * DAY_NS
    assert 1_788_220_800 * SECOND < day < 1_790_294_400 * SECOND, "between both visits"
    to = tmp_path / "a.csv"
    assert run_cli(["export", "--corrected", *recordings, "-o", str(to)]) == 0
    text = to.read_text()
    assert "# between 2026-09-01T00:00:00Z and 2026-09-25T00:00:00Z: on a line, U " in text
    rows = np.genfromtxt([line for line in text.splitlines() if not line.startswith("#")], delimiter=",", names=True)
    w = (rows["time_s"][0] * SECOND - 1_788_220_800 * SECOND) / (24 * DAY_NS)
    V = np.column_stack([rows[name] for name in ("vx", "vy", "vz")])
    wanted = np.linalg.solve((1.0 - 0.02 * w) * S, (V - (1.0 - 0.02 * w) * Q_TRUE).T).T
    got = np.column_stack([rows[name] for name in ("ax", "ay", "az")])
    np.testing.assert_allclose(got[:50], wanted[:50], rtol=1e-4, atol=1e-3)
    stepped = tmp_path / "b.csv"
    dates = {"since": "2026-09-12", "earliest": "2026-09-10", "latest": "2026-09-13"}
    told = verdicts(tmp_path / "verdicts.json", suspicion(sensor="s", gateway="gateway", axes="xyz", **dates))
    asked = ["export", "--corrected", *recordings, "-o", str(stepped), "--site-verdicts", str(told)]
    assert run_cli(asked) == 0
    assert (
        "a step of the sensitivity of xyz between 2026-09-10 and 2026-09-13, the rest on a line" in stepped.read_text()
    )
    capsys.readouterr()
    alone = [
        "export",
        "--corrected",
        recordings[0],
        "-o",
        str(tmp_path / "c.csv"),
        "--data-dir",
        str(tmp_path / "second"),
    ]
    assert run_cli(alone) == 0
    assert "# between 2026-09-01" in (tmp_path / "c.csv").read_text()


def opening() -> DeviceChange:
    info = json.dumps(asdict(DeviceInfo("serial-csv", "serial-csv", "A", "m/s2", 3, 10.0)))
    return DeviceChange(device="s", state="open", t_monotonic_ns=0, t_utc_ns=EPOCH_NS, info_json=info)
