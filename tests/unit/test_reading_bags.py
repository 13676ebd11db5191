"""Bags as people have them: cut, unchunked, out of order, doubled, of several publishers, in SQLite, of ROS 1."""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from agent.calibrate.tables import SensorFile, read_reference, read_sensor
from agent.cli.main import run_cli
from agent.reading.formats import Description
from agent.reading.source import TableError
from tests.unit.test_reading_csv import written
from tests.unit.test_reading_formats import GOLDEN, fault, imu

N, RATE_HZ = 1600, 100
NS = 1_700_000_000_000_000_000 + np.arange(N) * (10**9 // RATE_HZ)
TIME_S = NS * 1e-9
V = np.random.default_rng(36).normal(0.0, 5.0, (N, 3))
IMU = "sensor_msgs/msg/Imu"
Row = tuple[int, int, np.ndarray]  # stamp and time of recording in ns, acceleration


def rows(k: Sequence[int] | np.ndarray | range = range(N), late_ns: int = 0) -> list[Row]:
    return [(int(NS[i]), int(NS[i]) + late_ns, V[i]) for i in k]


def mcap(path: Path, *channels: list[Row], kind: str = IMU, language: str = "ros2msg", **options: Any) -> Path:
    """A bag by the library mcap; each of the channels is a publisher on /imu, and they take turns."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("ros2", "test")
        schema = writer.register_schema(kind, language, b"")
        numbers = [writer.register_channel("/imu", "cdr", schema) for _ in channels]
        for together in zip(*channels, strict=True):
            for number, (stamp_ns, log_ns, v) in zip(numbers, together, strict=True):
                writer.add_message(number, log_ns, imu(stamp_ns, v, "imu_link"), log_ns)
        writer.finish()
    return path


def part(path: Path, share: float) -> Path:
    """The first part of a file."""
    data = path.read_bytes()
    return written(path.parent, data[: int(share * len(data))], f"{share}-{path.name}")


def begins(found: SensorFile) -> int:
    """How many samples are there; they are the first of V."""
    n = len(found.v)
    np.testing.assert_array_equal(found.v[:], V[:n])
    np.testing.assert_allclose(found.time_s[:], TIME_S[:n], rtol=0, atol=5e-7)
    return n


# Cut files


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "share", "least"),
    [
        ({"compression": CompressionType.NONE}, 0.4, 0.39),
        ({"compression": CompressionType.NONE}, 0.9, 0.89),
        ({"compression": CompressionType.ZSTD}, 0.6, 0.5),
        ({"compression": CompressionType.LZ4}, 0.6, 0.5),
        ({"use_chunking": False}, 0.5, 0.49),
    ],
)
def test_a_cut_mcap_is_read_up_to_the_cut(options: dict[str, Any], share: float, least: float, tmp_path: Path) -> None:
    path = part(mcap(tmp_path / "a.mcap", rows(), **options), share)
    found = read_sensor(path)
    assert least * N < begins(found) < N
    told = f"{path}: the file ends early, as after a power cut; it is read up to byte "
    assert found.said[0].startswith(told)
    assert f" of {path.stat().st_size} (" in found.said[0]


def test_zeros_in_place_of_lost_data_are_a_cut(tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap", rows(), chunk_size=1 << 16)
    data = path.read_bytes()
    zeros = written(tmp_path, data[: len(data) // 2] + bytes(len(data) // 2), "b.mcap")
    found = read_sensor(zeros)
    assert 0.4 * N < begins(found) < 0.6 * N
    assert "ends early" in found.said[0]


def test_a_damaged_bag_is_refused_with_a_remedy_that_works(tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap", rows(), chunk_size=1 << 16, compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    fault(written(tmp_path, bytes(data), "b.mcap"), r"byte \d+ \(Chunk: .*; the file is damaged: .*`mcap recover`")


@pytest.mark.parametrize("share", [0.6, 0.95])
def test_a_cut_recording_of_this_program_says_so(
    share: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = read_sensor(GOLDEN)
    path = part(Path(shutil.copy(GOLDEN, tmp_path / "a.mcap")), share)
    found = read_sensor(path)
    n = len(found.v)
    assert 0 < n < len(whole.v)
    np.testing.assert_array_equal(found.v[:], whole.v[:][:n])
    assert not any("ends early" in line for line in whole.said)
    assert run_cli(["convert", str(path), "-o", str(tmp_path / "a.csv")]) == 0
    told = capsys.readouterr().err
    assert f"{path}: the file ends early, as after a power cut, or is still written; it is read up to byte " in told
    assert told.count("ends early") == 1
    early = part(Path(shutil.copy(GOLDEN, tmp_path / "b.mcap")), 0.1)
    fault(early, r"it is read up to byte \d+ of \d+ \(.*\); no sample is before that")


# Order, doubles, publishers


def test_messages_outside_chunks(tmp_path: Path) -> None:
    assert begins(read_sensor(mcap(tmp_path / "a.mcap", rows(), use_chunking=False))) == N


DRAW = np.random.default_rng(1)
SHUFFLED = DRAW.permutation(N)
SWAPPED = np.arange(N).reshape(-1, 2)[:, ::-1].ravel()


@pytest.mark.slow
@pytest.mark.parametrize(
    "order", [SHUFFLED, SWAPPED, np.roll(np.arange(N), N // 2)], ids=["shuffled", "swapped", "halves"]
)
@pytest.mark.parametrize("logged", [True, False], ids=["by recording", "by stamp"])
def test_messages_out_of_order_are_sorted(order: np.ndarray, logged: bool, tmp_path: Path) -> None:
    made = rows(order) if logged else [(int(NS[i]), int(NS[k]), V[i]) for k, i in enumerate(order)]
    found = read_sensor(mcap(tmp_path / "a.mcap", made))
    assert begins(found) == N
    assert "messages do not stand in the order of their times; they are sorted" in found.said[0]


def test_late_stamps_keep_the_order_of_recording(tmp_path: Path) -> None:
    """Stamps with noise of 20 ms at 100 Hz: the samples are in order, their stamps are not."""
    late = NS + (2e7 * DRAW.random(N)).astype(np.int64)
    made = [(int(late[i]), int(NS[i]), V[i]) for i in range(N)]
    found = read_sensor(mcap(tmp_path / "a.mcap", made))
    np.testing.assert_array_equal(found.v[:], V)
    assert not any("sorted" in line for line in found.said)


def test_a_clock_that_was_set_back_is_not_sorted_away(tmp_path: Path) -> None:
    """The second half has the stamps of the first, between them: sorting would mix two halves."""
    made = [(int(NS[i % (N // 2)]) + (i >= N // 2) * 5_000_000, int(NS[i]), V[i]) for i in range(N)]
    fault(mcap(tmp_path / "a.mcap", made), f"row {N // 2 + 1}, column time_s: .*; time must not decrease, sort or cut")


@pytest.mark.slow
@pytest.mark.parametrize("late_ns", [0, 700_000])
def test_doubled_messages_are_taken_once(late_ns: int, tmp_path: Path) -> None:
    """As after a merge of files that overlap, and as a driver that publishes twice (zed-ros-wrapper issue 577)."""
    doubled = sorted([*rows(), *rows(range(0, N, 7), late_ns)], key=lambda row: row[1])
    found = read_sensor(mcap(tmp_path / "a.mcap", doubled))
    assert begins(found) == N
    assert f"{len(range(0, N, 7))} messages are there twice; each is taken once" in found.said[0]
    merged = read_sensor(mcap(tmp_path / "b.mcap", [*rows(range(1200)), *rows(range(800, N))]))
    assert begins(merged) == N
    assert any("400 messages are there twice" in line for line in merged.said)


def test_equal_samples_of_a_burst_are_no_doubles(tmp_path: Path) -> None:
    """Ten samples have one stamp, and a sensor of few bits repeats its value."""
    coarse = np.round(V / 5.0)
    made = [(int(NS[i - i % 10]), int(NS[i]), coarse[i - (i % 10 == 5)]) for i in range(N)]
    found = read_sensor(mcap(tmp_path / "a.mcap", made))
    np.testing.assert_array_equal(found.v[:], [v for _, _, v in made])


def test_two_publishers_on_one_topic_are_two_streams(tmp_path: Path) -> None:
    other = [(stamp, log, -v) for stamp, log, v in rows()]
    path = mcap(tmp_path / "a.mcap", rows(), other)
    fault(path, r"several groups could be meant \(/imu#1, /imu#2\), add group=NAME")
    first, second = (read_sensor(path, columns=f"group=/imu#{k}") for k in (1, 2))
    assert begins(first) == N
    np.testing.assert_array_equal(second.v[:], -V)
    assert f"/imu has 2 publishers, each is a group of its own: /imu#1 ({N} messages), /imu#2 ({N}" in first.said[0]
    written(tmp_path, b'["/imu"]\nx = "linear_acceleration.z"\n', "m.toml")
    described = Description(mapping=tmp_path / "m.toml")
    mapped = read_reference(path, columns="group=/imu#2,time=time_s,x=x:g", described=described)
    np.testing.assert_allclose(mapped.x[:][:, 0], -9.80665 * V[:, 2], rtol=1e-15)


def test_two_publishers_in_one_channel_are_told_apart_by_their_frames(tmp_path: Path) -> None:
    """rosbag2 records all publishers of a topic in one channel."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        channel = writer.register_channel("/imu", "cdr", writer.register_schema(IMU, "ros2msg", b""))
        for stamp, log, v in rows():
            writer.add_message(channel, log, imu(stamp, v, "left"), log)
            writer.add_message(channel, log, imu(stamp, -v, "right"), log)
        writer.finish()
    fault(path, r"several groups could be meant \(/imu#1, /imu#2\), add group=NAME")
    left, right = (read_sensor(path, columns=f"group=/imu#{k}") for k in (1, 2))
    assert begins(left) == N
    np.testing.assert_array_equal(right.v[:], -V)
    assert f"/imu#1 (frame 'left', {N} messages), /imu#2 (frame 'right', {N} messages)" in left.said[0]


# What is not read


@pytest.mark.parametrize("language", ["ros2idl", "protobuf", "jsonschema", ""])
def test_a_schema_that_is_not_read_is_refused_at_once(language: str, tmp_path: Path) -> None:
    """Not after the user was told to state a mapping, which would not help."""
    kind = "sensor_msgs/msg/Imu" if language == "ros2idl" else "foxglove.Imu" if language else ""
    path = mcap(tmp_path / "a.mcap", rows(range(50)), kind=kind, language=language)
    told = f"{kind or 'no type'}, {language or 'no definition'}"
    with pytest.raises(TableError, match=rf"no topic can be read; the topics are /imu \({told}\);") as refused:
        read_sensor(path)
    assert "--mapping" not in str(refused.value)
    assert "write the samples as CSV" in str(refused.value)


def test_an_imu_in_g_is_told_and_the_remedy_is_accepted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rests = np.repeat(np.vstack([np.eye(3), -np.eye(3)]), N // 6, axis=0)
    in_g = rests + 0.05 * V[: len(rests)] / 5.0
    made = [(int(NS[i]), int(NS[i]), in_g[i]) for i in range(len(in_g))]
    path = mcap(tmp_path / "a.mcap", made)
    assert run_cli(["convert", str(path), "-o", str(tmp_path / "a.csv"), "--as", "reference"]) == 0
    told = next(line for line in capsys.readouterr().err.splitlines() if "in g" in line)
    assert re.search("/imu: the magnitude at rest is (0.99|1)[0-9]*, but the unit is m/s2: .* probably in g", told)
    remedy = told.rpartition("--reference-columns ")[2]
    words = ["convert", str(path), "-o", str(tmp_path / "b.csv"), "--as", "reference", "--columns", remedy]
    assert run_cli(words) == 0
    assert "in g" not in capsys.readouterr().err
    found = np.loadtxt(tmp_path / "b.csv", delimiter=",", skiprows=1)[:, 1:]
    np.testing.assert_allclose(found, 9.80665 * in_g, rtol=1e-15)
    in_mps2 = mcap(tmp_path / "c.mcap", [(s, log, 9.80665 * v) for s, log, v in made])
    without_gravity = mcap(tmp_path / "d.mcap", [(s, log, v - rests[k]) for k, (s, log, v) in enumerate(made)])
    for other in (in_mps2, without_gravity):
        assert not any("in g" in line for line in read_sensor(other).said)


# SQLite and ROS 1


def messages(store: Any, *, ros1: bool) -> Iterator[tuple[int, Any]]:
    types, none = store.types, np.zeros(9)
    vector, turn = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    for k, (ns, v) in enumerate(zip(NS.tolist(), V.tolist(), strict=True)):
        now = types["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9)
        header = types["std_msgs/msg/Header"](*((k,) if ros1 else ()), now, "imu_link")
        yield ns, types[IMU](header, turn, none, vector(7.0, 8.0, 9.0), none, vector(*v), none)


def db3(directory: Path) -> Path:
    """A bag of rosbag2 in SQLite, by rosbags."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed; it writes the files")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with rosbag2.Writer(directory / "bag", version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/imu", IMU, typestore=store)
        for ns, message in messages(store, ros1=False):
            writer.write(connection, ns, store.serialize_cdr(message, IMU))
    return next((directory / "bag").glob("*.db3"))


@pytest.mark.slow
def test_a_bag_in_sqlite(tmp_path: Path) -> None:
    path = db3(tmp_path)
    assert begins(read_sensor(path)) == N
    odd = Path(shutil.copy(path, tmp_path / "a?mode=rwc#b%41.db3"))  # in an address it would name another file
    before = sorted(tmp_path.iterdir())
    assert begins(read_sensor(odd)) == N
    assert sorted(tmp_path.iterdir()) == before
    for share in (0.3, 0.7):
        found = read_sensor(part(path, share))
        assert (share - 0.05) * N < begins(found) < share * N
        assert "the file is cut or damaged; it is read up to message " in found.said[0]
    written(path.parent, b"x" * 100, f"{path.name}-wal")
    assert "its newest messages are in bag.db3-wal, which is not read" in read_sensor(path).said[0]


def test_a_bag_in_sqlite_of_before_iron_needs_no_definition_of_imu(tmp_path: Path) -> None:
    path = db3(tmp_path)
    with sqlite3.connect(path) as file:
        file.executescript("DROP TABLE message_definitions; DROP TABLE schema; DROP TABLE metadata;")
    file.close()
    assert begins(read_sensor(path)) == N
    with sqlite3.connect(path) as file:
        file.execute("UPDATE topics SET type = 'vendor_msgs/msg/Imu'")
    file.close()
    written(tmp_path, b'["/imu"]\nx = "a"\n', "m.toml")
    with pytest.raises(TableError, match=r"no definition of vendor_msgs/msg/Imu, .*`ros2 bag convert`"):
        read_sensor(path, described=Description(mapping=tmp_path / "m.toml"))


HOSTILE_SQL = {
    "a view": ("DROP TABLE messages; CREATE VIEW messages AS SELECT 1 AS topic_id, 1 AS timestamp, x'00' AS data;",
               "has no tables topics and messages"),
    "values that are computed": (
        "DROP TABLE messages; CREATE TABLE messages(topic_id, timestamp, data AS (zeroblob(100000000)));"
        "INSERT INTO messages VALUES (1, 1), (1, 2), (1, 3);", "more bytes than the file"),
    "no table": ("DROP TABLE topics;", "has no tables topics and messages"),
    "other columns": ("DROP TABLE topics; CREATE TABLE topics(a);", "cannot be read: no such column"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", HOSTILE_SQL)
def test_hostile_databases(kind: str, tmp_path: Path) -> None:
    path, (script, message) = db3(tmp_path), HOSTILE_SQL[kind]
    with sqlite3.connect(path) as file:
        file.executescript(script)
    file.close()
    fault(path, message)


def ros1(path: Path, compression: str = "", publishers: int = 1) -> Path:
    """A bag of ROS 1, by rosbags."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="rosbags is not installed; it writes the files")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    with writer:
        sent = [writer.add_connection("/imu", IMU, typestore=store, callerid=f"/{k}") for k in range(publishers)]
        for ns, message in messages(store, ros1=True):
            for connection in sent:
                writer.write(connection, ns, store.serialize_ros1(message, IMU))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["", "BZ2", "LZ4"])
def test_a_bag_of_ros_1(compression: str, tmp_path: Path) -> None:
    path = ros1(tmp_path / "a.bag", compression)
    whole = read_sensor(path)
    assert begins(whole) == N
    assert not any("ends early" in line for line in whole.said)
    found = read_sensor(part(path, 0.9))
    assert 0.7 * N < begins(found) <= N
    assert f"{tmp_path}/0.9-a.bag: the file ends early, as after a power cut; it is read up to byte " in found.said[0]


def test_a_bag_of_ros_1_that_was_never_closed(tmp_path: Path) -> None:
    """As `rosbag record` leaves it (.bag.active): the place of the index is 0. `rosbag reindex` is not needed."""
    path = ros1(tmp_path / "a.bag", publishers=2)
    data = path.read_bytes()
    at = data.index(b"index_pos=") + 10
    index_at = int.from_bytes(data[at : at + 8], "little")
    open_bag = written(tmp_path, (data[:at] + bytes(8) + data[at + 8 :])[:index_at], "a.bag.active")
    found = read_sensor(open_bag, columns="group=/imu#2")
    assert begins(found) == N
    assert "(the recorder did not close it)" in found.said[0]
    broken = bytearray(data)
    broken[index_at // 2 : index_at // 2 + 4000] = bytes(4000)
    fault(written(tmp_path, bytes(broken), "b.bag"), r"byte \d+: .*; the file is damaged: .*`rosbag reindex`")
    fault(written(tmp_path, b"#ROSBAG V1.2\n" + data[13:], "c.bag"), "only bags of version 2.0 are read")
