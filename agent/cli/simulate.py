"""`fieldcal simulate`: virtual devices on pseudo-terminals, files with known truth, a recording played, or a fleet."""

from __future__ import annotations

import json
import time
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
import numpy as np
from click.core import ParameterSource
from numpy.typing import NDArray

from agent.cli.rules import check_rules
from agent.cli.simulate_fleet import FleetOptions, fleet_options, serve_fleet
from agent.config.whole_files import whole_file, write_whole
from agent.delivery.ending import StopRequest
from agent.terminal.text import say
from hw.virtual.bench import Bench, Truth
from hw.virtual.playback import PlaybackError, Player, read_track
from hw.virtual.presets import PRESETS
from hw.virtual.serial_bench import Role, decimals_of, serial_lines, serial_options
from hw.virtual.serial_port import PtyDevice
from hw.virtual.timebase import BenchTime

ROLES: tuple[Role, ...] = ("sensor", "reference")
POLL_S = 0.05
# A reader opens a port, sets it up and discards what was received until then; pyserial needs a few ms for this.
SETTLE_S = 0.25
LINGER_S = 1.0  # s; the port stays open this long after the last sample, so that a reader gets the last sample


@click.command()
@fleet_options
@click.option("--preset", type=click.Choice(list(PRESETS)), help="Virtual bench with sensor and reference.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=1, show_default=True, help="Seed of the bench.")
@click.option(
    "--csv", "directory", type=click.Path(path_type=Path, file_okay=False), help="Write files into this directory."
)
@click.option(
    "--duration", "duration_s", type=click.FloatRange(1, 1e6), help="Length in s; default: three repetitions."
)
@click.option("--play", type=click.Path(path_type=Path), help="Play this sensor.csv or reference.csv.")
@click.option(
    "--rate-hz", type=click.FloatRange(1e-3, 1e5), help="Play at this rate instead of the times in column time_s."
)
@click.option("--axes", help="Columns to play, e.g. vx,vy,vz; default: the signals of sensor.csv or reference.csv.")
@click.option("--sequence", is_flag=True, help="Start each played line with its sequence number.")
@click.option("--loop", is_flag=True, help="Repeat until Ctrl-C.")
@click.option(
    "--link", type=click.Path(path_type=Path), help="Path of the port; a bench appends -sensor and -reference."
)
def simulate(
    preset: str | None,
    seed: int,
    directory: Path | None,
    duration_s: float | None,
    play: Path | None,
    rate_hz: float | None,
    axes: str | None,
    sequence: bool,
    loop: bool,
    link: Path | None,
    **fleet: Any,
) -> int:
    """Serve virtual devices on pseudo-terminals, write a recording with known truth, or act as many gateways.

    \b
    --preset plain --csv DIR   sensor.csv, reference.csv, poses.csv and truth.json for `fieldcal calibrate`
    --preset plain             sensor and reference, each on its own port, until Ctrl-C
    --play FILE                a recording on a port, at its own speed, to its end
    --fleet N                  N gateways on the bus, with sensors that drift, step, die or lean, and silent gateways

    Nothing is sent until a reader opens the port; the first sample is sent then.
    """
    of_a_track = bool(rate_hz or axes or sequence or loop)
    if fleet["fleet"] is not None:
        if of_a_track or {preset, directory, play, rate_hz, axes, link} != {None}:
            raise click.UsageError("--fleet goes with --connect, --sensors, --every, --speed, --age, --keys, "
                                   "--truth, --seed and --duration only")  # fmt: skip
        return serve_fleet(FleetOptions(**fleet), seed, duration_s)
    check_rules(
        (
            not _given_options().isdisjoint(fleet),
            "--connect, --sensors, --every, --speed, --age, --keys and --truth need --fleet",
        ),
        ((preset is None) == (play is None), "give --preset, --play or --fleet"),
        (preset is not None and of_a_track, "--rate-hz, --axes, --sequence and --loop need --play"),
        (play is not None and directory is not None, "--csv needs --preset"),
        (duration_s is not None and directory is None, "--duration needs --csv or --fleet"),
    )
    try:
        if play is not None:
            track = read_track(play, tuple(axes.split(",")) if axes else None, rate_hz)
            return _serve_track(Player(track, sequence=sequence, loop=loop), link)
        assert preset is not None
        bench = Bench(PRESETS[preset](seed), seed)
        if directory is None:
            return _serve_bench(bench, link)
        write_files(bench, directory, duration_s, {"preset": preset, "seed": seed})
    except (PlaybackError, FileExistsError, FileNotFoundError, NotADirectoryError, PermissionError) as error:
        say(_fault_line(error), err=True)
        return 2
    say(
        f"fieldcal calibrate --sensor {directory}/sensor.csv --reference {directory}/reference.csv"
        f" --poses {directory}/poses.csv --nominal {bench.parameters.sensor.nominal_sensitivity:.6g} --u-nominal-pct 20"
    )
    return 0


def _fault_line(error: Exception) -> str:
    return f"{error.filename2 or error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)


def _given_options() -> set[str]:
    """The names of the options on the command line."""
    context = click.get_current_context()
    return {name for name in context.params if context.get_parameter_source(name) == ParameterSource.COMMANDLINE}


def write_files(bench: Bench, directory: Path, duration_s: float | None, origin: dict[str, Any]) -> None:
    """Write sensor.csv, reference.csv, poses.csv (formats of `fieldcal calibrate`) and truth.json.

    `duration_s` is in seconds of the bench's clock; default: three repetitions of its schedule, which is one on the
    clamp. `origin` is written into truth.json.
    """
    p = bench.parameters
    recording = bench.recording(p.schedule.duration_s(3) if duration_s is None else duration_s)
    directory.mkdir(parents=True, exist_ok=True)
    number = f"%.{decimals_of(p.sensor.resolution)}f"
    _write_csv(
        directory / "sensor.csv",
        "time_s,vx,vy,vz,temperature_degc",
        ["%.6f", number, number, number, "%.2f"],
        np.column_stack([recording.sensor_stamp_s, recording.v, recording.temperature_degc]),
    )
    number = f"%.{decimals_of(p.reference.resolution)}f"
    _write_csv(
        directory / "reference.csv",
        "time_s,ax,ay,az" if p.reference.channels == 3 else f"time_s,{p.reference.quantity[0]}",
        ["%.6f", *[number] * p.reference.channels],
        np.column_stack([recording.reference_stamp_s, recording.reference]),
    )
    poses = np.array([pose[:4] for pose in recording.poses], dtype=float).reshape(-1, 4)
    _write_csv(directory / "poses.csv", "start_s,stop_s,theta_deg,alpha_deg", ["%.6f", "%.6f", "%g", "%g"], poses)
    truth = origin | {
        "unit": p.sensor.unit,
        "nominal_sensitivity": p.sensor.nominal_sensitivity,
        **_json_ready(recording.truth),
    }
    write_whole(directory / "truth.json", f"{json.dumps(truth, indent=2)}\n".encode())


def _write_csv(path: Path, header: str, formats: list[str], rows: NDArray[np.float64]) -> None:
    with whole_file(path) as file:
        np.savetxt(file, rows, fmt=formats, delimiter=",", header=header, comments="")


def _json_ready(truth: Truth) -> dict[str, Any]:
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in asdict(truth).items()}


