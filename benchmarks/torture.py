"""Plain Method 3 and the adjustment on recordings with known truth: root mean square error, bounds, coverage.

    python -m benchmarks.torture [--quick] [--recordings 300] [--together 1000] [--row NAME] [--write]

For every recording faults are drawn from the priors that the adjustment gets. Checked for each row and each of the 12
parameters: RMS over the bound (the posterior u; Cramér-Rao where noise is the only fault) is inside the 99.9 %
chi-squared band for its count; coverage is inside the 99.9 % binomial band. Both bands are Bonferroni over the table.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import multiprocessing
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from benchmarks.cramer_rao import cramer_rao
from benchmarks.page import machine, write_part
from benchmarks.torture_front_end import adjusted, plain
from benchmarks.torture_rows import Q_TRUE, REPETITIONS, ROWS, S_TRUE
from hw.virtual.bench import Bench

TRUTH = np.concatenate([S_TRUE.ravel(), Q_TRUE])
MAIN, TRANSVERSE, OFFSET = [0, 4, 8], [1, 2, 3, 5, 6, 7], [9, 10, 11]
LEVEL = 1e-3  # probability of a false alarm anywhere in the table
SEED = 20180101
POOLED = 0.94, 0.97  # limits of the coverage of all parameters in all rows
COVERED = stats.norm.cdf(2.0) - stats.norm.cdf(-2.0)


@dataclass(frozen=True)
class Outcome:
    """Errors (N, 12) of plain Method 3 and of the adjustment, u (N, 12) of the adjustment, and k (N,)."""

    plain: np.ndarray
    errors: np.ndarray
    uncertainties: np.ndarray
    k: np.ndarray
    refused: list[str]

    def inside(self) -> np.ndarray:
        """Which errors (N, 12) lie within their expanded uncertainty."""
        return np.abs(self.errors) <= self.k[:, None] * self.uncertainties


def one(task: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, str]:
    """One recording of a row: errors of both methods, u, k, and the reasons of a refusal."""
    number, index = task
    row = ROWS[number]
    random = np.random.default_rng([SEED, number, index])
    parameters = row.bench(random)
    bench = Bench(parameters, int(random.integers(2**31)))
    recording = bench.recording(parameters.schedule.duration_s(REPETITIONS))
    velocity = parameters.reference.quantity == "velocity"
    found = adjusted(recording, row.priors, velocity)
    u = np.sqrt(np.diag(found.covariance)[:12])
    naive = plain(recording, velocity)
    return naive - TRUTH, found.mean[:12] - TRUTH, u, found.coverage_factor, "; ".join(found.reasons)


def outcome(pool: multiprocessing.pool.Pool, number: int, recordings: int) -> Outcome:
    """All recordings of a row."""
    results = pool.map(one, [(number, i) for i in range(recordings)], chunksize=4)
    naive, errors, u, k, refused = (list(column) for column in zip(*results, strict=True))
    return Outcome(np.array(naive), np.array(errors), np.array(u), np.array(k), [r for r in refused if r])


def line(name: str, result: Outcome, tests: int) -> tuple[str, list[str]]:
    """Markdown line of a row, and its violations of the bands."""
    n = len(result.errors)
    rms, bound = _rms(result.errors), _rms(result.uncertainties)
    if name == ROWS[0].name:
        bound = cramer_rao(ROWS[0].bench(np.random.default_rng(0)))
    naive = _rms(result.plain)
    ratio = rms / bound
    low, high = np.sqrt(stats.chi2.ppf([LEVEL / tests / 2, 1 - LEVEL / tests / 2], n) / n)
    inside = result.inside()
    least, most = stats.binom.ppf([LEVEL / tests / 2, 1 - LEVEL / tests / 2], n, COVERED) / n
    covered = inside.mean(axis=0)
    faults = [f"{name}: RMS over bound {r:.2f} outside {low:.2f}..{high:.2f}" for r in ratio if not low <= r <= high]
    faults += [f"{name}: coverage {c:.3f} outside {least:.3f}..{most:.3f}" for c in covered if not least <= c <= most]
    faults += [f"{name}: {len(result.refused)} of {n} refused, e.g. {result.refused[0]}"] if result.refused else []
    return (
        f"| {name} | {n} | {_worst(naive, MAIN)} / {_worst(naive, TRANSVERSE)} / {_mm(naive)} "
        f"| {_worst(rms, MAIN)} / {_worst(rms, TRANSVERSE)} / {_mm(rms)} "
        f"| {_worst(bound, MAIN)} / {_worst(bound, TRANSVERSE)} / {_mm(bound)} "
        f"| {ratio.min():.2f}–{ratio.max():.2f} ({low:.2f}–{high:.2f}) "
        f"| {100 * inside.mean():.1f} ({100 * covered.min():.1f}–{100 * covered.max():.1f}) |"
    ), faults


def _rms(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _worst(values: np.ndarray, which: list[int]) -> str:
    return f"{100 * values[which].max():.3f}"


def _mm(values: np.ndarray) -> str:
    return f"{1e3 * values[OFFSET].max():.1f}"


HOW = (
    "Theta 35°, alpha 0, 30, 120, 210°, three repetitions of six cycles at 3 Hz and "
    "10 m/s²; the faults are drawn anew for every recording, from the priors that the adjustment is given. The table "
    "has the root mean square error of the worst axis: main / transverse sensitivity in % of 1, Q in mm/s². The "
    "brackets have the 99.9 % band (Bonferroni over the table). The bound of the row without faults is that of Cramér "
    "and Rao."
)
HEADER = (
    "| fault in the recording | recordings | plain: main / transverse / Q | adjustment | bound (posterior u) "
    "| RMS over bound (band) | coverage, pooled (least–most of 12) |\n| --- | --- | --- | --- | --- | --- | --- |"
)


def main(arguments: Sequence[str] = ("--write",)) -> int:
    """Run the table; returns 0 if all bands hold."""
    options = _options(arguments)
    numbers = [i for i, row in enumerate(ROWS) if options.row in row.name]
    tests = 2 * 12 * len(numbers)
    lines, faults, results = [HEADER], [], {}
    print(HEADER)
    with multiprocessing.get_context("forkserver").Pool(options.processes) as pool:
        for number in numbers:
            row, start = ROWS[number], time.monotonic()
            count = options.together if row.name == "all together" else options.recordings
            results[row.name] = outcome(pool, number, count)
            text, wrong = line(row.name, results[row.name], tests)
            lines.append(text)
            faults += wrong
            print(text, f"<!-- {time.monotonic() - start:.0f} s -->", flush=True)
    faults += _as_good_as_clean(results)
    pooled = np.mean([r.inside().mean() for r in results.values()])
    print(f"coverage pooled over the table: {100 * pooled:.2f} %")
    if not options.quick and not POOLED[0] <= pooled <= POOLED[1]:
        faults.append(f"pooled coverage {pooled:.4f} outside {POOLED[0]}..{POOLED[1]}")
    for fault in faults:
        print("FAULT", fault)
    if options.write:
        table = "\n".join(lines)
        write_part("torture", f"`python -m benchmarks.torture --write` on {machine()}. {HOW}\n\n{table}")
    return 1 if faults else 0


def _as_good_as_clean(results: dict[str, Outcome]) -> list[str]:
    """Check rows with a completely correctable fault: main and transverse within 0.02 % of the row without faults."""
    clean = results.get(ROWS[0].name)
    if clean is None:
        return []
    least = _rms(clean.errors)[:9]
    return [
        f"{row.name}: {100 * (_rms(results[row.name].errors)[:9] - least).max():.3f} % above clean, 0.02 allowed"
        for row in ROWS
        if row.mended and row.name in results and (_rms(results[row.name].errors)[:9] - least).max() > 2e-4
    ]


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--quick",
        action="store_true",
        help="12 recordings per row, as a quick check that the benchmark runs and no result is far off",
    )
    parser.add_argument("--recordings", type=int, default=300)
    parser.add_argument("--together", type=int, default=1000, help="number of recordings of the last row")
    parser.add_argument("--row", default="", help="only rows whose name contains this")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--write", action="store_true", help="write the table into docs/performance.md")
    options = parser.parse_args(arguments)
    if options.quick:
        options.recordings = options.together = 12
    return options


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
