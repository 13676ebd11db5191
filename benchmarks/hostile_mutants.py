"""Makes valid files hostile: bits and blocks of bytes, words of texts, records and fields of recordings, and bombs."""

from __future__ import annotations

import bz2
import io
import random
import re
import sqlite3
import struct
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from google.protobuf.descriptor import FieldDescriptor

from agent.proto import fieldcal_pb2 as pb
from agent.recording.limits import UNPACKED_LIMIT
from agent.recording.records import MAGIC
from benchmarks.mutations import cut, double, drop, swap, wrong_schema
from tests.attacks.test_hostile_recordings import BOMBS, HEADER, chunk_of
from tests.replay.forgery import Message, Unpacked

LARGEST = 1 << 20  # bytes of a hostile file
Change = Callable[[bytearray, random.Random], None]
NUMBERS = [0, 1, 127, 128, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, 2**63, 2**64 - 1]
FLOATS = [0.0, -0.0, 1e308, -1e308, 5e-324, 1e-300, 1e19, float("nan"), float("inf"), -float("inf"), 1e9, -1.0]
WORDS = [
    "nan", "inf", "-inf", "1e308", "1e-320", "-1", "0", "1e999", "9" * 400, "9" * 5000, "1_000", "0x7f", "٣", "½",
    "true", "null", "{}", "[]", '""', "'", '"', "\\u0000", "\0", "\x1b[2J", "\x1b]0;x\a", "\r", "\n\n", ",", ";", "=",
    "../../etc/passwd", "/dev/zero", "/dev/stdin", "%s%n", "{0}", "$HOME", "A" * 70_000, "é", "\ud7ff", "\U0010ffff",
    "\u202e", "-0", "1e15", "9223372036854775808", "1979-05-27T07:32:00", "[[", "]]", "{", "}", "<!--", "&a;", "<x>",
]  # fmt: skip


def mutated(how: str, valid: bytes, draw: random.Random) -> bytes:
    """A hostile file made of a valid one. `how`: what it is, as in `benchmarks.hostile_inputs.Kind`."""
    chosen = draw.random()
    if how == "recording" and chosen < 0.7:
        return _of_recording(valid, draw)
    if how == "text" and chosen < 0.75:
        return _of_text(valid, draw)
    data = bytearray(valid)
    for _ in range(draw.choice((1, 1, 2, 4, 8))):
        if data:
            draw.choice(BYTES)(data, draw)
    return bytes(data[:LARGEST])


def _flip(data: bytearray, draw: random.Random) -> None:
    for _ in range(draw.choice((1, 1, 3, 20))):
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)


def _overwrite(data: bytearray, draw: random.Random) -> None:
    at, size = _place(data, draw)
    data[at : at + size] = draw.choice((bytes(size), b"\xff" * size, draw.randbytes(size)))


def _number(data: bytearray, draw: random.Random) -> None:
    """A number where a length, a count or an offset may stand."""
    number = draw.choice(NUMBERS) & 2**64 - 1
    packed = struct.pack(draw.choice("<>") + "Q", number)
    size = draw.choice((2, 4, 8))
    at = draw.choice((draw.randrange(len(data)), draw.randrange(min(len(data), 512)))) & ~1
    data[at : at + size] = packed[:size] if draw.random() < 0.5 else packed[-size:]


def _truncate(data: bytearray, draw: random.Random) -> None:
    del data[draw.randrange(len(data)) :]


def _insert(data: bytearray, draw: random.Random) -> None:
    at, size = _place(data, draw)
    data[at:at] = draw.choice((bytes(size), draw.randbytes(size), data[at : at + size]))


def _delete(data: bytearray, draw: random.Random) -> None:
    at, size = _place(data, draw)
    del data[at : at + size]


def _move(data: bytearray, draw: random.Random) -> None:
    at, size = _place(data, draw)
    to = draw.randrange(len(data))
    data[to : to + size] = data[at : at + size]


def _place(data: bytearray, draw: random.Random) -> tuple[int, int]:
    return draw.randrange(len(data)), draw.choice((1, 4, 8, 64, 512, 4096, 60_000))


