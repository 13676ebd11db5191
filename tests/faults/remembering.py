"""A remembering consumer, its gateway and their router are killed; stores are lost, and the clock is set back.

As a program (`python -m tests.faults.remembering ENDPOINT DIRECTORY`) it is the consumer: it appends what it is given
to a file.
"""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from random import Random

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from agent.config.known_keys import add_key
from agent.delivery.consumer import Consumer
from agent.delivery.history import FILE_NAME
from tests.faults.clock import clock_shim, step_clock
from tests.faults.invariants import Findings, read_store
from tests.faults.outcome import Outcome
from tests.faults.rig import ROOT, SENSOR, SOURCE, Rig, free_port, rig, stop
from tests.faults.routing import router

SEED = 20261123
BACK_S = -30 * 86400
AGAIN_S = 3.0  # s before a kill: results that came then may come again. It keeps its memory once a second
CAUGHT_UP_S = 60.0
ALIVE_S = (0.2, 2.0)  # s between two kills in a life of the agent
# What is done while the agent is dead, in turn.
LOSSES = ("store", "data directory and clock back", "", "store", "", "data directory", "clock back", "")


class Given(msgspec.Struct):
    """A result that the consumer gave. `t_s`: time.monotonic; `life`: of the consumer, counted from 0."""

    life: int
    t_s: float
    epoch: str
    sequence: int
    confirmed: bool
    new_epoch: bool
    signed: bool


def consume(endpoint: str, directory: Path) -> None:
    """Append all that a consumer gives to the file `given` in `directory`, until the process is killed."""
    memory, given = directory / "memory.json", directory / "given"
    life = given.read_bytes().count(b"#") if given.exists() else 0
    last = None if memory.exists() else {SOURCE: 0}
    with open(given, "ab", buffering=0) as file:
        file.write(b"#\n")
        keys = directory / "known.keys"
        for result in Consumer([endpoint], f"fieldcal/v1/{SOURCE}/{SENSOR}/**", last, memory=memory, keys=keys):
            flags = result.confirmed, result.new_epoch, bool(result.signed_by)
            one = Given(life, time.monotonic(), result.epoch, result.sequence, *flags)
            file.write(msgspec.json.encode(one) + b"\n")


class Consuming:
    """The consumer as a process. `killed_s`: when each of its lives ended."""

    def __init__(self, endpoint: str, directory: Path) -> None:
        self._endpoint, self._directory = endpoint, directory
        self.killed_s: list[float] = []
        self._process = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "tests.faults.remembering", self._endpoint, str(self._directory)]
        with open(self._directory / "consumer.log", "ab") as log:
            return subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)

    def kill(self) -> None:
        """Kill -9 it."""
        self._process.kill()
        self._process.wait()
        self.killed_s.append(time.monotonic())

    def replace(self) -> None:
        """Kill it and start it again."""
        self.kill()
        self._process = self._start()

    def given(self) -> list[Given]:
        """All that was given so far."""
        path = self._directory / "given"
        lines = path.read_bytes().splitlines() if path.exists() else []
        return [
            msgspec.json.decode(line, type=Given) for line in lines if line.startswith(b"{") and line.endswith(b"}")
        ]

    @property
    def log(self) -> str:
        """What it printed."""
        return (self._directory / "consumer.log").read_text(errors="replace")


def killed(directory: Path, kills: int) -> Outcome:
    """Kill the agent, the consumer and the router `kills` times in all, and lose stores in between; then judge."""
    moments, done = Random(SEED), dict.fromkeys(("agent", "consumer", "router"), 0)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    truth: dict[tuple[str, int], bool] = {}  # (epoch, number) of all results that were ever stored: signed or not
    directory.mkdir(exist_ok=True)
    with ExitStack() as stack, rig(directory / "rig", SEED, endpoint=endpoint) as r:
        keep_keys(r, directory)
        step = directory / "step"
        variables = clock_shim(directory, step)
        routed = stack.enter_context(ExitStack())
        routed.enter_context(router(endpoint))
        consuming = Consuming(endpoint, directory)
        stack.callback(consuming.kill)
        life = 0
        while sum(done.values()) < kills:
            with r.agent(variables=variables) as agent:
                r.run_to_a_moment(agent, moments)
                victim = ("consumer", "router", "")[life % 3]
                if victim == "consumer":
                    consuming.replace()
                elif victim == "router":
                    routed.close()
                    r.run(agent, moments.uniform(*ALIVE_S))
                    routed.enter_context(router(endpoint))
                if victim:
                    done[victim] += 1
                    r.run(agent, moments.uniform(*ALIVE_S))
                agent.kill()
                agent.wait()
            done["agent"] += 1
            truth |= stored(r)
            lose(r, LOSSES[life % len(LOSSES)], step)
            life += 1
        with r.agent(variables=variables) as agent:
            r.run(agent, until=lambda: len(stored(r).keys() - truth.keys()) > 5)
            r.device.unplug()
            caught_up = caught(r, agent, consuming)
            status = stop(agent)
        truth |= stored(r)
        given = consuming.given()
    told = ", ".join(f"{who} {count} times" for who, count in done.items())
    outcome = Outcome("killed beside a remembering consumer", f"{told}, seed {SEED}", Findings())
    judge(outcome, truth, given, consuming.killed_s)
    outcome.require(caught_up, "the consumer did not catch up")
    outcome.require(status == 0, f"the last run ended with {status}")
    outcome.require("Traceback" not in r.output + consuming.log, "a traceback was shown")
    return outcome


