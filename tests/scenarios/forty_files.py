"""Writers of other programs: each writes the same samples, which every one of their formats can hold exactly.

A sensor has whole counts below 2^15. A reference has multiples of 1/2048 m/s2 below 16 m/s2. The rate is a power of
two, so times are exact, also as seconds since 1970.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

RATE_HZ, SECONDS, BEGIN_NS = 128, 10, 1_700_000_000 * 10**9
STEPS = 2048  # of the reference for 1 m/s2
N = RATE_HZ * SECONDS
TIME_S = np.arange(N) / RATE_HZ
TIME_NS = BEGIN_NS + np.arange(N) * (10**9 // RATE_HZ)
SENSITIVITY = np.array([[1000.0, 20.0, -10.0], [-15.0, 1040.0, 25.0], [5.0, -30.0, 980.0]])
OFFSET = np.array([150.0, -200.0, 90.0])
AXES = ("x", "y", "z")


def samples() -> dict[str, np.ndarray]:
    """Sensor in counts and reference in m/s2 (N, 3): motion of several sines along each axis, and gravity."""
    rng = np.random.default_rng(4)
    a = np.tile([1.0, 2.0, 9.5], (N, 1))
    for k in range(3):
        for f in rng.uniform(2.0, 8.0, 5):
            a[:, k] += 0.5 * np.sin(2 * np.pi * f * TIME_S + rng.uniform(0, 6))
    reference = np.round(a * STEPS) / STEPS
    return {"sensor": np.round(reference @ SENSITIVITY.T + OFFSET + rng.normal(0, 2, a.shape)), "reference": reference}


Write = Callable[[Path, str, np.ndarray], None]


@dataclass(frozen=True)
class Writer:
    """A format: the library that writes it, the end of the name, and what `fieldcal calibrate` must be told.

    `full_scale`: of integers that are read as parts of it. `steps`: the reference is written in whole steps.
    `since_1970`: the file has dates.
    """

    library: str
    suffix: str
    write: Write
    options: Sequence[str] = ()
    full_scale: float = 1.0
    steps: bool = False
    since_1970: bool = False
    needs: Sequence[str] = field(default_factory=tuple)


def frame(v: np.ndarray, role: str, time: str = "time") -> Any:
    import pandas

    unit = "" if role == "sensor" else " [m/s2]"
    at = {"time": TIME_S, "date": np.array(TIME_NS, "datetime64[ns]")}[time]
    return pandas.DataFrame({time: at, **{f"acc {axis}{unit}": v[:, k] for k, axis in enumerate(AXES)}})


def pandas_csv(time: str = "time", **options: Any) -> Write:
    return lambda path, role, v: frame(v, role, time).to_csv(path, **options)


def parquet(time: str = "time", kind: str = "float64", **options: Any) -> Write:
    def write(path: Path, role: str, v: np.ndarray) -> None:
        table = frame(v, role, time)
        axes = [name for name in table if name != time]
        table.astype(dict.fromkeys(axes, "float32" if kind == "int16" and role == "reference" else kind)).to_parquet(
            path, **options
        )

    return write


def feather(**options: Any) -> Write:
    return lambda path, role, v: frame(v, role).to_feather(path, **options)


def arrow_csv(path: Path, role: str, v: np.ndarray) -> None:
    import pyarrow as pa
    from pyarrow import csv as arrow

    arrow.write_csv(pa.Table.from_pandas(frame(v, role), preserve_index=False), path)


def arrow_groups(path: Path, role: str, v: np.ndarray) -> None:
    import pyarrow as pa
    from pyarrow import parquet as pq

    pq.write_table(pa.Table.from_pandas(frame(v, role)), path, row_group_size=500, use_dictionary=False, version="1.0")


def pandas_excel(time: str = "time", engine: str = "openpyxl", **options: Any) -> Write:
    return lambda path, role, v: frame(v, role, time).to_excel(path, engine=engine, **options)


def openpyxl_book(path: Path, role: str, v: np.ndarray) -> None:
    """What people have: a title, a chart's sheet of text, the table on the second sheet, units in their own row."""
    import openpyxl

    book = openpyxl.Workbook()
    book.active.title = "about"
    book.active.append(["bridge 7", "spring"])
    sheet = book.create_sheet("samples")
    sheet.append(["Logger", 17])
    sheet.append([])
    sheet.append(["t", "acc x", "acc y", "acc z", "remark"])
    sheet.append(["ms", *["m/s²" if role == "reference" else "counts"] * 3])
    for k, row in enumerate(np.column_stack([1e3 * TIME_S, v]).tolist()):
        sheet.append([*row, *(["a knock"] if k == 7 else [])])
    book.save(path)


