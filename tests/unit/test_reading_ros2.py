"""Recordings of ROS 2 with topics of any type: numbers by a mapping in TOML; hostile ones end in one line."""

from __future__ import annotations

import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from agent.calibrate.tables import read_reference, read_sensor
from agent.reading.formats import Description
from agent.reading.ros2_fields import FieldError, Fields, read_definition
from agent.reading.source import TableError
from tests.unit.test_reading_formats import TIME_S, V, same

IMU = """# of a vendor
uint8 KIND=3
std_msgs/Header header
string<=20 label
bool ok
float32 temperature 20.0
int16[3] raw
Sample[] samples   # two each time
uint64 ticks
================================================================================
MSG: vendor_msgs/Sample
float64[<=4] extra
float64 x
float32[2] yz
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
SHAKER = "float64 seconds\nfloat64 a\n"
KIND, SHAKER_KIND = "vendor_msgs/msg/Imu", "vendor_msgs/msg/Shaker"


class Cdr:
    """CDR as its specification says: each number is aligned to its size."""

    def __init__(self, order: str = "<") -> None:
        self.order, self.body = order, b""

    def put(self, kind: str, *values: float) -> Cdr:
        for value in values:
            self.body += b"\0" * (-len(self.body) % struct.calcsize(kind)) + struct.pack(self.order + kind, value)
        return self

    def text(self, text: str) -> Cdr:
        self.put("I", len(text) + 1)
        self.body += text.encode() + b"\0"
        return self

    @property
    def message(self) -> bytes:
        return (b"\0\1\0\0" if self.order == "<" else b"\0\0\0\0") + self.body


def imu(k: int, order: str = "<", samples: int = 2) -> bytes:
    """x is a float64 in a structure, y the second of raw, z a float32 in an array of the second sample."""
    ns = round(TIME_S[k] * 1e9)
    cdr = Cdr(order).put("i", ns // 10**9).put("I", ns % 10**9).text("frame" + "s" * (k % 5))
    cdr.text("label").put("B", 1).put("f", 21.5).put("h", 7, round(V[k, 1]), 7).put("I", samples)
    for n in range(samples):
        cdr.put("I", k % 3).put("d", *[0.5] * (k % 3))
        cdr.put("d", V[k, 0] if n else 9.0).put("f", 9.0, float(np.float32(V[k, 2])))
    return cdr.put("Q", ns // 10**6).message


def bag(path: Path, messages: list[bytes], kind: str = KIND, definition: str = IMU, topic: str = "/imu") -> Path:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        schema = writer.register_schema(kind, "ros2msg", definition.encode())
        channel = writer.register_channel(topic, "cdr", schema)
        shaker = writer.register_channel(
            "/shaker", "cdr", writer.register_schema(SHAKER_KIND, "ros2msg", SHAKER.encode())
        )
        for k, message in enumerate(messages):
            ns = round(TIME_S[k] * 1e9)
            writer.add_message(channel, ns, message, ns, k)
            writer.add_message(shaker, ns, Cdr().put("d", 1e3 * TIME_S[k], V[k, 0]).message, ns, k)
        writer.finish()
    return path


def mapping(directory: Path, text: str) -> Description:
    (directory / "mapping.toml").write_text(text)
    return Description(mapping=directory / "mapping.toml")


MAPPED = """
["/imu"]
x = "samples[1].x"
y = "raw[1]"
z = "samples[1].yz[1]"
temperature = "temperature"

