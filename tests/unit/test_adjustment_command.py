"""`fieldcal calibrate` on files: the adjustment, the norm fit, an AC corner, refusals and exit statuses."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from agent.cli.calibrate import calibrate
from hw.virtual.bench import Bench, BenchRecording
from hw.virtual.motion import multisine
from hw.virtual.parameters import BenchParameters, ReferenceParameters, SensorParameters
from hw.virtual.schedule import Schedule, clamped
from hw.virtual.spread import Spread, drawn
from tests.clamp_windows import Q_TRUE, S_TRUE

SPREAD = Spread(angle_deg=0.2, theta_deg=0.2, offset_mps2=0.05)
STATED = [
    "--u-alpha-common-deg",
    "0",
    "--u-transverse-motion-pct",
    "0",
    "--u-reference-pct",
    "0",
    "--u-gravity-mps2",
    "0",
]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of an ordinary session: four alphas, twice, with a lag of 5 ms, angles and offsets drawn from SPREAD."""
    folder = tmp_path_factory.mktemp("session")
    stands = tuple(clamped(35.0, alpha, 4.0) for alpha in (0.0, 30.0, 120.0, 210.0))
    sensor = SensorParameters(sensitivity=S_TRUE, offset=Q_TRUE, noise_mps2=0.02, lag_s=(0.005,) * 3)
    parameters = BenchParameters(schedule=Schedule(stands, turn_s=1.0), sensor=sensor)
    parameters = drawn(parameters, SPREAD, np.random.default_rng(41))
    _files(folder, Bench(parameters, 41).recording(parameters.schedule.duration_s(2)))
    return folder


def _files(folder: Path, recording: BenchRecording) -> None:
    _write(folder / "sensor.csv", "time_s,vx,vy,vz", recording.sensor_stamp_s, recording.v)
    _write(folder / "reference.csv", "time_s,a", recording.reference_stamp_s, recording.reference)
    lines = [f"{p.start_s},{p.stop_s},{p.theta_deg},{p.alpha_deg}" for p in recording.poses]
    (folder / "poses.csv").write_text("\n".join(["start_s,stop_s,theta_deg,alpha_deg", *lines]) + "\n")


def _write(path: Path, header: str, stamps: np.ndarray, values: np.ndarray) -> None:
    np.savetxt(path, np.column_stack([stamps, values]), delimiter=",", header=header, comments="", fmt="%.7f")


def _run(folder: Path, *options: str) -> Result:
    files = ["--sensor", str(folder / "sensor.csv"), "--reference", str(folder / "reference.csv")]
    return CliRunner().invoke(
        calibrate, [*files, "--poses", str(folder / "poses.csv"), *options], standalone_mode=False
    )


@pytest.fixture(scope="module")
def table(session: Path) -> str:
    """The lines of the command without options."""
    return _run(session).stdout


@pytest.fixture(scope="module")
def plain(session: Path) -> Result:
    """The command with what is stated, and nothing else."""
    return _run(session, *STATED, "--json", "-")


def _told(result: Result) -> dict:  # type: ignore[type-arg]
    assert result.exception is None, result.output
    return json.loads(result.stdout)  # type: ignore[no-any-return]


@pytest.mark.slow
def test_truth_lies_within_the_expanded_uncertainty(plain):
    told = _told(plain)
    assert plain.return_value == 0
    assert told["status"] == "valid"
    U = told["expanded_uncertainty"]
    # All of twelve within k = 2 happens in two of three sessions; this seed was not chosen for it, 1.5 U is for all.
    assert np.all(np.abs(np.array(told["sensitivity"]) - S_TRUE) < 1.5 * np.array(U["sensitivity"]))
    assert np.all(np.abs(np.array(told["offset"]) - Q_TRUE) < 1.5 * np.array(U["offset"]))
    assert told["lag_s"] == pytest.approx(0.005, abs=5e-5)
    assert np.max(np.abs(np.array(told["sensitivity"]) - S_TRUE)) < 0.01
    assert {"value", "standard_uncertainty", "unit"} == set(told["nuisances"]["theta"])
    squares = sum(u["Sxx"] ** 2 for u in told["budget"].values())
    assert np.sqrt(squares) == pytest.approx(told["standard_uncertainty"]["sensitivity"][0][0], rel=1e-6)


@pytest.mark.nightly
def test_a_turned_static_sign_is_refused_with_status_3(session):
    result = _run(session, "--nominal", "1", "--u-nominal-pct", "20", "--static-sign", "-1", "--json", "-")
    told = _told(result)
    assert result.return_value == 3
    assert told["status"] == "refused"
    assert "static sign" in told["reasons"][0]
    assert told["sensitivity"] == [[None] * 3] * 3


@pytest.mark.slow
def test_a_contradicted_nominal_is_refused_with_numbers_and_tells_nothing_of_s(session):
    result = _run(session, "--nominal", "2", "--u-nominal-pct", "5", "--json", "-")
    told = _told(result)
    assert result.return_value == 3
    assert "2 with u 0.1 was expected" in told["reasons"][0]
    assert (told["sensitivity"], told["invariant"]) == ([[None] * 3] * 3, None)