def keep_keys(r: Rig, directory: Path) -> None:
    """Give the gateway a key, and the consumer its list."""
    key, path = Ed25519PrivateKey.generate(), directory / "recording.key"
    path.touch(mode=0o600)
    path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    add_key(directory / "known.keys", SOURCE, key.public_key().public_bytes_raw())
    r.config.write_text(r.config.read_text().replace("[recording]\n", f'[recording]\nsigning_key = "{path}"\n'))


def stored(r: Rig) -> dict[tuple[str, int], bool]:
    """All results in the store: by epoch and number, whether they are signed."""
    if not (r.data_dir / FILE_NAME).exists():
        return {}
    records = [record for record in read_store(r.data_dir) if record.sensor == SENSOR]
    return {(record.fields["epoch"], record.sequence): bool(record.signed) for record in records}


def lose(r: Rig, what: str, step: Path) -> None:
    """Lose what `what` says; no agent may be running."""
    if what == "store":
        for path in r.data_dir.glob(f"{FILE_NAME}*"):
            path.unlink()
    if "data directory" in what and r.data_dir.exists():
        r.data_dir.rename(r.data_dir.with_name(f"lost-{time.monotonic_ns()}"))
    if "clock back" in what:
        step_clock(step, BACK_S)
    elif what == "store":
        step_clock(step, 0)  # the clock is right again


def caught(r: Rig, agent: subprocess.Popen[bytes], consuming: Consuming) -> bool:
    """Wait until the consumer has been given the newest result; no new ones come."""
    end_s, before = time.monotonic() + CAUGHT_UP_S, -1
    while time.monotonic() < end_s:
        r.run(agent, 1.0)
        there = stored(r)
        given = {(one.epoch, one.sequence) for one in consuming.given() if one.confirmed}
        if len(there) == before and list(there)[-1] in given:
            return True
        before = len(there)
    return False


def judge(outcome: Outcome, truth: dict[tuple[str, int], bool], given: list[Given], killed_s: list[float]) -> None:
    """Every signed result once and in order; else it came again as documented, or the gap was told."""
    first: dict[tuple[str, int], Given] = {}
    newest: dict[str, int] = {}
    again = 0
    for one in (one for one in given if one.confirmed):
        name = one.epoch, one.sequence
        if name in first:
            again += 1
            before = first[name]
            documented = before.life < one.life and before.t_s > killed_s[before.life] - AGAIN_S
            outcome.require(documented, f"result {name} came again")
            continue
        first[name] = one
        outcome.require(one.sequence > newest.get(one.epoch, -1), f"result {name} came after {newest.get(one.epoch)}")
        newest[one.epoch] = one.sequence
    doubted = {(one.epoch, one.sequence) for one in given if not one.confirmed} - first.keys()
    missing = {name for name, signed in truth.items() if signed} - first.keys() - doubted
    told_of = [one.epoch for one in given if one.new_epoch]
    order = list(dict.fromkeys(epoch for epoch, _ in first))
    for epoch, sequence in sorted(missing):
        at_the_end = sequence > newest.get(epoch, -1)
        told = any(epoch not in order or order.index(later) > order.index(epoch) for later in told_of)
        outcome.require(at_the_end and told, f"result {sequence} of {epoch} never came and nothing was told of it")
    outcome.require(all(one.signed for one in given), "a result without a signature was given")
    outcome.require(not first.keys() - truth.keys(), f"{len(first.keys() - truth.keys())} results were in no store")
    epochs = len({epoch for epoch, _ in truth})
    outcome.also = (
        f"{len(truth)} results of {epochs} stores, {len(first)} came, in order; {again} came again after a kill of the"
        f" consumer; {len(missing)} were lost with their stores, and {len(told_of)} times this was told;"
        f" {len(doubted)} came as not confirmed only"
    )


if __name__ == "__main__":
    consume(sys.argv[1], Path(sys.argv[2]))
