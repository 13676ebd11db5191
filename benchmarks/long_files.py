"""Memory and time of `fieldcal calibrate` and `fieldcal export` on files of ten minutes to a day.

`python -m benchmarks.long_files --minutes 10 40 240 1440 --formats parquet csv mcap`. A sensor with three axes and a
reference, both at 1 kHz: a uniaxial one, with a clamp that turns by 30 degrees every 150 s, and a tri-axial one beside
the sensor that feels gravity, without poses.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import csv, parquet

from agent.config import Config
from agent.core.events import DeviceChange, RunStart
from agent.core.pipeline import Pipeline
from agent.engine import identity
from agent.recording.writer import Recorder
from benchmarks.page import machine, write_part
from calib.geometry import clamp
from calib.model import Array
from hw.block import SampleBlock

RATE_HZ, POSE_S, GUARD_S = 1000.0, 150.0, 1.0
PERIOD_S = 600.0  # after which the motion repeats
LINES = 60  # sines of the motion, from 0.5 to 12 Hz
NOISE = 0.02  # m/s2
LATE = 4  # samples by which the sensor comes late: windows are made several times until the lag is found
SENSITIVITY = np.array([[1.02, 0.01, -0.02], [0.0, 0.98, 0.01], [0.015, -0.01, 1.01]])
BURST = 25  # samples of a burst in a recording
LIMIT_MB = 400.0
SENSOR, REFERENCES = ("time_s", "vx", "vy", "vz"), {1: ("time_s", "a"), 3: ("time_s", "ax", "ay", "az")}
GRAVITY = np.array([0.0, 0.0, 9.80665])

Minute = tuple[Array, Array, Array]  # time (n,) in s, reference (n, 1 or 3), indications (n, 3)


def minutes_of(count: int, axes: int) -> Iterator[Minute]:
    """The samples, minute by minute; `axes` of the reference."""
    rng = np.random.default_rng(15)
    n, whole = int(60.0 * RATE_HZ), int(PERIOD_S * RATE_HZ)
    lines = np.zeros((whole // 2 + 1, axes), complex)
    used = np.linspace(0.5 * PERIOD_S, 12.0 * PERIOD_S, LINES).astype(int)
    lines[used] = np.exp(2j * np.pi * rng.random((LINES, axes)))
    motion = np.fft.irfft(lines, whole, axis=0)
    motion *= 3.0 / motion.std(axis=0)
    for k in range(count):
        number = k * n + np.arange(n)
        time_s, u, late = number / RATE_HZ, motion[number % whole], motion[(number - LATE) % whole]
        if axes == 3:
            u, felt = u + GRAVITY, late + GRAVITY
        else:
            pose = [clamp(np.deg2rad(35.0), np.deg2rad(30.0 * k)) for k in range(12)]
            at = (time_s // POSE_S).astype(int) % 12
            directions, gravity = (
                np.array([getattr(p, name) for p in pose])[at] for name in ("direction", "gravity_mps2")
            )
            felt = late * directions[:, :, 0] + gravity
        V = felt @ SENSITIVITY.T
        yield time_s, u + 0.1 * NOISE * rng.normal(size=u.shape), V + NOISE * rng.normal(size=V.shape)


def pose_rows(count: int) -> list[tuple[float, float, int]]:
    """Start and stop in s and alpha in deg of each position of the clamp."""
    positions = range(int(60 * count / POSE_S))
    return [(k * POSE_S + GUARD_S, (k + 1) * POSE_S - GUARD_S, 30 * (k % 12)) for k in positions]


def write_parquet(directory: Path, count: int, axes: int) -> tuple[Path, Path]:
    """The sensor's and the reference's file."""
    return _written(directory, count, axes, "parquet", lambda path, schema: parquet.ParquetWriter(path, schema))


def write_csv(directory: Path, count: int, axes: int) -> tuple[Path, Path]:
    """The same as text."""
    return _written(directory, count, axes, "csv", lambda path, schema: csv.CSVWriter(path, schema))


def _written(
    directory: Path, count: int, axes: int, ending: str, open_writer: Callable[..., object]
) -> tuple[Path, Path]:
    paths = directory / f"sensor.{ending}", directory / f"reference.{ending}"
    schemas = [pa.schema([(name, pa.float64()) for name in names]) for names in (SENSOR, REFERENCES[axes])]
    writers = [open_writer(str(path), schema) for path, schema in zip(paths, schemas, strict=True)]
    for time_s, u, V in minutes_of(count, axes):
        for writer, schema, values in zip(writers, schemas, (V, u), strict=True):
            columns = [time_s, *(column.round(6) for column in values.T)]
            writer.write_table(pa.table([pa.array(column) for column in columns], schema=schema))  # type: ignore[attr-defined]
    for writer in writers:
        writer.close()  # type: ignore[attr-defined]
    return paths


def configuration() -> Config:
    """A channel whose sensor stands for ten seconds at each of three angles, repeatedly."""
    poses = [
        {"start_s": start_s, "stop_s": start_s + 10, "theta_deg": 35, "alpha_deg": alpha_deg}
        for start_s, alpha_deg in ((3, 0), (16, 30), (29, 120))
    ]
    channel: dict[str, Any] = {"sensor": "mems", "reference": "reference", "poses": poses, "poses_repeat_s": 39}
    devices = [{"name": name, "driver": "adxl355"} for name in ("mems", "reference")]
    return Config.model_validate({"devices": devices, "channels": [channel | {"prior": {"sensitivity": 26000.0}}]})


def write_recording(directory: Path, count: int, axes: int) -> tuple[Path, Path]:
    """One recording of both devices, as `fieldcal run` writes it, without results; its time begins at 0."""
    config = configuration()
    recorder = Recorder(directory, ["mems", "reference"], ["mems"], max_bytes=1 << 50, max_age_s=1e9)
    start = RunStart(
        run_id="r", site="s", gateway="g", boot_id="b", t_monotonic_ns=0, t_utc_ns=0,
        config_json=config.model_dump_json(), versions={}, fingerprint={},
        snapshot=Pipeline.begin(config, "r", 0, 0, {}).snapshot(), file_sequence=1, event_sequence=0,
        engine=identity.name(),
    )  # fmt: skip
    opened = DeviceChange(device="reference", state="open", t_monotonic_ns=0, t_utc_ns=0, info_json='{"unit": "m/s2"}')
    recorder.record(0, start, [])
    recorder.record(1, opened, [])
    number, n = 1, int(0.5 * RATE_HZ)
    for time_s, u, V in minutes_of(count, axes):
        for first in range(0, len(time_s), n):
            index = round(time_s[first] * RATE_HZ)
            bursts = np.arange(BURST, n + 1, BURST, dtype=np.int32)
            arrivals_ns = np.round((index + bursts - 1) * 1e9 / RATE_HZ).astype(np.int64)
            counts = np.rint(26000.0 * V[first : first + n]).astype(np.int32)
            for device, values in (("mems", counts), ("reference", u[first : first + n].round(6))):
                number += 1
                block = SampleBlock(device, "b", int(arrivals_ns[-1]), index, RATE_HZ, arrivals_ns, bursts, values)
                recorder.record(number, block, [])
        recorder.sync()
    recorder.close()
    path = directory / "fieldcal-000001.mcap"
    return path, path


WRITERS = {"parquet": write_parquet, "csv": write_csv, "mcap": write_recording}


# A small process that waits for the command: of a child, the kernel counts the memory of the process that started it.
WAITED = """
import os, sys
child = os.posix_spawn(sys.executable, [sys.executable, "-m", "agent", *sys.argv[1:]], os.environ)
_, status, used = os.wait4(child, 0)
print(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, file=sys.stderr)
sys.exit(os.waitstatus_to_exitcode(status))
"""


def measured(arguments: Sequence[str]) -> tuple[float, float, str]:
    """CPU time in s, peak memory in MB and standard output of a `fieldcal` command, which must succeed."""
    done = subprocess.run(
        [sys.executable, "-c", WAITED, *arguments],
        capture_output=True,
        text=True,
        check=False,
        stdin=subprocess.DEVNULL,
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments)} ended with status {done.returncode}: {done.stderr}")
    took_s, peak = done.stderr.split()[-2:]
    return float(took_s), float(peak), done.stdout


def pose_options(directory: Path, count: int, axes: int) -> list[str]:
    """The options of `fieldcal calibrate` that tell the poses; beside a tri-axial reference there is one."""
    if axes == 3:
        return ["--rotation", "1,0,0,0,1,0,0,0,1"]
    rows = [f"{start_s},{stop_s},35,{alpha_deg}" for start_s, stop_s, alpha_deg in pose_rows(count)]
    (directory / "poses.csv").write_text("\n".join(["start_s,stop_s,theta_deg,alpha_deg", *rows]) + "\n")
    return ["--poses", str(directory / "poses.csv")]


def calibrate(sensor: Path, reference: Path, pose: Sequence[str]) -> tuple[float, float, float]:
    """CPU time in s and peak memory in MB of `fieldcal calibrate`, and the largest error of S in its own U."""
    files = ["--sensor", str(sensor), "--reference", str(reference), *pose]
    if sensor == reference:
        files += ["--columns", "group=mems", "--reference-columns", "group=reference"]
    took_s, peak, out = measured(["calibrate", *files, "--json", "-"])
    result = json.loads(out)
    scale = 26000.0 if sensor.suffix == ".mcap" else 1.0
    error = np.abs(np.array(result["sensitivity"]) / scale - SENSITIVITY)
    worst = np.max(error / (np.array(result["expanded_uncertainty"]["sensitivity"]) / scale))
    return took_s, peak, float(worst)


def main() -> None:
    """Measure, print and, with --write, put the table into the page."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", nargs="+", type=int, default=[10, 40, 240, 1440])
    parser.add_argument("--formats", nargs="+", choices=[*WRITERS], default=[*WRITERS])
    parser.add_argument("--reference-axes", nargs="+", type=int, choices=[1, 3], default=[1, 3])
    parser.add_argument("--directory", type=Path, help="where the files are made; a day takes 6 GB")
    parser.add_argument("--write", action="store_true", help="write docs/performance.md")
    asked = parser.parse_args()
    rows = []
    for axes, ending, count in itertools.product(asked.reference_axes, asked.formats, asked.minutes):
        with tempfile.TemporaryDirectory(dir=asked.directory) as name:
            rows += list(_rows(Path(name), ending, count, axes))
    head = ["| command | file | axes of the reference | length, min | bytes read | CPU time, s | peak memory, MB "
            "| error of S over U, worst |", "| --- | --- | --- | --- | --- | --- | --- | --- |"]  # fmt: skip
    if asked.write:
        told = f"`python -m benchmarks.long_files --write` on {machine()}; goal: {LIMIT_MB:g} MB at any length."
        write_part("long_files", "\n".join([told, "", *head, *rows]))


def _rows(directory: Path, ending: str, count: int, axes: int) -> Iterator[str]:
    sensor, reference = WRITERS[ending](directory, count, axes)
    size = sum(path.stat().st_size for path in {sensor, reference})
    took_s, peak, worst = calibrate(sensor, reference, pose_options(directory, count, axes))
    yield _row(f"| calibrate | {ending} | {axes} | {count} | {size:.3g} | {took_s:.0f} | {peak:.0f} | {worst:.2f} |")
    if ending == "mcap":
        for to in ("samples.parquet", "samples.csv", "plots.mcap"):
            option = "--mcap" if to.startswith("plots") else "--to"
            took_s, peak, _ = measured(["export", str(sensor), option, str(directory / to)])
            yield _row(
                f"| export {option} {to} | {ending} | {axes} | {count} | {size:.3g} | {took_s:.0f} | {peak:.0f} | |"
            )
            (directory / to).unlink()


def _row(text: str) -> str:
    print(text, flush=True)
    return text


if __name__ == "__main__":
    main()
