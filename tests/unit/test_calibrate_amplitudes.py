"""`fieldcal calibrate --method 1|2` as a user runs it: files from the virtual bench, clocks and bursts included."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import calib
from agent.cli.main import run_cli
from agent.cli.simulate import write_files
from hw.virtual.bench import Bench
from hw.virtual.motion import multisine, sine
from hw.virtual.parameters import BenchParameters, ReferenceParameters
from hw.virtual.presets import plain
from hw.virtual.schedule import Schedule, Stand, clamped, directed

DOWN = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
ON_AXES = tuple(directed(np.eye(3)[j], DOWN[j], hold_s=4.0) for j in range(3))
ON_CLAMP = tuple(clamped(35.0, alpha, hold_s=4.0) for alpha in (45.0, 135.0))


def files(directory: Path, stands: tuple[Stand, ...], repetitions: int = 1, **changes: Any) -> Bench:
    parameters: BenchParameters = replace(
        plain(3), **{"schedule": Schedule(stands, turn_s=1.0), "motion": sine(3.0, 6.0), **changes}
    )
    bench = Bench(parameters, seed=3)
    write_files(bench, directory, parameters.schedule.duration_s(repetitions), {})
    if stands is ON_AXES:
        poses = bench.parameters.schedule.poses(parameters.schedule.duration_s(repetitions))
        rows = [f"{p.start_s},{p.stop_s},{'xyz'[k % 3]}" for k, p in enumerate(poses)]
        (directory / "poses.csv").write_text("\n".join(["start_s,stop_s,axis", *rows, ""]))
    return bench


def run(
    directory: Path, capsys: pytest.CaptureFixture[str], method: int, *more: str
) -> tuple[int, dict[str, Any], str]:
    paths = [part for n in ("sensor", "reference", "poses") for part in (f"--{n}", str(directory / f"{n}.csv"))]
    status = run_cli(["calibrate", *paths, "--method", str(method), "--json", "-", *more])
    captured = capsys.readouterr()
    return status, json.loads(captured.out) if captured.out else {}, captured.err


@pytest.mark.one_case
@pytest.mark.parametrize("quantity", ["acceleration", "velocity"])
def test_method_1_finds_all_of_s(tmp_path: Path, capsys: pytest.CaptureFixture[str], quantity: Any) -> None:
    reference = replace(plain(3).reference, quantity=quantity, noise=2e-4, resolution=1e-6)
    bench = files(tmp_path, ON_AXES, repetitions=2, reference=reference)
    status, found, said = run(tmp_path, capsys, 1)
    assert (status, found["status"], said) == (0, "valid", "")
    nominal = bench.parameters.sensor.nominal_sensitivity
    off = (np.array(found["sensitivity"]) - bench.truth.sensitivity) / nominal
    # type A is 2e-5; main ones need no more of the clocks than the rate, transverse ones half a sample's phase of 5 %
    assert np.abs(off).max() < 2e-4
    assert found["offset"] == [None] * 3
    assert found["frequency_hz"] == pytest.approx(3.0, rel=1e-4)
    assert abs(found["lag_s"]) < 1e-3
    assert len(found["windows"]) == 6
    assert [s["n"] for s in found["statistics"]["Sxx"]] == [11, 11]  # 3.8 s without the guard
    U = np.array(found["expanded_uncertainty"]["sensitivity"]) / nominal
    assert 0.002 < np.diag(U).max() < 0.003  # the reference, 0.1 %
    assert found["statistics"]["beyond_5_pct"] == {}
    transverse = found["sensitivity"][0][1] / found["sensitivity"][0][0] * 100
    assert found["statistics"]["rel_S_pct"][0][1] == pytest.approx(transverse)
    assert set(found["budget"]) >= {"type A", "reference sensitivity", "transverse motion"}


def test_method_2_finds_main_sensitivities_within_u(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench = files(tmp_path, ON_CLAMP)
    status, found, _ = run(tmp_path, capsys, 2)
    assert status == 0
    truth = bench.truth.sensitivity
    S, U = (np.array(part["sensitivity"], dtype=float) for part in (found, found["expanded_uncertainty"]))
    assert np.all(np.abs(np.diag(S - truth)) <= np.diag(U))
    assert np.isnan(S[~np.eye(3, dtype=bool)]).all()
    seen = np.diag(truth) + np.array([truth[0, 2], 0, truth[2, 0]]) * np.array(  # 45 and 135 deg leave S_xz and S_zx
        [-np.tan(np.deg2rad(35)) * np.sqrt(2), 0, -np.sqrt(0.5) / np.tan(np.deg2rad(35))]
    )
    np.testing.assert_allclose(np.diag(S), seen, rtol=1e-4)
    assert "rel_S_pct" not in found["statistics"]


@pytest.mark.thorough
def test_what_the_methods_cannot_use_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files(tmp_path, ON_CLAMP)
    status, found, said = run(tmp_path, capsys, 1)
    assert status == 3
    assert "Method 1 needs one axis along the motion" in said
    assert found["sensitivity"] == [[None] * 3] * 3
    status, found, said = run(tmp_path, capsys, 2, "--nominal", "20000", "--u-nominal-pct", "5")
    assert status == 3
    assert "Sxx is" in said
    assert "from the prior value 2e+04 (u 1e+03)" in said
    status, _, said = run(tmp_path, capsys, 2, "--plain")
    assert (status, "--plain is for Method 3 only" in said) == (2, True)

    files(tmp_path / "broad", ON_CLAMP, motion=multisine(np.random.default_rng(1), peak_mps2=6.0))
    status, _, said = run(tmp_path / "broad", capsys, 2)
    assert status == 3
    assert "the reference is no sine" in said

    files(tmp_path / "dead", ON_CLAMP, reference=ReferenceParameters(sensitivity=0.0, resolution=1e-5, noise=1e-3))
    status, _, said = run(tmp_path / "dead", capsys, 2)
    assert (status, "windows can be used" in said) == (3, True)


@pytest.mark.slow
def test_an_earlier_result_is_a_prior(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files(tmp_path, ON_AXES)
    _, earlier, _ = run(tmp_path, capsys, 1)
    prior = tmp_path / "prior.json"
    prior.write_text(json.dumps(earlier))
    assert run(tmp_path, capsys, 1, "--prior", str(prior))[0] == 0
    earlier["sensitivity"][1][1] *= 1.01  # U is 0.2 %
    prior.write_text(json.dumps(earlier))
    status, found, said = run(tmp_path, capsys, 1, "--prior", str(prior))
    assert (status, len(found["reasons"])) == (3, 1)
    assert "Syy is" in said


def test_an_axis_that_shows_much_of_another_is_refused_unless_s_was_stated() -> None:
    t = np.arange(9000) / 200.0
    a = 3.0 * np.sin(2.0 * np.pi * 3.0 * t)
    poses = [{"start_s": 15.0 * k, "stop_s": 15.0 * k + 14.0, "axis": axis} for k, axis in enumerate("xyz")]
    along = a[:, None] * np.eye(3)[np.minimum(t // 15.0, 2.0).astype(int)]
    V = along @ np.array([[1.0, 0.4, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]).T
    V += np.random.default_rng(1).normal(0.0, 1e-4, V.shape)
    (turned,) = calib.calibrate((t, V), (t, a), poses=poses, method=1).reasons
    assert turned.startswith("Sxy is 40% of the largest sensitivity of row x")
    (stated,) = calib.calibrate((t, V), (t, a), poses=poses, method=1, nominal=1.0, u_nominal_pct=1.0).reasons
    assert stated.startswith("Sxy is 0.4, ")
