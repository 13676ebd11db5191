"""`python -m tests.faults.ends`: ends real programs by SIGTERM and SIGINT at many moments, and says how each ended.

The agent is ended at a random time from 0 to START_S after its start, and after its first VALID; without a router, and
with one that comes and goes. Without one, the start is that of the console script on the virtual bench. Routers, and
the witness and the monitor beside them, are ended too.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random

from tests.faults.rig import ROOT, free_port, rig

SEED = 32
START_S = 2.5
VALID_S, ATTEMPTS = 30.0, 5  # a machine under load loses samples of the rig, and S may then be wrong until it ends
ROUTER_LIVES_S, ROUTER_AWAY_S, OTHER_LIVES_S = (0.2, 3.0), (0.0, 1.0), (0.0, 1.0)
OTHERS_EVERY = 10  # ends of the agent beside a router for one of the witness and of the monitor
GIVE_UP_S = 60.0  # what has not ended so long after the signal is killed, and counted
QUIET_S, LOADED_S = 2.0, 10.0  # what an end may take while no process waits for a processor, and at LOADED
LOADED = 6.0  # load of the machine above which times are not judged
NONE, SOME = "none", "comes and goes"
COLUMNS = ("moment", "router", "signal", "ends", "statuses", "before the first line", "load", "longest", "faults")
HEAD = f"| {' | '.join(COLUMNS)} |\n|{' --- |' * len(COLUMNS)}"


@dataclass(frozen=True)
class End:
    """How a process ended. `early`: its first line had not run yet when the signal was sent."""

    number: signal.Signals
    status: int | None  # None: it had not ended after GIVE_UP_S
    early: bool
    took_s: float
    load: float
    said: str
    unfinished: int = 0  # recordings that were not closed, though it had begun
    moment: str = ""
    router: str = NONE

    @property
    def faults(self) -> list[str]:
        """What is not as docs/limits.md says."""
        # Before the first line Python itself ends: by the signal, or by a KeyboardInterrupt that it shows.
        allowed = {0, -self.number} | ({1} if self.number == signal.SIGINT else set()) if self.early else {0}
        found = [] if self.status in allowed else [f"status {self.status}"]
        if not self.early:
            found += [word for word in ("FATAL", "Traceback", "Exception ignored") if word in self.said]
        if self.unfinished:
            found.append(f"{self.unfinished} recordings not closed")
        most_s = QUIET_S if self.load <= (os.cpu_count() or 1) else LOADED_S if self.load <= LOADED else GIVE_UP_S
        if self.took_s > most_s:
            found.append(f"{self.took_s:.1f} s")
        return found


def end(process: subprocess.Popen[bytes], number: signal.Signals, output: Path, already: int = 0) -> End:
    """Send a signal to a process and wait until it has ended. `already`: characters of `output` before its own."""
    early = not _caught(process.pid, signal.SIGTERM)
    load, began_s = os.getloadavg()[0], time.monotonic()
    process.send_signal(number)
    try:
        status: int | None = process.wait(GIVE_UP_S)
    except subprocess.TimeoutExpired:
        status = None
    return End(number, status, early, time.monotonic() - began_s, load, output.read_text(errors="replace")[already:])


def _caught(pid: int, number: signal.Signals) -> bool:
    """Whether a process has a handler for a signal; Python has none for SIGTERM until the program sets one."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    caught = next((int(line.split()[1], 16) for line in lines if line.startswith("SigCgt:")), 0)
    return bool(caught >> (number - 1) & 1)