def savetxt(**options: Any) -> Write:
    return lambda path, _, v: np.savetxt(path, np.column_stack([TIME_S, v]), **options)


def stdlib_csv(dialect: str) -> Write:
    def write(path: Path, _: str, v: np.ndarray) -> None:
        with path.open("w", newline="", encoding="utf-16" if dialect == "excel-tab" else "utf-8") as file:
            writer = csv.writer(file, dialect)
            writer.writerow(["Logger", "17"])
            writer.writerow(["t (ms)", "accX (m/s²)", "accY (m/s²)", "accZ (m/s²)"])
            writer.writerows(np.column_stack([1e3 * TIME_S, v]).tolist())

    return write


def hdf5(kind: str) -> Write:
    def write(path: Path, role: str, v: np.ndarray) -> None:
        import h5py

        with h5py.File(path, "w", userblock_size=512 if kind == "7.3" else 0) as file:
            if kind == "matrix":
                file["run/acc"] = v
                file["run"].attrs["sample_rate"] = float(RATE_HZ)
            elif kind == "7.3":
                file["t"], file["acc"] = TIME_S[None, :], v.T
            else:
                file["time"] = TIME_S
                for k, axis in enumerate(AXES):
                    file.create_dataset(axis, data=v[:, k].astype("f4"), compression="gzip", shuffle=True)
                    file[axis].attrs["units"] = "m/s2" if role == "reference" else "counts"
        if kind == "7.3":
            data = path.read_bytes()
            path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(128) + data[128:])

    return write


def matlab(kind: str = "vectors", **options: Any) -> Write:
    def write(path: Path, _: str, v: np.ndarray) -> None:
        from scipy.io import savemat

        told: dict[str, Any] = {"t": TIME_S, "x": v[:, 0], "y": v[:, 1], "z": v[:, 2]}
        if kind == "structure":
            told = {"imu": {"time": TIME_S, "acc": v}}
        elif kind == "rate":
            told = {"fs": float(RATE_HZ), "acc": v}
        savemat(path, told, **options)

    return write


def scipy_wav(kind: str) -> Write:
    def write(path: Path, _: str, v: np.ndarray) -> None:
        from scipy.io import wavfile

        wavfile.write(path, RATE_HZ, v.astype(kind))

    return write


def soundfile(subtype: str, full_scale: float = 1.0, form: str = "WAV") -> Write:
    def write(path: Path, _: str, v: np.ndarray) -> None:
        import soundfile as sf

        sf.write(path, v / full_scale, RATE_HZ, subtype=subtype, format=form)

    return write


def pcm(bits: int) -> Write:
    return soundfile(f"PCM_{bits}", 2.0 ** (bits - 1))


def miniseed(kind: str, encoding: str, **options: Any) -> Write:
    def write(path: Path, _: str, v: np.ndarray) -> None:
        import obspy

        about = {
            "network": "XX",
            "station": "FIELD",
            "sampling_rate": RATE_HZ,
            "starttime": obspy.UTCDateTime(ns=BEGIN_NS),
        }
        traces = [
            obspy.Trace(np.ascontiguousarray(v[:, k].astype(kind)), about | {"channel": f"HN{letter}"})
            for k, letter in enumerate("ENZ")
        ]
        obspy.Stream(traces).write(str(path), format="MSEED", encoding=encoding, **options)

    return write


def tdms(waveform: bool) -> Write:
    def write(path: Path, role: str, v: np.ndarray) -> None:
        import nptdms

        about: dict[str, Any] = {"unit_string": "m/s2"} if role == "reference" else {}
        if waveform:
            about |= {"wf_increment": 1.0 / RATE_HZ, "wf_samples": N, "wf_start_offset": 0.0}
        channels = [nptdms.ChannelObject("imu", f"acc {axis}", v[:, k], about) for k, axis in enumerate(AXES)]
        if not waveform:
            channels.insert(0, nptdms.ChannelObject("imu", "time", TIME_S, {"unit_string": "s"}))
        with nptdms.TdmsWriter(path) as writer:
            writer.write_segment(channels)

    return write


