"""`fieldcal calibrate --plain` as a user runs it: files in, S and Q out, exit statuses and messages."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.cli.simulate import write_files
from hw.virtual.bench import Bench
from hw.virtual.parameters import BenchParameters, Knocks
from hw.virtual.presets import plain
from hw.virtual.schedule import Schedule, clamped, directed
from hw.virtual.timebase import Clock

MEMBERS = {
    "sensitivity", "offset", "standard_uncertainty", "expanded_uncertainty", "covariance", "determined", "nuisances",
    "lag_s", "rate_hz", "status", "reasons", "windows", "statistics", "version",
}  # fmt: skip


def files(directory: Path, parameters: BenchParameters, seconds: float | None = None) -> Bench:
    bench = Bench(parameters, seed=7)
    p = bench.parameters.schedule
    write_files(bench, directory, p.duration_s(1) if seconds is None else seconds, {})
    return bench


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Bench]:
    directory = tmp_path_factory.mktemp("plain")
    return directory, files(directory, plain(7))


def arguments(directory: Path, *more: str, reference: bool = True) -> list[str]:
    names = ["sensor", "reference", "poses"] if reference else ["sensor", "poses"]
    return ["calibrate", *(part for n in names for part in (f"--{n}", str(directory / f"{n}.csv"))), "--plain", *more]


def run(capsys: pytest.CaptureFixture[str], *args: str) -> tuple[int, dict[str, Any], str]:
    status = run_cli([*args, "--json", "-"])
    captured = capsys.readouterr()
    return status, json.loads(captured.out) if captured.out else {}, captured.err


def errors(found: dict[str, Any], bench: Bench) -> tuple[float, float]:
    """Largest error of S in % of the nominal sensitivity, of Q in m/s2."""
    nominal = bench.parameters.sensor.nominal_sensitivity
    dS = np.abs(np.array(found["sensitivity"], dtype=float) - bench.truth.sensitivity).max() / nominal
    dQ = np.abs(np.array(found["offset"], dtype=float) - bench.truth.offset).max() / nominal
    return 100 * dS, dQ


@pytest.mark.slow
def test_plain_bench_is_found(recorded: tuple[Path, Bench], capsys: pytest.CaptureFixture[str]) -> None:
    directory, bench = recorded
    status, found, said = run(capsys, *arguments(directory))
    assert (status, found["status"], found["reasons"], said) == (0, "valid", [], "")
    dS, dQ = errors(found, bench)
    assert dS < 0.02  # 7 u of white noise; a clock half a millisecond off would stand at 0.1
    assert dQ < 0.003
    assert set(found) >= MEMBERS
    assert found["rate_hz"] == pytest.approx(1003.3, abs=0.05)
    assert np.array(found["covariance"]).shape == (12, 12)
    assert np.array(found["determined"]["sensitivity"]).all()
    u, expanded = found["standard_uncertainty"], found["expanded_uncertainty"]
    np.testing.assert_allclose(np.diag(found["covariance"]) ** 0.5, np.ravel(u["sensitivity"]).tolist() + u["offset"])
    np.testing.assert_allclose(expanded["sensitivity"], expanded["coverage_factor"] * np.array(u["sensitivity"]))
    for window in found["windows"]:
        assert set(window) >= {"start_s", "stop_s", "used", "reason", "points", "left_out"}
        assert window["used"]
        assert window["left_out"] == 0
    # Nothing is lost at the ends but the guard of 0.1 s (where the motion is not just fading).
    begun_s = np.array([w["start_s"] for w in found["windows"]]) - [p.start_s for p in bench.poses]
    assert np.sum(np.abs(begun_s - 0.1) < 0.0025) >= 3
    assert [w["position"] for w in found["windows"]] == [f"theta 35 deg, alpha {a} deg" for a in (0, 30, 120, 210)]


def test_the_table_for_people(recorded: tuple[Path, Bench], capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(arguments(recorded[0])) == 0
    out = capsys.readouterr().out
    assert "type A, white" in out
    assert "theta 35 deg, alpha 120 deg" in out
    assert " ± " in out


@pytest.mark.slow
def test_a_velocity_reference_is_differentiated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    p = plain(7)
    bench = files(
        tmp_path, replace(p, reference=replace(p.reference, quantity="velocity", noise=1e-5, resolution=1e-8))
    )
    status, found, _ = run(capsys, *arguments(tmp_path))
    assert status == 0
    assert errors(found, bench)[0] < 0.02


@pytest.mark.slow
def test_a_tri_axial_reference_needs_no_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    p = plain(7)
    directions = [directed(d, np.array(g), 8.0) for d in np.eye(3) for g in ([0.0, 0.0, 9.80665], [0.0, -9.80665, 0.0])]
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    bench = files(
        tmp_path,
        replace(p, schedule=Schedule(tuple(directions), 0.5, 1.0), reference=replace(p.reference, rotation=turn)),
    )
    args = [a for a in arguments(tmp_path) if not a.endswith("poses.csv") and a != "--poses"]
    status, found, _ = run(capsys, *args, "--rotation", ",".join(f"{x:g}" for x in turn.ravel()))
    assert status == 0
    assert errors(found, bench)[0] < 0.1  # the turnings between positions are in it, at 1 % of the points
    assert errors(found, bench)[1] < 0.02


def test_directions_without_gravity_leave_the_offset_open(
    recorded: tuple[Path, Bench], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory, bench = recorded
    rows = ["start_s,stop_s,dx,dy,dz"]
    rows += [f"{i.start_s},{i.stop_s},{','.join(f'{x:.9f}' for x in i.direction)}" for i in bench.poses]
    (tmp_path / "poses.csv").write_text("\n".join(rows) + "\n")
    for name in ("sensor", "reference"):
        (tmp_path / f"{name}.csv").symlink_to(directory / f"{name}.csv")
    status, found, _ = run(capsys, *arguments(tmp_path))
    assert status == 0
    assert found["offset"] == [None] * 3
    assert found["determined"]["offset"] == [False] * 3
    assert all(x is None for row in found["covariance"][9:] for x in row)
    S = np.array(found["sensitivity"], dtype=float)
    assert np.abs(S - bench.truth.sensitivity).max() / bench.parameters.sensor.nominal_sensitivity < 3e-4


def test_one_axis_gives_one_column(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    p = plain(7)
    still = directed(np.array([1, 0, 0]), np.array([0, 0, 9.8]), 8.0)
    bench = files(tmp_path, replace(p, schedule=Schedule((still,), 1.0, 1.0)))
    (tmp_path / "poses.csv").write_text("start_s,stop_s,axis\n1,9,x\n")
    status, found, _ = run(capsys, *arguments(tmp_path))
    assert status == 0
    S = np.array(found["sensitivity"], dtype=float)
    assert np.isnan(S[:, 1:]).all()
    np.testing.assert_allclose(S[:, 0], bench.truth.sensitivity[:, 0], atol=3e-4 * 26_000)


@pytest.mark.slow
def test_knocks_stay_in_with_plain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench = files(tmp_path, replace(plain(7), knocks=Knocks(rate_hz=0.5)))
    status, found, _ = run(capsys, *arguments(tmp_path))
    assert status == 0
    assert sum(w["left_out"] for w in found["windows"]) == 0
    assert errors(found, bench)[0] > 0.05


def test_two_alphas_are_refused_with_their_rank(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    schedule = Schedule(tuple(clamped(35.0, a, 5.0) for a in (0.0, 90.0)), 1.0, 1.0)
    files(tmp_path, replace(plain(7), schedule=schedule))
    status, found, said = run(capsys, *arguments(tmp_path))
    assert (status, found["status"]) == (3, "refused")
    assert "rank 3 of 4" in found["reasons"][0]
    assert "rank 3 of 4" in said
    assert found["sensitivity"] == [[None] * 3] * 3


def test_a_dead_reference_is_refused(
    recorded: tuple[Path, Bench], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("sensor", "poses"):
        (tmp_path / f"{name}.csv").symlink_to(recorded[0] / f"{name}.csv")
    (tmp_path / "reference.csv").write_text("time_s,a\n" + "".join(f"{k / 100:.2f},0.013\n" for k in range(6000)))
    status, found, _ = run(capsys, *arguments(tmp_path))
    assert status == 3
    (reason,) = found["reasons"]
    assert reason.startswith(
        "none of the 4 windows can be used; the longest of them (theta 35 deg, alpha 0 deg): the reference is silent"
    )
    assert all("silent" in w["reason"] for w in found["windows"])


def rounded(path: Path, step_s: float, share: float) -> None:
    """The stamps of a share of the rows rounded."""
    random, (head, *rows) = np.random.default_rng(1), path.read_text().splitlines()
    parts = [row.split(",", 1) for row in rows]
    stamps = np.array([float(stamp) for stamp, _ in parts])
    some = random.random(len(stamps)) < share
    stamps[some] = np.round(stamps[some] / step_s) * step_s
    path.write_text("\n".join([head, *(f"{t:.6f},{p[1]}" for t, p in zip(stamps, parts, strict=True))]) + "\n")


@pytest.mark.one_case
@pytest.mark.parametrize("rate_hz", [50.0, 125.0, 200.0, 1000.0])
def test_stamps_of_which_some_are_rounded(rate_hz: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    p = plain(7)
    stands = tuple(clamped(35.0, alpha, 25.0) for alpha in (0.0, 30.0, 120.0, 210.0))
    sensor = replace(p.sensor, clock=Clock(rate_hz, rate_error=3e-6, offset_s=0.49e-3), bursts=None)
    bench = files(tmp_path, replace(p, sensor=sensor, schedule=Schedule(stands, 3.0, 3.0)))
    exact = (tmp_path / "sensor.csv").read_bytes()
    for step_s, share in ((0.5e-3, 0.02), (1e-3, 0.005), (1e-3, 0.3)):
        (tmp_path / "sensor.csv").write_bytes(exact)
        rounded(tmp_path / "sensor.csv", step_s, share)
        status, found, said = run(capsys, *arguments(tmp_path))
        assert (status, said) == (0, "")
        assert errors(found, bench)[0] < 0.01, (step_s, share)  # u of white noise is 0.007 at 50 Hz


def later(path: Path) -> None:
    head, *rows = path.read_text().splitlines()
    moved = [f"{float(t) + 1000:.6f},{rest}" for t, rest in (row.split(",", 1) for row in rows[:5000])]
    path.write_text("\n".join([head, *moved]) + "\n")


def no_number(path: Path) -> None:
    rows = path.read_text().splitlines()
    rows[4321] = rows[4321].rsplit(",", 1)[0] + ",?"
    path.write_text("\n".join(rows) + "\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "more", "message"),
    [
        (later, [], r"reference.csv from 1000\.\d+ s to 100\d\.\d+ s"),
        (no_number, [], "reference.csv, line 4322, column a: '?' is not a finite number"),
        (
            None,
            ["--reference-quantity", "velocity"],
            "reference.csv, line 1, column a: the column holds acceleration, but --reference-quantity says velocity",
        ),
        (None, ["--rotation", "1,2,3"], "'1,2,3' must be nine numbers"),
        (None, ["--rotation", "1,0,0,0,1,0,0,0,1"], "--rotation is for a tri-axial --reference"),
        (None, ["--u-angle-deg", "nan"], "'--u-angle-deg': 'nan' is not a finite number"),
        (None, ["--u-offset-mps2", "inf"], "'--u-offset-mps2': 'inf' is not a finite number"),
        (None, ["--nominal", "nan", "--u-nominal-pct", "5"], "'--nominal': 'nan' is not a finite number"),
        (None, ["--nominal", "1"], "--nominal and --u-nominal-pct must be given together"),
        (None, ["--u-angle-deg", "-1"], "--u-angle-deg"),
        (None, ["--prior", "x.json", "--nominal", "1", "--u-nominal-pct", "2"], "give --nominal or --prior, not both"),
    ],
)
def test_bad_input_is_one_clear_line_and_status_2(
    recorded: tuple[Path, Bench],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    spoil: Callable[[Path], None] | None,
    more: list[str],
    message: str,
) -> None:
    for name in ("sensor", "reference", "poses"):
        (tmp_path / f"{name}.csv").write_bytes((recorded[0] / f"{name}.csv").read_bytes())
    if spoil is not None:
        spoil(tmp_path / "reference.csv")
    status = run_cli(arguments(tmp_path, *more))
    captured = capsys.readouterr()
    assert status == 2
    assert captured.out == ""
    assert "Traceback" not in captured.err
    import re

    assert re.search(message.replace("?", r"\?"), captured.err), captured.err


def test_poses_that_nobody_recorded_are_told(
    recorded: tuple[Path, Bench], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("sensor", "reference"):
        (tmp_path / f"{name}.csv").symlink_to(recorded[0] / f"{name}.csv")
    poses = (recorded[0] / "poses.csv").read_text()
    (tmp_path / "poses.csv").write_text(poses + "5000,5010,35,300\n")
    status, found, _ = run(capsys, *arguments(tmp_path))
    assert status == 0
    assert found["windows"][-1]["reason"] == "no samples of the sensor, or none of the reference, in this pose"
    (tmp_path / "poses.csv").write_text(poses.splitlines()[0] + "\n5000,5010,35,300\n")
    status, _, said = run(capsys, *arguments(tmp_path))
    assert status == 2
    assert "do not overlap in time" in said


@pytest.mark.slow
def test_plain_too_is_refused_where_what_was_known_contradicts_it(
    recorded: tuple[Path, Bench], capsys: pytest.CaptureFixture[str]
) -> None:
    nominal = recorded[1].parameters.sensor.nominal_sensitivity
    twice = ["--nominal", str(2 * nominal), "--u-nominal-pct", "10"]
    status, found, _ = run(capsys, *arguments(recorded[0], *twice))
    assert (status, found["sensitivity"]) == (3, [[None] * 3] * 3)
    assert found["reasons"][0].startswith("Sxx is ")
    status, _, _ = run(capsys, *arguments(recorded[0], "--nominal", str(nominal), "--u-nominal-pct", "10"))
    assert status == 0


@pytest.mark.parametrize("g", [1.0, 981.0])
def test_gravity_in_another_unit_is_bad_input(
    g: float, recorded: tuple[Path, Bench], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sensor.csv").symlink_to(recorded[0] / "sensor.csv")
    (tmp_path / "poses.csv").write_text(f"start_s,stop_s,gx,gy,gz\n0,5,0,0,{-g}\n")
    status, _, said = run(capsys, *arguments(tmp_path, reference=False))
    assert status == 2
    assert f"poses.csv, line 2: gx,gy,gz (0, 0, {-g:g}) has length {g:g} m/s2" in said
