"""`fieldcal simulate`: files with known truth, playing a recording, serving a bench."""

from __future__ import annotations

import fcntl
import json
import os
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
from numpy.testing import assert_allclose

from agent.cli.main import run_cli
from agent.cli.simulate import SETTLE_S
from hw.virtual.bench import Bench
from hw.virtual.playback import PlaybackError, Player, read_track
from hw.virtual.presets import PRESETS

SENSOR = "time_s,vx,vy,vz\n10.0,1,-2.50,3e-1\n10.01,4,5,6\n10.01,7,8,9\n10.03,10,11,12\n"


def write(directory: Path, text: str) -> Path:
    path = directory / "sensor.csv"
    path.write_text(text)
    return path


@contextmanager
def running(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "agent", "simulate", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.one_case
@pytest.mark.parametrize("preset", list(PRESETS))
def test_files_hold_the_recording_and_its_truth(preset, tmp_path, capsys) -> None:
    directory = tmp_path / "example"
    assert run_cli(["simulate", "--preset", preset, "--seed", "3", "--csv", str(directory), "--duration", "30"]) == 0
    files = " ".join(f"--{name} {directory}/{name}.csv" for name in ("sensor", "reference", "poses"))
    assert capsys.readouterr().out == f"fieldcal calibrate {files} --nominal 26104.7 --u-nominal-pct 20\n"
    recording = Bench(PRESETS[preset](3), 3).recording(30.0)
    half_microsecond: dict[str, Any] = {"rtol": 0, "atol": 0.5001e-6}
    sensor = np.loadtxt(directory / "sensor.csv", delimiter=",", skiprows=1)
    assert (directory / "sensor.csv").read_text().startswith("time_s,vx,vy,vz,temperature_degc\n")
    assert_allclose(sensor[:, 0], recording.sensor_stamp_s, **half_microsecond)
    assert np.array_equal(sensor[:, 1:4], recording.v)
    assert_allclose(sensor[:, 4], recording.temperature_degc, atol=0.00501)
    reference = np.loadtxt(directory / "reference.csv", delimiter=",", skiprows=1)
    assert (directory / "reference.csv").read_text().startswith("time_s,a\n")
    assert_allclose(reference[:, 0], recording.reference_stamp_s, **half_microsecond)
    assert_allclose(reference[:, 1], recording.reference[:, 0], atol=1e-12)
    poses = (directory / "poses.csv").read_text().splitlines()
    assert poses[:2] == ["start_s,stop_s,theta_deg,alpha_deg", "3.000000,13.000000,35,0"]
    assert len(poses) == 1 + len(recording.poses) == 3
    truth = json.loads((directory / "truth.json").read_text())
    assert (truth["preset"], truth["seed"], truth["unit"]) == (preset, 3, "count")
    assert np.array_equal(truth["sensitivity"], recording.truth.sensitivity)
    assert np.array_equal(truth["offset"], recording.truth.offset)
    assert truth["lag_s"] == ([0.005] * 3 if preset == "faulty" else [0.0] * 3)
    assert truth["rate_hz"] == pytest.approx(1013.0 if preset == "faulty" else 1003.3)


@pytest.mark.thorough
def test_three_repetitions_by_default_and_no_pose_in_a_short_one(tmp_path) -> None:
    assert run_cli(["simulate", "--preset", "plain", "--csv", str(tmp_path)]) == 0
    poses = np.loadtxt(tmp_path / "poses.csv", delimiter=",", skiprows=1)
    assert poses[:, 3].tolist() == [0, 30, 120, 210] * 3
    assert np.loadtxt(tmp_path / "sensor.csv", delimiter=",", skiprows=1)[-1, 0] > poses[-1, 1] - 0.1
    assert run_cli(["simulate", "--preset", "plain", "--csv", str(tmp_path), "--duration", "2"]) == 0
    assert (tmp_path / "poses.csv").read_text() == "start_s,stop_s,theta_deg,alpha_deg\n"


def test_a_track_keeps_the_files_own_digits(tmp_path) -> None:
    track = read_track(write(tmp_path, SENSOR))
    assert track.values == ["1,-2.50,3e-1", "4,5,6", "7,8,9", "10,11,12"]
    assert_allclose(track.time_s, [0, 0.01, 0.01, 0.03])
    assert_allclose(read_track(write(tmp_path, SENSOR), rate_hz=50.0).time_s, [0, 0.02, 0.04, 0.06])
    assert read_track(write(tmp_path, SENSOR), ("vz", "vx")).values[0] == "3e-1,1"
    uniaxial = read_track(write(tmp_path, "time_s,a\r\n0,0.5\r\n1,0.25\r\n\r\n"))
    assert uniaxial.values == ["0.5", "0.25"]
    assert read_track(write(tmp_path, "vx,vy,vz\n1,2,3\n"), rate_hz=10.0).values == ["1,2,3"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: none of the columns vx,vy,vz or ax,ay,az or a or v in the header ''"),
        ("time_s,b\n0,1\n", "line 1: none of the columns vx,vy,vz or ax,ay,az or a or v in the header 'time_s,b'"),
        ("vx,vy,vz\n1,2,3\n", "line 1: no column time_s in the header 'vx,vy,vz'"),
        ("time_s,a\n", "no samples"),
        ("time_s,a\n0,1\n1\n", "line 3: 1 fields, the header has 2"),
        ("time_s,a\n0,1\n1,x\n", "line 3, column a: 'x' is not a finite number"),
        ("time_s,a\n0,1\nnan,1\n", "line 3, column time_s: 'nan' is not a finite number"),
        ("time_s,a\n0,1\n\n2,1\n1.5,1\n", "sample 3, column time_s: 1.5 is earlier than 2.0 before it"),
    ],
)
def test_bad_recordings_are_named_by_file_line_column_and_value(text, message, tmp_path, capsys) -> None:
    path = write(tmp_path, text)
    assert run_cli(["simulate", "--play", str(path)]) == 2
    shown = capsys.readouterr()
    assert shown.err == f"{path}{',' if message.startswith(('line', 'sample')) else ':'} {message}\n"
    assert shown.out == ""


