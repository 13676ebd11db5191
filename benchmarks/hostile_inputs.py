"""The files that `benchmarks.hostile_files` makes hostile: valid ones of each kind, and the commands that read them."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import wave
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.core.events import Result
from agent.delivery.history import StoredResult
from agent.delivery.store import Store
from agent.export.cdr import DEFINITIONS, IMU, imu
from tests.replay.golden_files import FORMATS, RECORDING
from tests.unit.recorded_bench import record
from tests.unit.results import calibration, status, window

ROOT = Path(__file__).resolve().parents[1]
SIGNED = ROOT / "tests" / "replay" / "signatures" / "version-2-results"
RECORDED_S = 8.0
SLOW = {"MATLAB": 5, "Excel": 5}  # kinds that are read in a process of their own: only each so manieth file
# They stand in the arguments for the hostile file, its directory, and a directory that does not exist.
FILE, FOLDER, OUT = "FILE", "FOLDER", "OUT"
RATE_HZ, REST_S, G_MPS2 = 100, 3, 9.80665
DIRECTIONS = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)], dtype=float) - 1.0
UP = DIRECTIONS[::2] / np.linalg.norm(DIRECTIONS[::2], axis=1, keepdims=True)


@dataclass(frozen=True)
class Use:
    """A command that reads a file of a kind. `every`: only each so manieth file, since the command is slow."""

    arguments: tuple[str, ...]
    every: int = 1

    def filled(self, file: Path, out: Path) -> list[str]:
        """The arguments for a file."""
        stands = {FILE: file, FOLDER: file.parent, OUT: out}
        return [str(stands.get(word, word)) for word in self.arguments]


@dataclass(frozen=True)
class Kind:
    """A kind of file. `name`: of the file, in a directory of its own. `valid`: files; `empty`: one with nothing in it.

    `how`: "binary", "text" or "recording". `beside`: other files of its directory.
    """

    title: str
    name: str
    how: str
    valid: Sequence[bytes]
    empty: bytes
    uses: Sequence[Use]
    beside: Sequence[Path] = ()


def kinds(site: Path, *, quick: bool = False) -> list[Kind]:
    """All kinds; with `quick` those that are made and read within a second. `site`: a directory for valid files."""
    time_s, v = _rests()
    good = _companions(site, time_s, v)
    record(site / "data", RECORDED_S)
    _fill(site / "data")
    table = Use(("calibrate", "--sensor", FILE))
    moved = ("calibrate", "--sensor", good["sensor.csv"], "--reference", good["reference.csv"])
    reference = Use(("calibrate", "--sensor", good["sensor.csv"], "--reference", FILE, "--poses", good["poses.csv"]))
    signed = sorted(SIGNED.iterdir())
    audited = str(SIGNED)
    csv = (site / "rests.csv").read_bytes()
    found = [
        *_recordings(signed, site / "data"),
        Kind("head", "kept.json", "text", [(SIGNED / "head.json").read_bytes()], b"{}",
             [Use(("audit", audited, "--head", FILE))]),
        Kind("key of a gateway", "gateway.pub", "text", [(SIGNED / "gateway.pub").read_bytes()], b"",
             [Use(("audit", audited, "--public-key", FILE))]),
        Kind("list of keys", "known.keys", "text", [_key_list()], b"", [Use(("audit", audited, "--keys", FILE))]),
        Kind("sensor.csv", "sensor.csv", "text", [csv, (site / "sensor.csv").read_bytes()], b"time_s,vx,vy,vz\n",
             [table, Use(("calibrate", "--sensor", FILE, "--reference", good["reference.csv"], "--poses",
                          good["poses.csv"]))]),
        Kind("reference.csv", "reference.csv", "text", [(site / "reference.csv").read_bytes()], b"time_s,a\n",
             [reference]),
        Kind("poses.csv", "poses.csv", "text", [(site / "poses.csv").read_bytes()], b"start_s,stop_s,gx,gy,gz\n",
             [Use((*moved, "--poses", FILE))]),
        Kind("result (JSON)", "result.json", "text", [(site / "result.json").read_bytes()], b"{}",
             [Use(("report", FILE, "-o", OUT), every=10),
              Use(("calibrate", "--sensor", good["rests.csv"], "--prior", FILE)),
              Use((*moved, "--poses", good["poses.csv"], "--reference-certificate", FILE))]),
        Kind("certificate (TOML)", "certificate.toml", "text", [_CERTIFICATE], b"",
             [Use((*moved, "--poses", good["poses.csv"], "--reference-certificate", FILE))]),
        Kind("configuration", "gateway.toml", "text",
             [(ROOT / "examples" / "gateway.toml").read_bytes(), _small_configuration()], b"",
             [Use(("check", FILE)), Use(("check", FILE, "--json", "-"))]),
    ]  # fmt: skip
    if quick:
        return [replace(kind, uses=[use for use in kind.uses if use.arguments[0] != "report"]) for kind in found]
    certified = [
        Use(("calibrate", "--sensor", good["rests.csv"], "--prior", FILE)),
        Use((*moved, "--poses", good["poses.csv"], "--reference-certificate", FILE)),
    ]
    found.append(Kind("certificate (DCC)", "certificate.xml", "text", [_dcc(site)], b"<x/>", certified))
    for title, name, data, empty in _tables(site, time_s, v):
        uses = [replace(use, every=SLOW.get(title, 1)) for use in (table, reference)]
        found.append(Kind(title, name, "binary", [data], empty, uses))
    return found


def _recordings(signed: Sequence[Path], recorded: Path) -> list[Kind]:
    golden = [(FORMATS[-1] / RECORDING).read_bytes(), (recorded / RECORDING).read_bytes()]
    stands_alone = [(SIGNED / "fieldcal-000002.mcap").read_bytes()]
    empty = _empty_recording()
    store = (recorded / "state.sqlite").read_bytes()
    uses = [
        Use(("audit", FILE)),
        Use(("replay", FILE)),
        Use(("calibrate", "--sensor", FILE, "--columns", "group=imu")),
        Use(("report", FILE, "-o", OUT), every=50),
    ]
    of_store = [Use(("audit", FOLDER)), Use(("report", FOLDER, "-o", OUT), every=10)]
    return [
        Kind("recording", "fieldcal-000001.mcap", "recording", golden, empty, uses),
        Kind("recording, signed", "fieldcal-000002.mcap", "recording", stands_alone, empty,
             [Use(("audit", FOLDER, "--public-key", str(SIGNED / "gateway.pub"), "--strict"))],
             [path for path in signed if path.name != "fieldcal-000002.mcap"]),
        Kind("head beside recordings", "head.json", "text", [(SIGNED / "head.json").read_bytes()], b"{}",
             [Use(("audit", FOLDER))], [path for path in signed if path.suffix == ".mcap"]),
        Kind("store", "state.sqlite", "binary", [store], b"", of_store, [recorded / RECORDING]),
    ]  # fmt: skip


def _fill(data_dir: Path) -> None:
    """Put calibrations, windows and a status into the store of a data directory."""
    store = Store(data_dir, 0)
    makers: tuple[Callable[[int], Result], ...] = (window, status, calibration)
    results = [made(number) for number, made in enumerate(makers * 3, start=store.last_sequence() + 1)]
    store.commit([StoredResult.of(result, recorded=True, recording=RECORDING) for result in results])
    store.close()


def _rests() -> tuple[np.ndarray, np.ndarray]:
    """(time in s (n,), indications (n, 3)) of a sensor that rests in many positions."""
    draw = np.random.default_rng(14)
    S = np.array([[1.03, 0.012, -0.006], [-0.008, 0.97, 0.01], [0.005, -0.011, 1.01]])
    v = np.repeat(G_MPS2 * UP @ S.T + [0.21, -0.34, 0.12], REST_S * RATE_HZ, axis=0)
    return np.arange(len(v)) / RATE_HZ, v + 0.005 * draw.standard_normal(v.shape)


def _companions(site: Path, time_s: np.ndarray, v: np.ndarray) -> dict[str, str]:
    """Write valid files; returns their paths. The sensor is moved along a direction of its own in each position."""
    motion = np.sum([np.sin(2 * np.pi * f * time_s + f) for f in (3.1, 5.3, 8.7)], axis=0)
    along = np.repeat(np.roll(UP, 1, axis=1), REST_S * RATE_HZ, axis=0)
    _csv(site / "rests.csv", "time_s,vx,vy,vz", time_s, v)
    _csv(site / "sensor.csv", "time_s,vx,vy,vz", time_s, v + motion[:, None] * along)
    _csv(site / "reference.csv", "time_s,a", time_s, motion[:, None])
    starts = np.arange(len(UP)) * REST_S
    poses = np.column_stack([starts + REST_S - 0.05, np.roll(UP, 1, axis=1), G_MPS2 * UP])
    _csv(site / "poses.csv", "start_s,stop_s,dx,dy,dz,gx,gy,gz", starts + 0.05, poses)
    run = [sys.executable, "-m", "agent", "calibrate", "--sensor", "rests.csv", "--json", "result.json"]
    subprocess.run(run, cwd=site, check=True, capture_output=True, env=_environment())
    return {path.name: str(path) for path in site.iterdir()}


def _environment() -> dict[str, str]:
    return {"PYTHONPATH": f"{ROOT}:{':'.join(sys.path)}"}


def _csv(path: Path, header: str, first: np.ndarray, others: np.ndarray) -> None:
    np.savetxt(path, np.column_stack([first, others]), "%.5f", ",", header=header, comments="")


def _tables(site: Path, time_s: np.ndarray, v: np.ndarray) -> list[tuple[str, str, bytes, bytes]]:
    """(kind, name, a valid file, one with no samples) of each binary format whose library is here."""
    made: list[tuple[str, str, bytes, bytes]] = []
    for title, name, write in (
        ("Parquet", "a.parquet", _parquet), ("Feather", "a.feather", _feather), ("WAV", "a.wav", _wav),
        ("MATLAB", "a.mat", _matlab), ("HDF5", "a.h5", _hdf5), ("TDMS", "a.tdms", _tdms),
        ("MiniSEED", "a[1].mseed", _miniseed), ("MiniSEED with gaps", "gaps.mseed", _miniseed_with_gaps),
        ("bag (MCAP)", "a.mcap", _bag), ("bag without chunks", "b.mcap", _bag_without_chunks),
        ("bag (SQLite)", "a.db3", _bag_in_sqlite), ("bag (ROS 1)", "a.bag", _bag_of_ros_1),
        ("NPZ", "a.npz", _npz), ("Excel", "a.xlsx", _excel),
    ):  # fmt: skip
        try:
            write(site / name, time_s, v)
            write(site / f"empty-{name}", time_s[:1], v[:1])
        except ImportError as error:
            print(f"{title}: {error.name} is not installed, none is made", file=sys.stderr)
            continue
        made.append((title, name, (site / name).read_bytes(), (site / f"empty-{name}").read_bytes()))
    return made


def _columns(time_s: np.ndarray, v: np.ndarray) -> dict[str, Any]:
    return {"time_s": time_s, "vx": v[:, 0], "vy": v[:, 1], "vz": v[:, 2]}


def _parquet(path: Path, time_s: np.ndarray, v: np.ndarray) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table(_columns(time_s, v)), path)


def _feather(path: Path, time_s: np.ndarray, v: np.ndarray) -> None:
    import pyarrow as pa
    import pyarrow.feather as feather

    feather.write_feather(pa.table(_columns(time_s, v)), path)


def _wav(path: Path, _: np.ndarray, v: np.ndarray) -> None:
    with wave.open(str(path), "wb") as file:
        file.setnchannels(3)
        file.setsampwidth(2)
        file.setframerate(RATE_HZ)
        file.writeframes((1000 * v).astype("<i2").tobytes())


def _matlab(path: Path, time_s: np.ndarray, v: np.ndarray) -> None:
    from scipy.io import savemat

    savemat(path, {"time": time_s, "imu": {"acc": v}, "note": "a"}, do_compression=True)


def _hdf5(path: Path, time_s: np.ndarray, v: np.ndarray) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file["time"] = time_s
        for k, axis in enumerate("xyz"):
            file.create_dataset(axis, data=v[:, k], chunks=(min(100, len(v)),), compression="gzip", shuffle=True)


def _tdms(path: Path, time_s: np.ndarray, v: np.ndarray) -> None:
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(str(path)) as writer:
        writer.write_segment([ChannelObject("imu", name, values) for name, values in _columns(time_s, v).items()])


def _miniseed(path: Path, _: np.ndarray, v: np.ndarray) -> None:
    from obspy import Stream, Trace

    about = {"sampling_rate": float(RATE_HZ), "station": "A"}
    traces = [Trace((1000 * v[:, k]).astype(np.int32), about | {"channel": f"HN{'ENZ'[k]}"}) for k in range(3)]
    Stream(traces).write(str(path), format="MSEED", reclen=512)


def _miniseed_with_gaps(path: Path, _: np.ndarray, v: np.ndarray) -> None:
    """Stays of a logger that is off between them, of which the clock is set after the first."""
    from obspy import Stream, Trace, UTCDateTime

    traces = []
    for n, stay in enumerate(np.array_split(v, min(4, len(v)))):
        about = {"sampling_rate": float(RATE_HZ), "station": "A", "starttime": UTCDateTime(1e9 * (n > 0) + 50.123 * n)}
        counts = np.ascontiguousarray((1000 * stay).astype(np.int32))
        traces += [Trace(np.ascontiguousarray(counts[:, k]), about | {"channel": f"HN{'ENZ'[k]}"}) for k in range(3)]
    Stream(traces).write(str(path), format="MSEED", reclen=512)


def _bag(path: Path, time_s: np.ndarray, v: np.ndarray, **options: Any) -> None:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("ros2", "benchmark")
        schema = writer.register_schema(IMU, "ros2msg", DEFINITIONS[IMU].encode())
        channel = writer.register_channel("/imu", "cdr", schema)
        for ns, sample in zip(np.round(1e9 * time_s).astype(int).tolist(), v, strict=True):
            writer.add_message(channel, ns, imu(ns, "imu", sample), ns)
        writer.finish()


def _bag_without_chunks(path: Path, time_s: np.ndarray, v: np.ndarray) -> None:
    _bag(path, time_s, v, use_chunking=False)


def _bag_in_sqlite(path: Path, time_s: np.ndarray, v: np.ndarray) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store, folder = get_typestore(Stores.ROS2_HUMBLE), path.with_suffix("")
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/imu", IMU, typestore=store)
        for ns, sample in zip(np.round(1e9 * time_s).astype(int).tolist(), v, strict=True):
            writer.write(connection, ns, imu(ns, "imu", sample))
    next(folder.glob("*.db3")).rename(path)


def _bag_of_ros_1(path: Path, time_s: np.ndarray, v: np.ndarray) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, none = get_typestore(Stores.ROS1_NOETIC), np.zeros(9)
    types = store.types
    vector, turn = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    with Writer(path) as writer:
        connection = writer.add_connection("/imu", IMU, typestore=store)
        for ns, sample in zip(np.round(1e9 * time_s).astype(int).tolist(), v, strict=True):
            header = types["std_msgs/msg/Header"](0, types["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9), "")
            message = types[IMU](header, turn, none, vector(0.0, 0.0, 0.0), none, vector(*sample.tolist()), none)
            writer.write(connection, ns, store.serialize_ros1(message, IMU))


def _npz(path: Path, time_s: np.ndarray, v: np.ndarray) -> None:
    np.savez_compressed(path, **_columns(time_s, v))


def _excel(path: Path, time_s: np.ndarray, v: np.ndarray) -> None:
    import openpyxl

    book = openpyxl.Workbook(write_only=True)
    sheet = book.create_sheet()
    sheet.append(["time_s", "vx", "vy", "vz"])
    for row in np.column_stack([time_s, v]).tolist():
        sheet.append(row)
    book.save(path)


def _empty_recording() -> bytes:
    from mcap.writer import Writer

    out = io.BytesIO()
    writer = Writer(out, enable_data_crcs=True)
    writer.start("", "fieldcal")
    writer.finish()
    return out.getvalue()


def _key_list() -> bytes:
    told = (SIGNED / "gateway.pub").read_text()
    raw = "".join(told.splitlines()[1:-1])[16:]  # without the twelve bytes that say it is an Ed25519 key
    return f"# keys\ngateway site/gateway {raw}\nrevoked {'A' * 43}= stolen\n".encode()


def _small_configuration() -> bytes:
    return b"""[gateway]
site = "site"
name = "gw"
[[devices]]
name = "imu"
driver = "serial-csv"
options = { port = "/dev/null", rate_hz = 100.0, axes = 3, unit = "m/s2" }
[[channels]]
sensor = "imu"
poses = [{ start_s = 0, stop_s = 3, gravity_mps2 = [0, 0, 9.8] }]
"""


_CERTIFICATE = b"""[certificate]
sensitivity = 1.0
u_sensitivity_pct = 0.1
serial_number = "R1"
"""


def _dcc(site: Path) -> bytes:
    """A digital calibration certificate of the result in `site`."""
    import tests.unit.certificates as made

    folder = site / "dcc"
    folder.mkdir()
    (folder / "result.json").write_text(json.dumps(made.uneven()))
    stated = made.stated(folder)
    run = [sys.executable, "-m", "agent", "certificate", "result.json", "--stated", str(stated), "-o", "out"]
    subprocess.run(run, cwd=folder, check=True, capture_output=True, env=_environment())
    return next((folder / "out").glob("*.xml")).read_bytes()
