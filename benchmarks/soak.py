"""`make soak`: hours of the real agent on serial ports; watches its memory, threads and file descriptors.

With `--speed 20`, 24 h take 72 min: the ports send 20 times as fast, and the clock of a plug-in driver runs 20 times as
fast (benchmarks.fast_serial), so that stamps, windows and file rotation are the same as in real time.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.core.events import CalibrationUpdate
from agent.delivery.consumer import Consumer
from agent.delivery.history import FILE_NAME, History, StoredResult
from benchmarks.fast_serial import environment
from benchmarks.page import machine, write_part
from hw.virtual.bench import Bench
from hw.virtual.presets import plain
from hw.virtual.serial_bench import Role, serial_lines, serial_options
from hw.virtual.serial_port import PtyDevice
from hw.virtual.timebase import BenchTime

ROOT = Path(__file__).resolve().parents[1]
SEED = 1
SAMPLE_S = 5.0
SETTLE_S = 0.5  # a reader discards what arrives before its port is set up
# Limit of the median of the last quarter over that of the second. A value that grows by 1 % in half a day has no limit.
# The first quarter is left out because caches, windows and clock models fill then.
FLAT = 1.02
ENDPOINT = "tcp/127.0.0.1:{port}"
# Files are rotated by size alone, because a file starts by the agent's clock and its age follows the drivers' clock,
# which is ahead.
ROTATION = "[recording]\nrotate_s = 86400\nrotate_bytes = 2097152"
ROLES: tuple[Role, ...] = ("sensor", "reference")


@dataclass(frozen=True, slots=True)
class Sample:
    """Resources of a process at one moment."""

    elapsed_s: float
    memory_mb: float
    threads: int
    descriptors: int


@dataclass(frozen=True, slots=True, eq=False)
class Soaked:
    """Results of a soak; `hours` are of the drivers' clocks."""

    speed: int
    rate_hz: int
    hours: float
    samples: list[Sample]
    lost_bytes: int
    kept: list[StoredResult]
    received: list[int]
    worst_error_pct: float
    exit_status: int | None


def soak(hours: float, speed: int, rate_hz: int, port: int) -> Soaked:
    """Run the agent for `hours` of its drivers' clock and observe it."""
    bench, bench_time = slow_bench(rate_hz), BenchTime()
    with ExitStack() as stack:
        directory = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        devices = [
            PtyDevice(serial_lines(bench, r, bench_time), lambda: speed * time.monotonic(), directory / r)
            for r in ROLES
        ]
        for device in devices:
            stack.callback(device.stop)
            device.start()
        config = directory / "config.toml"
        config.write_text(configuration(bench, directory, speed, port))
        stack.enter_context(process(["router", "--listen", ENDPOINT.format(port=port)], directory, speed))
        received = stack.enter_context(_received(ENDPOINT.format(port=port)))
        agent = stack.enter_context(
            process(["run", str(config), "--data-dir", str(directory / "data")], directory, speed)
        )
        while not all(device.has_reader() for device in devices):
            time.sleep(0.05)
        time.sleep(SETTLE_S)
        bench_time.begin(speed * time.monotonic())
        samples = list(_watched(agent, hours * 3600 / speed))
        lasted_h = samples[-1].elapsed_s * speed / 3600
        lost = sum(device.lost_bytes for device in devices)  # before the agent stops reading
        agent.terminate()
        agent.wait(20)
        with History(directory / "data" / FILE_NAME) as history:
            kept = history.after(-1, limit=10_000_000)
        return Soaked(
            speed, rate_hz, lasted_h, samples, lost, kept, list(received), _worst_error(bench, kept), agent.returncode
        )


def slow_bench(rate_hz: int) -> Bench:
    """The plain bench with sensor and reference at this rate, in Hz."""
    parameters = plain(SEED)
    sensor, reference = (replace(p.clock, nominal_rate_hz=rate_hz) for p in (parameters.sensor, parameters.reference))
    parameters = replace(
        parameters,
        sensor=replace(parameters.sensor, clock=sensor),
        reference=replace(parameters.reference, clock=reference),
    )
    return Bench(parameters, SEED)


def configuration(bench: Bench, directory: Path, speed: int, port: int) -> str:
    """Configuration of an agent whose ports are named as the roles, in `directory`."""
    driver = "serial-csv" if speed == 1 else "serial-csv-fast"
    lines = [f'[zenoh]\nconnect = ["{ENDPOINT.format(port=port)}"]', ROTATION]
    for role in ROLES:
        options = serial_options(bench, role) | {"port": str(directory / role), "serial_number": "soak"}
        table = ", ".join(f"{key} = {json.dumps(value)}" for key, value in options.items())
        lines.append(f'[[devices]]\nname = "{role}"\ndriver = "{driver}"\noptions = {{ {table} }}')
    poses = ", ".join(
        f"{{ start_s = {p.start_s}, stop_s = {p.stop_s}, theta_deg = {p.theta_deg}, alpha_deg = {p.alpha_deg} }}"
        for p in bench.poses
    )
    lines.append(
        f'[[channels]]\nsensor = "sensor"\nreference = "reference"\nposes = [{poses}]\n'
        f"prior = {{ sensitivity = {bench.parameters.sensor.nominal_sensitivity} }}\n"
        # On the fast clock a pause of the machine is 20 times as long.
        f"silence_s = {30 * speed}\nlate_horizon_s = 60\n"
        f"poses_repeat_s = {bench.parameters.schedule.period_s}"
    )
    return "\n".join(lines) + "\n"


