"""Sends hostile results, names and payloads to the fleet page over a bus, and looks whether page and threads go on.

    .venv/bin/python -m benchmarks.hostile_bus [--count 10000] [--seed 1]

Exit status 1 where a message was not taken singly: the program had a fault, a page did not answer, or a good result
that came later is not shown.
"""

from __future__ import annotations

import argparse
import json
import logging
import tempfile
import time
from contextlib import closing
from itertools import islice
from pathlib import Path

from tests.attacks.hostile_bus import HostileGateway, messages, payloads, put_all
from tests.attacks.monitor_pages import bus, pages, shown
from tests.unit.monitor_site import Served
from tests.unit.zenoh_site import Site, record, wait_for

AT_ONCE = 200  # results between two looks at the page
LONGEST_S = 60.0


class _Counted(logging.Handler):
    """Counts the lines of the log."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.lines += 1
        if self.lines <= 20:
            print(f"log: {record.getMessage()[:300]}")


def attack(seed: int, count: int) -> bool:
    """Send half of `count` as results that a store confirms, half as messages of a stranger; True where all go on."""
    log = _Counted()
    logging.getLogger().addHandler(log)
    site, begun_s, slowest_s, bad = Site(), time.monotonic(), 0.0, 0
    with tempfile.TemporaryDirectory() as directory, Served(site, Path(directory) / "monitor") as served:
        made, sent = payloads(seed, count // 2, 1), messages(seed + 1, count - count // 2)
        with closing(HostileGateway(site, "gw")) as hostile, site.client() as stranger:
            for number, (what, payload) in enumerate(made, start=1):
                hostile.publish("mems", what, payload)
                put_all(stranger, islice(sent, 1))
                if number % AT_ONCE == 0 or number == count // 2:
                    for path in pages("mems"):
                        asked_s = time.monotonic()
                        answer = served.ask(path)
                        slowest_s = max(slowest_s, time.monotonic() - asked_s)
                        bad += answer.status != 200
                        if path.startswith("/api"):
                            json.loads(answer.text)
            good = record(count // 2 + 1, "status", "good")
            hostile.publish("good", "status", good.payload)
            wait_for(lambda: shown(served).get("good") == "VALID", LONGEST_S)
            told = bus(served)
        kept = sum(len(served.ask(path).json) for path in pages("mems") if path.startswith("/api/history"))
    print(f"{count} messages in {time.monotonic() - begun_s:.0f} s: {kept} results kept, {told['malformed']} malformed")
    print(f"{told['faults']} faults of the program, {bad} pages not answered, slowest {slowest_s:.2f} s")
    print(f"{log.lines} lines of log")
    return told["faults"] == bad == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    return 0 if attack(given.seed, given.count) else 1


if __name__ == "__main__":
    raise SystemExit(main())
