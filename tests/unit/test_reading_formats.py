"""Files that other programs made give the same samples as the plain CSV; broken and hostile ones end in one line."""

from __future__ import annotations

import io
import struct
import wave
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.calibrate.tables import read_reference, read_sensor
from agent.proto import fieldcal_pb2 as pb
from agent.reading import arrow
from agent.reading.source import TableError
from tests.unit.test_reading_csv import HEADER, VALUES, table, written

GOLDEN = Path(__file__).parents[1] / "replay" / "golden" / "format-1" / "fieldcal-000001.mcap"
RATE_HZ = 100
TIME_S, V = VALUES[:, 0], VALUES[:, 1:]


def same(path: Path, time_s: np.ndarray = TIME_S, v: np.ndarray = V, columns: str | None = None) -> None:
    found = read_sensor(path, columns=columns)
    np.testing.assert_allclose(found.time_s[:], time_s, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.v[:], v, rtol=1e-12)


def fault(path: Path, message: str) -> None:
    with pytest.raises(TableError, match=message) as told:
        read_sensor(path)
    assert str(told.value).startswith(str(path))
    assert "\n" not in str(told.value)


# Recordings of this program


def blocks(device: str) -> tuple[np.ndarray, np.ndarray]:
    """Arrivals in s of CLOCK_MONOTONIC and indications of a device, by the library mcap and the protobuf schema."""
    from mcap.reader import make_reader

    stamps: list[float] = []
    samples: list[list[float]] = []
    with GOLDEN.open("rb") as file:
        for _, _, message in make_reader(file).iter_messages([f"/{device}/raw"], log_time_order=False):
            block = pb.RawBlock.FromString(message.data)
            axes = (
                (block.x_counts, block.y_counts, block.z_counts) if not block.decimal else (block.x, block.y, block.z)
            )
            samples += [list(row) for row in zip(*axes[: block.axes], strict=True)]
            before = 0
            for arrival, count in zip(block.burst_t_monotonic_ns, block.burst_count, strict=True):
                stamps += [arrival * 1e-9] * (count - before)
                before = count
    return np.array(stamps), np.array(samples)


def test_a_recording_of_this_program() -> None:
    sensor, reference = read_sensor(GOLDEN), read_reference(GOLDEN)
    stamps, v = blocks("mems")
    np.testing.assert_array_equal(sensor.v[:], v)
    assert len(v) > 1000
    shift_s = sensor.time_s[:][0] - stamps[0]
    np.testing.assert_allclose(sensor.time_s[:], stamps + shift_s, rtol=0, atol=5e-7)
    stamps, a = blocks("reference")
    np.testing.assert_array_equal(reference.x[:], a)
    np.testing.assert_allclose(reference.time_s[:], stamps + shift_s, rtol=0, atol=5e-7)  # one clock for both
    assert reference.quantity == "acceleration"


