"""`fieldcal fleet adjust` as a user calls it: files of a small site, its result, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.config.earlier import read_earlier
from agent.fleet.meeting import stated_calibration
from agent.fleet.site_file import DeviceSection
from agent.reading.source import TableError
from tests.unit.drawn_recording import Devices, Recording
from tests.unit.recorded_bench import record
from tests.unit.test_reading_formats import GOLDEN

RATE_HZ, SECONDS = 50.0, 30.0
S_TRUE = np.array([[204.0, 2.0, -3.0], [1.0, 212.0, 2.0], [-2.0, 1.0, 208.0]])
Q_TRUE = np.array([40.0, -20.0, 10.0])
S_OTHER = np.array([[95.0, 1.0, 0.0], [-1.0, 102.0, 1.0], [0.0, 2.0, 99.0]])
GAINS = {"ref 1": 1.0005, "ref 2": 0.9995, "ref 3": 1.02}
SITE = """
gravity_mps2 = 9.81
[devices.s1]
nominal = 208
u_nominal_pct = 10
[devices."ref 1"]
u_sensitivity_pct = 0.1
[devices."ref 2"]
u_sensitivity_pct = 0.1
[devices."ref 3"]
u_sensitivity_pct = 0.1
"""
LINK = """
[[links]]
sensor = "s1"
sensor_file = "s1-{k}.csv"
reference = "ref {k}"
reference_file = "ref-{k}.csv"
options = {{ rotation = "1,0,0,0,1,0,0,0,1", u-rotation-deg = 0.05 }}
"""

SECOND = LINK.replace('"s1"', '"s2"').replace("s1-{k}", "s2").replace('"ref {k}"', '"s1"').replace("ref-{k}", "s1-{k}")
CHAIN = SITE.replace("[devices.s1]", "[devices.s2]\n[devices.s1]") + LINK.format(k=1) + SECOND.format(k=1)
ONE_LINK = """
[devices.s]
nominal = 1
u_nominal_pct = 5
[devices.r]
u_sensitivity_pct = 0.1
[[links]]
sensor = "s"
sensor_file = "sensor.csv"
reference = "r"
reference_file = "reference.csv"
options = { poses = "poses.csv", reference-coupling = "dc" }
"""


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sensor beside three references, the third of which indicates 2 % too much."""
    made = tmp_path_factory.mktemp("site")
    random = np.random.default_rng(3)
    t = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    for k, gain in enumerate(GAINS.values(), start=1):
        a = np.tile([0.0, 0.0, 9.81], (len(t), 1))
        for axis in range(3):
            for f in (0.7, 1.3, 2.1, 3.7):
                a[:, axis] += np.sin(2.0 * np.pi * f * t + random.uniform(0.0, 2.0 * np.pi))
        v = a @ S_TRUE.T + Q_TRUE + 0.2 * random.normal(size=a.shape)
        _write(made / f"s1-{k}.csv", "time_s,vx,vy,vz", t, v)
        if k == 1:
            other = a @ S_OTHER.T + 0.2 * random.normal(size=a.shape)
            _write(made / "s2.csv", "time_s,vx,vy,vz", t, other)
        _write(made / f"ref-{k}.csv", "time_s,ax,ay,az", t, gain * a)
    singular = {"sensitivity": [[1.0, 0.0, 0.0]] * 3, "offset": [0.0] * 3, "covariance": np.eye(12).tolist()}
    (made / "singular.json").write_text(json.dumps(singular))
    (made / "sound.toml").write_text(SITE + "".join(LINK.format(k=k) for k in (1, 2)))
    (made / "bad.toml").write_text(SITE + "".join(LINK.format(k=k) for k in (1, 2, 3)))
    return made


def _write(path: Path, header: str, time_s: np.ndarray, values: np.ndarray) -> None:
    np.savetxt(path, np.column_stack([time_s, values]), delimiter=",", header=header, comments="", fmt="%.10g")


