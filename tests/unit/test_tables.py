"""Tables of `fieldcal calibrate`: what they accept, and where they say a fault is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agent.calibrate.faults import as_table_error
from agent.calibrate.poses import PosesFile
from agent.calibrate.tables import read_reference, read_sensor
from agent.reading import lines
from agent.reading.source import TableError
from calib.recorded.poses import PoseInterval, PoseSettings, intervals_of

HEADER = "time_s,vx,vy,vz\n"


def write(tmp_path: Path, text: str | bytes, name: str = "sensor.csv") -> Path:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def grid(n: int = 200) -> np.ndarray:
    return np.column_stack([np.arange(n) / 100, np.random.default_rng(1).normal(0, 5, (n, 3)).round(4)])


def body(rows: np.ndarray, form: str = "%.6f") -> str:
    return "".join(",".join(form % x for x in row) + "\n" for row in rows)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["%.6f", "%.17g", "%.9e", " %.6f "])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("tail", ["", "\n\n", "cut"])
def test_any_spelling_of_numbers(tmp_path: Path, form: str, end: str, tail: str) -> None:
    rows = grid()
    text = (HEADER + body(rows, form)).replace("\n", end)
    text = text[: -len(end)] if tail == "cut" else text + tail
    table = read_sensor(write(tmp_path, text))
    whole = rows[:-1] if tail == "cut" else rows  # a last line without its end may be cut off
    np.testing.assert_allclose(np.column_stack([table.time_s[:], table.v[:]]), whole, rtol=1e-9, atol=1e-9)
    assert table.temperature_degc is None


def test_columns_in_any_order_with_others_between_and_a_byte_order_mark(tmp_path: Path) -> None:
    text = "\ufeffvz,gyro,vx,time_s,vy,temperature_degc\n" + "".join(f"3,9,1,{k}.5,2,2{k}\n" for k in range(4))
    table = read_sensor(write(tmp_path, text))
    np.testing.assert_array_equal(table.time_s[:], [0.5, 1.5, 2.5, 3.5])
    np.testing.assert_array_equal(table.v[:], [[1, 2, 3]] * 4)
    assert table.temperature_degc is not None
    np.testing.assert_array_equal(table.temperature_degc[:], [20, 21, 22, 23])


def test_a_file_of_many_chunks_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = grid(3000)
    path = write(tmp_path, HEADER + body(rows[:1500]) + body(rows[1500:], "%.8e"))
    monkeypatch.setattr(lines, "CHUNK_BYTES", 1000)
    seen = list[int]()
    table = read_sensor(path, seen.append)
    np.testing.assert_allclose(np.column_stack([table.time_s[:], table.v[:]]), rows, rtol=1e-9, atol=1e-9)
    assert sum(seen) == path.stat().st_size


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time_s,vx,vy\n0,1,2\n", "line 1: column vz is missing in the header 'time_s,vx,vy'"),
        ("time_s,vx,vy,vz,vx_mg\n0,1,2,3,4\n", "line 1: there are both vx and vx_mg"),
        ("time_s,vx,vx,vy,vz\n0,1,2,3,4\n", "line 1: a column is there twice"),
        (HEADER + "0,1,2,3\n0.1,1,2\n0.2,1,2,3\n", "line 3: 3 fields, but the header has 4"),
        (HEADER + "0,1,2,3\n0.1,1,x2,3\n0.2,1,2,3\n", "line 3, column vy: 'x2' is not a finite number"),
        (HEADER + "0,1,2,3\n0.1,1,2,-inf\n0.2,1,2,3\n", "line 3, column vz: '-inf' is not a finite number"),
        (HEADER + "0,1,2,3\n0.1,1,2,1e200\n0.2,1,2,3\n", "line 3, column vz: '1e200' is larger than 1e\\+19"),
        (HEADER + "0,1,2,3\n1,,,\n2,,,\n", "1 rows of data, at least 2 are needed"),
        (HEADER + "0,1,2,3\n", "1 rows of data, at least 2 are needed"),
        (HEADER, "0 rows of data"),
        ("", "line 1: the file is empty; expected a header such as time_s"),
        (b"\x7fELF\x00,1\n", "line 1: the file is not text"),
        (HEADER + "1,1,2,3\n1,1,2,3\n1,1,2,3\n", "column time_s: the value is 1 in every row"),
        (HEADER + "2,1,2,3\n1,1,2,3\n0,1,2,3\n", "line 3, column time_s: 1 after 2; time must not decrease"),
    ],
)
def test_a_fault_is_named_with_its_place(tmp_path: Path, text: str | bytes, message: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(TableError, match=message) as error:
        read_sensor(path)
    assert str(error.value).startswith(str(path))


def test_a_fault_far_inside_has_the_right_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = (HEADER + body(grid(5000))).splitlines(keepends=True)
    told[3776] = "37.75,1,2,three\n"
    monkeypatch.setattr(lines, "CHUNK_BYTES", 4096)
    with pytest.raises(TableError, match="line 3777, column vz: 'three'"):
        read_sensor(write(tmp_path, "".join(told)))


def test_one_stamp_back_on_a_grid_is_a_fault_but_not_among_jittery_ones(tmp_path: Path) -> None:
    rows = grid(3000)
    rows[700, 0] = rows[697, 0]
    with pytest.raises(TableError, match=r"line 702, column time_s: 6\.97 after 6\.99"):
        read_sensor(write(tmp_path, HEADER + body(rows)))
    rows[:, 0] = np.arange(3000) / 100 + np.random.default_rng(2).normal(0, 0.01, 3000)
    assert len(read_sensor(write(tmp_path, HEADER + body(rows))).time_s) == 3000
    rows[2000:, 0] -= 5.0
    with pytest.raises(TableError, match=r"line 2002, column time_s: .* time must not decrease"):
        read_sensor(write(tmp_path, HEADER + body(rows)))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(TableError, match=r"gone.csv: No such file"):
        read_sensor(tmp_path / "gone.csv")


@pytest.mark.parametrize(
    ("header", "channels", "quantity"),
    [
        ("time_s,a", 1, "acceleration"),
        ("time_s,v", 1, "velocity"),
        ("time_s,d", 1, "displacement"),
        ("ax,ay,az,time_s", 3, "acceleration"),
    ],
)
def test_references(tmp_path: Path, header: str, channels: int, quantity: str) -> None:
    fields = header.split(",")
    text = header + "\n" + "".join(",".join(str(k if f == "time_s" else 7) for f in fields) + "\n" for k in range(3))
    table = read_reference(write(tmp_path, text))
    assert (table.x[:].shape, table.quantity) == ((3, channels), quantity)
    np.testing.assert_array_equal(table.x[:], 7)
    np.testing.assert_array_equal(table.time_s[:], [0, 1, 2])


@pytest.mark.parametrize("header", ["time_s,a,v", "time_s,ax,ay", "time_s"])
def test_a_reference_must_be_one_thing(tmp_path: Path, header: str) -> None:
    with pytest.raises(TableError, match="expected exactly one of"):
        read_reference(write(tmp_path, header + "\n" + ",".join("1" for _ in header.split(",")) + "\n"))


UNIAXIAL = PoseSettings(reference_channels=1)


def read_poses(path: Path, setting: PoseSettings) -> list[PoseInterval]:
    read = PosesFile(path)
    assert read.poses is not None
    with as_table_error(read.line):
        return intervals_of(read.poses, setting)


@pytest.mark.parametrize(
    ("header", "row", "direction", "gravity"),
    [
        ("theta_deg,alpha_deg", "90,0", [0, 0, 1], [0, -9.80665, 0]),
        ("dx,dy,dz", "0.6,0,0.8", [0.6, 0, 0.8], [np.nan] * 3),
        ("dx,dy,dz,gx,gy,gz", "0.6,0,0.8,0,9.8,0", [0.6, 0, 0.8], [0, 9.8, 0]),
        ("axis", "Y", [0, 1, 0], [np.nan] * 3),
        ("axis,gx,gy,gz", "x,0,0,9.8", [1, 0, 0], [0, 0, 9.8]),
    ],
)
def test_poses_of_motion(tmp_path: Path, header: str, row: str, direction: list, gravity: list) -> None:
    [interval] = read_poses(write(tmp_path, f"start_s,stop_s,{header}\n1.5,2.5,{row}\n"), UNIAXIAL)
    assert (interval.start_s, interval.stop_s) == (1.5, 2.5)
    np.testing.assert_allclose(interval.pose.direction[:, 0], direction, atol=1e-15)
    np.testing.assert_allclose(interval.pose.gravity_mps2, gravity, atol=1e-14)


def test_who_feels_gravity(tmp_path: Path) -> None:
    clamp = write(tmp_path, "start_s,stop_s,theta_deg,alpha_deg\n0,1,90,0\n", "clamp.csv")
    given = write(tmp_path, "start_s,stop_s,dx,dy,dz,gx,gy,gz\n0,1,0.6,0,0.8,0,0,9.8\n", "given.csv")
    rest = write(tmp_path, "start_s,stop_s,gx,gy,gz\n0,1,0,0,9.8\n", "rest.csv")

    def gravity(path: Path, **setting: object) -> list[float]:
        return read_poses(path, PoseSettings(**setting))[0].pose.gravity_mps2.tolist()  # type: ignore[arg-type]

    assert gravity(clamp, coupling="ac") == [0, 0, 0]
    np.testing.assert_allclose(gravity(clamp, static_sign=-1, gravity_mps2=9.7), [0, 9.7, 0], atol=1e-14)
    np.testing.assert_allclose(gravity(given, reference_coupling="dc"), [-0.6 * 0.8 * 9.8, 0, 9.8 - 0.64 * 9.8])
    assert gravity(rest, reference_channels=0) == [0, 0, 9.8]
    beside = {"reference_channels": 3, "rotation": np.eye(3)}
    assert gravity(rest, **beside, reference_coupling="ac") == [0, 0, 9.8]
    assert gravity(rest, **beside, reference_coupling="dc") == [0, 0, 0]
    assert np.isnan(gravity(rest, **beside, reference_coupling="dc", coupling="ac")).all()


@pytest.mark.parametrize(
    ("text", "setting", "message"),
    [
        ("start_s,stop_s,dx,dy,dz\n0,1,1,1,0\n", UNIAXIAL, r"line 2: direction must be a unit vector"),
        ("start_s,stop_s,axis\n0,1,x\n2,3,w\n", UNIAXIAL, r"line 3: axis must be x, y or z, is 'w'"),
        ("start_s,stop_s,axis\n1,1,x\n", UNIAXIAL, r"line 2, column stop_s: 1 is not after start_s 1"),
        (
            "start_s,stop_s,axis\n5,9,x\n0,5.5,y\n",
            UNIAXIAL,
            r"line 2, column start_s: this pose begins at 5 s, before the end of the pose from 0 s to 5\.5 s",
        ),
        ("start_s,stop_s,axis\n0,1\n", UNIAXIAL, r"line 2: 2 fields, but the header has 3"),
        ("start_s,stop_s,axis\n0,inf,x\n", UNIAXIAL, r"line 2, column stop_s: 'inf' is not a finite number"),
        ("start_s,stop_s,axis\n", UNIAXIAL, r"there are no poses"),
        ("start_s,axis\n0,x\n", UNIAXIAL, r"line 1: column stop_s is missing"),
        (
            "start_s,stop_s,theta_deg,alpha_rad\n0,1,35,0\n",
            UNIAXIAL,
            r"line 1: column alpha_deg is missing .*alpha_rad has ano",
        ),
        ("start_s,stop_s,theta_deg,alpha_deg,axis\n0,1,35,0,x\n", UNIAXIAL, r"line 1: expected one of"),
        ("start_s,stop_s\n0,1\n", UNIAXIAL, r"line 1: expected one of"),
        ("start_s,stop_s,gx,gy,gz\n0,1,0,0,9.8\n", UNIAXIAL, r"line 2: gx,gy,gz alone is a static position"),
        (
            "start_s,stop_s,gx,gy,gz\n0,1,0,0,9.8\n",
            PoseSettings(reference_channels=0, coupling="ac"),
            "line 2: an AC-coupled",
        ),
        ("start_s,stop_s,axis\n0,1,x\n", PoseSettings(reference_channels=0), r"line 2: .*--reference is needed"),
        (
            "start_s,stop_s,axis\n0,1,x\n",
            PoseSettings(reference_channels=3),
            r"line 2: a tri-axial reference measures the direction itself",
        ),
        ("start_s,stop_s,gx,gy,gz\n0,1,0,0,9.8\n", PoseSettings(reference_channels=3), r"line 2: .* needs --rotation"),
    ],
)
def test_a_fault_of_poses_is_named_with_its_place(
    tmp_path: Path, text: str, setting: PoseSettings, message: str
) -> None:
    path = write(tmp_path, text, "poses.csv")
    with pytest.raises(TableError, match=message) as error:
        read_poses(path, setting)
    assert str(error.value).startswith(str(path))
