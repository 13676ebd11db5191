"""Each command in the page of files of other programs runs, with files as the page says."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat, wavfile

from agent.calibrate.tables import read_sensor
from agent.cli.main import run_cli
from agent.cli.simulate import write_files
from hw.virtual.bench import Bench
from hw.virtual.presets import plain
from tests.unit.test_reading_formats import GOLDEN

PAGE = Path(__file__).parents[2] / "docs" / "files.md"
FENCE = re.compile(r"^```text\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMANDS = [line for block in FENCE.findall(PAGE.read_text("utf-8")) for line in block.splitlines()]
NEEDS = {"parquet": "pyarrow", "h5": "h5py", "tdms": "nptdms"}
G = 9.80665


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with the bench's sensor and reference as plain CSV."""
    directory = tmp_path_factory.mktemp("page")
    write_files(Bench(plain(7), seed=7), directory, None, {})
    return directory


def calibrated(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert run_cli([*arguments, "--plain", "--json", "-"]) in (0, 3), capsys.readouterr().err
    found = json.loads(capsys.readouterr().out)
    assert isinstance(found, dict)
    return found


def write(kind: str, site: Path) -> None:
    """The files of one command, from the plain ones; the WAV files have the mean rate of the stamps."""
    t, *v = np.loadtxt(site / "sensor.csv", delimiter=",", skiprows=1).T[:4]
    at, a = np.loadtxt(site / "reference.csv", delimiter=",", skiprows=1).T
    if kind == "parquet":
        import pandas

        pandas.DataFrame({"time": t, "accX": v[0], "accY": v[1], "accZ": v[2]}).to_parquet(site / "imu.parquet")
        pandas.DataFrame({"time": at, "acc": a / G * 1e3}).to_feather(site / "shaker.feather")
    elif kind == "wav":
        wavfile.write(
            site / "three.wav", 1000, np.column_stack([np.interp(np.arange(0, t[-1], 1e-3), t, x) for x in v])
        )
        wavfile.write(site / "one.wav", 1000, np.interp(np.arange(0, at[-1], 1e-3), at, a))
    elif kind == "mat":
        savemat(site / "imu.mat", {"t": t, "acc": np.column_stack(v)})
        with pytest.importorskip("h5py", reason="h5py is not installed (extra hdf5)").File(
            site / "imu.h5", "w"
        ) as file:
            file["t"], file["ref"] = at, a / G
    elif kind == "tdms":
        nptdms = pytest.importorskip("nptdms", reason="npTDMS is not installed (extra tdms)")
        with nptdms.TdmsWriter(site / "daq.tdms") as writer:
            channels = [("imu", "time", t, "s"), *(("imu", f"acc {n}", x, "") for n, x in zip("xyz", v, strict=True))]
            channels += [("shaker", "time", at, "s"), ("shaker", "acc", a, "m/s2")]
            writer.write_segment([nptdms.ChannelObject(g, n, x, {"unit_string": u}) for g, n, x, u in channels])


@pytest.mark.two_cases
@pytest.mark.parametrize("line", [line for line in COMMANDS if ".mcap" not in line and ".wav" not in line])
def test_the_same_s_and_q_from_every_format(line: str, site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for suffix, library in NEEDS.items():
        if f".{suffix}" in line:
            pytest.importorskip(library, reason=f"{library} is not installed")
    write(next(kind for kind in ("parquet", "mat", "tdms") if f".{kind}" in line), site)
    words = [str(site / word) if re.fullmatch(r"\w+\.\w+", word) else word for word in shlex.split(line)[1:]]
    plain_words = ["calibrate", *(w for n in ("sensor", "reference", "poses") for w in (f"--{n}", f"{site}/{n}.csv"))]
    found, expected = calibrated(words, capsys), calibrated(plain_words, capsys)
    assert found["status"] == expected["status"] == "valid"
    for name in ("sensitivity", "offset"):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-9, atol=1e-9 * 26000)


@pytest.mark.one_case
@pytest.mark.parametrize("line", [line for line in COMMANDS if "run.mcap" in line or ".wav" in line])
def test_commands_with_files_of_one_rate(line: str, site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if ".wav" in line:
        write("wav", site)
    else:
        site = site / "run"
        site.mkdir()
        shutil.copy(GOLDEN, site / "run.mcap")
        begin_s = float(read_sensor(GOLDEN).time_s[:1][0])
        poses = f"start_s,stop_s,theta_deg,alpha_deg\n{begin_s + 3},{begin_s + 15},35,0\n"
        (site / "poses.csv").write_text(poses)
    words = [str(site / word) if re.fullmatch(r"\w+\.\w+", word) else word for word in shlex.split(line)[1:]]
    assert calibrated(words, capsys)["windows"]
