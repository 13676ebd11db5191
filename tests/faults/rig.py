"""The test rig: the real agent as a process, a virtual sensor that is turned through six rests, and a consumer."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random

import numpy as np

from agent.delivery.consumer import Consumer, Received
from agent.delivery.router import open_router
from benchmarks.fast_serial import environment
from hw.virtual.serial_port import PtyDevice, format_lines

ROOT = Path(__file__).resolve().parents[2]
SITE, GATEWAY = "faults", "rig"
SOURCE = f"{SITE}/{GATEWAY}"
SENSOR = "imu"
RATE_HZ = 100.0
# The shortest rest that gives a window: rests are found in blocks of 0.25 s, need 1 s and lose 0.25 s and the guard at
# both ends.
HOLD_S = 2.5
GUARD_S = 0.25
SPEED = 10  # a window each 0.25 s instead of 2.5 s, so that a fault at a random moment hits more of the agent's work
POLL_S = 0.005
G_MPS2 = 9.80665
UP = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -1], [-1, 0, 0], [0, -1, 0]], dtype=float)
SENSITIVITY = np.array([[1.03, 0.012, -0.006], [-0.008, 0.97, 0.01], [0.005, -0.011, 1.01]])
OFFSET = np.array([0.21, -0.34, 0.12])
NOISE_MPS2 = 0.005
LINE_BYTES = 28
STOP_S = 10.0
IN_START, START_S, WORK_S = 0.25, 1.0, 4.0  # rests begin to count after 0.25 s, four determine S and Q
GIVE_UP_S = 120.0  # s after which a test fails; what is waited for takes seconds, on a machine under load more


def never() -> bool:
    """A condition that never becomes true."""
    return False


class TurnedSensor:
    """Text of the sensor for a `PtyDevice`: silent until `begin`, then a new position every `HOLD_S` of its clock."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._began_s: float | None = None
        self._next = 0

    def begin(self, t_s: float) -> None:
        """Start sending; the first sample is due at `t_s`."""
        self._next = 0
        self._began_s = t_s

    @property
    def speaks(self) -> bool:
        """Whether sending has started."""
        return self._began_s is not None

    def silence(self) -> None:
        """Send no samples until the next `begin`."""
        self._began_s = None

    def __call__(self, t_s: float) -> bytes:
        if self._began_s is None:
            return b""
        n = int((t_s - self._began_s) * RATE_HZ) - self._next
        if n <= 0:
            return b""
        at_s = (self._next + np.arange(n)) / RATE_HZ
        position = (at_s / HOLD_S).astype(int) % len(UP)
        values = G_MPS2 * UP[position] @ SENSITIVITY.T + OFFSET + NOISE_MPS2 * self._random.standard_normal((n, 3))
        greeting = b"# rests\n" if self._next == 0 else b""
        text = greeting + format_lines(values, "%.4f", self._next)
        self._next += n
        return text


class Witness:
    """A consumer that keeps all results it received, each with its time of arrival (time.monotonic)."""

    def __init__(self, endpoint: str, last_sequence: Mapping[str, int] | None = None) -> None:
        self.received: list[tuple[float, Received]] = []
        self._consumer = Consumer([endpoint], f"fieldcal/v1/{SOURCE}/{SENSOR}/**", last_sequence)
        self._thread = threading.Thread(target=self._take, name="witness", daemon=True)
        self._thread.start()

    def _take(self) -> None:
        for result in self._consumer:
            self.received.append((time.monotonic(), result))

    def before(self, t_s: float) -> list[Received]:
        """The results that had arrived by `t_s`, without those that were forgotten."""
        return [result for came_s, result in self.received if came_s <= t_s]

    def forget_since(self, t_s: float) -> None:
        """Forget the results that have arrived since `t_s`: an agent whose disk has failed goes on publishing, and
        nobody promises that these results are in the store."""
        self.received = [(came_s, result) for came_s, result in self.received if came_s <= t_s]

    def close(self) -> None:
        """Stop listening."""
        self._consumer.close()
        self._thread.join(5)