def rosbag(kind: str, compressed: bool = False, storage: str = "MCAP") -> Write:
    def write(path: Path, _: str, v: np.ndarray) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
        from rosbags.rosbag2 import Writer as BagWriter
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_HUMBLE)
        types = store.types
        vector, now = types["geometry_msgs/msg/Vector3"], types["builtin_interfaces/msg/Time"]
        turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        name, none = f"{kind.replace('/', '/msg/')}", np.zeros(9)
        bag = path.with_suffix("")
        writer = BagWriter(bag, version=9, storage_plugin=StoragePlugin[storage])
        if compressed:
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection("/imu", name, typestore=store)
            for ns, (x, y, z) in zip(TIME_NS.tolist(), v.tolist(), strict=False):
                header = types["std_msgs/msg/Header"](now(ns // 10**9, ns % 10**9), "imu_link")
                acceleration = vector(x, y, z)
                if kind == "sensor_msgs/Imu":
                    message = types[name](header, turn, none, vector(0.0, 0.0, 0.0), none, acceleration, none)
                else:
                    message = types[name](header, types["geometry_msgs/msg/Accel"](acceleration, vector(7.0, 8.0, 9.0)))
                writer.write(connection, ns, store.serialize_cdr(message, name))
        next(bag.glob(f"*{path.suffix}")).rename(path)

    return write


def rosbag_1(path: Path, _: str, v: np.ndarray) -> None:
    from rosbags.rosbag1 import Writer as BagWriter
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    types, name, none = store.types, "sensor_msgs/msg/Imu", np.zeros(9)
    vector, now = types["geometry_msgs/msg/Vector3"], types["builtin_interfaces/msg/Time"]
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    with BagWriter(path) as writer:
        connection = writer.add_connection("/imu", name, typestore=store)
        for ns, (x, y, z) in zip(TIME_NS.tolist(), v.tolist(), strict=False):
            header = types["std_msgs/msg/Header"](0, now(ns // 10**9, ns % 10**9), "imu_link")
            message = types[name](header, turn, none, vector(0.0, 0.0, 0.0), none, vector(x, y, z), none)
            writer.write(connection, ns, store.serialize_ros1(message, name))


MAPPING = """["/imu"]
x = "accel.linear.x"
y = "accel.linear.y"
z = "accel.linear.z"
unit = "m/s2"
"""
MAPPED = ("--mapping",)
IN_STEPS = ("--sensitivity", f"{STEPS} counts/(m/s2)")
STEPPED: dict[str, Any] = {"options": IN_STEPS, "steps": True, "since_1970": True}
AS_NUMBERS = ("--sensitivity", "1 counts/(m/s2)")


def of_full_scale(bits: int) -> tuple[str, str]:
    """A sensitivity for steps that are read as parts of full scale."""
    return "--sensitivity", repr(STEPS / 2.0 ** (bits - 1))


WRITERS: dict[str, Writer] = {
    "pandas csv": Writer("pandas", ".csv", pandas_csv()),
    "pandas csv without index": Writer("pandas", ".csv", pandas_csv(index=False)),
    "pandas csv of Germany": Writer("pandas", ".csv", pandas_csv(index=False, sep=";", decimal=",")),
    "pandas tsv": Writer("pandas", ".tsv", pandas_csv(index=False, sep="\t")),
    "pandas csv with quotes": Writer("pandas", ".csv", pandas_csv(index=False, quoting=csv.QUOTE_ALL)),
    "pandas csv for Excel": Writer("pandas", ".csv", pandas_csv(index=False, encoding="utf-8-sig")),
    "pandas csv with dates": Writer("pandas", ".csv", pandas_csv("date", index=False), since_1970=True),
    "pandas csv with digits": Writer("pandas", ".csv", pandas_csv(index=False, float_format="%.12e")),
    "pandas parquet": Writer("pandas", ".parquet", parquet(), needs=("pyarrow",)),
    "pandas parquet zstd": Writer("pandas", ".parquet", parquet(compression="zstd"), needs=("pyarrow",)),
    "pandas parquet with dates": Writer("pandas", ".parquet", parquet("date"), since_1970=True, needs=("pyarrow",)),
    "pandas parquet float32": Writer("pandas", ".parquet", parquet(kind="float32"), needs=("pyarrow",)),
    "pandas parquet int16": Writer("pandas", ".parquet", parquet(kind="int16", compression=None), needs=("pyarrow",)),
    "pandas feather": Writer("pandas", ".feather", feather(), needs=("pyarrow",)),
    "pandas feather plain": Writer("pandas", ".feather", feather(compression="uncompressed"), needs=("pyarrow",)),
    "pyarrow csv": Writer("pyarrow", ".csv", arrow_csv, needs=("pandas",)),
    "pyarrow parquet 1.0": Writer("pyarrow", ".parquet", arrow_groups, needs=("pandas",)),
    "pandas Excel": Writer("pandas", ".xlsx", pandas_excel(index=False), needs=("openpyxl",)),
    "pandas Excel with index": Writer("pandas", ".xlsx", pandas_excel(), needs=("openpyxl",)),
    "openpyxl": Writer("openpyxl", ".xlsx", openpyxl_book),
    "numpy savetxt": Writer("numpy", ".txt", savetxt(header="time x y z")),
    "numpy savetxt csv": Writer("numpy", ".csv", savetxt(header="time,x,y,z", delimiter=",", comments="")),
    "csv of Excel": Writer("csv", ".csv", stdlib_csv("excel")),
    "csv of Excel as Unicode text": Writer("csv", ".txt", stdlib_csv("excel-tab")),
    "h5py": Writer("h5py", ".h5", hdf5("columns")),
    "h5py with a rate": Writer("h5py", ".hdf5", hdf5("matrix")),
    "MATLAB 7.3": Writer("h5py", ".mat", hdf5("7.3")),
    "scipy mat": Writer("scipy", ".mat", matlab()),
    "scipy mat compressed": Writer("scipy", ".mat", matlab("rate", do_compression=True)),
    "scipy mat structure": Writer("scipy", ".mat", matlab("structure")),
    "scipy mat 4": Writer("scipy", ".mat", matlab(format="4")),
    "scipy wav int16": Writer("scipy", ".wav", scipy_wav("int16"), of_full_scale(16), 2.0**15, steps=True),
    "scipy wav int32": Writer("scipy", ".wav", scipy_wav("int32"), of_full_scale(32), 2.0**31, steps=True),
    "scipy wav float32": Writer("scipy", ".wav", scipy_wav("float32")),
    "scipy wav float64": Writer("scipy", ".wav", scipy_wav("float64")),
    "soundfile PCM 16": Writer(
        "soundfile", ".wav", soundfile("PCM_16", 2.0**15), of_full_scale(16), 2.0**15, steps=True
    ),
    "soundfile PCM 24": Writer(
        "soundfile", ".wav", soundfile("PCM_24", 2.0**23), of_full_scale(24), 2.0**23, steps=True
    ),
    "soundfile float": Writer("soundfile", ".wav", soundfile("FLOAT")),
    "soundfile extensible": Writer("soundfile", ".wav", soundfile("DOUBLE", form="WAVEX")),
    "ObsPy Steim 2": Writer("obspy", ".mseed", miniseed("int32", "STEIM2"), **STEPPED),
    "ObsPy Steim 1": Writer(
        "obspy", ".mseed", miniseed("int32", "STEIM1", reclen=512), IN_STEPS, steps=True, since_1970=True
    ),
    "ObsPy int16": Writer(
        "obspy", ".msd", miniseed("int16", "INT16", byteorder="<"), IN_STEPS, steps=True, since_1970=True
    ),
    "ObsPy float64": Writer("obspy", ".mseed", miniseed("float64", "FLOAT64"), AS_NUMBERS, since_1970=True),
    "npTDMS waveform": Writer("nptdms", ".tdms", tdms(True)),
    "npTDMS": Writer("nptdms", ".tdms", tdms(False)),
    "rosbags Imu": Writer("rosbags", ".mcap", rosbag("sensor_msgs/Imu"), since_1970=True),
    "rosbags Imu zstd": Writer("rosbags", ".mcap", rosbag("sensor_msgs/Imu", compressed=True), since_1970=True),
    "rosbags Imu in SQLite": Writer("rosbags", ".db3", rosbag("sensor_msgs/Imu", storage="SQLITE3"), since_1970=True),
    "rosbags Imu of ROS 1": Writer("rosbags", ".bag", rosbag_1, since_1970=True),
    "rosbags AccelStamped": Writer(
        "rosbags", ".mcap", rosbag("geometry_msgs/AccelStamped"), ("--mapping",), since_1970=True
    ),
}
