"""A fleet of simulated gateways through a router and a monitor that are killed: what is lost, and what it costs.

`python -m benchmarks.fleet_scale --gateways N --minutes M`. The router is killed after a fifth of the time (back after
5 s), the monitor after two fifths (back after 5 s); from half the time on the router is away for `--cut` seconds.
A second process asks the page for the whole fleet all the time. At the end the stores of the gateways are compared with
the database, result by result. Exit status 1 where results are missing there.
"""

from __future__ import annotations

import argparse
import http.client
import os
import resource
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from agent.config.known_keys import add_key
from agent.delivery.router import router_running
from agent.fleet.simulated import SITE, SimulatedFleet
from benchmarks.page import machine

ROOT = Path(__file__).resolve().parents[1]
AWAY_S = 5.0
CAUGHT_UP_S = 180.0
PROBE_S = 0.5  # s between two requests to the page; a page asks when something has changed, at most once a second
YEAR_MIN = 525_960
COMMAND = "import sys; from agent.cli.main import run_cli; sys.exit(run_cli(sys.argv[1:]))"


class Program:
    """`fieldcal` with these arguments, as a process that can be killed and started again."""

    def __init__(self, log: Path, *arguments: str) -> None:
        self._arguments, self._log = arguments, log
        self.cpu_s = 0.0  # of the lives that ended
        self.rss_mb = 0.0  # the largest of all lives
        self._process = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        with self._log.open("ab") as log:
            command = [sys.executable, "-c", COMMAND, *self._arguments]
            return subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)

    def measured(self) -> float:
        """CPU time in s of all lives so far."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        peak_kb = next((line.split()[1] for line in status.splitlines() if line.startswith("VmHWM")), "0")
        self.rss_mb = max(self.rss_mb, int(peak_kb) / 1000)
        return self.cpu_s + (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def away(self, for_s: float, stop: threading.Event) -> None:
        """Kill -9 it, and start it again after `for_s`."""
        self.cpu_s = self.measured()
        self._process.kill()
        self._process.wait()
        stop.wait(for_s)
        self._process = self._start()

    def end(self) -> None:
        """End it."""
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Probe(threading.Thread):
    """Asks the page, while it runs. `times`: (monotonic time, s until the whole answer was there)."""

    def __init__(self, port: int, stop: threading.Event) -> None:
        super().__init__(daemon=True)
        self.times: list[tuple[float, float]] = []
        self.bytes = 0
        self._port, self._stop_probing = port, stop

    def run(self) -> None:
        """Ask until it is to stop; while the monitor is away there are no times."""
        while not self._stop_probing.wait(PROBE_S):
            began_s = time.monotonic()
            try:
                connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=30)
                connection.request("GET", "/api/fleet")
                self.bytes = len(connection.getresponse().read())
                connection.close()
            except (OSError, http.client.HTTPException):
                continue
            self.times.append((began_s, time.monotonic() - began_s))


def missing(fleet: SimulatedFleet, database: Path, after: dict[str, int]) -> int:
    """The number of results in the stores after these numbers that the database does not have."""
    with sqlite3.connect(f"file:{database}?mode=ro", uri=True) as connection:
        rows = connection.execute("SELECT gateway, sequence FROM result WHERE site = ?", (SITE,)).fetchall()
    kept: dict[str, set[int]] = {}
    for gateway, sequence in rows:
        kept.setdefault(gateway, set()).add(sequence)
    return sum(
        len(set(range(after[g.name] + 1, g.last_sequence + 1)) - kept.get(g.name, set()))
        for g in fleet.gateways
        if g.behaviour != "silent"  # what it had not sent when it left the bus for ever cannot be had
    )


def wait(condition: Callable[[], bool], limit_s: float) -> float:
    """Seconds until the condition holds, at most `limit_s`."""
    began_s = time.monotonic()
    while not condition() and time.monotonic() - began_s < limit_s:
        time.sleep(0.5)
    return time.monotonic() - began_s


def at_times(minutes: float, cut_s: float) -> Iterator[tuple[float, str, float]]:
    """(s after the start, who is killed, for how many s)."""
    yield minutes * 12, "router", AWAY_S
    yield minutes * 24, "monitor", AWAY_S
    yield minutes * 30, "router", cut_s


def measure(
    fleet: SimulatedFleet, router: Program, monitor: Program, database: Path, port: int, args: argparse.Namespace
) -> int:
    """Run the fleet and print the figures; returns the number of lost results."""
    stop = threading.Event()
    first = fleet.step(time.time_ns())
    nothing = {gateway.name: gateway.last_sequence - 1 for gateway in fleet.gateways}
    wait(lambda: missing(fleet, database, nothing) == 0, CAUGHT_UP_S)
    after = {gateway.name: gateway.last_sequence for gateway in fleet.gateways}
    probe = Probe(port, stop)
    probe.start()
    programs = {"router": router, "monitor": monitor}
    before = {name: program.measured() for name, program in programs.items()}
    own = resource.getrusage(resource.RUSAGE_SELF)
    began_s = time.monotonic()

    def disturb() -> None:
        for at_s, name, for_s in at_times(args.minutes, args.cut):
            stop.wait(max(0.0, began_s + at_s - time.monotonic()))
            if not stop.is_set():
                programs[name].away(for_s, stop)

    disturbing = threading.Thread(target=disturb)
    disturbing.start()
    sent, rounds = 0, 0
    try:
        while time.monotonic() - began_s < args.minutes * 60:
            sent += fleet.step(time.time_ns())
            rounds += 1
            time.sleep(max(0.0, began_s + rounds * args.every - time.monotonic()))
    except BaseException:
        stop.set()
        raise
    finally:
        disturbing.join()
    caught_up_s = wait(lambda: missing(fleet, database, after) == 0, CAUGHT_UP_S)
    spent_s = time.monotonic() - began_s
    stop.set()
    probe.join()
    lost = missing(fleet, database, after)
    cpu = {name: 100 * (program.measured() - before[name]) / spent_s for name, program in programs.items()}
    now = resource.getrusage(resource.RUSAGE_SELF)
    own_cpu = 100 * (now.ru_utime + now.ru_stime - own.ru_utime - own.ru_stime) / spent_s
    times_ms = 1000 * np.array([s for _, s in probe.times])
    with sqlite3.connect(database) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        count = connection.execute("SELECT count(*) FROM result").fetchone()[0]
    a_result = database.stat().st_size / count
    a_round = first / (len(fleet.gateways) * args.sensors)
    a_minute = sent / rounds / (len(fleet.gateways) * args.sensors)
    p50, p95, p99 = np.percentile(times_ms, (50, 95, 99))
    print(
        f"{machine()}: {len(fleet.gateways)} gateways x {args.sensors} sensors, {spent_s:.0f} s, "
        f"a round each {args.every:g} s"
    )
    print(f"results sent {sent}, lost {lost}; the monitor had all {caught_up_s:.1f} s after the last round")
    print(
        f"page (/api/fleet, {probe.bytes / 1000:.0f} kB): p50 {p50:.0f} ms, p95 {p95:.0f} ms, p99 {p99:.0f} ms, "
        f"max {times_ms.max():.0f} ms of {len(times_ms)} requests, {100 * np.mean(times_ms <= 100):.1f} % within 100 ms"
    )
    for name, program in programs.items():
        print(f"{name}: CPU {cpu[name]:.1f} % of one core, memory at most {program.rss_mb:.0f} MB")
    print(f"fleet itself: CPU {own_cpu:.1f} %, memory {now.ru_maxrss / 1000:.0f} MB")
    print(
        f"database: {a_result:.0f} B a result, {a_minute:.2f} results a sensor and round ({a_round:.2f} in the first): "
        f"{a_result * a_minute * YEAR_MIN / 1e9:.2f} GB a sensor and year at one round a minute"
    )
    return lost


def main() -> int:
    """Exit status: 1 results were lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gateways", type=int, default=1000)
    parser.add_argument("--sensors", type=int, default=4)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--every", type=float, default=60.0, help="s between two rounds of results")
    parser.add_argument("--cut", type=float, default=300.0, help="s for which the router is away")
    parser.add_argument("--port", type=int, default=7471, help="of the router; the page has the next one")
    args = parser.parse_args()
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the programs and the directory do not stay
    endpoint = f"tcp/127.0.0.1:{args.port}"
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fieldcal-scale-")))
        router = Program(place / "log", "router", "--listen", endpoint)
        stack.callback(router.end)
        wait(lambda: router_running(endpoint), 20.0)
        fleet = stack.enter_context(SimulatedFleet(args.gateways, args.sensors, 7, [endpoint], place / "gateways"))
        print(
            f"{fleet.unconnected} of {args.gateways} gateways found no router at first; "
            f"{len(os.listdir('/proc/self/fd')) / args.gateways:.1f} open files each",
            flush=True,
        )
        for gateway in fleet.gateways:
            add_key(place / "known.keys", gateway.source, gateway.public_key)
        monitor = Program(
            place / "log", "monitor", "--connect", endpoint, "--listen", f"127.0.0.1:{args.port + 1}",
            "--data-dir", str(place / "monitor"), "--keys", str(place / "known.keys"),
        )  # fmt: skip
        stack.callback(monitor.end)
        database = place / "monitor" / "monitor.sqlite"
        wait(database.exists, 20.0)
        wait(lambda: "result" in _tables(database), 20.0)
        lost = measure(fleet, router, monitor, database, args.port + 1, args)
        print((place / "log").read_text()[-2000:], file=sys.stderr)
    return 1 if lost else 0


def _tables(database: Path) -> set[str]:
    with sqlite3.connect(f"file:{database}?mode=ro", uri=True) as connection:
        return {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}


if __name__ == "__main__":
    sys.exit(main())