def test_a_sensor_beside_two_references_gets_one_calibration(
    directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["fleet", "adjust", str(directory / "sound.toml"), "--json", "-", "-o", str(tmp_path / "out")]
    assert run_cli([*arguments, "--between", "s1", "ref 1"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["status"] == "valid"
    assert told["contradicts"] == []
    sensor = told["devices"]["s1"]
    assert np.array(sensor["determined"]["sensitivity"]).all()
    mean_gain = np.mean([GAINS["ref 1"], GAINS["ref 2"]])
    found, u = (np.array(part)[[0, 1, 2], [0, 1, 2]] for part in (
        sensor["sensitivity"], sensor["standard_uncertainty"]["sensitivity"]))  # fmt: skip
    assert found == pytest.approx(np.diag(S_TRUE) / mean_gain, rel=2e-4)
    assert u / found == pytest.approx(1e-3 / np.sqrt(2.0), rel=0.15)  # two references of 0.1 %
    errors = [np.diag(told["devices"][name]["sensitivity"]) - 1.0 for name in ("ref 1", "ref 2")]
    assert errors[0] - errors[1] == pytest.approx(1e-3, abs=2e-4)
    # Nothing tells the error that both references share; it is all that is left in S and in each of them.
    cross = np.array(told["between"][0]["covariance"])[0, 0]
    u_reference = told["devices"]["ref 1"]["standard_uncertainty"]["sensitivity"][0][0]
    assert cross / (u[0] * u_reference) == pytest.approx(1.0, abs=0.02)
    values, covariance = read_earlier(tmp_path / "out" / "device-1.json")
    assert values[:9] == pytest.approx(np.ravel(sensor["sensitivity"]))
    assert covariance == pytest.approx(np.array(sensor["covariance"]))
    assert json.loads((tmp_path / "out" / "site.json").read_text()) == told


@pytest.mark.slow
def test_the_reference_that_contradicts_the_others_is_named(
    directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_cli(["fleet", "adjust", str(directory / "bad.toml")]) == 3
    out, err = capsys.readouterr()
    assert "refused: ref 3 contradicts the other devices: it indicates otherwise than its certificate says" in err
    assert "most suspect: ref 3" in out


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("changed", "by", "fault"),
    [
        ('reference = "ref 1"', 'reference = "ref 9"', "links.0.reference: there is no device 'ref 9'"),
        ("u_nominal_pct = 10", "", "nominal and u_nominal_pct must be given together"),
        ("u-rotation-deg = 0.05", "u-reference-pct = 1", "options.u-reference-pct: is a statement on a device"),
        ("u-rotation-deg = 0.05", "gravity = 9.8", "options.gravity: is the same in the whole site"),
        ("u-rotation-deg = 0.05", "u-rotatoin-deg = 1", "links.0: No such option"),
        ('"s1-1.csv"', '"nowhere.csv"', "nowhere.csv"),
        ("u-rotation-deg = 0.05", '"prior=x" = 1', "options.prior=x: is no option of a link"),
        ("u-rotation-deg = 0.05", "help = 1", "options.help: is no option of a link"),
        ("nominal = 208\nu_nominal_pct = 10", "u_sensitivity_pct = 1", "which is for references in SI units"),
        ("nominal = 208\nu_nominal_pct = 10", 'certificate = "singular.json"', "cannot be inverted"),
        ('[devices."ref 1"]\nu_sensitivity_pct = 0.1', '[devices."ref 1"]', "nothing is stated of 'ref 1'"),
    ],
)
def test_faults_of_the_file_are_named(
    directory: Path, capsys: pytest.CaptureFixture[str], changed: str, by: str, fault: str
) -> None:
    text = (directory / "sound.toml").read_text()
    assert changed in text
    path = directory / "faulty.toml"
    path.write_text(text.replace(changed, by, 1))
    assert run_cli(["fleet", "adjust", str(path), "--json", "-"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert fault in err
    assert "Traceback" not in err


def test_a_reference_with_a_certificate_has_its_values_and_their_covariance(directory: Path) -> None:
    stated = {"sensitivity": (208.0 * np.eye(3)).tolist(), "offset": [1.0, 2.0, 3.0], "covariance": np.eye(12).tolist()}
    (directory / "certificate.json").write_text(json.dumps(stated))
    told = stated_calibration(DeviceSection(certificate=Path("certificate.json")), directory)
    assert told is not None
    np.testing.assert_array_equal(told[0], [*(208.0 * np.eye(3)).ravel(), 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(told[1], np.eye(12))
    with pytest.raises(TableError, match=r"singular.json, sensitivity: the matrix cannot be inverted"):
        stated_calibration(DeviceSection(certificate=Path("singular.json")), directory)


def test_a_link_that_is_refused_is_left_out_with_its_reason(
    directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    time_s = np.arange(1500) / RATE_HZ
    dead = np.random.default_rng(1).normal(size=(1500, 3)) * 0.01 + [0.0, 0.0, 9.81]
    _write(directory / "ref-dead.csv", "time_s,ax,ay,az", time_s, dead)
    text = (directory / "sound.toml").read_text()
    (directory / "dead.toml").write_text(text.replace("ref-2.csv", "ref-dead.csv"))
    assert run_cli(["fleet", "adjust", str(directory / "dead.toml"), "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [link["used"] for link in told["links"]] == [True, False]
    assert told["links"][1]["reasons"]
    assert "ref 2" not in told["devices"]


def test_a_sensor_is_the_reference_of_another_by_its_own_indications(
    directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (directory / "chain.toml").write_text(CHAIN)
    assert run_cli(["fleet", "adjust", str(directory / "chain.toml"), "--json", "-", "--between", "s1", "s2"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["devices"]["s1"]["used_as"] == ["sensor", "reference"]
    main, u = np.array(told["devices"]["s2"]["sensitivity"]), np.array(
        told["devices"]["s2"]["standard_uncertainty"]["sensitivity"])  # fmt: skip
    assert np.diag(main) == pytest.approx(np.diag(S_OTHER) / GAINS["ref 1"], rel=3e-4)
    assert np.diag(u / main) == pytest.approx(1e-3, rel=0.1)  # the 0.1 % of the only reference, through s1
    between = np.array(told["between"][0]["covariance"])[0, 0]
    u_first = told["devices"]["s1"]["standard_uncertainty"]["sensitivity"][0][0]
    assert between / (u_first * u[0, 0]) == pytest.approx(1.0, abs=0.05)


def test_a_certificate_of_all_axes_needs_a_reference_that_measures_gravity(
    directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    head, _, tail = CHAIN.rpartition("u-rotation-deg = 0.05")
    (directory / "ac.toml").write_text(f'{head}u-rotation-deg = 0.05, reference-coupling = "ac"{tail}')
    assert run_cli(["fleet", "adjust", str(directory / "ac.toml"), "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [link["used"] for link in told["links"]] == [True, False]
    assert "needs a reference that measures gravity itself" in told["links"][1]["reasons"][0]


@pytest.mark.slow
def test_one_link_alone_is_what_calibrate_finds(tmp_path: Path) -> None:
    recording = Recording(5, Devices(), bench=True, stand_s=12.0)
    stated = ("--nominal", "1", "--u-nominal-pct", "5", "--reference-coupling", "dc")
    _, alone = recording.through_files(tmp_path, *stated)
    (tmp_path / "site.toml").write_text(ONE_LINK)
    assert run_cli(["fleet", "adjust", str(tmp_path / "site.toml"), "--json", str(tmp_path / "site.json")]) == 0
    found = json.loads((tmp_path / "site.json").read_text())["devices"]["s"]
    u = np.array(alone["standard_uncertainty"]["sensitivity"] + [alone["standard_uncertainty"]["offset"]])
    for away in ("sensitivity", "offset"):
        scale = u[:3] if away == "sensitivity" else u[3]
        assert np.array(found[away]) / scale == pytest.approx(np.array(alone[away]) / scale, abs=1e-3)
    assert np.array(found["covariance"]) == pytest.approx(np.array(alone["covariance"]), rel=1e-3, abs=1e-9)


@pytest.mark.thorough
def test_recordings_need_no_list_of_meetings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = record(tmp_path, 130.0)
    (recording,) = tmp_path.glob("*.mcap")
    assert run_cli(["fleet", "adjust", str(recording), "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    (link,) = told["links"]
    assert link["sensor"].startswith("virtual mems-1")
    assert link["reference"].startswith("virtual reference-1")
    sensor = told["devices"][link["sensor"]]
    off = np.array(sensor["sensitivity"]) - truth.sensitivity
    expanded = np.array(sensor["expanded_uncertainty"]["sensitivity"])
    assert (np.abs(off) < expanded).all()
    assert expanded.max() < 0.03 * truth.sensitivity.max()
    assert run_cli(["fleet", "adjust", str(recording), str(recording)]) == 2
    assert "give each recording once" in capsys.readouterr().err


def test_a_cut_recording_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = GOLDEN.read_bytes()
    (tmp_path / "a.mcap").write_bytes(data[: len(data) // 2])
    run_cli(["fleet", "adjust", str(tmp_path / "a.mcap")])
    told = f"{tmp_path}/a.mcap: the file ends early, as after a power cut, or is still written; it is read up to byte "
    assert capsys.readouterr().err.count(told) == 1


def test_a_file_that_is_no_recording_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.mcap").write_bytes(b"no recording")
    assert run_cli(["fleet", "adjust", str(tmp_path / "a.mcap")]) == 2
    assert "a.mcap: this is no recording of fieldcal" in capsys.readouterr().err