@pytest.mark.slow
def test_an_earlier_result_serves_as_prior_and_may_be_contradicted(session, plain, tmp_path):
    first = _told(plain)
    covariance = np.array(first["covariance"]) + np.diag([4e-4] * 9 + [0.1] * 3)  # known to 2 % beforehand
    prior = tmp_path / "prior.json"
    prior.write_text(json.dumps({**first, "covariance": covariance.tolist()}))
    again = _run(session, *STATED, "--prior", str(prior), "--json", "-")
    assert again.return_value == 0
    np.testing.assert_allclose(_told(again)["sensitivity"], first["sensitivity"], rtol=0, atol=2e-3)
    far = np.array(first["sensitivity"]) + 0.2 * np.eye(3)
    prior.write_text(json.dumps({**first, "sensitivity": far.tolist(), "covariance": covariance.tolist()}))
    assert _run(session, *STATED, "--prior", str(prior)).return_value == 3


@pytest.mark.slow
def test_the_same_data_again_add_too_little_to_be_a_result(session, plain, tmp_path):
    prior = tmp_path / "prior.json"
    prior.write_text(plain.stdout)
    result = _run(session, *STATED, "--prior", str(prior), "--json", "-")
    assert result.return_value == 3
    assert _told(result)["sensitivity"] == [[None] * 3] * 3


@pytest.mark.parametrize("text", ["", "{}", '{"sensitivity": 1, "offset": 2, "covariance": 3}', "no JSON"])
def test_a_prior_that_is_none_is_bad_input(session, tmp_path, text):
    prior = tmp_path / "prior.json"
    prior.write_text(text)
    result = _run(session, "--prior", str(prior))
    assert result.return_value == 2
    assert result.stderr.count("\n") == 1
    assert "prior.json" in result.stderr


@pytest.mark.slow
def test_a_reference_that_is_ac_coupled_gives_its_corner(tmp_path):
    """Stated at 0.16 Hz within 0.03, truly 0.13: found to 2 mHz, and S is right to 0.1 % though 0.5 Hz is in it."""
    stands = tuple(clamped(35.0, alpha, 8.0) for alpha in (0.0, 30.0, 120.0, 210.0))
    parameters = BenchParameters(
        schedule=Schedule(stands, turn_s=1.0),
        motion=multisine(np.random.default_rng(44), 0.5, 8.0, lines=8, peak_mps2=10.0),
        sensor=SensorParameters(sensitivity=S_TRUE, offset=Q_TRUE, noise_mps2=0.02),
        reference=ReferenceParameters(highpass_hz=0.13),
    )
    _files(tmp_path, Bench(parameters, 44).recording(parameters.schedule.duration_s(1)))
    exact = ["--u-angle-deg", "0", "--u-theta-deg", "0", *STATED]
    told = _told(
        _run(tmp_path, *exact, "--reference-corner-hz", "0.16", "--u-reference-corner-hz", "0.03", "--json", "-")
    )
    assert told["status"] == "valid"
    assert told["nuisances"]["reference_corner"]["value"] == pytest.approx(0.13, abs=2e-3)
    np.testing.assert_allclose(told["sensitivity"], S_TRUE, rtol=0, atol=1e-3)


