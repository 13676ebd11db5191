"""Four sensors at 1 kHz and two references for ten minutes: does the agent lose samples, and what does it cost?

The twins run in another process than the agent: four ADXL355 at register level, each on its own I2C bus, whose
transfers go over a socket (the agent uses the real smbus2; only the kernel is replaced), and two references that write
lines on pseudo-terminals. `python -m benchmarks four_sensors`; the environment variable RUN_SECONDS sets another
duration.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from agent.core.events import CalibrationUpdate, Event, Gap
from agent.recording.reading import RecordingReader
from benchmarks.agent_cost import cpu_s, peak_mb
from benchmarks.page import machine, write_part
from benchmarks.witness import Late, Witness, before_others
from hw.block import BlockFlags, SampleBlock
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.bench import Bench
from hw.virtual.kernel import I2CBus, installed
from hw.virtual.presets import plain
from hw.virtual.remote_bus import RemoteBus, serve
from hw.virtual.serial_bench import serial_lines
from hw.virtual.serial_port import PtyDevice
from hw.virtual.timebase import BenchTime

SECONDS = float(os.environ.get("RUN_SECONDS", "600"))
WARM_UP_S = 6.0  # imports and the first fits are not part of the running cost
BENCHES, SENSORS = (1, 2), range(4)  # seeds of the benches; each bench has two sensors and a reference
ADDRESS = 0x1D
FIFO_S = 0.032  # time in which the FIFO fills at 1 kHz
STILL_S = 0.005  # pause of the machine that does not disturb a read every 8 ms


def bench_of(sensor: int) -> int:
    """The bench to which a sensor belongs."""
    return sensor // 2


def configuration(directory: Path) -> str:
    """Configuration of the agent, as TOML."""
    lines = ["[zenoh]", "enabled = false"]
    for i in SENSORS:
        options = f"{{ bus = {i}, address = {ADDRESS}, rate_hz = 1000, serial_number = '{i}' }}"
        lines += ["[[devices]]", f"name = 'mems-{i}'", "driver = 'adxl355'", f"options = {options}"]
    for i in range(len(BENCHES)):
        options = f"{{ port = '{directory}/reference-{i}', rate_hz = 1000, axes = 1, sequence = true, unit = 'm/s2' }}"
        lines += ["[[devices]]", f"name = 'reference-{i}'", "driver = 'serial-csv'", f"options = {options}"]
    for i in SENSORS:
        schedule = plain(BENCHES[bench_of(i)]).schedule
        poses = [
            f"{{ start_s = {p.start_s}, stop_s = {p.stop_s}, theta_deg = {p.theta_deg}, alpha_deg = {p.alpha_deg} }}"
            for p in schedule.poses(schedule.duration_s(1))
        ]
        lines += ["[[channels]]", f"sensor = 'mems-{i}'", f"reference = 'reference-{bench_of(i)}'"]
        lines += ["prior = {}", f"poses_repeat_s = {schedule.period_s}", f"poses = [{', '.join(poses)}]"]
    return "\n".join(lines) + "\n"


def run_twins(directory: Path) -> None:
    """Serve all devices until a request to stop."""
    stopped = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopped.set())
    ports = []
    for i, seed in enumerate(BENCHES):
        bench, clock = Bench(plain(seed), seed), BenchTime()
        for sensor in (sensor for sensor in SENSORS if bench_of(sensor) == i):
            twin = Adxl355Twin(bench.sensor_counts, _begun(bench, clock), time.monotonic)
            serve(I2CBus({ADDRESS: twin}), directory / f"i2c-{sensor}")
        ports.append(PtyDevice(serial_lines(bench, "reference", clock), link=directory / f"reference-{i}"))
        bench.sensor_counts(0, 1)
        bench.reference_values(0, 1)
    for port in ports:
        port.start()
    stopped.wait()
    for port in ports:
        port.stop()


def _begun(bench: Bench, clock: BenchTime) -> Any:
    def due(t_s: float) -> int:
        if not clock.begun:  # the first request of a twin comes when it is set to measure
            clock.begin(t_s)
        return bench.sensor_samples_due(clock(t_s))

    return due


def run_agent(directory: Path, seconds: float) -> int:
    """Run `fieldcal run` with the kernel replaced; write the largest queue length into a file."""
    from agent.acquisition import service
    from agent.acquisition.reader import EventQueue
    from agent.cli.main import run_cli

    class Watched(EventQueue):
        longest = 0

        def put(self, device: str, event: Event) -> None:
            super().put(device, event)
            Watched.longest = max(Watched.longest, self._queue.qsize())

    service.EventQueue = Watched  # type: ignore[attr-defined, misc]
    buses = {f"/dev/i2c-{i}": RemoteBus(directory / f"i2c-{i}") for i in SENSORS}
    with installed(buses):
        data = str(directory / "data")
        status = run_cli(["run", str(directory / "config.toml"), "--data-dir", data, "--duration", str(seconds)])
    (directory / "queue").write_text(str(Watched.longest))
    return status


def measure(directory: Path) -> dict[str, float]:
    """Run twins and agent; returns CPU time per s after the warm-up, peak memory, longest queue."""
    (directory / "config.toml").write_text(configuration(directory))
    command = [sys.executable, "-m", "benchmarks.four_sensors"]
    twins = subprocess.Popen([*command, "twins", str(directory)])
    try:
        while not (directory / f"reference-{len(BENCHES) - 1}").exists():
            time.sleep(0.05)
        agent = subprocess.Popen([*command, "agent", str(directory), str(SECONDS)], stdout=subprocess.DEVNULL)
        time.sleep(WARM_UP_S)
        before, began = (cpu_s(agent.pid), cpu_s(twins.pid)), time.monotonic()
        time.sleep(SECONDS - 2 * WARM_UP_S)
        passed = time.monotonic() - began
        found = {
            "agent": (cpu_s(agent.pid) - before[0]) / passed,
            "twins": (cpu_s(twins.pid) - before[1]) / passed,
            "peak_mb": peak_mb(agent.pid),
        }
        agent.wait(60)
        return found | {"queue": float((directory / "queue").read_text())}
    finally:
        twins.terminate()
        twins.wait(10)


def recorded(directory: Path) -> tuple[Counter[str], dict[str, list[SampleBlock]], int]:
    """Number of gaps by reason, blocks by device (the indications are not used), number of calibrations."""
    gaps: Counter[str] = Counter()
    blocks: dict[str, list[SampleBlock]] = {}
    calibrations = 0
    for path in sorted((directory / "data").glob("*.mcap")):
        for step in RecordingReader(path).steps():
            if isinstance(step.event, Gap):
                gaps[step.event.reason] += step.event.dropped
            elif isinstance(step.event, SampleBlock):
                blocks.setdefault(step.event.device, []).append(step.event)
            calibrations += sum(isinstance(result, CalibrationUpdate) for result in step.results)
    return gaps, blocks, calibrations


def reads_late(blocks: dict[str, list[SampleBlock]]) -> list[Late]:
    """Reads of each FIFO that came too late after the read before: time and delay, s; if none, the latest read."""
    found: list[Late] = []
    for device in (f"mems-{i}" for i in SENSORS):
        read_s = np.concatenate([block.burst_t_monotonic_ns for block in blocks[device]]) * 1e-9
        apart_s = np.diff(read_s)
        late = np.flatnonzero(apart_s > FIFO_S) if apart_s.max() > FIFO_S else [np.argmax(apart_s)]
        found += [(float(read_s[k]), float(apart_s[k])) for k in late]
    return found


def told(reads: list[Late], stood: list[Late]) -> str:
    """Text: the longest time between two reads, and how many of the late reads were caused by pauses of the machine."""
    longest = f"{1e3 * max(apart_s for _, apart_s in reads):.1f} ms"
    late = [(t_s, apart_s) for t_s, apart_s in reads if apart_s > FIFO_S]
    if not late:
        return longest
    within = [
        (apart_s, [by_s for due_s, by_s in stood if t_s < due_s + by_s and due_s < t_s + apart_s])
        for t_s, apart_s in late
    ]
    excused = sum(apart_s - max(by_s, default=0.0) <= FIFO_S for apart_s, by_s in within)
    return f"{longest}; {len(late)} too long, {excused} of them only because the machine itself paused"


def circumstances(before: bool, stood: list[Late]) -> str:
    """Text: load and pauses of the machine, and whether its other processes had lower priority."""
    kept = ", all under SCHED_FIFO" if before else ""
    still = f"the machine itself paused {len(stood)} times for more than {1e3 * STILL_S:g} ms"
    if stood:
        still += f", {1e3 * max(late_s for _, late_s in stood):.0f} ms at most"
    return f"load of the machine {os.getloadavg()[2]:.0f}{kept};\n{still}"


def main() -> None:
    """Measure and write the table."""
    before, witness = before_others(), Witness()
    with tempfile.TemporaryDirectory(prefix="fieldcal-") as name:
        directory = Path(name)
        found = measure(directory)
        stood = witness.result(STILL_S)
        gaps, blocks, calibrations = recorded(directory)
    flags = Counter(flag.name for held in blocks.values() for b in held[1:] for flag in BlockFlags if b.flags & flag)
    missing = sum(b.first_index - a.first_index - a.n for held in blocks.values() for a, b in itertools.pairwise(held))
    samples = sum(block.n for held in blocks.values() for block in held)
    lost = ", ".join(f"{name} {n}" for name, n in sorted(flags.items())) or "none"
    write_part(
        "four_sensors",
        f"""
`python -m benchmarks four_sensors` on {machine()}; four ADXL355 twins at 1 kHz (register level, each on a bus of its
own) and two references at 1 kHz (serial) in another process. The agent records them and finds windows; {SECONDS:g} s;
{circumstances(before, stood)}.

| figure | measured | goal |
| --- | --- | --- |
| blocks that report a loss (overrun, restart, gap) | {lost} | none |
| samples missing, of {samples} | {missing} | 0 |
| dropped between driver and pipeline | {json.dumps(dict(gaps)) if gaps else "nothing"} | nothing |
| longest time between two reads of a FIFO | {told(reads_late(blocks), stood)} | 32 ms |
| largest number of events that waited in the queue | {found["queue"]:.0f} of {60 * len(blocks)} | |
| CPU of the agent, share of one core | {found["agent"]:.1%} | |
| CPU of the twins, share of one core | {found["twins"]:.1%} | |
| peak memory of the agent (VmHWM) | {found["peak_mb"]:.0f} MB | |
| calibrations made | {calibrations} | |
""",
    )


if __name__ == "__main__":
    if sys.argv[1] == "twins":
        run_twins(Path(sys.argv[2]))
    else:
        sys.exit(run_agent(Path(sys.argv[2]), float(sys.argv[3])))
