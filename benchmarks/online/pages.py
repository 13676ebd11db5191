"""Runs the scenarios and writes their results into the pages of docs/ that have their markers."""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from benchmarks.online import (
    agreement,
    bench,
    bridge,
    chip,
    cost,
    coverage,
    day,
    drifting,
    filters,
    harm,
    lorries,
    references,
    temperature,
    touched,
    year,
)
from benchmarks.page import machine, write_part
from hw.virtual.building import Building
from hw.virtual.harm_kinds import KINDS


def main() -> int:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.online", description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*PARTS, []], help="default: all")
    parser.add_argument("--write", action="store_true", help="write the tables into the pages")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--runs",
        type=int,
        help="number of runs of harm (and as many without harm), of coverage, or of each line of touched; number of "
        "windows of year or cost",
    )
    options = parser.parse_args()
    for name in options.names or PARTS:
        begin = time.monotonic()
        text = PARTS[name](options.workers, options.runs)
        text = f"`python -m benchmarks.online {name}`, {machine()}.\n\n{text}"
        if options.write:
            write_part(name, text)
        else:
            print(text)
        print(f"[{name}: {time.monotonic() - begin:.0f} s]\n", flush=True)
    return 0


def spread(work: Callable[[Any], Any], items: Sequence[Any], workers: int) -> list[Any]:
    """All results in order, computed by `workers` processes."""
    if workers == 1:
        return [work(item) for item in items]
    with ProcessPoolExecutor(workers) as pool:
        return list(pool.map(work, items, chunksize=max(1, len(items) // (8 * workers))))


def _harm(workers: int, runs: int | None) -> str:
    count = runs or 1000
    kinds = list(KINDS)
    jobs = [(kinds[k % len(kinds)], harm.SEED + k) for k in range(count)]
    jobs += [("", harm.SEED + 100_000 + k) for k in range(count)]
    outcomes = spread(_one_harm, jobs, workers)
    wrong = [f"- {o.kind} ({o.name}), seed {o.seed}: {o.wrong}" for o in outcomes if o.wrong]
    return "\n".join([harm.table(outcomes), "", *wrong])


def _filters(workers: int, runs: int | None) -> str:
    return filters.table(spread(filters.one, filters.jobs(runs or filters.RUNS), workers))


def _lorries(workers: int, runs: int | None) -> str:
    count = runs or lorries.RUNS
    records = [(order, seed) for order in lorries.RECORDS for seed in range(count)]
    whole = lorries.table(spread(lorries.one, lorries.jobs(count), workers))
    return f"{lorries.records_table(spread(lorries.of_records, records, workers))}\n\n{whole}"


def _bridge(workers: int, runs: int | None) -> str:
    return bridge.table(spread(bridge.one, bridge.jobs(runs or bridge.RUNS), workers))


def _chip(workers: int, runs: int | None) -> str:
    return chip.table(spread(chip.one, chip.jobs(runs or chip.RUNS), workers))


def _one_harm(job: tuple[str, int]) -> harm.Outcome:
    return harm.harmed(*job)


def _coverage(workers: int, runs: int | None) -> str:
    seeds = range(coverage.SEED, coverage.SEED + (runs or coverage.RUNS))
    return coverage.table(spread(coverage.one, seeds, workers))


def _touched(workers: int, runs: int | None) -> str:
    counts = [runs or line.runs for line in touched.LINES]
    told = iter(spread(touched.one, [(line, seed) for line, n in enumerate(counts) for seed in range(n)], workers))
    return touched.table([[next(told) for _ in range(n)] for n in counts])


def _year(workers: int, runs: int | None) -> str:
    windows = runs or 8760
    found = spread(_one_year, [(windows, 0.0), (windows, 0.05)], min(workers, 2))
    return year.table(dict(zip(["y alone", "5 % in other directions"], found, strict=True)))


def _one_year(job: tuple[int, float]) -> dict[str, str]:
    windows, elsewhere = job
    building = Building(year.parameters(1, elsewhere), 1)
    return year.facts(building, year.whole(building, range(windows)))


def _day(_workers: int, _runs: int | None) -> str:
    return day.table()


def _bench(workers: int, runs: int | None) -> str:
    seeds = range(bench.SEED, bench.SEED + (runs or bench.RUNS))
    tables = [
        bench.table(spread(functools.partial(bench.day, rate_hz=rate_hz), seeds, workers), rate_hz)
        for rate_hz in bench.RATES_HZ
    ]
    tables.append(bench.free_table(spread(bench.free_day, seeds, workers)))
    return "\n\n".join(tables)


def _agreement(workers: int, runs: int | None) -> str:
    seeds = range(agreement.SEED, agreement.SEED + (runs or agreement.RUNS))
    rows = [
        agreement.table(spread(one, seeds, workers), kind)
        for kind, one in (("bench day", agreement.bench_day), ("building", agreement.building))
    ]
    return "\n".join([agreement.HEADER, *rows])


def _drift(workers: int, runs: int | None) -> str:
    seeds = range(drifting.SEED, drifting.SEED + (runs or drifting.RUNS))
    rows = [
        drifting.table(spread(functools.partial(drifting.one, rate_pct=rate_pct), seeds, workers), rate_pct)
        for rate_pct in (drifting.RATE_PCT, 0.0)
    ]
    return "\n".join([drifting.HEADER, *rows])


def _references(workers: int, runs: int | None) -> str:
    seeds = range(references.SEED, references.SEED + (runs or references.RUNS))
    jobs = {name: [(role, seed, True) for seed in seeds] for name, role in references.KINDS.items()}
    return references.table([(name, spread(references.one, own, workers)) for name, own in jobs.items()])


def _temperature(workers: int, runs: int | None) -> str:
    lines = temperature.jobs(runs or temperature.RUNS)
    return temperature.table([spread(temperature.one, own, workers) for own in lines])


def _cost(_workers: int, runs: int | None) -> str:
    return cost.table(cost.measure(runs or cost.TIMING.windows))


PARTS: dict[str, Callable[[int, int | None], str]] = {
    "bench": _bench,
    "agreement": _agreement,
    "year": _year,
    "harm": _harm,
    "coverage": _coverage,
    "filters": _filters,
    "chip": _chip,
    "touched": _touched,
    "lorries": _lorries,
    "bridge": _bridge,
    "drift": _drift,
    "references": _references,
    "temperature": _temperature,
    "day": _day,
    "cost": _cost,
}