BYTES: list[Change] = [_flip, _flip, _overwrite, _number, _number, _truncate, _insert, _delete, _move]
_TOKEN = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?|\w+|[^\w\s]")


def _of_text(valid: bytes, draw: random.Random) -> bytes:
    text = valid.decode()
    for _ in range(draw.choice((1, 1, 2, 5, 30))):
        lines = text.splitlines(keepends=True)
        if not lines:
            break
        at = draw.randrange(len(lines)) if draw.random() < 0.5 else draw.randrange(min(len(lines), 10))
        match draw.randrange(8):
            case 0:
                del lines[at : at + draw.choice((1, 1, 100))]
            case 1:
                lines.insert(draw.randrange(len(lines) + 1), lines[at])
            case 2:
                to = draw.randrange(len(lines))
                lines[at], lines[to] = lines[to], lines[at]
            case _:
                tokens = list(_TOKEN.finditer(lines[at])) or list(re.finditer("^", lines[at]))
                token = draw.choice(tokens)
                assert token is not None
                lines[at] = lines[at][: token.start()] + draw.choice(WORDS) + lines[at][token.end() :]
        text = "".join(lines)
    encoding = draw.choice(("utf-8",) * 18 + ("utf-16", "latin-1"))
    return text.encode(encoding, "replace")[:LARGEST]


