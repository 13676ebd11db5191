"""Cost of the live agent: CPU relative to a bare loop that only reads and records, start time, memory, its screen.

Another process serves the sensor (1 kHz, three axes) and the reference (1 kHz) on pseudo-terminals. The agent,
the agent with its screen on a terminal, and the bare loop run one after the other on the same ports, twice.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from agent.recording.reading import RecordingReader
from benchmarks.page import machine, write_part
from hw.block import SampleBlock

WARM_UP_S = 6.0  # imports and the first fits are not part of the running cost
MEASURED_S = 40.0
CONFIG = """
[[devices]]
name = "mems"
driver = "serial-csv"
options = {{ port = "{link}-sensor", rate_hz = 1000, axes = 3, sequence = true, unit = "count" }}
[[devices]]
name = "reference"
driver = "serial-csv"
options = {{ port = "{link}-reference", rate_hz = 1000, axes = 1, sequence = true, unit = "m/s2" }}
[[channels]]
sensor = "mems"
prior = {{ sensitivity = 26105 }}
reference = "reference"
poses_repeat_s = 52
poses = [
  {{ start_s = 3, stop_s = 13, theta_deg = 35, alpha_deg = 0 }},
  {{ start_s = 16, stop_s = 26, theta_deg = 35, alpha_deg = 30 }},
  {{ start_s = 29, stop_s = 39, theta_deg = 35, alpha_deg = 120 }},
  {{ start_s = 42, stop_s = 52, theta_deg = 35, alpha_deg = 210 }},
]
[zenoh]
connect = ["tcp/127.0.0.1:7449"]
"""


def cpu_s(pid: int) -> float:
    """CPU time of a process until now, user and system, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def peak_mb(pid: int) -> float:
    """Peak resident memory, MB."""
    line = next(x for x in Path(f"/proc/{pid}/status").read_text().splitlines() if x.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


@contextmanager
def terminal() -> Iterator[int]:
    """A terminal for a process to draw on, which a thread reads; the descriptor of the process's side."""
    reading, drawing = os.openpty()
    reader = threading.Thread(target=read_all, args=(reading,), daemon=True)
    reader.start()
    try:
        yield drawing
    finally:
        os.close(drawing)
        reader.join(5)
        os.close(reading)


def read_all(descriptor: int) -> None:
    """Read until the other side is closed."""
    with suppress(OSError):
        while os.read(descriptor, 65_536):
            pass


def measure(command: list[str], stdout: int = subprocess.DEVNULL) -> tuple[float, float]:
    """CPU time per s after the warm-up, and peak memory in MB."""
    process = subprocess.Popen([sys.executable, *command], stdout=stdout, env=os.environ | {"TERM": "xterm-256color"})
    try:
        time.sleep(WARM_UP_S)
        before, began = cpu_s(process.pid), time.monotonic()
        time.sleep(MEASURED_S)
        share = (cpu_s(process.pid) - before) / (time.monotonic() - began)
        return share, peak_mb(process.pid)
    finally:
        process.terminate()
        process.wait(20)


def first_block_s(config: Path, data_dir: Path) -> float:
    """Time in s from the start of the process to the arrival of the first block that is in the recording."""
    began_ns = time.monotonic_ns()
    command = [sys.executable, "-m", "agent", "run", str(config), "--data-dir", str(data_dir), "--duration", "3"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    steps = RecordingReader(next(data_dir.glob("*.mcap"))).steps()
    first = next(step.event for step in steps if isinstance(step.event, SampleBlock))
    return (first.t_monotonic_ns - began_ns) * 1e-9


@contextmanager
def twins(directory: Path) -> Iterator[None]:
    """The sensor and the reference, begun anew, so that the positions come when the configuration says."""
    serving = [sys.executable, "-m", "agent", "simulate", "--preset", "plain", "--link", str(directory / "port")]
    process = subprocess.Popen(serving, stdout=subprocess.DEVNULL)
    try:
        while not (directory / "port-sensor").exists():
            time.sleep(0.05)
        yield
    finally:
        process.terminate()
        process.wait(10)


def main() -> None:
    """Measure and write the table."""
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        config = directory / "config.toml"
        config.write_text(CONFIG.format(link=directory / "port"))
        router = subprocess.Popen(
            [sys.executable, "-m", "agent", "router", "--listen", "tcp/127.0.0.1:7449"], stdout=subprocess.DEVNULL
        )
        try:
            with twins(directory):
                starts = sorted(first_block_s(config, directory / f"start{i}") for i in range(5))
            shares: dict[str, list[float]] = {"agent": [], "screen": [], "bare": []}
            peaks: list[float] = []
            for turn in range(2):
                data = str(directory / f"data{turn}")
                running = ["-m", "agent", "run", str(config), "--data-dir"]
                with twins(directory):
                    share, peak = measure([*running, data])
                shares["agent"].append(share)
                peaks.append(peak)
                with twins(directory), terminal() as drawing:
                    share, _ = measure([*running, data + "-screen"], stdout=drawing)
                shares["screen"].append(share)
                with twins(directory):
                    share, _ = measure(["-m", "benchmarks.bare_loop", str(config), data + "-bare", "600"])
                shares["bare"].append(share)
        finally:
            router.terminate()
            router.wait(10)
    agent, screen, bare = (sum(shares[k]) / len(shares[k]) for k in ("agent", "screen", "bare"))
    cost = f"{agent / bare:.2f} ({agent:.1%} against {bare:.1%} of a core)"
    drawn = f"{screen / agent:.2f} ({screen:.1%} of a core)"
    start = f"{starts[len(starts) // 2]:.2f} s"
    write_part(
        "agent_cost",
        f"""
`python -m benchmarks agent_cost` on {machine()}; sensor 1 kHz x 3 and reference 1 kHz on two serial ports (served by
another process). The agent records them, finds windows, and publishes to a router. {MEASURED_S:g} s are measured after
a warm-up of {WARM_UP_S:g} s; all three processes are measured in turn, twice, each beside instruments that begin anew.

| figure | measured | goal |
| --- | --- | --- |
| CPU of the agent, divided by that of a bare loop that only reads and records | {cost} | 1.3 |
| CPU of the agent with its screen on a terminal, divided by that of the agent without | {drawn} | |
| time from the start to the first recorded block, median of {len(starts)} | {start} | 1.5 s |
| peak memory of the agent (VmHWM) | {max(peaks):.0f} MB | 130 MB |
""",
    )


if __name__ == "__main__":
    main()
