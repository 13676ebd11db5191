"""Growth of the monitor's database for one sensor with one result a minute, and what a result and a step cost.

.venv/bin/python -m benchmarks.monitor_growth [postgresql://...]
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import msgspec

from agent.core.events import Result
from agent.delivery.keys import Address
from agent.delivery.received import Received
from agent.fleet.simulated_sensor import SimulatedSensor, Story
from agent.monitor.database import DAY_NS, Database
from agent.monitor.engines import DatabaseEngine, open_engine
from agent.monitor.summaries import FULL_DAYS

MINUTE_NS = 60_000_000_000
SENSORS, MORE_DAYS = 2, 7
DRAWN = 60  # rounds that are drawn; later ones repeat their numbers
START = 20_000 * DAY_NS


def main() -> None:
    """Fill the days that are kept in full, then measure from one day to the next."""
    url = sys.argv[1] if len(sys.argv) > 1 else None
    with tempfile.TemporaryDirectory() as directory:
        engine = open_engine(Path(directory), url)
        now_ns, sequence = START, 0
        database = Database(engine, now_ns=lambda: now_ns)
        sensors = [drawn(f"s{k}", [7, k]) for k in range(SENSORS)]
        sizes, adding_s, steps, published, results = [], 0.0, [], 0, 0
        for day in range(FULL_DAYS + 1 + MORE_DAYS):
            for minute in range(1440):
                now_ns = START + day * DAY_NS + minute * MINUTE_NS
                for rounds in sensors:
                    for result in rounds[(day * 1440 + minute) % DRAWN]:
                        sequence += 1
                        data = msgspec.json.encode(msgspec.structs.replace(result, sequence=sequence, t_utc_ns=now_ns))
                        published, results = published + len(data), results + 1
                        address = Address("site", "gateway", result.sensor, result.what)
                        received = Received("", address, sequence, msgspec.json.decode(data), None)
                        begun = time.perf_counter()
                        database.add([received])
                        adding_s += time.perf_counter() - begun
            while True:
                begun = time.perf_counter()
                if not database.summarise():
                    break
                steps.append(time.perf_counter() - begun)
            sizes.append(used_bytes(engine, url))
        full, growth = sizes[FULL_DAYS], (sizes[-1] - sizes[FULL_DAYS]) / MORE_DAYS * 365.25
        print(f"{results} results of {published / results:.0f} bytes as JSON on average; {FULL_DAYS} days in full")
        print(
            f"full days: {full / SENSORS / 1e6:.1f} MB a sensor; then {growth / SENSORS / 1e6:.1f} MB a sensor a year"
        )
        print(f"{1e6 * adding_s / results:.0f} us a result; a step of the summaries {1e3 * max(steps):.0f} ms at most")
        database.close()


def drawn(name: str, seed: list[int]) -> list[list[Result]]:
    """The results of DRAWN rounds of a sound sensor, a minute apart, without those of its begin."""
    sensor = SimulatedSensor(Story(name, "sound", seed), name)
    rounds = [sensor.results(k, START + k * MINUTE_NS, 1) for k in range(DRAWN + 1)]
    return rounds[1:]


def used_bytes(engine: DatabaseEngine, url: str | None) -> int:
    """Bytes in use: free pages of SQLite are used again."""
    with engine.transaction() as run:
        if url is None:
            names = ("page_count", "freelist_count", "page_size")
            pages, free, size = (run(f"PRAGMA {name}")[0][0] for name in names)
            return int((pages - free) * size)
        return int(run("SELECT sum(pg_total_relation_size(oid)) FROM pg_class WHERE relname IN ('sensor', 'newest',"
                       " 'followed', 'day', 'summary') OR relname ~ '^result_[0-9]+$'")[0][0])  # fmt: skip


if __name__ == "__main__":
    main()
