"""What signed results cost: for each result, for a live agent, and for a replay of its recording.

    python -m benchmarks.signing [--seconds 120]

Two agents run at the same time on ports that send the same 20 times as fast as in real time, one with a key and one
without, so that other work on the machine slows both down alike; then again, begun in the other order.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from agent.config.known_keys import WatchedKeys
from agent.delivery.received import receive
from agent.delivery.verifying import Verifier
from agent.recording.messages import is_result_topic
from benchmarks.soak import ENDPOINT, ROLES, ROOT, SETTLE_S, configuration, process, slow_bench
from hw.virtual.serial_bench import serial_lines
from hw.virtual.serial_port import PtyDevice
from hw.virtual.timebase import BenchTime
from tests.attacks.chain_site import KEY
from tests.attacks.signed_site import PLACE, listed, signed_record, signer_of
from tests.replay.forgery import Unpacked
from tests.unit.results import calibration

COUNT = 2000
SPEED, RATE_HZ = 20, 100
WARM_UP_S = 10.0  # imports and the first fits are not part of the running cost
PORT = 7460
SIGNATURE = 67  # bytes of a signature at the end of a message
REPLAYS = 3  # in turn with and without; the shortest counts
EPOCH = "00c0ffee00c0ffee"


def each_us(what: Callable[[int], object]) -> float:
    """CPU time of one call, in microseconds."""
    began_s = time.process_time()
    for number in range(1, COUNT + 1):
        what(number)
    return (time.process_time() - began_s) / COUNT * 1e6


def cpu_s(pid: int) -> float:
    """CPU time of all threads of a process until now, s."""
    parts = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(part.read_text().split()[0]) for part in parts) * 1e-9


class Agent:
    """An agent with its own ports in a directory of its own; with `key` it signs."""

    def __init__(self, stack: ExitStack, directory: Path, key: Path | None) -> None:
        directory.mkdir()
        bench, self._time = slow_bench(RATE_HZ), BenchTime()
        self._ports = [
            PtyDevice(serial_lines(bench, role, self._time), lambda: SPEED * time.monotonic(), directory / role)
            for role in ROLES
        ]
        for port in self._ports:
            stack.callback(port.stop)
            port.start()
        text = configuration(bench, directory, SPEED, PORT)
        signing = f'[recording]\nsigning_key = "{key}"\n' if key else "[recording]\n"
        (directory / "config.toml").write_text(text.replace("[recording]\n", signing))
        self.data = directory / "data"
        command = ["run", str(directory / "config.toml"), "--data-dir", str(self.data)]
        self.process = stack.enter_context(process(command, directory, SPEED))

    def begin(self) -> None:
        """Wait until it reads its ports, then let them send."""
        while not all(port.has_reader() for port in self._ports):
            time.sleep(0.05)
        time.sleep(SETTLE_S)
        self._time.begin(SPEED * time.monotonic())


def live(directory: Path, seconds: float, order: Sequence[bool]) -> tuple[dict[bool, float], dict[bool, Path]]:
    """(CPU time for a second, data directory) of two agents that run together, by whether they sign."""
    key = directory / "recording.key"
    key.touch(mode=0o600)
    key.write_bytes(KEY.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    with ExitStack() as stack:
        router = ["router", "--listen", ENDPOINT.format(port=PORT)]
        stack.enter_context(process(router, directory, SPEED))
        agents = {signs: Agent(stack, directory / f"signs-{signs}", key if signs else None) for signs in order}
        for agent in agents.values():
            agent.begin()
        time.sleep(WARM_UP_S)
        before, began_s = {signs: cpu_s(a.process.pid) for signs, a in agents.items()}, time.monotonic()
        time.sleep(seconds)
        lasted_s = time.monotonic() - began_s
        spent = {signs: (cpu_s(a.process.pid) - before[signs]) / lasted_s for signs, a in agents.items()}
    return spent, {signs: agent.data for signs, agent in agents.items()}


def stripped(data: Path, to: Path) -> Path:
    """Copies of the recordings of a directory, without the signatures of results."""
    to.mkdir()
    for path in sorted(data.glob("*.mcap")):
        found = Unpacked.of(path)
        for at, (*place, message) in enumerate(found.messages):
            if is_result_topic(found.messages[at][0]) and message[-SIGNATURE:].startswith(b"\xc2\x3e\x40"):
                found.messages[at] = (*place, message[:-SIGNATURE])  # type: ignore[assignment]
        found.write(to / path.name)
    return to


def replay_s(data: Path) -> float:
    """CPU time in s of a replay of all recordings of a directory."""
    files = sorted(map(str, data.glob("*.mcap")))
    before = os.times()
    run = [sys.executable, "-m", "agent", "replay", *files, "--json", "-"]
    subprocess.run(run, capture_output=True, check=True, cwd=ROOT)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def main(arguments: Sequence[str]) -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=120.0, help="that the agents run, twice")
    given = parser.parse_args(arguments)
    each_result()
    print(f"\n| two agents together, {given.seconds:g} s, {SPEED} times real time | without a key | signed | more |")
    print("| --- | --- | --- | --- |")
    for number, order in enumerate(((False, True), (True, False)), start=1):
        with tempfile.TemporaryDirectory() as directory:
            spent, data = live(Path(directory), given.seconds, order)
            bare = stripped(data[True], Path(directory) / "stripped")
            pairs = [(replay_s(bare), replay_s(data[True])) for _ in range(REPLAYS)]
        print(_row(f"run {number}: CPU of the live agent, of a core", spent[False], spent[True]))
        without, signed = map(min, zip(*pairs, strict=True))
        print(_row(f"run {number}: CPU of a replay of what was signed, s", without, signed), flush=True)


def _row(name: str, without: float, signed: float) -> str:
    return f"| {name} | {without:.3f} | {signed:.3f} | {100 * (signed / without - 1):+.1f} % |"


def each_result() -> None:
    """Measure encoding, signing and verifying a result, and print the table."""
    results = [calibration(number) for number in range(COUNT + 1)]
    plain, signer = signer_of("site/gw", EPOCH, None), signer_of("site/gw", EPOCH, KEY)
    encoded_us = each_us(lambda n: plain.encode(n, results[n]))
    signed_us = each_us(lambda n: signer.encode(n, results[n]))
    record = signed_record(results[7], signer, EPOCH)
    with tempfile.TemporaryDirectory() as directory:
        verifier = Verifier(WatchedKeys(listed(Path(directory) / "known.keys", KEY)))
        plain_us = each_us(lambda _: receive(PLACE, record.payload, b"6"))
        verified_us = each_us(lambda _: receive(PLACE, record.payload, b"6\n" + record.signed, verifier))
    print("| of a calibration, the largest result | without a key | signed | more |\n| --- | --- | --- | --- |")
    for name, without, with_key in (
        ("gateway: encoded for the recording", encoded_us, signed_us),
        ("consumer: received", plain_us, verified_us),
    ):
        print(f"| {name} | {without:.0f} us | {with_key:.0f} us | {with_key - without:.0f} us |")
    print(f"\nThe signed bytes have {len(record.signed)} bytes, the JSON has {len(record.payload)}.")


if __name__ == "__main__":
    main(sys.argv[1:])
