"""`fieldcal convert`: other formats in, the plain CSV out, with the same numbers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from agent.calibrate.tables import read_reference, read_sensor
from agent.cli.main import run_cli
from agent.cli.simulate import write_files
from hw.virtual.bench import Bench
from hw.virtual.presets import plain
from tests.unit.test_reading_csv import DATED, VALUES, written


def test_a_sensor_with_gaps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path, DATED["ISO 8601"].replace(",", ",,", 1), "a.csv")
    lines = DATED["ISO 8601 with Z"].splitlines()
    lines[5] = lines[5].split(",")[0] + ",,,"
    path = written(tmp_path, "\n".join(["time,vx,vy,vz,temp [degC]", *(f"{x},21.5" for x in lines[1:]), ""]), "a.csv")
    assert run_cli(["convert", str(path), "-o", str(tmp_path / "b.csv")]) == 0
    assert "400 rows of time_s,vx,vy,vz,temperature_degc" in capsys.readouterr().out
    before, after = read_sensor(path), read_sensor(tmp_path / "b.csv")
    np.testing.assert_array_equal(after.time_s[:], before.time_s[:])
    np.testing.assert_array_equal(after.v[:], before.v[:])
    assert np.isnan(after.v[:][4]).all()
    assert after.temperature_degc is not None
    np.testing.assert_array_equal(after.temperature_degc[:], 21.5)
    assert after.said == ()


@pytest.mark.parametrize(
    ("options", "header", "factor"),
    [
        (["--columns", "time=t,x=b:mm/s"], "time_s,v", 1e-3),
        (["--columns", "time=t,x=b:mV", "--sensitivity", "100 mV/g"], "time_s,a", 0.0980665),
        (["--columns", "time=t,x=a:g,y=b:g,z=c:g"], "time_s,ax,ay,az", 9.80665),
    ],
)
def test_a_reference_comes_in_si_units(options: list[str], header: str, factor: float, tmp_path: Path) -> None:
    text = "t,a,b,c\n" + "".join(",".join(map(repr, row)) + "\n" for row in VALUES.tolist())
    path, output = written(tmp_path, text), tmp_path / "b.csv"
    assert run_cli(["convert", str(path), "-o", str(output), "--as", "reference", *options]) == 0
    assert output.read_text().partition("\n")[0] == header
    expected = VALUES[:, 2] if header.count(",") == 1 else VALUES[:, 1]
    np.testing.assert_allclose(read_reference(output).x[:][:, 0], factor * expected, rtol=1e-14)


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path, "t,a,b,c\n1,2,3,4\n2,2,3,4\n")
    for arguments, message in (
        ([path, "-o", path], "file.csv: the file exists; remove it, or choose another name"),
        ([path, "-o", tmp_path / "no" / "b.csv"], "no/b.csv: No such file"),
        ([tmp_path / "gone", "-o", tmp_path / "b.csv"], "gone: No such file"),
        (
            [path, "-o", tmp_path / "b.csv", "--as", "reference", "--columns", "time=t,x=a:m,y=b:m,z=c:m"],
            "is no reference",
        ),
        ([path, "-o", tmp_path / "b.csv", "--sensitivity", "1"], "--sensitivity is for --as reference"),
        ([path, "-o", tmp_path / "b.csv", "--as", "reference", "--sensitivity", "x"], "'x' is not a sensitivity"),
    ):
        assert run_cli(["convert", *map(str, arguments)]) == 2
        told = capsys.readouterr()
        assert message in told.err
        assert told.out == ""
    assert not (tmp_path / "b.csv").exists()


@pytest.mark.thorough
def test_the_same_s_and_q(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A whole calibration from files as other programs write them."""
    write_files(Bench(plain(7), seed=7), tmp_path, None, {})
    rows = np.loadtxt(tmp_path / "sensor.csv", delimiter=",", skiprows=1)
    text = "".join(f"{r[0]:.6f};{r[1]};{r[2]};{r[3]}\n".replace(".", ",") for r in rows.tolist())
    written(tmp_path, "# logger\nZeit (s);Kanal 1;Kanal 2;Kanal 3\n" + text, "semicolon.csv")
    a = np.loadtxt(tmp_path / "reference.csv", delimiter=",", skiprows=1)
    np.savetxt(tmp_path / "mv.csv", a * [1000, 1 / 0.0980665], "%.17g", "\t", header="t [ms]\tPCB [mV]", comments="")
    found = []
    for sensor, reference in (("sensor.csv", "reference.csv"), ("semicolon.csv", "mv.csv")):
        names = {"sensor": sensor, "reference": reference, "poses": "poses.csv"}
        options = [part for name, file in names.items() for part in (f"--{name}", str(tmp_path / file))]
        more = ["--sensitivity", "100 mV/g"] if reference == "mv.csv" else []
        assert run_cli(["calibrate", *options, *more, "--plain", "--json", "-"]) == 0
        found.append(json.loads(capsys.readouterr().out))
    np.testing.assert_allclose(found[1]["sensitivity"], found[0]["sensitivity"], rtol=0, atol=1e-9 * 26000)
    np.testing.assert_allclose(found[1]["offset"], found[0]["offset"], rtol=0, atol=1e-9 * 26000)