def test_a_damaged_recording(tmp_path: Path) -> None:
    data = bytearray(GOLDEN.read_bytes())
    data[len(data) // 2] ^= 1
    path = written(tmp_path, bytes(data), "a.mcap")
    fault(path, r"byte \d+ \(Chunk\): .*; `fieldcal audit .*a.mcap` says more")
    fault(written(tmp_path, bytes(data[:60]), "b.mcap"), "reach beyond the end of the file")


# ROS 2


def imu(stamp_ns: int, acceleration: np.ndarray, frame: str) -> bytes:
    """sensor_msgs/msg/Imu in CDR, little-endian, from its definition."""
    body = struct.pack("<iI", stamp_ns // 10**9, stamp_ns % 10**9)
    body += struct.pack("<I", len(frame) + 1) + frame.encode() + b"\0"
    body += b"\0" * (-len(body) % 8)
    numbers = [0, 0, 0, 1, *[9.0] * 9, 7, 7, 7, *[8.0] * 9, *acceleration, *[6.0] * 9]
    return b"\0\1\0\0" + body + struct.pack("<37d", *numbers)


def bag(path: Path, **options: object) -> Path:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, **options)  # type: ignore[arg-type]
        writer.start("ros2", "test")
        schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", b"")
        other = writer.register_schema("std_msgs/msg/String", "ros2msg", b"")
        channels = [writer.register_channel("/imu/data", "cdr", schema), writer.register_channel("/log", "cdr", other)]
        for row in VALUES:
            ns = round(row[0] * 1e9)
            writer.add_message(channels[0], ns + 10**6, imu(ns, row[1:], "imu_link"), ns)
            writer.add_message(channels[1], ns, b"text", ns)
        writer.finish()
    return path


@pytest.mark.parametrize("crcs", [True, False])
def test_imu_of_ros_2(tmp_path: Path, crcs: bool) -> None:
    same(bag(tmp_path / "bag.mcap", enable_crcs=crcs))


def test_a_bag_without_imu(tmp_path: Path) -> None:
    path = bag(tmp_path / "bag.mcap")
    path.write_bytes(path.read_bytes()[:40])
    fault(path, "byte .*write the file anew")


# Parquet and Feather


def frame() -> Any:
    import pandas

    pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra files)")
    return pandas.DataFrame({"time": TIME_S, "x": V[:, 0], "label": "a", "y": V[:, 1], "z": V[:, 2]})