def _serve_track(player: Player, link: Path | None) -> int:
    with _Serving() as serving:
        device = serving.start(PtyDevice(player, link=link))
        say(str(device.path))
        if serving.wait_for_reader(device):
            player.begin(time.monotonic())
            while not player.finished and serving.goes_on():
                pass
            serving.linger(device)
    return 0


def _serve_bench(bench: Bench, link: Path | None) -> int:
    bench_time = BenchTime()
    with _Serving() as serving:
        devices: dict[Role, PtyDevice] = {}
        for role in ROLES:
            own_link = link and link.with_name(f"{link.name}-{role}")
            devices[role] = serving.start(PtyDevice(serial_lines(bench, role, bench_time), link=own_link))
        for role, device in devices.items():
            options = ", ".join(f"{name} = {json.dumps(value)}" for name, value in serial_options(bench, role).items())
            say(f"{role} {device.path}  # serial-csv: {options}")
        if serving.wait_for_reader(devices["sensor"]):
            bench_time.begin(time.monotonic())
            while serving.goes_on():
                pass
    return 0


class _Serving:
    """Serves ports until it is told to stop. SIGINT and SIGTERM end it in order, so that no links are left."""

    def __init__(self) -> None:
        self._stop = StopRequest.by_signals()
        self._open = ExitStack()

    def __enter__(self) -> _Serving:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def start(self, device: PtyDevice) -> PtyDevice:
        """Serve this port until `_Serving` ends."""
        self._open.callback(device.stop)
        device.start()
        return device

    def goes_on(self) -> bool:
        """Wait a moment; False after a request to stop."""
        return not self._stop.wait(POLL_S)

    def wait_for_reader(self, device: PtyDevice) -> bool:
        """Wait until a reader has opened and set up the port; False after a request to stop."""
        while self.goes_on():
            if device.has_reader():
                return not self._stop.wait(SETTLE_S)
        return False

    def linger(self, device: PtyDevice) -> None:
        """Wait until the reader has had time to read the rest."""
        end = time.monotonic() + LINGER_S
        while time.monotonic() < end and device.has_reader() and self.goes_on():
            pass