def test_rests_alone_give_a_free_frame(tmp_path):
    """Fourteen rests of a sensor with known upper-triangular S; between them it is turned."""
    random = np.random.default_rng(42)
    S = np.array([[1.02, 0.01, -0.02], [0.0, 0.98, 0.005], [0.0, 0.0, 1.01]])
    directions = random.normal(size=(14, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    parts = []
    for before, after in zip(directions, np.roll(directions, -1, axis=0), strict=True):
        way = np.linspace(0.0, 1.0, 100)[:, None] * (after - before) + before
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        parts += [np.repeat(before[None], 400, axis=0), way]
    a = 9.81 * np.concatenate(parts)
    V = a @ S.T + Q_TRUE + 0.01 * random.normal(size=a.shape)
    _write(tmp_path / "sensor.csv", "time_s,vx,vy,vz", np.arange(len(V)) / 100.0, V)
    options = ["--sensor", str(tmp_path / "sensor.csv"), "--gravity", "9.81", "--json", "-"]
    result = CliRunner().invoke(calibrate, options, standalone_mode=False)
    told = _told(result)
    assert result.return_value == 0
    assert told["frame"] == "free"
    # 400 samples of 0.01 a rest: 0.5 mm/s2 a rest, 0.02 % of S after the geometry; four of that
    np.testing.assert_allclose(told["sensitivity"], S, rtol=0, atol=8e-4)
    np.testing.assert_allclose(told["offset"], Q_TRUE, rtol=0, atol=3e-3)
    for nominal, status in ("1", 0), ("2", 3):
        known = [*options, "--nominal", nominal, "--u-nominal-pct", "10"]
        result = CliRunner().invoke(calibrate, known, standalone_mode=False)
        assert result.return_value == status
    assert "the length of S's row x is 1.02" in _told(result)["reasons"][0]


def test_too_few_rests_are_refused(tmp_path):
    V = np.tile([0.0, 0.0, 9.81], (3000, 1)) + 0.01 * np.random.default_rng(43).normal(size=(3000, 3))
    _write(tmp_path / "sensor.csv", "time_s,vx,vy,vz", np.arange(len(V)) / 100.0, V)
    result = CliRunner().invoke(calibrate, ["--sensor", str(tmp_path / "sensor.csv")], standalone_mode=False)
    assert result.return_value == 3
    assert "10 rests" in result.stderr


@pytest.mark.thorough
def test_the_table_ends_with_s_q_the_band_and_the_three_largest_sources(session, table):
    lines = table.splitlines()
    told = _told(_run(session, "--json", "-"))
    at = lines.index("  largest sources          U(Szz)  U(Qz)  smaller with")
    assert len(lines) == at + 4
    assert [line.split()[0] for line in lines[at - 6 : at - 3]] == ["x", "y", "z"]
    assert lines[at - 2].startswith("  S holds at 3 Hz; from ")
    assert lines[at - 1].startswith("  at 0 Hz: Sxx ")
    k, budget = told["expanded_uncertainty"]["coverage_factor"], told["budget"]
    shares = {
        name: max(part["Szz"] / told["standard_uncertainty"]["sensitivity"][2][2],
                  part["Qz"] / told["standard_uncertainty"]["offset"][2])
        for name, part in budget.items()
    }  # fmt: skip
    largest = sorted(shares, key=lambda name: -shares[name])[:3]
    ways = ("--u-transverse-motion-pct", "--u-gravity-mps2", "--sensor-filter, --reference-filter")
    for line, name, way in zip(lines[at + 1 :], largest, ways, strict=True):
        assert line.startswith(f"  {name} ")
        assert line.endswith(way)
        S, Q = line.removeprefix(f"  {name} ").split()[:2]
        assert float(S) == pytest.approx(k * budget[name]["Szz"], rel=0.06)
        assert float(Q) == pytest.approx(k * budget[name]["Qz"], rel=0.06)


@pytest.mark.slow
def test_nuisances_are_shown_where_all_is_asked_for(session, table):
    whole = _run(session, "--all").stdout
    nuisances = [line for line in whole.splitlines() if line not in table.splitlines()]
    assert {line.split(":")[0].strip() for line in nuisances} >= {"lag", "theta", "gravity", "attenuation"}
    assert "sampling rate" in whole
    assert all(len(line) <= 80 for line in table.splitlines()), table


@pytest.mark.thorough
def test_a_parameter_that_the_prior_tells_has_its_posterior_and_a_star(session, tmp_path):
    files = [part for name in ("sensor", "reference", "poses") for part in (f"--{name}", str(session / f"{name}.csv"))]
    covariance = np.diag([1e-8] * 9 + [1.0] * 3).tolist()
    earlier = {"sensitivity": S_TRUE.tolist(), "offset": [0.0] * 3, "covariance": covariance}
    (tmp_path / "earlier.json").write_text(json.dumps(earlier))
    known = [*files, "--prior", str(tmp_path / "earlier.json")]
    told = _told(CliRunner().invoke(calibrate, [*known, "--json", "-"], standalone_mode=False))
    assert told["determined"]["sensitivity"][0][0] is False
    assert told["determined"]["offset"] == [True] * 3
    assert abs(told["sensitivity"][0][0] - S_TRUE[0, 0]) < 3e-4
    assert 5e-5 < told["standard_uncertainty"]["sensitivity"][0][0] <= 1e-4
    result = CliRunner().invoke(calibrate, known, standalone_mode=False)
    (row,) = [line for line in result.stdout.splitlines() if line.strip().startswith("x ")]
    assert row.split()[4] == "*", row
    assert "* known before: the data do not halve its uncertainty" in result.stdout


@pytest.mark.slow
def test_the_certificate_of_the_reference_is_in_the_result_and_tells_its_u(session: Path, tmp_path: Path) -> None:
    certificate = tmp_path / "reference.toml"
    certificate.write_text('[certificate]\nserial_number = "R-9"\nsensitivity = 10.2\nu_sensitivity_pct = 0.3\n')
    result = _run(session, "--reference-certificate", str(certificate), "--json", "-")
    assert result.return_value == 0, result.output
    told = json.loads(result.stdout)
    (shared,) = told["shared_errors"]
    assert (shared["serial_number"], shared["sensitivity"], shared["u_stated"]) == ("R-9", [10.2], [0.003])
    assert shared["certificate_sha256"] == hashlib.sha256(certificate.read_bytes()).hexdigest()
    assert told["files"][-1]["sha256"] == shared["certificate_sha256"]
    # It would be S if nothing but the reference told S; gravity tells a part of it.
    assert 0.2 * told["sensitivity"][0][0] < shared["derivative"][0][0] < told["sensitivity"][0][0]