@contextmanager
def program(command: Sequence[str | Path], output: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process of its own; it is killed at the end if it runs."""
    with open(output, "wb") as file:
        process = subprocess.Popen([*map(str, command)], cwd=ROOT, stdout=file, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def bench_at_start(directory: Path, number: signal.Signals, after_s: float) -> End:
    """End the virtual bench while it starts."""
    script, output = Path(sys.executable).with_name("fieldcal"), directory / "output"
    with program([script, "run", "--data-dir", directory / "data"], output) as process:
        time.sleep(after_s)  # the random moment
        return replace(end(process, number, output), moment="start")


def agent_at_start(directory: Path, number: signal.Signals, endpoint: str, seed: int, after_s: float) -> End:
    """End the agent on a rig while it starts."""
    with rig(directory, seed, endpoint=endpoint) as r, r.agent() as agent:
        r.run(agent, after_s)
        return replace(end(agent, number, directory / "output"), moment="start")


def agent_after_valid(directory: Path, number: signal.Signals, endpoint: str, seed: int) -> End:
    """End the agent on a rig after its first VALID."""
    for attempt in range(ATTEMPTS):
        place = directory / str(attempt)
        with rig(place, seed, endpoint=endpoint) as r, r.agent() as agent:
            assert r.run(agent, VALID_S, until=lambda r=r: ": VALID" in r.output), r.output  # type: ignore[misc]
            if ": VALID" in r.output:
                ended = end(agent, number, place / "output")
                return replace(ended, moment="after VALID", unfinished=len([*r.data_dir.glob("*.active")]))
    raise AssertionError(f"{directory}: {ATTEMPTS} runs did not become VALID")


def other(directory: Path, number: signal.Signals, name: str, options: Sequence[str | Path], random: Random) -> End:
    """End another command that uses Zenoh a random time after it has printed its first line."""
    output = directory / "output"
    with program([sys.executable, "-u", "-m", "agent", name, *options], output) as process:
        while not output.read_text() and process.poll() is None:
            time.sleep(0.02)  # polls; the first line decides
        time.sleep(random.uniform(*OTHER_LIVES_S))  # the random moment
        return replace(end(process, number, output), moment=name)


class Routers(threading.Thread):
    """Routers at an endpoint that come, and go by a kill or by SIGTERM, until `stop`. `ends`: those by SIGTERM."""

    def __init__(self, endpoint: str, directory: Path, seed: int) -> None:
        super().__init__(name="routers", daemon=True)
        self.ends: list[End] = []
        self._endpoint, self._output, self._random = endpoint, directory / "router", Random(seed)
        self._stop_request = threading.Event()

    def run(self) -> None:
        """Start and end routers."""
        command = [sys.executable, "-u", "-m", "agent", "router", "--listen", self._endpoint]
        while not self._stop_request.is_set():
            with program(command, self._output) as process:
                while "router at" not in self._output.read_text() and process.poll() is None:
                    time.sleep(0.02)  # polls; what the router says decides
                self._stop_request.wait(self._random.uniform(*ROUTER_LIVES_S))
                if self._random.random() < 0.5:
                    self.ends.append(replace(end(process, signal.SIGTERM, self._output), moment="router"))
            self._stop_request.wait(self._random.uniform(*ROUTER_AWAY_S))

    def __enter__(self) -> Routers:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop_request.set()
        self.join()


def ends(directory: Path, count: int, seed: int) -> Iterator[End]:
    """End the agent `count` times, a quarter in each of the four conditions, and others beside the routers."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it, and so its children
    random = Random(seed)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    for router in (NONE, SOME):
        routers = Routers(endpoint, directory, seed) if router == SOME else None
        with routers or nullcontext():
            for k in range(count // 2):
                place = directory / f"{router} {k}"
                place.mkdir()
                number = random.choice((signal.SIGTERM, signal.SIGINT))
                after_s = random.uniform(0, START_S) if k % 2 else None
                if after_s is None:
                    ended = agent_after_valid(place, number, endpoint, seed + k)
                elif routers is None:
                    ended = bench_at_start(place, number, after_s)
                else:
                    ended = agent_at_start(place, number, endpoint, seed + k, after_s)
                yield replace(ended, router=router)
                if routers is not None and k % OTHERS_EVERY == 0:
                    for name, options in _others(place, endpoint).items():
                        yield replace(other(place, number, name, options, random), router=router)
        if routers is not None:
            yield from (replace(ended, router="itself") for ended in routers.ends)


def _others(place: Path, endpoint: str) -> dict[str, list[str | Path]]:
    page = f"127.0.0.1:{free_port()}"
    return {
        "witness": ["--connect", endpoint, "--dir", place / "witness"],
        "monitor": ["--connect", endpoint, "--data-dir", place / "monitor", "--listen", page],
    }


def counts(values: Iterable[object]) -> str:
    """How often each value occurs."""
    return ", ".join(f"{n} x {value}" for value, n in Counter(values).most_common())


def table(found: Sequence[End]) -> str:
    """One row for each moment, router and signal."""
    rows = []
    for key in sorted({(one.moment, one.router, one.number) for one in found}):
        some = [one for one in found if (one.moment, one.router, one.number) == key]
        loads = [one.load for one in some]
        cells = (
            *key[:2], key[2].name, len(some), counts(one.status for one in some), sum(one.early for one in some),
            f"{min(loads):.1f} to {max(loads):.1f}", f"{max(one.took_s for one in some):.2f} s",
            counts(fault for one in some for fault in one.faults) or "none",
        )  # fmt: skip
        rows.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join([HEAD, *rows])


def main() -> int:
    """Print a line for each end that is not as documented, and the table; exit status 3 where there is one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ends", type=int, default=500)
    parser.add_argument("--seed", type=int, default=SEED)
    given = parser.parse_args()

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # no process is left behind where this is ended
    found: list[End] = []
    try:
        with tempfile.TemporaryDirectory(prefix="fieldcal-ends-") as directory:
            for one in ends(Path(directory), given.ends, given.seed):
                found.append(one)
                if one.faults:
                    print(f"{one.moment}, router {one.router}, {one.number.name}: {one.faults}\n{one.said}", flush=True)
    finally:
        print(table(found))
    return 3 if any(one.faults for one in found) else 0


if __name__ == "__main__":
    sys.exit(main())
