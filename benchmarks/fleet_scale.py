"""A fleet of simulated gateways through a router and a monitor that are killed: what is lost, and what it costs.

`python -m benchmarks.fleet_scale [--postgres]`. Simulated gateways make a round of results every `--every` seconds,
each gateway at its own moment (`--together`: all at the same one). The router is killed after a fifth of `--minutes`
(back after 5 s), the monitor after two fifths (back after 5 s); from half the time on the router is away for `--cut`
seconds. Another process asks the page all the time. At the end the numbers of the results in the stores of the
gateways are compared with the database, one by one. Exit status 1 where one is missing or is there twice.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import NamedTuple
from urllib.parse import parse_qs, urlsplit

import numpy as np

from agent.config.known_keys import add_key
from agent.delivery.router import router_running
from agent.fleet.simulated import SITE, FleetPlan
from agent.fleet.simulated_processes import FleetProcesses
from agent.monitor.engines import DatabaseEngine, open_engine
from benchmarks.fleet_programs import Asked, Probe, Program, Usage, tree
from benchmarks.monitor_growth import used_bytes
from benchmarks.page import machine
from tests.unit.postgres import postgres

AWAY_S = 5.0
CAUGHT_UP_S = 300.0
FIRST_WITHIN_S = 20.0  # s over which the first round is spread, in which all publishers and sensors are new
BEHIND_S = 2.0  # s of results that may be on their way when the monitor counts as having caught up


class Counted(NamedTuple):
    """At `at_s` (monotonic time) so many results of the fleet were in the database."""

    at_s: float
    results: int


class Arrivals(threading.Thread):
    """Counts the results in the database each second, from `nothing` (last number of each gateway) on."""

    def __init__(self, engine: DatabaseEngine, nothing: dict[str, int], stop: threading.Event) -> None:
        super().__init__(daemon=True)
        self.counts: list[Counted] = []
        self._engine, self._nothing, self._stop_counting = engine, nothing, stop

    def run(self) -> None:
        """Count until it is to stop, and then once more."""
        stopped = False
        while not stopped:
            stopped = self._stop_counting.wait(1.0)
            reached = followed(self._engine)
            self.counts.append(
                Counted(time.monotonic(), sum(reached.get(name, n) - n for name, n in self._nothing.items()))
            )


def followed(engine: DatabaseEngine) -> dict[str, int]:
    """The last result of each gateway in the database."""
    with engine.transaction() as run:
        return dict(run("SELECT gateway, sequence FROM followed WHERE site = :site", site=SITE))


def has(engine: DatabaseEngine, numbers: dict[str, int]) -> bool:
    """Whether the database has reached these numbers."""
    return followed(engine).items() >= numbers.items()


def compared(engine: DatabaseEngine, after: dict[str, int], last: dict[str, int]) -> tuple[int, int]:
    """(results of the stores after these numbers that the database does not have, results that it has twice)."""
    with engine.transaction() as run:
        rows = run(
            "SELECT s.gateway, r.sequence FROM result r JOIN sensor s ON s.id = r.sensor WHERE s.site = :site",
            site=SITE,
        )
    kept = Counter(rows)
    lost = sum((name, number) not in kept for name in last for number in range(after[name] + 1, last[name] + 1))
    return lost, sum(count - 1 for count in kept.values())


def wait(condition: Callable[[], bool], limit_s: float) -> float:
    """Seconds until the condition holds, at most `limit_s`."""
    began_s = time.monotonic()
    while not condition() and time.monotonic() - began_s < limit_s:
        time.sleep(0.5)
    return time.monotonic() - began_s


class Scene:
    """Router, database, fleet and monitor, all running."""

    def __init__(self, args: argparse.Namespace, opened: ExitStack) -> None:
        self.args = args
        place = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="fieldcal-scale-")))
        self.log, endpoint = place / "log", f"tcp/127.0.0.1:{args.port}"
        self.url = opened.enter_context(postgres(fsync=True)) if args.postgres else None
        self.router = Program(self.log, "router", "--listen", endpoint)
        opened.callback(self.router.end)
        wait(lambda: router_running(endpoint), 20.0)
        began_s = time.monotonic()
        self.fleet = opened.enter_context(
            FleetProcesses(FleetPlan(args.gateways, args.sensors, 7, [endpoint], place / "gateways"))
        )
        self.opened_s = time.monotonic() - began_s
        for gateway in self.fleet.gateways:
            add_key(place / "known.keys", gateway.source, gateway.public_key)
        settings = place / "monitor.toml"
        settings.write_text(f'[database]\nurl = "{self.url}"\n' if self.url else "")
        self.monitor = Program(
            self.log, "monitor", "--connect", endpoint, "--listen", f"127.0.0.1:{args.port + 1}",
            "--data-dir", str(place / "monitor"), "--keys", str(place / "known.keys"), "--config", str(settings),
        )  # fmt: skip
        opened.callback(self.monitor.end)
        wait(lambda: _answers(args.port + 1), 30.0)
        self.engine = opened.enter_context(closing(open_engine(place / "monitor", self.url)))

    def usage(self, stop: threading.Event) -> Usage:
        """Of each part, from now until `stop`."""
        fleet = self.fleet.pids()
        groups: dict[str, Callable[[], Sequence[int]]] = {"router": self.router.pids, "monitor": self.monitor.pids}
        if self.url is not None:
            (place,) = parse_qs(urlsplit(self.url).query)["host"]
            server = int((Path(place) / "data" / "postmaster.pid").read_text().split("\n")[0])
            groups["PostgreSQL"] = lambda: tree(server)
        return Usage(groups | {"simulated gateways": lambda: fleet}, stop)

    def disturb(self, began_s: float, stop: threading.Event) -> None:
        """Kill router and monitor at their times, and start them again."""
        programs = {"router": self.router, "monitor": self.monitor}
        for at_s, name, for_s in self.kills():
            stop.wait(max(0.0, began_s + at_s - time.monotonic()))
            if not stop.is_set():
                programs[name].away(for_s, stop)

    def kills(self) -> list[tuple[float, str, float]]:
        """(s after the beginning, who is killed, for how many s)."""
        minutes = self.args.minutes
        return [(minutes * 12, "router", AWAY_S), (minutes * 24, "monitor", AWAY_S),
                (minutes * 30, "router", self.args.cut)]  # fmt: skip


def _answers(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), 1.0).close()
    except OSError:
        return False
    return True


class Run:
    """What happened in one run. Times are monotonic, in s."""

    def __init__(self, scene: Scene) -> None:
        args, fleet, engine = scene.args, scene.fleet, scene.engine
        stop = threading.Event()
        began_s = time.monotonic()
        self.first = fleet.step(time.time_ns(), FIRST_WITHIN_S)
        self.after = fleet.last_sequence()
        wait(lambda: has(engine, self.after), CAUGHT_UP_S)
        self.first_s = time.monotonic() - began_s
        usage, arrivals = scene.usage(stop), Arrivals(engine, self.after, stop)
        place = f"site={SITE}&gateway=gw0000&sensor=s1"
        probe = Probe(args.port + 1, ["/api/fleet", f"/api/spread?{place}", f"/api/history?{place}&what=window"])
        self.began_s = time.monotonic()
        disturbing = threading.Thread(target=scene.disturb, args=(self.began_s, stop))
        for thread in (usage, arrivals, disturbing):
            thread.start()
        self.made = [Counted(self.began_s, 0)]
        try:
            while (begin_s := time.monotonic()) - self.began_s < args.minutes * 60:
                sent = fleet.step(time.time_ns(), 0.0 if args.together else args.every)
                made = self.made[-1].results
                self.made += [Counted(begin_s, made), Counted(time.monotonic(), made + sent)]
                time.sleep(max(0.0, begin_s + args.every - time.monotonic()))
        except BaseException:
            stop.set()
            raise
        finally:
            disturbing.join()
        self.last = fleet.last_sequence()
        self.caught_up_s = wait(lambda: has(engine, self.last), CAUGHT_UP_S)
        self.spent_s = time.monotonic() - self.began_s
        stop.set()
        usage.join()
        arrivals.join()
        self.asked, self.used, self.counts = probe.end(), usage.used, arrivals.counts
        self.lost, self.twice = compared(engine, self.after, self.last)

    def caught_up(self, back_s: float) -> float:
        """Seconds from `back_s` until the database had all results but those of the last BEHIND_S."""
        times, made = zip(*self.made, strict=True)
        for at_s, results in self.counts:
            if at_s > back_s and results >= np.interp(at_s - BEHIND_S, times, made):
                return at_s - back_s
        return float("inf")

    def most(self, over_s: int = 5) -> float:
        """The largest number of results a second that came into the database, over so many seconds."""
        pairs = zip(self.counts, self.counts[over_s:], strict=False)
        return max((b.results - a.results) / (b.at_s - a.at_s) for a, b in pairs)


def told(scene: Scene, run: Run) -> Iterator[str]:
    """The figures, one a line."""
    args, sent = scene.args, run.made[-1].results
    rounds = len(run.made) // 2
    yield (
        f"{machine()}: {args.gateways} gateways x {args.sensors} sensors, {run.spent_s:.0f} s, a round each "
        f"{args.every:g} s, {'all gateways at once' if args.together else 'each gateway at its own moment'}, "
        f"{'PostgreSQL' if args.postgres else 'SQLite'}; load average at the end {os.getloadavg()[1]:.1f}"
    )
    yield (
        f"opened in {scene.opened_s:.0f} s, {scene.fleet.unconnected} without router at first; the monitor had the "
        f"first {run.first} results after {run.first_s:.0f} s"
    )
    yield (
        f"results sent {sent}, lost {run.lost}, twice {run.twice}; the monitor had all {run.caught_up_s:.1f} s after "
        "the last round and the last cut"
    )
    for at_s, name, away_s in scene.kills():
        back_s = run.began_s + at_s + away_s
        yield f"{name} away for {away_s:g} s: nothing missing {run.caught_up(back_s):.0f} s after its start"
    yield f"at most {run.most():.0f} results a second into the database"
    for path in dict.fromkeys(asked.path for asked in run.asked):
        yield _page(path, [asked for asked in run.asked if asked.path == path])
    names = ["router", "monitor", *(["PostgreSQL"] if args.postgres else []), "simulated gateways"]
    for name in names:
        used = run.used(name)
        yield (
            f"{name}: CPU {used.mean_pct:.0f} % of one core, {used.peak_pct:.0f} % in the busiest 10 s; "
            f"memory at most {used.memory_mb:.0f} MB"
        )
    with scene.engine.transaction() as query:
        ((count,),) = query("SELECT count(*) FROM result")
    a_round = sent / rounds / (args.gateways * args.sensors)
    size = used_bytes(scene.engine, scene.url) / count
    yield f"database: {size:.0f} B a result, {a_round:.2f} results a sensor and round"


def _page(path: str, asked: Sequence[Asked]) -> str:
    times_ms = 1000 * np.array([each.took_s for each in asked])
    p50, p95, p99 = np.percentile(times_ms, (50, 95, 99))
    return (
        f"{path.split('?')[0]} ({max(each.size for each in asked) / 1000:.0f} kB): p50 {p50:.0f} ms, p95 {p95:.0f} ms, "
        f"p99 {p99:.0f} ms, max {times_ms.max():.0f} ms of {len(times_ms)} requests, "
        f"{100 * np.mean(times_ms <= 100):.1f} % within 100 ms"
    )


def main() -> int:
    """Exit status: 1 results were lost or are there twice."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gateways", type=int, default=1000)
    parser.add_argument("--sensors", type=int, default=4)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--every", type=float, default=60.0, help="s between two rounds of results")
    parser.add_argument("--together", action="store_true", help="all gateways make their results at the same moment")
    parser.add_argument("--cut", type=float, default=300.0, help="s for which the router is away")
    parser.add_argument("--postgres", action="store_true", help="on a PostgreSQL 15 that is started for it")
    parser.add_argument("--port", type=int, default=7471, help="of the router; the page has the next one")
    args = parser.parse_args()
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the programs and the directory do not stay
    with ExitStack() as opened:
        scene = Scene(args, opened)
        run = Run(scene)
        for line in told(scene, run):
            print(line, flush=True)
        print(scene.log.read_text()[-2000:], file=sys.stderr)
    return 1 if run.lost or run.twice else 0


if __name__ == "__main__":
    sys.exit(main())
