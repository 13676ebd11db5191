"""Files whose units, columns or times could be taken for others: read right, or refused; never another S in silence."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from agent.calibrate.tables import read_reference, read_sensor
from agent.cli.main import run_cli
from agent.reading.dialect import dialect_of
from agent.reading.source import TableError
from calib.geometry import STANDARD_GRAVITY_MPS2 as G
from calib.recorded.arrays import sensor_table

S = np.array([[102.3, 1.1, -0.7], [-0.9, 98.4, 0.6], [0.5, -1.3, 95.1]])
RATE_HZ, STAY_S = 100.0, 15.0
ROTATION = ("--rotation", "1,0,0,0,1,0,0,0,1")


def motion(t: np.ndarray, seed: int) -> np.ndarray:
    """Accelerations (n,) in m/s2 of 15 sines."""
    random = np.random.default_rng(seed)
    frequency_hz, phase = random.uniform(1.0, 8.0, 15), random.uniform(0.0, 6.0, 15)
    return np.asarray(0.5 * np.sin(2.0 * np.pi * frequency_hz * t[:, None] + phase).sum(axis=1))


def written(path: Path, header: str, t: np.ndarray, values: np.ndarray) -> Path:
    with path.open("w") as file:
        file.write(header + "\n")
        np.savetxt(file, np.column_stack([t, values]), fmt="%.7g", delimiter=",")
    return path


def along_each_axis(folder: Path, header: str, unit: float) -> list[str]:
    """Options for a sensor that was moved along x, y and z, and a reference of one axis. Gravity is not stated."""
    t = np.arange(0.0, 3.0 * STAY_S, 1.0 / RATE_HZ)
    along, axis = motion(t, 1), np.minimum(t // STAY_S, 2.0).astype(int)
    random = np.random.default_rng(2)
    v = (along[:, None] * np.eye(3)[axis]) @ S.T + random.normal(0.0, 0.5, (len(t), 3))
    sensor = written(folder / "sensor.csv", "time_s,vx,vy,vz", t, v)
    reference = written(folder / "reference.csv", header, t, along / unit)
    stays = [(k * STAY_S + 0.5, (k + 1) * STAY_S - 0.5, *np.eye(3)[k]) for k in range(3)]
    poses = folder / "poses.csv"
    poses.write_text(
        "start_s,stop_s,dx,dy,dz\n" + "".join(",".join(f"{value:g}" for value in row) + "\n" for row in stays)
    )
    return ["--sensor", str(sensor), "--reference", str(reference), "--poses", str(poses)]


Calibrate = Callable[..., tuple[int, str]]


@pytest.fixture
def calibrate(capsys: pytest.CaptureFixture[str]) -> Calibrate:
    """Gives the exit status, and what is printed on standard output, or on standard error where nothing is."""

    def run(*options: str) -> tuple[int, str]:
        status = run_cli(["calibrate", *options, "--json", "-"])
        out, err = capsys.readouterr()
        return status, out or err

    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("header", "unit", "warned"),
    [
        ("time_s,a", 1.0, False),
        ("Time (s),Acc (ft/s2)", 0.3048, False),
        ("Time (s),Acc (in/s^2)", 0.0254, False),
        ("Time (s),Acc (G's)", G, False),
        ("Time (s),Acc (m·s⁻²)", 1.0, False),
        ("Time (s),Acc", 1.0, True),
    ],
)
def test_a_reference_of_one_axis(header: str, unit: float, warned: bool, tmp_path: Path, calibrate: Calibrate) -> None:
    status, told = calibrate(*along_each_axis(tmp_path, header, unit))
    assert status == 0, told
    found = json.loads(told)
    np.testing.assert_allclose(found["sensitivity"], S, atol=0.4)
    assert [w for w in found["warnings"] if "nobody stated the unit of the reference" in w] == found["warnings"]
    assert bool(found["warnings"]) == warned


@pytest.mark.parametrize("unit", ["EU", "%g", "g rms", "g pk", "ips2", "dB", "gRMS"])
def test_a_unit_of_a_reference_that_is_not_known(unit: str, tmp_path: Path) -> None:
    for header in (f"Time (s),Acc ({unit})", f"Time,Acc\ns,{unit}", f"Time,Acc [{unit}]"):
        path = written(tmp_path / "r.csv", header, np.arange(9.0), np.ones(9))
        with pytest.raises(TableError, match=r"line 1: unit .* of column .* is not known|expected exactly one"):
            read_reference(path)


@pytest.mark.parametrize("name", ["Acc (1)", "Acc (Ch 2)", "Acc (filtered)", "Acc (x)", "Acc [SN 1234]"])
def test_brackets_without_a_unit(name: str, tmp_path: Path) -> None:
    found = read_reference(written(tmp_path / "r.csv", f"Time,{name}", np.arange(9.0), np.ones(9)))
    assert not found.unit_stated
    assert found.x[:1].tolist() == [[1.0]]


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, G])
def test_a_reference_without_gravity_and_without_unit(unit: float, tmp_path: Path, calibrate: Calibrate) -> None:
    t = np.arange(0.0, 30.0, 1.0 / RATE_HZ)
    a = np.column_stack([motion(t, seed) for seed in (1, 2, 3)])
    v = (a + np.array([0.0, 0.0, 9.81])) @ S.T + np.random.default_rng(2).normal(0.0, 0.5, a.shape)
    options = ("--sensor", str(written(tmp_path / "s.csv", "time_s,vx,vy,vz", t, v)), "--reference",
               str(written(tmp_path / "r.csv", "Time,X,Y,Z", t, a / unit)), *ROTATION)  # fmt: skip
    status, told = calibrate(*options)
    assert status == 0, told
    found = json.loads(told)
    assert found["offset"] == [None] * 3  # gravity would be in it
    assert any("nobody stated its unit" in w for w in found["warnings"])


@pytest.mark.parametrize(
    ("names", "read"),
    [
        ("Ch1,Ch2,Ch3", "123"), ("AI 8,AI 9,AI 10", "123"), ("NS,EW,UD", "213"),
        ("Acc U-D (mV),Acc N-S (mV),Acc E-W (mV)", "321"),
        ("Longitudinal,Lateral,Vertical", "123"), ("N,E,D", "123"), ("A,B,C", "123"),
        ("Ch3,Ch1,Ch2", ""), ("acc3,acc2,acc1", ""), ("C,A,B", ""), ("AI 10,AI 9,AI 8", ""),
        ("Vertical,Longitudinal,Lateral", ""),
    ],
)  # fmt: skip
def test_columns_whose_names_tell_an_order(names: str, read: str, tmp_path: Path) -> None:
    values = np.tile([1.0, 2.0, 3.0], (9, 1))
    path = written(tmp_path / "s.csv", f"Time,{names}", np.arange(9.0), values)
    if not read:
        for reader in (read_sensor, read_reference):
            with pytest.raises(TableError, match=r"tell another order than x, y, z .*say which columns to use"):
                reader(path)
        return
    assert "".join(f"{v:g}" for v in read_sensor(path).v[:1][0]) == read


@pytest.mark.parametrize(
    ("begin", "told"),
    [
        (b'"TOB1","CR6"\r\n"SECONDS","NANOSECONDS","RECORD"\r\n"","",""\r\n' + bytes(range(256)), "convert it to TOA5"),
        (b"\x1f\x8b\x08\x00abc", "unpack it"), (b"PK\x03\x04s.csv", "unpack it"),
        (b"PK\x03\x04" + bytes(26) + b"arr_0.npy\x93NUMPY", r"an archive of NumPy \(.npz\)"),
        (b"PK\x03\x04" + bytes(26) + b"info.txt", r"ActiGraph \(.gt3x\)"),
        (b"PK\x03\x04" + bytes(26) + b"mimetypeapplication/vnd.oasis.opendocument", r"LibreOffice \(.ods\)"),
        (b"\x93NUMPY\x01\x00", "an array of NumPy"),
        (np.random.default_rng(1).integers(1, 256, 4000, np.uint8).tobytes(), "the file is not text"),
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "write it as .xlsx"),
        ("time_s,vx,vy,vz\n".encode("utf-32"), "write it in UTF-8"),
        (b'{"t": 0, "x": 1}\n', "it is JSON"), (b'[{"t": 0}]', "it is JSON"), (b"<?xml version='1.0'?>", "it is XML"),
        (b"    -1\r\n    58\r\nacc X\r\n", "it is UFF58"),
        (b"TIMESERIES XX_STA_00_HNZ_R, 4 samples, 100 sps, 2024-03-25T14:22:13, SLIST, INTEGER, Counts\n"
         b"9813\t10123\t10401\t10624\n", "fetch the same data as MiniSEED"),
        (b"Origin Time       2011/03/11 14:46:00\nLat.              38.103\n", "K-NET .* one channel"),
        (b"PEER NGA STRONG MOTION DATABASE RECORD\n", "PEER .* one channel"),
        (b"Uncorrected acceleration  (Format v01.20 with 13 text lines)\n", "COSMOS.* one channel"),
        (b"EVENT_NAME: X\nEVENT_ID: EMSC-1\n", "ESM .* one channel"),
    ],
)  # fmt: skip
def test_files_that_are_not_read(begin: bytes, told: str, tmp_path: Path) -> None:
    path = tmp_path / "file.csv"
    path.write_bytes(begin)
    with pytest.raises(TableError, match=told):
        read_sensor(path)


@pytest.mark.parametrize("name", ["MX840_CH_1", "QuantumX_1615", "cDAQ9188"])
def test_a_number_in_the_name_of_a_device_is_no_rate(name: str, tmp_path: Path) -> None:
    """A regression test. Behind "default sample rate", 840 of a module MX840 was the rate in Hz."""
    path = tmp_path / "s.txt"
    head = f"Time 1 - default sample rate\t{name}"
    path.write_text(f"CATMAN\n{head}\tb\tc\ns\tg\tg\tg\n" + "".join(f"{k / 50:.2f}\t0\t0\t1\n" for k in range(100)))
    assert dialect_of(path).rate_hz is None


def test_empty_quoted_fields_between_blanks(tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text('time_s vx vy vz\n0.0 1 2 ""\n0.1 1 2 3\n0.2 1 2 3\n')
    assert np.isnan(read_sensor(path).v[:1]).all()


@pytest.mark.parametrize("head", ["time_s,vz,vy,vx", '"s","V","V","V"', "Time (s),X (V),Y (V),Z (V)"])
def test_another_head_within_the_data(head: str, tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    rows = [f"{k / 10},1,2,3\n" for k in range(20)]
    path.write_text("time_s,vx,vy,vz\n" + "".join(rows[:10]) + head + "\n" + "".join(rows[10:]))
    with pytest.raises(TableError, match=r"line 12: .* has words and no value; .* cut the file here"):
        read_sensor(path)


def test_ms_without_leading_zeros(tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text("time,x,y,z\n" + "".join(f"17000000{k // 200:02d}.{5 * (k % 200)},1,2,3\n" for k in range(400)))
    with pytest.raises(TableError, match=r"1700000000\.1 after 1700000000\.5; .*do not sort, but write \.005"):
        read_sensor(path)


def test_times_in_us_in_both_files(tmp_path: Path, calibrate: Calibrate) -> None:
    t = np.arange(0.0, 6e7, 1e4)
    values = np.random.default_rng(3).normal(size=(len(t), 3))
    sensor = written(tmp_path / "s.csv", "Time,X,Y,Z", t, values)
    reference = written(tmp_path / "r.csv", "Time,ax,ay,az", t, values)
    began = time.process_time()
    status, told = calibrate("--sensor", str(sensor), "--reference", str(reference), *ROTATION)
    assert status == 2
    assert "1e+04 s apart, at most 10 s beside a reference; if they are in ms or in us, state their unit" in told
    assert time.process_time() - began < 5.0


@pytest.mark.parametrize(
    ("head", "unit", "factors"),
    [
        ("Time,Channel A,Channel B,Channel C\n(s),(V),(mV),(mV)", "V", [1.0, 1e-3, 1e-3]),
        ("Time (s),AccX (m/s2),AccY (g),AccZ (mg)", "m/s2", [1.0, G, 1e-3 * G]),
        ("time_s,vx,vy,vz\ns,g,g,mg", "g", [1.0, 1.0, 1e-3]),
        ("Time (s),X (cm/s2),Y (Gal),Z (gal)", "cm/s2", [1.0, 1.0, 1.0]),
    ],
)
def test_axes_in_several_units_are_read_in_that_of_x(
    head: str, unit: str, factors: list[float], tmp_path: Path
) -> None:
    path = written(tmp_path / "s.csv", head, np.arange(9.0), np.tile([1.0, 2.0, 3.0], (9, 1)))
    found = read_sensor(path)
    np.testing.assert_allclose(found.v[:2], np.multiply([[1.0, 2.0, 3.0]] * 2, factors), rtol=1e-14)
    assert found.unit == unit
    several = [line for line in found.said if f"all values are converted to {unit}" in line]
    assert bool(several) == (len(set(factors)) > 1)


def test_axes_in_several_units_in_a_notebook() -> None:
    columns = {"time [s]": np.arange(9.0), "x [V]": np.ones(9), "y [mV]": np.ones(9), "z [uV]": np.ones(9)}
    found = sensor_table(columns)
    np.testing.assert_allclose(found.v[:1], [[1.0, 1e-3, 1e-6]], rtol=1e-14)
    assert found.unit == "V"


@pytest.mark.parametrize("units", [("g", "V", "V"), ("m/s2", "m/s2", "m/s"), ("V", "V", "EU"), ("g", "", "mg")])
def test_axes_whose_units_do_not_go_together(units: tuple[str, ...], tmp_path: Path) -> None:
    head = "Time (s)," + ",".join(f"{axis} ({unit})" if unit else axis for axis, unit in zip("XYZ", units, strict=True))
    path = written(tmp_path / "s.csv", head, np.arange(9.0), np.ones((9, 3)))
    told = rf"the units do not go together, 'X.*' in {units[0]}, 'Y.*' in {units[1] or 'no unit'}.*'Z.*' in {units[2]}"
    for reader in (read_sensor, read_reference):
        with pytest.raises(TableError, match=told):
            reader(path)


def test_an_axis_without_a_unit_beside_others_in_g(tmp_path: Path) -> None:
    """Of a sensor it changes no value, and the unit is not known; that of a reference would be taken in m/s2."""
    path = written(tmp_path / "r.csv", "Time (s),X (g),Y (g),Z", np.arange(9.0), np.ones((9, 3)))
    assert read_sensor(path).unit == ""
    with pytest.raises(TableError, match=r"do not go together, 'X \(g\)' in g, .* 'Z' in no unit that is stated"):
        read_reference(path)


@pytest.mark.parametrize(("unit", "taken"), [("°C", True), ("degF", False), ("°F", False), ("K", False)])
def test_a_temperature_in_another_unit_is_left_out(unit: str, taken: bool, tmp_path: Path) -> None:
    path = written(tmp_path / "s.csv", f"Time,X,Y,Z,Temp ({unit})", np.arange(9.0), np.ones((9, 4)))
    found = read_sensor(path)
    assert (found.temperature_degc is not None) == taken
    assert any("not in degC; it is left out" in line for line in found.said) != taken


ROWS = "".join(f"{k / 100:.2f},1,2,3\n" for k in range(20))


@pytest.mark.parametrize(
    "head",
    [
        "Test ID,RUN_1\nEU Units,g,g,g\nTime,Chan 0:Acc X,Chan 1:Acc Y,Chan 2:Acc Z\n",
        "Sampling rate:,100 Hz\nUnit:,g\n\nTime,Ch_X,Ch_Y,Ch_Z\n",
        "# Unit: g\nTime,X,Y,Z\n",
        "Time,X,Y,Z\ns,g,g,g\n",
    ],
)
def test_units_that_a_line_of_the_head_states(head: str, tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text(head + ROWS)
    assert read_sensor(path).unit == "g"
    np.testing.assert_allclose(read_reference(path).x[:1], [[G, 2 * G, 3 * G]], rtol=1e-14)


@pytest.mark.parametrize(
    "line",
    [
        "Unit: 4711",
        "Units: SI",
        "Temperature unit: degC",
        "EU Units,g,g",
        "Unit: V\nUnit: mV",
        "Time unit: s",
        "Mass unit: g",
        "Length unit: m",
    ],
)
def test_lines_of_the_head_that_state_no_unit_of_the_channels(line: str, tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text(f"{line}\nTime,X,Y,Z\n{ROWS}")
    assert read_sensor(path).unit == ""


def test_units_in_names_come_before_those_of_the_head(tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text(f"Unit: g\nTime,X (mg),Y (mg),Z (mg)\n{ROWS}")
    assert read_sensor(path).unit == "mg"


@pytest.mark.parametrize("unit", ["m/(s^2)", "(m/(s^2))", "[m/(s²)]", "m/(s2)"])
def test_a_unit_with_brackets(unit: str, tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text(f"Time,X,Y,Z\ns,{unit},{unit},{unit}\n{ROWS}")
    assert read_sensor(path).unit == "m/s2"
    path.write_text(f"Time,X [{unit}],Y [{unit}],Z [{unit}]\n{ROWS}" if unit[0] == "m" else f"time_s,x,y,z\n{ROWS}")
    assert read_sensor(path).unit == ("m/s2" if unit[0] == "m" else "")


@pytest.mark.parametrize("head", ["Time(s),ax(g),ay(g),az(g),T(°)", "Time,X,Y,Z,T\ns,g,g,g,Deg C", "t,x,y,z,T [°C]"])
def test_t_in_degrees_is_a_temperature_and_no_time(head: str, tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text(head + "\n" + ROWS.replace(",3\n", ",3,25\n"))
    found = read_sensor(path)
    assert found.time_s[:2].tolist() == [0.0, 0.01]
    assert found.temperature_degc is not None
    assert found.temperature_degc[:1].tolist() == [25.0]


@pytest.mark.parametrize(("tick", "rate_hz", "told"), [(1e-6, 100, "us"), (1e-4, 100, "0.1 ms"), (1e-3, 125, "ms")])
def test_a_time_whose_unit_the_rate_in_the_head_tells(tick: float, rate_hz: int, told: str, tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    step = round(1.0 / rate_hz / tick)
    rows = "".join(f"{k},{7 * step + k * step},1,2,3\n" for k in range(20))
    path.write_text(f"OutputRate:,{rate_hz}Hz\n\nPacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z\n{rows}")
    found = read_sensor(path)
    np.testing.assert_allclose(np.diff(found.time_s[:]), 1.0 / rate_hz, rtol=1e-9)
    assert any(f"the head states {rate_hz} Hz; they are taken in {told}" in line for line in found.said)


def test_a_time_of_several_columns_names_them(tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text("secs,nsecs,x,y,z\n" + "".join(f"1700000000,{k}00000000,1,2,3\n" for k in range(9)))
    assert any("column 'secs' is the sum of 'secs' and 'nsecs'" in line for line in read_sensor(path).said)


@pytest.mark.parametrize(
    "line",
    ["acc,site=bridge x=0.1,y=0.2,z=9.8 1711376533000000000", "# export\nacc x=0.1,y=0.2,z=9.8 1711376533000000000"],
)
def test_the_line_protocol_of_influxdb_is_named(line: str, tmp_path: Path) -> None:
    path = tmp_path / "a.lp"
    path.write_text(f"{line}\n" * 9)
    with pytest.raises(TableError, match="the line protocol of InfluxDB, which is not read; write a CSV with a column"):
        read_sensor(path)


def test_times_that_differ_are_not_taken_for_the_same(tmp_path: Path) -> None:
    """The arrival is up to 40 ms later than the sample, which has ms."""
    path, late_s = tmp_path / "a.csv", np.random.default_rng(1).uniform(0.0, 0.04, 400)
    rows = (f"{k / 100:.3f},{k / 100 + late:.3f},{k},{k},{k}\n" for k, late in enumerate(late_s))
    path.write_text("time,timestamp,x,y,z\n" + "".join(rows))
    with pytest.raises(TableError, match="several columns could be time: 'time', 'timestamp'"):
        read_sensor(path)


def test_the_unit_of_the_channels_is_not_that_of_times_without_a_name(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("Unit: mV\n" + "".join(f"{k / 100:.2f},{k},2,3\n" for k in range(40)))
    found = read_sensor(path)
    assert (found.unit, found.time_s[:].tolist()[3], found.v[:].tolist()[3]) == ("mV", 0.03, [3.0, 2.0, 3.0])