def test_a_file_that_is_not_there_or_not_text(tmp_path) -> None:
    with pytest.raises(PlaybackError, match=r"missing\.csv: cannot be read: No such file"):
        read_track(tmp_path / "missing.csv")
    (tmp_path / "noise.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(PlaybackError, match=r"noise\.csv: cannot be read"):
        read_track(tmp_path / "noise.csv")


@pytest.mark.parametrize(
    "arguments",
    [[], ["--preset", "plain", "--play", "x"], ["--preset", "plain", "--loop"], ["--play", "x", "--csv", "d"],
     ["--preset", "odd"], ["--play", "x", "--duration", "5"]],
)  # fmt: skip
def test_options_that_do_not_go_together(arguments, capsys) -> None:
    assert run_cli(["simulate", *arguments]) == 2
    assert "Error:" in capsys.readouterr().err


def test_a_link_that_exists_or_cannot_be_made_is_named(tmp_path, capsys) -> None:
    path = write(tmp_path, SENSOR)
    assert run_cli(["simulate", "--play", str(path), "--link", str(path)]) == 2
    assert capsys.readouterr().err == f"{path}: File exists\n"
    assert run_cli(["simulate", "--play", str(path), "--link", str(tmp_path / "no" / "port")]) == 2
    assert capsys.readouterr().err == f"{tmp_path}/no/port: No such file or directory\n"
    assert run_cli(["simulate", "--preset", "plain", "--csv", str(path / "in-a-file")]) == 2
    (tmp_path / "bench-reference").touch()
    assert run_cli(["simulate", "--preset", "plain", "--link", str(tmp_path / "bench")]) == 2
    assert not (tmp_path / "bench-sensor").is_symlink(), "the port that was made must be removed"


def test_a_player_sends_what_is_due_once(tmp_path) -> None:
    player = Player(read_track(write(tmp_path, SENSOR)), sequence=True)
    assert player(5.0) == b""
    player.begin(100.0)
    assert player(100.0) == b"# playing\n0,1,-2.50,3e-1\n"
    assert player(100.005) == b""
    assert player(100.0101) == b"1,4,5,6\n2,7,8,9\n"
    assert not player.finished
    assert player(200.0) == b"3,10,11,12\n"
    assert player.finished
    assert player(300.0) == b""


def test_a_loop_goes_on_one_interval_after_the_end(tmp_path) -> None:
    player = Player(read_track(write(tmp_path, "time_s,a\n0,1\n1,2\n2,3\n")), sequence=True, loop=True)
    player.begin(0.0)
    assert player(2.99) == b"# playing\n0,1\n1,2\n2,3\n"
    assert player(3.001) == b"3,1\n"
    assert player(7.5) == b"4,2\n5,3\n6,1\n7,2\n"
    assert not player.finished


@pytest.mark.slow
def test_a_recording_is_played_whole_at_its_own_pace_and_the_port_ends_with_it(tmp_path) -> None:
    rows = [f"{k / 100:.2f},{k}.250,{-k},0" for k in range(80)]
    path = write(tmp_path, "\n".join(["time_s,vx,vy,vz", *rows, ""]))
    link = tmp_path / "port"
    with running("--play", str(path), "--link", str(link)) as process:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == str(link)
        arrived: list[tuple[bytes, float]] = []
        with serial.Serial(str(link), timeout=60) as port:
            while len(arrived) < 81:
                arrived.append((port.readline().strip(), time.monotonic()))
        assert process.wait(timeout=60) == 0
    assert [line for line, _ in arrived] == [b"# playing", *(row.split(",", 1)[1].encode() for row in rows)]
    spans_s = [later[1] - earlier[1] for earlier, later in zip(arrived[1:], arrived[41:], strict=False)]
    # 40 lines are 0.40 s; some come in bursts, and on a busy machine late at either end
    assert max(spans_s) > 0.3
    assert min(spans_s) < 0.6
    assert not link.is_symlink()


@pytest.mark.slow
def test_a_reader_that_sets_its_port_up_slowly_and_reads_late_loses_nothing(tmp_path) -> None:
    path = write(tmp_path, SENSOR)
    whole = b"# playing\n1,-2.50,3e-1\n4,5,6\n7,8,9\n10,11,12\n"
    with running("--play", str(path)) as process:
        assert process.stdout is not None
        port = os.open(process.stdout.readline().strip(), os.O_RDWR | os.O_NOCTTY)
        try:
            assert select.select([port], [], [], 0.1) == ([], [], []), "it must wait for the port to be set up"
            termios.tcflush(port, termios.TCIFLUSH)  # as pyserial does at the end of opening
            deadline = time.monotonic() + 60
            while _waiting(port) < len(whole) and time.monotonic() < deadline:
                select.select([], [], [], 0.01)
            # The process keeps the port open, because closing it would discard the text
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(timeout=0.3)
            assert os.read(port, 1000) == whole
            assert process.wait(timeout=60) == 0
        finally:
            os.close(port)


def _waiting(port: int) -> int:
    return int.from_bytes(fcntl.ioctl(port, termios.FIONREAD, bytes(4)), sys.byteorder)


def neighboured(lines: list[bytes]) -> np.ndarray:  # type: ignore[type-arg]
    """Number and three values (n, 4) of the lines between two that follow each other.

    A busy machine that is late by 60 ms loses bytes, as a real line does (`PtyDevice`): then two lines become one, and
    the number of the next line does not follow.
    """
    cells = [line.decode().rstrip().split(",") for line in lines]
    number = np.array([int(first) for first, *_ in cells])
    kept = np.flatnonzero((np.diff(number)[:-1] == 1) & (np.diff(number)[1:] == 1)) + 1
    return np.array([cells[k] for k in kept], dtype=np.float64)


@pytest.mark.slow
def test_a_bench_serves_both_devices_from_one_zero_until_interrupted(tmp_path) -> None:
    with running("--preset", "plain", "--seed", "4", "--link", str(tmp_path / "bench")) as process:
        assert process.stdout is not None
        shown = [process.stdout.readline().split() for _ in range(2)]
        assert [words[:2] for words in shown] == [
            ["sensor", f"{tmp_path}/bench-sensor"],
            ["reference", f"{tmp_path}/bench-reference"],
        ]
        opened_s = time.monotonic()  # the bench's zero is later: it lets the reader settle first
        with serial.Serial(shown[1][1], timeout=60) as reference, serial.Serial(shown[0][1], timeout=60) as sensor:
            received = [[sensor.readline()], [reference.readline()]]
            for _ in range(800):
                received[0].append(sensor.readline())
                received[1].append(reference.readline())
            took_s = time.monotonic() - opened_s
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
    bench = Bench(PRESETS["plain"](4), 4)
    for (first, *lines), values in zip(received, (bench.sensor_values, bench.reference_values), strict=True):
        assert (first[:1], lines[0][:2]) == (b"#", b"0,")
        sent = neighboured(lines)
        assert len(sent) > 400
        number = sent[:, 0].astype(int)
        assert_allclose(sent[:, 1:], values(0, number[-1] + 1)[number], atol=1e-9)
        # The faster clock has 1003.3 Hz. No upper limit: a busy machine may be late by any time.
        assert took_s > SETTLE_S + number[-1] / 1003.3, "samples came before they were due"
    assert not list(tmp_path.iterdir())