["/shaker"]
time = "seconds"
time_unit = "ms"
a = "a"
unit = "mg"
"""


@pytest.mark.parametrize("order", ["<", ">"])
def test_numbers_of_any_topic(order: str, tmp_path: Path) -> None:
    path = bag(tmp_path / "a.mcap", [imu(k, order) for k in range(len(V))])
    described = mapping(tmp_path, MAPPED)
    found = read_sensor(path, described=described)
    expected = np.column_stack([V[:, 0], np.round(V[:, 1]), V[:, 2].astype(np.float32)])
    np.testing.assert_array_equal(found.v[:], expected)
    np.testing.assert_allclose(found.time_s[:], TIME_S, rtol=1e-12, atol=1e-12)
    assert found.temperature_degc is not None
    np.testing.assert_array_equal(found.temperature_degc[:], 21.5)
    reference = read_reference(path, described=described)
    np.testing.assert_allclose(reference.x[:][:, 0], 9.80665e-3 * V[:, 0], rtol=1e-14)
    np.testing.assert_allclose(reference.time_s[:], TIME_S, rtol=1e-12, atol=1e-12)


def test_the_time_of_the_recording_and_a_sequence_that_is_too_short(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.mcap", [imu(k, samples=1 if k == 5 else 2) for k in range(20)])
    text = MAPPED.partition('["/shaker"]')[0].replace('x = "', 'time = "log_time"\nx = "').replace("raw[1]", "ticks")
    found = read_sensor(path, described=mapping(tmp_path, text))
    np.testing.assert_allclose(found.time_s[:], TIME_S[:20], rtol=1e-12, atol=1e-12)
    assert np.isnan(found.v[:][5]).all()  # a gap
    assert np.isfinite(np.delete(found.v[:], 5, 0)).all()


def test_imu_with_a_definition_needs_no_mapping(tmp_path: Path) -> None:
    from agent.export.cdr import DEFINITIONS, imu
    from agent.export.cdr import IMU as STANDARD

    messages = [imu(round(t * 1e9), "imu_link", v) for t, v in zip(TIME_S, V, strict=True)]
    same(bag(tmp_path / "a.mcap", messages, STANDARD, DEFINITIONS[STANDARD]))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"raw[1]"', '"raw[3]"', r"/imu: 'raw\[3\]': \[3\] is not there; int16\[3\] is"),
        ('"raw[1]"', '"raw"', r"/imu: 'raw' is int16\[3\], which is no number"),
        ('"raw[1]"', '"label"', "/imu: 'label' is string, which is no number"),
        ('"raw[1]"', '"header"', "'header' is std_msgs/Header, which is no number; it has stamp, frame_id"),
        ('"raw[1]"', '"samples[0].w"', "there is no 'w' in vendor_msgs/Sample; it has extra, x, yz"),
        ('"raw[1]"', '"samples.x"', r"there is no 'x' in vendor_msgs/Sample\[\]"),
        ('"raw[1]"', '"raw[-1]"', r"'raw\[-1\]' is no field; write it as in linear_acceleration.x"),
        (
            '["/imu"]',
            '["/other"]',
            r"there is no topic '/other' with messages; the topics are /imu \(vendor",
        ),
        ("temperature =", "temprature =", "temprature"),
        ('unit = "mg"', 'unit = "parsec"', "parsec"),
        ('["/imu"]', '["/imu"', "mapping.toml: line 2: .*this bracket is not closed; close it"),
    ],
)
def test_mappings_that_do_not_fit(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = bag(tmp_path / "a.mcap", [imu(k) for k in range(3)])
    with pytest.raises(TableError, match=message) as told:
        read_sensor(path, described=mapping(tmp_path, MAPPED.replace(old, new)))
    assert "\n" not in str(told.value)


BODY = imu(4)


@pytest.mark.parametrize(
    ("definition", "data", "message"),
    [
        (IMU, BODY[:60], "message 1: a message of 60 bytes ends before its last field"),
        (IMU, b"\0\7\0\0" + BODY[4:], "does not begin as CDR"),
        (IMU, b"", "a message of 0 bytes does not begin as CDR"),
        (IMU, Cdr().put("i", 1).put("I", 2, 1 << 31).message, "ends before its last field"),  # a text of 2 GB
        (IMU, Cdr().put("i", 1).put("I", 2, 0, 0).put("B", 1).put("f", 1).put("h", 1, 2, 3).put("I", 1 << 31).message,
         "ends before its last field"),  # a sequence of 2^31 structures
        (IMU.replace("Sample[]", "Nothing[]"), BODY, "there is no 'x' in vendor_msgs/Nothing"),
        (IMU + "===\nno title", BODY, "stands where MSG: is expected"),
        (IMU.replace("int16[3]", "int16[99999999]"), BODY, "is longer than"),
        (IMU.replace("bool ok", "bool"), BODY, "the line 'bool' of the definition is not understood"),
    ],
    ids=range(9),
)  # fmt: skip
def test_hostile_definitions_and_messages(definition: str, data: bytes, message: str, tmp_path: Path) -> None:
    path = bag(tmp_path / "a.mcap", [imu(0), data], definition=definition)
    with pytest.raises(TableError, match=message) as told:
        read_sensor(path, described=mapping(tmp_path, MAPPED))
    assert str(told.value).startswith(str(path))
    assert "\n" not in str(told.value)


def test_structures_within_structures_end() -> None:
    root, types = read_definition("v/msg/T", "T[] inner\nfloat64 x\n")
    fields = Fields(root, types, ["x"])
    with pytest.raises(ValueError, match="it is too deep"):
        fields.read(Cdr().put("I", *[1] * 40).message)


def test_damaged_messages_end_in_a_number_or_one_line() -> None:
    fields = Fields(*read_definition(KIND, IMU), ["header.stamp", "samples[1].x", "ticks"])
    rng = np.random.default_rng(5)
    for _ in range(2000):
        data = bytearray(BODY)
        for at in rng.integers(4, len(data), 3):
            data[at] = rng.integers(256)
        with suppress(FieldError):
            assert len(fields.read(bytes(data))) == 3
