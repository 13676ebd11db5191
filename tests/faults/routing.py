"""The router is missing for thousands of results, freezes, is killed and comes back."""

from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from agent.delivery.history import FILE_NAME
from agent.delivery.router import router_running
from tests.faults.acquisition import LONGEST_S, acquisition
from tests.faults.invariants import Ledger, read_store
from tests.faults.outcome import Outcome
from tests.faults.rig import ROOT, SOURCE, Rig, Witness, free_port, rig, stop

SEED = 20261121
LEAST_A_SECOND = 5  # results per second that must come even on a machine under load
FROZEN_S = 15.0  # s; Zenoh closes a link after 10 s without an answer
DEAD_S = 5.0
ALIVE_S = 5.0
CAUGHT_UP_S = 60.0


def away(directory: Path, results: int, speed: int) -> Outcome:
    """Run without a router until the store holds `results` results; then with one that freezes, is killed, and returns.

    At a `speed` of 50 there are 40 results per second.
    """
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with rig(directory, SEED, endpoint=endpoint, speed=speed) as r, r.agent() as agent:
        lives = r.run(agent, results / LEAST_A_SECOND, until=lambda: _kept(r) >= results)
        waiting = _kept(r)
        assert waiting >= results, r.output[-500:]
        first = read_store(r.data_dir)[0].sequence
        witness = None
        try:
            with router(endpoint) as process:
                witness = Witness(endpoint, {SOURCE: first - 1})
                began_s = time.monotonic()
                lives &= r.run(agent, CAUGHT_UP_S, until=lambda: len(witness.received) >= waiting)
                caught_up_s = time.monotonic() - began_s
                lives &= r.run(agent, ALIVE_S)
                process.send_signal(signal.SIGSTOP)
                lives &= r.run(agent, FROZEN_S)
                process.send_signal(signal.SIGCONT)
                lives &= r.run(agent, ALIVE_S)
                process.kill()
                process.wait()
                lives &= r.run(agent, DEAD_S)
            with router(endpoint):
                lives &= r.run(agent, ALIVE_S)
                unread_s = r.unread_s
                r.device.unplug()
                kept = _settled(r, agent)
                r.run(agent, CAUGHT_UP_S, until=lambda: len(witness.received) >= kept)
                status = stop(agent)
        finally:
            if witness is not None:
                witness.close()
        ledger = Ledger(r.data_dir)
        received = witness.before(time.monotonic())
        ledger.inspect(received)
        read = acquisition(r.data_dir, r.speed)
        numbers = [result.sequence for result in received]
        missing = {record.sequence for record in ledger.records} - set(numbers)
        outcome = Outcome(
            "router down, frozen, killed, back",
            f"down for {waiting} results, frozen {FROZEN_S:g} s, killed for {DEAD_S:g} s",
            ledger.findings,
        )
        outcome.also = (
            f"{len(ledger.records)} results, {len(missing)} never came, {len(numbers) - len(set(numbers))} came twice,"
            f" {'in' if numbers == sorted(numbers) else 'OUT OF'} order; the {waiting} came within {caught_up_s:.1f} s;"
            f" {read}; {unread_s:.2f} s of the text unread at the port"
        )
        outcome.require(not missing, f"{len(missing)} results never came")
        outcome.require(numbers == sorted(set(numbers)), "out of order or twice")
        outcome.require(read.longest_pause_s < LONGEST_S + r.late_s, f"reading paused {read.longest_pause_s:.2f} s")
        outcome.require(unread_s < LONGEST_S + r.late_s, f"{unread_s:.2f} s of the text were not read")
        outcome.require(read.dropped == 0, f"{read.dropped} blocks dropped")
        outcome.require(lives and status == 0, f"the agent ended with {status}: {r.output[-300:]}")
        outcome.require("Traceback" not in r.output, "a traceback was shown")
    return outcome


@contextmanager
def router(endpoint: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a router as a process; it is killed at the end if it still runs."""
    command = [sys.executable, "-m", "agent", "router", "--listen", endpoint]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)
    try:
        while not router_running(endpoint):
            assert process.poll() is None, f"no router at {endpoint}"
        yield process
    finally:
        process.kill()
        process.wait()


def _kept(r: Rig) -> int:
    path = r.data_dir / FILE_NAME
    if not path.exists():
        return 0
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as connection, suppress(sqlite3.OperationalError):
        return int(connection.execute("SELECT count(*) FROM results").fetchone()[0])
    return 0  # the agent has not made its tables yet


def _settled(r: Rig, agent: subprocess.Popen[bytes]) -> int:
    """Wait until no more results come; returns their number."""
    before = -1
    while (now := _kept(r)) != before:
        before = now
        r.run(agent, 1.0)
    return now