@contextmanager
def process(arguments: list[str], directory: Path, speed: int) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command of fieldcal whose clock, in fast drivers, runs `speed` times as fast."""
    variables = os.environ | environment(speed, directory / "site")
    with open(directory / f"{arguments[0]}.output", "wb") as output:
        started = subprocess.Popen(
            [sys.executable, "-m", "agent", *arguments], stdout=output, stderr=subprocess.STDOUT, env=variables
        )
    try:
        yield started
    finally:
        started.terminate()
        started.wait(20)


@contextmanager
def _received(endpoint: str) -> Iterator[list[int]]:
    """Numbers of all results that a consumer received, in order of arrival."""
    numbers: list[int] = []
    while True:
        with contextlib.suppress(ConnectionError):
            consumer = Consumer([endpoint])
            break

    def take() -> None:
        numbers.extend(result.sequence for result in consumer)

    thread = threading.Thread(target=take, daemon=True)
    thread.start()
    yield numbers
    consumer.close()
    thread.join(10)


def _watched(agent: subprocess.Popen[bytes], duration_s: float) -> Iterator[Sample]:
    began_s = time.monotonic()
    while (elapsed_s := time.monotonic() - began_s) < duration_s and agent.poll() is None:
        status = dict(
            line.split(":", 1) for line in Path(f"/proc/{agent.pid}/status").read_text().splitlines() if ":" in line
        )
        descriptors = len(os.listdir(f"/proc/{agent.pid}/fd"))
        sample = Sample(elapsed_s, int(status["VmRSS"].split()[0]) / 1024, int(status["Threads"]), descriptors)
        print(
            f"{elapsed_s:7.0f} s  {sample.memory_mb:6.1f} MB  {sample.threads} threads  {descriptors} fds", flush=True
        )
        yield sample
        time.sleep(min(SAMPLE_S, max(0.1, duration_s / 100)))


def _worst_error(bench: Bench, kept: list[StoredResult]) -> float:
    """Largest error of any main sensitivity in any calibration, %."""
    truth = np.diag(bench.truth.sensitivity)
    updates = [r.result for r in kept if r.what == "calibration"]
    found = np.array([np.diag(np.array(u.sensitivity)) for u in updates if isinstance(u, CalibrationUpdate)])
    return float(100 * np.abs(found / truth - 1).max()) if len(found) else float("nan")


def _row(name: str, values: NDArray[np.float64], unit: str) -> str:
    quarters = [float(np.median(q)) for q in np.array_split(values, 4)]
    verdict = "flat" if quarters[3] <= FLAT * quarters[1] else "GROWS"
    return f"| {name} | " + " | ".join(f"{q:.4g}{unit}" for q in quarters) + f" | {verdict} |"


def table(soaked: Soaked) -> str:
    """Text of the page."""
    numbers = [record.sequence for record in soaked.kept]
    calibrations = sum(record.what == "calibration" for record in soaked.kept)
    used = sum(record.what == "window" and bool(record.fields["used"]) for record in soaked.kept)
    windows = sum(record.what == "window" for record in soaked.kept)
    lost = len(set(numbers) - set(soaked.received))
    rows = [
        _row("resident memory", np.array([s.memory_mb for s in soaked.samples]), " MB"),
        _row("threads", np.array([s.threads for s in soaked.samples], float), ""),
        _row("file descriptors", np.array([s.descriptors for s in soaked.samples], float), ""),
    ]
    return f"""
{time.strftime("%Y-%m-%d", time.gmtime())}, {machine()}: {soaked.hours:.2f} h of the drivers' clock in
{soaked.samples[-1].elapsed_s / 60:.0f} min, {soaked.speed} times real time; sensor {soaked.rate_hz} Hz x 3 and
reference {soaked.rate_hz} Hz, seed {SEED}; exit status {soaked.exit_status};
{len(soaked.samples)} readings of memory, threads and descriptors.

| median of a quarter of the time | first | second | third | last | last over second at most {FLAT} |
| --- | --- | --- | --- | --- | --- |
{chr(10).join(rows)}

{len(numbers)} results, {calibrations} of them calibrations, {used} of {windows} windows used. Results that did not
reach the consumer: {lost}; out of order: {sum(np.diff(soaked.received) <= 0) if len(soaked.received) > 1 else 0}.
Largest error of a main sensitivity in any calibration: {soaked.worst_error_pct:.3f} %.
Bytes that the ports lost because the machine was late: {soaked.lost_bytes}.
"""


def main() -> None:
    """Run one soak and write its part of the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="of the drivers' clock")
    parser.add_argument("--speed", type=int, default=20)
    parser.add_argument("--rate-hz", type=int, default=100)
    parser.add_argument("--router-port", type=int, default=7461)
    parser.add_argument("--part", required=True, help="markers in docs/reliability.md")
    options = parser.parse_args()
    soaked = soak(options.hours, options.speed, options.rate_hz, options.router_port)
    write_part(options.part, table(soaked))


if __name__ == "__main__":
    main()