def _of_recording(valid: bytes, draw: random.Random) -> bytes:
    """Records or fields are changed; every CRC and index is right again."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "f.mcap"
        path.write_bytes(valid)
        found = Unpacked.of(path)
        if draw.random() < 0.25:
            draw.choice((drop, double, swap, wrong_schema, cut))(found.messages, found.messages, draw)
        else:
            for _ in range(draw.choice((1, 1, 2, 5))):
                _change_message(found.messages, draw)
        found.write(path)
        return path.read_bytes()


def _change_message(messages: list[Message], draw: random.Random) -> None:
    """Change a field of a message; the first message, which holds configuration and state, is often the one."""
    at = 0 if draw.random() < 0.3 else draw.randrange(len(messages))
    topic, schema, log_time, publish_time, sequence, data = messages[at]
    message = getattr(pb, schema.rsplit(".", 1)[-1])()
    message.ParseFromString(data)
    change_field(message, draw)
    if draw.random() < 0.05:
        log_time = draw.choice(NUMBERS)
    messages[at] = (topic, schema, log_time, publish_time, sequence, message.SerializeToString())


def change_field(message: Any, draw: random.Random) -> None:
    """Set a field of a protobuf message, at any depth, to an extreme value."""
    fields = message.ListFields()
    if not fields:
        return
    field, value = draw.choice(fields)
    if field.type == FieldDescriptor.TYPE_MESSAGE and field.message_type.GetOptions().map_entry:
        key = draw.choice(list(value))
        if field.message_type.fields_by_name["value"].type == FieldDescriptor.TYPE_STRING:
            value[key] = draw.choice(WORDS)
        else:
            value[key] = draw.choice(FLOATS)
    elif field.type == FieldDescriptor.TYPE_MESSAGE:
        change_field(draw.choice(list(value)) if field.is_repeated else value, draw)
    elif field.is_repeated:
        match draw.randrange(4):
            case 0:
                del value[draw.randrange(len(value)) :]
            case 1:
                value.extend(list(value)[:1000])
            case _:
                value[draw.randrange(len(value))] = _extreme(field, value[0], draw)
    else:
        setattr(message, field.name, _extreme(field, value, draw))


def _extreme(field: FieldDescriptor, value: Any, draw: random.Random) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, float):
        return draw.choice([*FLOATS, -value, value * 1e6])
    if isinstance(value, int):
        bits, signed = (32 if "32" in _TYPES[field.type] else 64), "U" not in _TYPES[field.type]
        number = draw.choice([*NUMBERS, value + 1, -value, value * 1000, value + 10**15, value - 10**15])
        low = -(1 << bits - 1) if signed else 0
        return min(max(number, low), low + (1 << bits) - 1)
    if isinstance(value, bytes):
        return mutated("binary", value, draw)
    if draw.random() < 0.5:
        return draw.choice(WORDS)
    return _of_text(value.encode(), draw).decode("utf-8", "replace")


_TYPES = {number: name for name, number in vars(FieldDescriptor).items() if name.startswith("TYPE_")}


def bomb(title: str, how: str, draw: random.Random) -> bytes:
    """A small file that would become large or deep, or a file of 1 MB that says nothing."""
    made = _of_format(title)
    if how == "recording":
        chosen: bytes = MAGIC + HEADER + b"".join(draw.choice(list(BOMBS.values()))())
        return chosen if draw.random() < 0.9 else MAGIC + HEADER + chunk_of([bytes(UNPACKED_LIMIT)]) * 2000
    if made and draw.random() < 0.7:
        return made
    return draw.choice(TEXTS)()[:LARGEST]


TEXTS: list[Callable[[], bytes]] = [
    lambda: b"[" * LARGEST,
    lambda: b'{"a":' * 200_000,
    lambda: b"a = " + b"[" * LARGEST,
    lambda: b"a." * 500_000 + b"a = 1\n",
    lambda: b"1" * LARGEST,
    lambda: b"a = " + b"9" * LARGEST,
    lambda: b'{"sensitivity": ' + b"9" * 500_000 + b"}",
    lambda: b"time_s,vx,vy,vz\n" + b"0,1,2,3\n" * 130_000,
    lambda: b"time_s,vx,vy,vz\n" + b"".join(b"%d.5,1,2,3\n" % (k * 10**9) for k in range(60_000)),
    lambda: b"time_s,vx,vy,vz\n" + b",".join([b"1"] * 500_000),
    lambda: b",".join(b"c%d" % k for k in range(150_000)) + b"\n" + b"1," * 150_000,
    lambda: b"start_s,stop_s,gx,gy,gz\n" + b"".join(b"%d,%d,0,0,9.8\n" % (k, k + 1) for k in range(60_000)),
    lambda: b"\n" * LARGEST,
    lambda: bytes(LARGEST),
    lambda: b"\xff\xfe" * (LARGEST // 2),
    lambda: b'"' * LARGEST,
    lambda: b"gateway a/b " * 80_000,
    lambda: b"[[devices]]\n" * 80_000,
    lambda: b"[[channels]]\nsensor = 'a'\n" * 30_000,
    lambda: b'<!DOCTYPE x [<!ENTITY a "' + b"a" * 99 + b'"><!ENTITY b "' + b"&a;" * 9 + b'">]><x>' + b"&b;" * 9,
    lambda: b"<x>" * 300_000,
    lambda: b"<x " + b"".join(b"a%d='' " % k for k in range(80_000)) + b"/>",
]  # fmt: skip


def _of_format(title: str) -> bytes:
    """A bomb of a binary format; empty where there is none, or its library is not here."""
    makers: dict[str, Callable[[Path], None]] = {
        "Parquet": _zeros_in_parquet, "MATLAB": _zeros_in_matlab, "HDF5": _zeros_in_hdf5, "WAV": _long_wav,
        "Excel": _cells_in_excel, "MiniSEED": _archive_behind_miniseed, "MiniSEED with gaps": _hours_between_samples,
        "bag (MCAP)": _zeros_in_a_bag, "bag (SQLite)": _computed_messages, "bag (ROS 1)": _zeros_in_a_bag_of_ros_1,
        "NPZ": lambda path: np.savez_compressed(path, vx=np.zeros(50_000_000, np.uint8)),
    }  # fmt: skip
    if title not in makers:
        return b""
    if title not in _MADE:
        with tempfile.TemporaryDirectory() as directory:
            path = Path(directory) / ("a.npz" if title == "NPZ" else "a")
            makers[title](path)
            _MADE[title] = path.read_bytes()
    return _MADE[title]


_MADE: dict[str, bytes] = {}


def _zeros_in_parquet(path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    zeros = np.zeros(8_000_000)
    pq.write_table(pa.table(dict.fromkeys(("time_s", "vx", "vy", "vz"), zeros)), path, compression="zstd")


def _zeros_in_matlab(path: Path) -> None:
    from scipy.io import savemat

    savemat(path, {name: np.zeros(8_000_000) for name in ("time", "x", "y", "z")}, do_compression=True)


def _zeros_in_hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for name in ("time", "x", "y", "z"):
            file.create_dataset(name, shape=(60_000_000,), dtype="f8", chunks=(1_000_000,), compression="gzip")


def _archive_behind_miniseed(path: Path) -> None:
    """A program that looks for an archive in the file unpacks 1 GiB."""
    path.write_bytes(_seed_record(0, 100))
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive, archive.open("a", "w") as file:
        for _ in range(64):
            file.write(bytes(1 << 24))


def _hours_between_samples(path: Path) -> None:
    path.write_bytes(b"".join(_seed_record(k, 1) for k in range(1900)))


def _seed_record(hour: int, samples: int, rate_hz: int = 20_000) -> bytes:
    """A record of MiniSEED with 32-bit integers."""
    head = b"000001D A      HNZXX" + struct.pack(">HHBBBBH", 2023, 1 + hour // 24, hour % 24, 0, 0, 0, 0)
    head += struct.pack(">HhhBBBBiHH", samples, rate_hz, 1, 0, 0, 0, 1, 0, 64, 48)
    return (head + struct.pack(">HHBBBB", 1000, 0, 3, 1, 9, 0)).ljust(512, b"\0")


def _zeros_in_a_bag(path: Path) -> None:
    """Chunks of zeros, and of empty messages."""
    header = b"\x01" + struct.pack("<QII", 8, 0, 0)
    empty = (b"\x05" + struct.pack("<QHIQQ", 22, 1, 0, 0, 0)) * 200_000
    path.write_bytes(MAGIC + header + b"".join(_chunk(data) for data in (empty, empty, *[bytes(100 << 20)] * 8)))


def _chunk(data: bytes) -> bytes:
    packed = zstandard.compress(data)
    body = struct.pack("<QQQI", 0, 0, len(data), 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(packed))
    return b"\x06" + struct.pack("<Q", len(body) + len(packed)) + body + packed


def _computed_messages(path: Path) -> None:
    """A table of which the values are not in the file."""
    with closing(sqlite3.connect(path)) as file:
        file.executescript(
            "CREATE TABLE topics(id, name, type, serialization_format);"
            "INSERT INTO topics VALUES (1, '/imu', 'sensor_msgs/msg/Imu', 'cdr');"
            "CREATE TABLE messages(topic_id, timestamp, data AS (zeroblob(100000000)));"
        )
        file.executemany("INSERT INTO messages VALUES (1, ?)", [(k,) for k in range(9999)])
        file.commit()


def _zeros_in_a_bag_of_ros_1(path: Path) -> None:
    packed = bz2.compress(bytes(100 << 20), 9)
    fields = [b"op=\x05", b"compression=bz2", b"size=" + struct.pack("<I", 100 << 20)]
    head = b"".join(struct.pack("<I", len(each)) + each for each in fields)
    chunk = struct.pack("<I", len(head)) + head + struct.pack("<I", len(packed)) + packed
    path.write_bytes(b"#ROSBAG V2.0\n" + chunk * 20)


def _cells_in_excel(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("[Content_Types].xml", "<Types/>")
        archive.writestr("xl/worksheets/sheet1.xml", b"<row><c/></row>" * 10_000_000)


def _long_wav(path: Path) -> None:
    out = io.BytesIO()
    out.write(b"RIFF" + struct.pack("<I", 2**32 - 1) + b"WAVEfmt " + struct.pack("<IHHIIHH", 16, 1, 3, 1, 6, 6, 16))
    out.write(b"data" + struct.pack("<I", 2**32 - 1) + bytes(LARGEST - 44))
    path.write_bytes(out.getvalue())
