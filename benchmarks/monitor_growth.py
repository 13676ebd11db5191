"""Growth of the monitor's database for one sensor with one result a minute, and what a result and a step cost.

.venv/bin/python -m benchmarks.monitor_growth [--store DATA_DIR] [postgresql://...]

With `--store` the sensors have the calibrations and windows of a gateway's data directory, in turn, instead of
simulated ones.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from agent.delivery.history import History
from agent.delivery.keys import Address
from agent.delivery.received import Received
from agent.fleet.simulated_sensor import SimulatedSensor
from agent.monitor.database import DAY_NS, Database
from agent.monitor.engines import Engine, open_engine
from agent.monitor.summaries import FULL_DAYS

MINUTE_NS = 60_000_000_000
SENSORS, MORE_DAYS = 2, 7
START = 20_000 * DAY_NS


def main() -> None:
    """Fill the days that are kept in full, then measure from one day to the next."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url", nargs="?", help="of PostgreSQL; default: SQLite")
    parser.add_argument("--store", type=Path, help="data directory of a gateway")
    args = parser.parse_args()
    url = args.url
    made = recorded(args.store) if args.store else simulated()
    with tempfile.TemporaryDirectory() as directory:
        engine = open_engine(Path(directory), url)
        now_ns, sequence = START, 0
        database = Database(engine, now_ns=lambda: now_ns)
        sizes, adding_s, steps, published, results = [], 0.0, [], 0, 0
        for day in range(FULL_DAYS + 1 + MORE_DAYS):
            for minute in range(1440):
                now_ns = START + day * DAY_NS + minute * MINUTE_NS
                for k in range(SENSORS):
                    for what, fields in made(k, day * 1440 + minute, now_ns, sequence + 1):
                        sequence = fields["sequence"]
                        published, results = published + len(msgspec.json.encode(fields)), results + 1
                        received = Received("", Address("site", "gateway", f"s{k}", what), sequence, fields, None)
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


Made = Callable[
    [int, int, int, int], list[tuple[str, dict[str, Any]]]
]  # number of the sensor, minute, UTC, first number


def simulated() -> Made:
    """Results of simulated sensors."""
    sensors = [SimulatedSensor(f"s{k}", "sound", [7, k]) for k in range(SENSORS)]

    def made(k: int, minute: int, t_utc_ns: int, first: int) -> list[tuple[str, dict[str, Any]]]:
        results = sensors[k].results(minute, t_utc_ns, first)
        return [(result.what, msgspec.json.decode(msgspec.json.encode(result))) for result in results]

    return made


def recorded(data_dir: Path) -> Made:
    """Calibrations and windows of a gateway, one of each in a minute."""
    with History(data_dir / "state.sqlite") as history:
        records = list(history.after(0, limit=10_000))
    of = {
        what: [msgspec.json.decode(r.payload) for r in records if r.what == what] for what in ("window", "calibration")
    }
    for what, each in of.items():
        print(f"{len(each)} of {what}, {sum(len(msgspec.json.encode(f)) for f in each) / len(each):.0f} bytes as JSON")

    def made(k: int, minute: int, t_utc_ns: int, first: int) -> list[tuple[str, dict[str, Any]]]:
        chosen = [(what, each[(minute + k) % len(each)]) for what, each in of.items()]
        return [(what, f | {"sequence": first + i, "t_utc_ns": t_utc_ns}) for i, (what, f) in enumerate(chosen)]

    return made


def used_bytes(engine: Engine, url: str | None) -> int:
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