@dataclass
class Rig:
    """A directory with a configuration, a sensor, and the Zenoh endpoint to which agents publish."""

    directory: Path
    endpoint: str
    speed: int
    sensor: TurnedSensor
    device: PtyDevice
    config: Path
    data_dir: Path
    late_s: float = 0.0  # longest time that this process itself had to wait for the processor
    _said: int = 0

    @property
    def output(self) -> str:
        """The output of all agents of this rig."""
        path = self.directory / "output"
        return path.read_text(errors="replace") if path.exists() else ""

    @property
    def unread_s(self) -> float:
        """The sensor's output that the port lost because nobody read it, as a time in s."""
        return self.device.lost_bytes / (LINE_BYTES * RATE_HZ * self.speed)

    @contextmanager
    def agent(
        self, prefix: Sequence[str] = (), variables: dict[str, str] | None = None
    ) -> Iterator[subprocess.Popen[bytes]]:
        """Start the real agent, through the command `prefix` (strace) if given; at the end it is killed if it runs."""
        self.sensor.silence()
        self._said = len(self.output)
        command = [
            *prefix,
            sys.executable,
            "-u",
            "-m",
            "agent",
            "run",
            str(self.config),
            "--data-dir",
            str(self.data_dir),
        ]
        known = os.environ | environment(self.speed, self.directory / "site") | (variables or {})
        with open(self.directory / "output", "ab") as output:
            process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT, env=known)
        try:
            yield process
        finally:
            for pid in [*descendants(process.pid), process.pid]:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            process.wait()

    def _opened(self) -> bool:
        """Whether the agent has opened the port and discarded old input: after that it prints the sensor's status."""
        return self.device.has_reader() and f"{SENSOR}: " in self.output[self._said :]

    def run(
        self, process: subprocess.Popen[bytes], seconds: float | None = None, until: Callable[[], bool] = never
    ) -> bool:
        """Let the agent work for `seconds`, or until `until()` is true. A silent sensor starts when the port is opened.

        Returns False where the agent ended before. Without `seconds`, `until()` must become true within GIVE_UP_S.
        """
        end_s = time.monotonic() + (GIVE_UP_S if seconds is None else seconds)
        while process.poll() is None and not until():
            if time.monotonic() >= end_s:
                assert seconds is not None, f"it does not get there: {self.output[-2000:]}"
                break
            if not self.sensor.speaks and self._opened():
                self.sensor.begin(self.speed * time.monotonic())
            polled_s = time.monotonic()
            time.sleep(POLL_S)  # the conditions decide, not the time
            self.late_s = max(self.late_s, time.monotonic() - polled_s - POLL_S)
        return process.poll() is None

    def run_to_a_moment(self, process: subprocess.Popen[bytes], random: Random) -> None:
        """Let the agent work up to a random moment: one of four within its start, the others while it works.

        The time counts from the opening of the port, since a start takes longer on a machine under load.
        """
        if random.random() < IN_START:
            self.run(process, random.uniform(0.0, START_S))
        else:
            self.run(process, until=lambda: self.sensor.speaks)
            self.run(process, random.uniform(0.0, WORK_S))


@contextmanager
def rig(
    directory: Path, seed: int, *, endpoint: str = "", speed: int = SPEED, data_dir: Path | None = None
) -> Iterator[Rig]:
    """Make a rig in `directory`; without `endpoint` its agents publish nothing."""
    directory.mkdir(parents=True, exist_ok=True)
    sensor = TurnedSensor(seed)
    device = PtyDevice(sensor, lambda: speed * time.monotonic(), directory / "port")
    config = directory / "config.toml"
    config.write_text(_config(device.path, endpoint, speed))
    device.start()
    try:
        yield Rig(directory, endpoint, speed, sensor, device, config, data_dir or directory / "data")
    finally:
        device.stop()


def _config(port: Path, endpoint: str, speed: int) -> str:
    poses = ", ".join(
        f"{{ start_s = {k * HOLD_S}, stop_s = {(k + 1) * HOLD_S}, gravity_mps2 = {(G_MPS2 * up).tolist()} }}"
        for k, up in enumerate(UP)
    )
    connect = f'connect = ["{endpoint}"]' if endpoint else "enabled = false"
    return f"""
[gateway]
site = "{SITE}"
name = "{GATEWAY}"
[[devices]]
name = "{SENSOR}"
driver = "serial-csv-fast"
[devices.options]
port = "{port}"
rate_hz = {RATE_HZ}
axes = 3
sequence = true
unit = "m/s2"
serial_number = "R1"
[[channels]]
sensor = "{SENSOR}"
prior = {{}}
guard_s = {GUARD_S}
silence_s = {5 * speed}
poses = [{poses}]
poses_repeat_s = {len(UP) * HOLD_S}
[recording]
rotate_s = 86400  # a file begins by the agent's clock and ages by the driver's, which is ahead of it
[zenoh]
{connect}
"""


@contextmanager
def local_router() -> Iterator[str]:
    """Run a router in this process; yields its endpoint."""
    session, endpoints = open_router("tcp/127.0.0.1:0")
    try:
        yield endpoints[0]
    finally:
        session.close()


@contextmanager
def witnessed(directory: Path, seed: int, *, data_dir: Path | None = None) -> Iterator[tuple[Rig, Witness]]:
    """Make a rig with a router and a consumer that keeps all results."""
    with ExitStack() as stack:
        endpoint = stack.enter_context(local_router())
        witness = Witness(endpoint)
        stack.callback(witness.close)
        yield stack.enter_context(rig(directory, seed, endpoint=endpoint, data_dir=data_dir)), witness


def stop(process: subprocess.Popen[bytes]) -> int:
    """End an agent as systemd does, also one that runs under strace; returns its exit status."""
    for pid in descendants(process.pid) or [process.pid]:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGTERM)
    return process.wait(STOP_S)


def strace(calls: str, how: str, path: Path | None = None) -> list[str]:
    """A command to put before the agent's. It injects faults (`how`) into the system calls `calls`, on `path` if given.

    Where strace can, it does not stop at other system calls, so that the agent is not slowed down. strace 6.1 cannot do
    this when it injects signals.
    """
    where = ["-P", str(path)] if path else []
    fast = [] if how.startswith("signal") else ["--seccomp-bpf"]
    return ["strace", "-f", *fast, "-qq", "-o", "/dev/null", *where, f"--trace={calls}", f"--inject={calls}:{how}"]


def descendants(pid: int) -> list[int]:
    """All processes that the process `pid` has started, directly or indirectly."""
    with suppress(OSError):
        children = [int(c) for c in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
        return [d for child in children for d in [*descendants(child), child]]
    return []


def free_port() -> int:
    """A port of 127.0.0.1 that is not in use."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])