WRITERS: dict[str, Callable[..., None]] = {
    "parquet": lambda f, path: f.to_parquet(path),
    "zstd.parquet": lambda f, path: f.to_parquet(path, compression="zstd", row_group_size=90),
    "brotli.parquet": lambda f, path: f.to_parquet(path, compression="brotli"),
    "feather": lambda f, path: f.to_feather(path),
    "zstd.feather": lambda f, path: f.to_feather(path, compression="zstd", chunksize=90),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_frames_of_pandas(kind: str, tmp_path: Path) -> None:
    WRITERS[kind](frame(), tmp_path / f"a.{kind}")
    same(tmp_path / f"a.{kind}")


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_dates_and_gaps_of_pandas(unit: str, tmp_path: Path) -> None:
    import pandas

    table = frame()
    stamps = pandas.Series(1_700_000_000 * 10**9 + (TIME_S * 1e9).round().astype("int64"))
    table["time"] = stamps.astype("datetime64[ns]").astype(f"datetime64[{unit}]").dt.tz_localize("UTC")
    table["x"] = table["x"].astype("Float32").where(table.index != 5)
    table.to_parquet(tmp_path / "a.parquet")
    gap = V.copy()
    gap[:, 0] = gap[:, 0].astype(np.float32)
    gap[5] = np.nan
    same(tmp_path / "a.parquet", 1_700_000_000 + TIME_S, gap)


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_a_date_that_is_missing_is_no_number(unit: str) -> None:
    import pyarrow

    dates = pyarrow.array([None, datetime(2023, 11, 14, 22, 13, 20)], pyarrow.timestamp(unit))
    np.testing.assert_array_equal(arrow._values(dates), [np.nan, 1_700_000_000.0])


@pytest.mark.slow
def test_a_bomb_of_parquet_is_refused(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra files)")
    from pyarrow import parquet

    bomb = pa.table({name: pa.chunked_array([pa.array(np.zeros(1 << 20))] * 12) for name in ("time", "x", "y", "z")})
    parquet.write_table(bomb, tmp_path / "a.parquet", compression="zstd")
    assert (tmp_path / "a.parquet").stat().st_size < 1e6
    fault(tmp_path / "a.parquet", "the file says that it holds 4.03e\\+08 bytes of values, 2.68e\\+08 are allowed")


@pytest.mark.parametrize("kind", ["parquet", "feather"])
def test_damaged_frames(kind: str, tmp_path: Path) -> None:
    WRITERS[kind](frame(), tmp_path / f"a.{kind}")
    data = (tmp_path / f"a.{kind}").read_bytes()
    fault(written(tmp_path, data[: len(data) // 2], f"b.{kind}"), "cannot be read: .*; write it anew")
    fault(written(tmp_path, data[:8] + b"\xff" * (len(data) - 40) + data[-32:], f"c.{kind}"), "write it anew")


# WAV


def counts(bits: int) -> np.ndarray:
    return np.clip(np.round(V / 20 * 2 ** (bits - 1)), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1).astype(int)


@pytest.mark.parametrize("bits", [8, 16, 24, 32])
def test_wav_of_the_standard_library(bits: int, tmp_path: Path) -> None:
    whole = counts(bits)
    with wave.open(str(tmp_path / "a.wav"), "wb") as file:
        file.setnchannels(3)
        file.setsampwidth(bits // 8)
        file.setframerate(RATE_HZ)
        raw = whole + 128 if bits == 8 else whole
        file.writeframes(b"".join((int(x) & (2**bits - 1)).to_bytes(bits // 8, "little") for x in raw.ravel()))
    same(tmp_path / "a.wav", v=whole / 2 ** (bits - 1))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_wav_of_scipy(dtype: type, tmp_path: Path) -> None:
    from scipy.io import wavfile

    wavfile.write(tmp_path / "a.wav", RATE_HZ, V.astype(dtype))
    same(tmp_path / "a.wav", v=V.astype(dtype).astype(float))


@pytest.mark.parametrize("subtype", ["PCM_16", "PCM_24", "FLOAT", "DOUBLE"])
def test_wav_of_soundfile(subtype: str, tmp_path: Path) -> None:
    soundfile = pytest.importorskip("soundfile", reason="soundfile is not installed; it only checks the stdlib reader")
    path = tmp_path / "a.wav"
    soundfile.write(path, V / 20, RATE_HZ, subtype=subtype, format="WAVEX" if subtype == "PCM_24" else "WAV")
    same(path, v=soundfile.read(path)[0])


def test_a_reference_in_a_wav_needs_its_unit(tmp_path: Path) -> None:
    from scipy.io import wavfile

    wavfile.write(tmp_path / "a.wav", RATE_HZ, V[:, 0])
    with pytest.raises(TableError, match="neither name nor unit tells what 'ch1' is, add its unit"):
        read_reference(tmp_path / "a.wav")
    found = read_reference(tmp_path / "a.wav", columns="time=time_s,x=ch1:mg")
    np.testing.assert_allclose(found.x[:][:, 0], 9.80665e-3 * V[:, 0], rtol=1e-14)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda d: d[:30], "has no format"),
        (lambda d: d[:44], "has no samples"),
        (lambda d: d[:20] + b"\x11\0" + d[22:], "format 17 with 16 bits is not read"),
        (lambda d: d[:22] + b"\0\0" + d[24:], "0 channels"),
        (lambda d: d[:32] + b"\x09\0" + d[34:], "frames of 9 bytes do not agree"),
        (lambda d: b"RF64" + d[4:], "is not RIFF/WAVE"),
    ],
)
def test_broken_wavs(spoil: Callable[[bytes], bytes], message: str, tmp_path: Path) -> None:
    whole = io.BytesIO()
    with wave.open(whole, "wb") as file:
        file.setnchannels(3)
        file.setsampwidth(2)
        file.setframerate(RATE_HZ)
        file.writeframes(counts(16).astype("<i2").tobytes())
    fault(written(tmp_path, spoil(whole.getvalue()), "a.wav"), message)


def test_a_directory_is_told(tmp_path: Path) -> None:
    fault(tmp_path, "Is a directory")


def test_a_missing_library_names_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    path = written(tmp_path, b"PAR1" + b"\0" * 40, "a.parquet")
    fault(path, r"Parquet files need pyarrow, which is not installed: fieldcal extras --install files")
    same(written(tmp_path, HEADER + table()))
