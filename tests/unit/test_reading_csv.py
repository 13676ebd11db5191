"""CSV as people and programs write it gives the same numbers as the plain CSV, and a fault is told in one line."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from agent.calibrate.tables import read_reference, read_sensor
from agent.cli.main import run_cli
from agent.reading import delimited
from agent.reading.source import TableError
from calib.recorded.table import ReferenceTable, SensorTable
from calib.recorded.units import sensitivity_of

G = 9.80665
N = 400
START_S = 1_700_000_000  # 2023-11-14T22:13:20Z
VALUES = np.column_stack([np.arange(N) / 100, np.random.default_rng(3).normal(0, 5, (N, 3)).round(4)])


@pytest.fixture(params=["pyarrow", "numpy"], autouse=True)
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "numpy":
        monkeypatch.setattr(delimited, "_arrow_parser", lambda: None)
    elif importlib.util.find_spec("pyarrow") is None:
        pytest.skip("pyarrow is not installed (extra files)")
    return str(request.param)


def table(delimiter: str = ",", decimal: str = ".", quote: str = "", end: str = "\n", form: str = "%.6f") -> str:
    cells = [[f"{quote}{(form % x).replace('.', decimal)}{quote}" for x in row] for row in VALUES]
    return "".join(delimiter.join(row) + end for row in cells)


def dates(form: Callable[[str], str], scale: float = 1.0) -> str:
    stamps = (np.datetime64(START_S, "s") + (VALUES[:, 0] * 1e6).round().astype("timedelta64[us]")).astype(str)
    return "".join(
        f"{form(stamp)},{','.join(f'{scale * x:.4f}' for x in row)}\n"
        for stamp, row in zip(stamps, VALUES[:, 1:], strict=True)
    )


def epoch(per_second: int) -> str:
    return "".join(
        f"{START_S * per_second + round(t * per_second)},{','.join(f'{x:.4f}' for x in row)}\n"
        for t, row in ((row[0], row[1:]) for row in VALUES)
    )


def in_two(per_second: int) -> str:
    """Whole seconds, and their parts in the next column."""
    ticks = [(round(row[0] * per_second), row[1:]) for row in VALUES]
    return "".join(
        f"{START_S + t // per_second},{t % per_second},{','.join(f'{x:.4f}' for x in row)}\n" for t, row in ticks
    )


HEADER = "time_s,vx,vy,vz\n"
SENSORS: dict[str, str | bytes] = {
    "plain": HEADER + table(),
    "semicolons and decimal commas": "time_s;vx;vy;vz\n" + table(";", ","),
    "tabs": "time_s\tvx\tvy\tvz\n" + table("\t"),
    "tabs and decimal commas": "time_s\tvx\tvy\tvz\n" + table("\t", ","),
    "bars": "time_s|vx|vy|vz\n" + table("|"),
    "blanks": "time_s vx vy vz\n" + table("   "),
    "blanks to begin with": "   time_s   vx  vy  vz\n" + "".join(f"  {x}\n" for x in table("  ").splitlines()),
    "quotes": '"time_s","vx","vy","vz"\n' + table(quote='"'),
    "quotes around decimal commas": '"time_s","vx","vy","vz"\n' + table(",", ",", '"'),
    "byte order mark and carriage returns": ("\ufeff" + HEADER + table()).replace("\n", "\r\n"),
    "UTF-16 of Excel": ("time_s\tvx\tvy\tvz\n" + table("\t", ",")).encode("utf-16"),
    "header of numpy.savetxt": "# " + HEADER + table(form="%.18e"),
    "no header": table(),
    "comments": "# logger 12\n# rate 100 Hz\n" + HEADER + table(),
    "lines before the header": 'Device: "A, B"\nSerial;17\nRange, 2\n\n' + HEADER + table(),
    "a row of units": "Time,Acc X,Acc Y,Acc Z\n(s),(m/s²),(m/s²),(m/s²)\n" + table(),
    "a row of units in cp1252": ("Time,Acc X,Acc Y,Acc Z\ns,m/s²,m/s²,m/s²\n" + table()).encode("cp1252"),
    "units in the names": "Time [ms],X (mg),Y (mg),Z (mg)\n"
    + "".join(f"{1000 * r[0]:.3f},{r[1]},{r[2]},{r[3]}\n" for r in VALUES.tolist()),
    "suffixes": "time_us,ax_g,ay_g,az_g\n"
    + "".join(f"{1e6 * r[0]:.0f},{r[1]},{r[2]},{r[3]}\n" for r in VALUES.tolist()),
    "many other columns": "Timestamp,label,gyroX,accelX,gyroY,accelY,accelZ,gyroZ,Temp\n"
    + "".join(f"{r[0]},walk,9,{r[1]},9,{r[2]},{r[3]},9,21\n" for r in VALUES.tolist()),
    "names without a meaning": "Time,ch1,ch2,ch3\n" + table(),
    "delimiters at the end": "time_s,vx,vy,vz,\n" + table().replace("\n", ",\n"),
    "delimiters at the end of rows alone": HEADER + table().replace("\n", ",\n"),
    "an index before": ",time_s,vx,vy,vz\n" + "".join(f"{k},{x}\n" for k, x in enumerate(table().splitlines())),
    "empty lines": HEADER + table(end="\n\n"),
    "blanks around": "time_s , vx , vy , vz\n" + table(" , "),
}  # fmt: skip
DATED: dict[str, str] = {
    "ISO 8601": "time,vx,vy,vz\n" + dates(lambda t: t),
    "ISO 8601 with Z": "time,vx,vy,vz\n" + dates(lambda t: t + "Z"),
    "ISO 8601 with a zone": "time,vx,vy,vz\n" + dates(lambda t: t.replace("T22", "T23") + "+01:00"),
    "a blank between date and time": "Date/Time,vx,vy,vz\n" + dates(lambda t: t.replace("T", " ").replace("-", "/")),
    "s since 1970": "timestamp,x,y,z\n"
    + "".join(f"{START_S + r[0]:.2f},{r[1]},{r[2]},{r[3]}\n" for r in VALUES.tolist()),
    "ms since 1970": "timestamp,x,y,z\n" + epoch(10**3),
    "us since 1970": "timestamp,x,y,z\n" + epoch(10**6),
    "ns since 1970": "timestamp,x,y,z\n" + epoch(10**9),
    "secs and nsecs": "secs,nsecs,x,y,z\n" + in_two(10**9),
    "stamps of ROS 2": "header.stamp.sec,header.stamp.nanosec,accel.x,accel.y,accel.z\n" + in_two(10**9),
}  # fmt: skip


def written(tmp_path: Path, text: str | bytes, name: str = "file.csv") -> Path:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.slow
@pytest.mark.parametrize("kind", SENSORS)
def test_sensors(kind: str, tmp_path: Path) -> None:
    found = read_sensor(written(tmp_path, SENSORS[kind]))
    np.testing.assert_allclose(found.time_s[:], VALUES[:, 0], rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(found.v[:], VALUES[:, 1:])
    told = "vx" not in str(SENSORS[kind])[:100] and kind != "UTF-16 of Excel"
    assert bool(found.said) == (told or kind == "UTF-16 of Excel" or "decimal commas" in kind)


def test_seconds_and_their_parts_that_are_stated(tmp_path: Path) -> None:
    text = "n,tv_sec,tv_usec,x,y,z\n" + "".join(f"{k},{line}\n" for k, line in enumerate(in_two(10**6).split()))
    found = read_sensor(written(tmp_path, text), columns="time=tv_sec,x=x,y=y,z=z")
    np.testing.assert_allclose(found.time_s[:], START_S + VALUES[:, 0], rtol=0, atol=2.5e-7)


@pytest.mark.slow
@pytest.mark.parametrize("kind", DATED)
def test_dates(kind: str, tmp_path: Path) -> None:
    found = read_sensor(written(tmp_path, DATED[kind]))
    np.testing.assert_allclose(
        found.time_s[:], START_S + VALUES[:, 0], rtol=0, atol=2.5e-7
    )  # one unit in the last place
    np.testing.assert_array_equal(found.v[:], VALUES[:, 1:])


def test_columns_that_are_stated(tmp_path: Path) -> None:
    text = "n,when,p,q,r\n" + "".join(f"{k},{1000 * r[0]},{r[1]},{r[2]},{r[3]}\n" for k, r in enumerate(VALUES))
    found = read_sensor(written(tmp_path, text), columns="time=when:ms, x=r, y=q, z=p")
    np.testing.assert_allclose(found.time_s[:], VALUES[:, 0], rtol=1e-12)
    np.testing.assert_array_equal(found.v[:], VALUES[:, :0:-1])
    assert found.said == ()


def test_a_missing_value_is_a_gap(tmp_path: Path) -> None:
    lines = (HEADER + table()).splitlines()
    for k, word in enumerate(("", "nan", "NaN", "NA", "null", "N/A")):
        fields = lines[10 + 3 * k].split(",")
        lines[10 + 3 * k] = ",".join([*fields[:2], word, fields[3]])
    found = read_sensor(written(tmp_path, "\n".join(lines) + "\n"))
    gaps = np.arange(9, 27, 3)
    assert np.isnan(found.v[:][gaps]).all()
    np.testing.assert_array_equal(np.delete(found.v[:], gaps, axis=0), np.delete(VALUES[:, 1:], gaps, axis=0))
    np.testing.assert_array_equal(found.time_s[:], VALUES[:, 0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("header", "unit", "quantity", "options"),
    [
        ("time_s,a", 1.0, "acceleration", {}),
        ("Time (s),Acceleration (g)", G, "acceleration", {}),
        ("t,acc_mg", 1e-3 * G, "acceleration", {}),
        ("t,acc", 1.0, "acceleration", {}),
        ("t,ch1", G, "acceleration", {"columns": "time=t,x=ch1:g"}),
        ("t,ch1", 1.0, "velocity", {"columns": "time=t,v=ch1"}),
        ("t,geophone [mm/s]", 1e-3, "velocity", {}),
        ("t,laser [um]", 1e-6, "displacement", {}),
        ("t,PCB (mV)", G / 102.5, "acceleration", {"sensitivity": "102.5 mV/g"}),
        ("t,PCB (V)", 1000 / 10.4, "acceleration", {"sensitivity": "10.4 mV/(m/s2)"}),
        ("t,PCB (counts)", 1 / 26000, "acceleration", {"sensitivity": "26000"}),
        ("t,ch1 (V)", 1 / 28.8, "velocity", {"sensitivity": "28.8 V/(m/s)"}),
    ],
)
def test_references_in_si(header: str, unit: float, quantity: str, options: dict[str, str], tmp_path: Path) -> None:
    text = header + "\n" + "".join(f"{t},{x}\n" for t, x in VALUES[:, :2].tolist())
    found = reference(written(tmp_path, text), **options)
    assert found.quantity == quantity
    np.testing.assert_allclose(found.x[:][:, 0], unit * VALUES[:, 1], rtol=1e-14)


def reference(path: Path, columns: str | None = None, sensitivity: str | None = None) -> ReferenceTable:
    return read_reference(path, None, columns, sensitivity_of(sensitivity) if sensitivity else None)


@pytest.mark.parametrize(
    ("header", "stated"),
    [("x [m/s2],y [m/s2],z [m/s2]", True), ("x,y [m/s2],z [m/s2]", False), ("x,y,z", False)],
)
def test_the_unit_is_stated_where_each_axis_has_one(header: str, stated: bool, tmp_path: Path) -> None:
    assert reference(written(tmp_path, f"time_s,{header}\n" + table())).unit_stated is stated


def test_three_axes_in_g(tmp_path: Path) -> None:
    found = reference(written(tmp_path, "Time,AccX [g],AccY [g],AccZ [g]\n" + table()))
    np.testing.assert_allclose(found.x[:], G * VALUES[:, 1:], rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b,c,d\n" + table(), r"line 1: column time_s, vx, vy, vz is missing in the header 'a,b,c,d'; say which .*"),
        ("time,ax,ay\n1,2,3\n2,3,4\n", "line 1: column vz is missing in the header 'time,ax,ay'; say which .*"),
        ("t,ax,ax2,x,y,z\n1,2,3,4,5,6\n2,3,4,5,6,7\n", "line 1: several columns could be x: 'ax', 'x' in .*--columns"),
        ("time,ax_g,ay_g,az_g,az_mg\n1,2,3,4,5\n2,2,3,4,5\n", "several columns could be z: 'az_g', 'az_mg'"),
        (HEADER + table().replace("1.230000,", "1.230000,a", 1), r"line 125, column vx: 'a[-.\d]+' is not .*gap"),
        (HEADER + table().replace("\n1.230000,", "\n1.230000,1,", 1), "line 125: 5 fields, but the header has 4"),
        ("time_s;vx;vy;vz\n" + table(";", ",").replace("\n1,2", "\n1.000,2", 1), "line .*, column time_s: '1.000,2"),
        (HEADER + table() + "2024-13-45T00:00:00,1,2,3\n", "line 402, column time_s: '2024-13-45T00:00:00' is not"),
        ("only words\nand more words\n", "line 1: column time_s, vx, vy, vz is missing"),
        (b"PK\x03\x04\0\0\0", "it is a compressed file, which is not read; unpack it"),
        (HEADER + "0,1,2," + "3" * (1 << 24) + "\n", "line 2: the line is longer|line 1: the line is longer"),
    ],
)  # fmt: skip
def test_faults(text: str | bytes, message: str, tmp_path: Path) -> None:
    with pytest.raises(TableError, match=message) as told:
        read_sensor(written(tmp_path, text))
    assert "\n" not in str(told.value)
    assert str(told.value).startswith(str(tmp_path / "file.csv"))


@pytest.mark.parametrize(
    ("header", "options", "message"),
    [
        ("t,ch1", {}, "neither name nor unit tells what 'ch1' is, add its unit .*--reference-columns"),
        (
            "t,PCB (mV)",
            {},
            "column 'PCB \\(mV\\)' is in mV, and its sensitivity is not stated; state it .* --sensitivity .100 mV/g",
        ),
        ("t,acc (g)", {"sensitivity": "100 mV/g"}, "is in g already; remove --sensitivity"),
        ("t,PCB (counts)", {"sensitivity": "100 mV/g"}, "--sensitivity is not for counts"),
        ("t,a", {"columns": "time=t,x=b"}, "there is no column 'b' in the header 't,a'"),
        ("t,a", {"columns": "time=t,x=a:furlong"}, "there is no column 'a:furlong'|unit 'furlong' .* is not known"),
        ("t,a", {"columns": "t,a"}, "--reference-columns: 't,a' is not understood; write time=NAME"),
        ("t_g,a", {"columns": "time=t_g,x=a"}, "column 't_g' is in g, which is no unit of time"),
    ],
)
def test_faults_of_references(header: str, options: dict[str, str], message: str, tmp_path: Path) -> None:
    path = written(tmp_path, header + "\n" + "".join(f"{t},{x}\n" for t, x in VALUES[:, :2].tolist()))
    with pytest.raises(TableError, match=message) as told:
        reference(path, **options)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("text", ["100 mV", "mV/g", "0 mV/g", "100 K/g", "100 mV/K", "nan mV/g", ""])
def test_sensitivities_that_are_none(text: str) -> None:
    with pytest.raises(ValueError, match=r"write it as|none of"):
        sensitivity_of(text)


def test_as_pandas_writes_it(tmp_path: Path) -> None:
    import pandas

    frame = pandas.DataFrame(VALUES[:, 1:], columns=["accel_x", "accel_y", "accel_z"])
    frame.index = pandas.to_datetime(START_S * 10**9 + (VALUES[:, 0] * 1e9).round().astype(int), utc=True)
    frame.index.name = "timestamp"
    frame.iloc[7, 1] = np.nan
    frame.to_csv(tmp_path / "frame.csv")
    found: SensorTable = read_sensor(tmp_path / "frame.csv")
    np.testing.assert_allclose(found.time_s[:], START_S + VALUES[:, 0], rtol=0, atol=2.5e-7)
    np.testing.assert_array_equal(np.delete(found.v[:], 7, axis=0), np.delete(VALUES[:, 1:], 7, axis=0))
    assert np.isnan(found.v[:][7]).all()


@pytest.mark.slow
def test_gaps_do_not_hide_the_rests(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(5)
    towards = random.normal(size=(14, 3))
    rests = np.repeat(G * towards / np.linalg.norm(towards, axis=1)[:, None], 400, axis=0)
    V = rests + random.normal(0, 0.002, rests.shape)
    lines = [f"{k / 100:.2f},{','.join(f'{x:.5f}' for x in row)}" for k, row in enumerate(V)]
    whole = written(tmp_path, HEADER + "\n".join(lines), "whole.csv")
    for k in range(50, len(lines), 97):
        lines[k] = f"{k / 100:.2f},,{lines[k].split(',', 2)[2]}"
    gaps = written(tmp_path, HEADER + "\n".join(lines), "gaps.csv")
    found = []
    for path in (whole, gaps):
        assert run_cli(["calibrate", "--sensor", str(path), "--json", "-"]) == 0
        found.append(json.loads(capsys.readouterr().out))
    np.testing.assert_allclose(found[1]["sensitivity"], found[0]["sensitivity"], atol=1e-4)
    assert len(found[1]["windows"]) == len(found[0]["windows"]) == 14


def test_a_reference_in_g_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = np.random.default_rng(4).normal([0.01, -0.02, 0.99], 0.01, (N, 3))
    text = "time_s,ax,ay,az\n" + "".join(f"{k / 100},{x},{y},{z}\n" for k, (x, y, z) in enumerate(rows.tolist()))
    sensor, beside = written(tmp_path, HEADER + table()), written(tmp_path, text, "reference.csv")
    arguments = ["calibrate", "--sensor", str(sensor), "--reference", str(beside), "--rotation", "1,0,0,0,1,0,0,0,1"]
    assert run_cli(arguments) == 2
    told = capsys.readouterr().err
    assert "values of about 1 at rest are in g; state the unit with --reference-columns time=NAME,x=NAME:g" in told
    assert told.count("\n") == 1
