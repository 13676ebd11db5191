"""10^5 mutated and random command bodies and as many payloads: how many are accepted, errors, cost."""

from __future__ import annotations

import os
import random
import resource
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from agent.delivery.received import receive
from tests.unit.command_desk import DeskSite, sealed, signed
from tests.unit.test_commands import mutated
from tests.unit.zenoh_site import KEY, record

SEED = 6
RANDOM_SHARE = 0.2  # share of bodies that are random bytes instead of a mutation


def body(good: bytes, random_: random.Random) -> bytes:
    """A mutation of `good`, or random bytes."""
    if random_.random() < RANDOM_SHARE:
        return random_.randbytes(random_.randrange(5000))
    return mutated(good, random_)


def fuzz_commands(count: int, random_: random.Random) -> str:
    """Give all bodies to a desk, some signed with invalid content; then a good command must be accepted."""
    with tempfile.TemporaryDirectory() as directory:
        site = DeskSite(Path(directory))
        began_s = time.perf_counter()
        good = sealed({"theta_deg": 10, "alpha_deg": 20}, verb="pose")
        inside = good.split(b"\n", 1)[1]
        for i in range(count):
            # Half of the bodies are signed with a valid key, so that they reach the parsers.
            data = body(good, random_) if i % 2 else signed(body(inside, random_)[:3000])
            taken = site.send(data, verb="pose").taken
            assert i % 2 == 0 or not taken, data
        took_s = time.perf_counter() - began_s
        counts = site.desk.counts()
        assert sum(counts.values()) == count
        assert site.send(sealed(counter=site.desk.counters.last("anna") + 1)).taken
        recorded = sum(bool(event.refused) for event in site.events)
    said = f"{count} commands, half of them signed: {counts}, {recorded} refusals recorded"
    return f"{said}, {took_s / count * 1e6:.0f} us each"


def fuzz_payloads(count: int, random_: random.Random) -> str:
    """Give all payloads to a consumer; every accepted payload must be a complete result."""
    taken: Counter[str] = Counter()
    began_s = time.perf_counter()
    for i in range(count):
        what = ("window", "calibration", "status")[i % 3]
        data = body(record(7, what).payload, random_)
        received = receive(f"{KEY}/mems/{what}", data, b"6")
        taken[what if received else "refused"] += 1
    took_s = time.perf_counter() - began_s
    return f"{count} payloads: {dict(sorted(taken.items()))}, {took_s / count * 1e6:.0f} us each, making them included"


def main(count: int) -> None:
    """Print one line each for commands and payloads."""
    os.nice(10)
    random_ = random.Random(SEED)
    for fuzz in (fuzz_commands, fuzz_payloads):
        fuzz(count // 10, random_)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        line = fuzz(count, random_)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
        print(f"{line}; memory grew by {grown:.1f} MB", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)
