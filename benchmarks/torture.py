"""Plain Method 3 against the adjustment on recordings with known truth: root mean square, bounds, coverage.

    python benchmarks/torture.py [--quick] [--recordings 300] [--together 1000] [--row NAME] [--write FILE]

Every recording is drawn anew: faults from the priors that the adjustment is told. Per row and each of the 12
parameters: RMS over the bound (the posterior u; Cramér-Rao where there is nothing but noise) inside the 99.9 %
chi-squared band for its count, coverage inside the 99.9 % binomial band, both Bonferroni over the table.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import multiprocessing
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.torture_front_end import adjusted, plain
from benchmarks.torture_rows import Q_TRUE, REPETITIONS, ROWS, S_TRUE
from hw.virtual.bench import Bench

TRUTH = np.concatenate([S_TRUE.ravel(), Q_TRUE])
MAIN, TRANSVERSE, OFFSET = [0, 4, 8], [1, 2, 3, 5, 6, 7], [9, 10, 11]
LEVEL = 1e-3  # of a false alarm anywhere in the table
SEED = 20180101
COVERED = stats.norm.cdf(2.0) - stats.norm.cdf(-2.0)
BEGIN, END = "<!-- torture: written by benchmarks/torture.py -->", "<!-- end of torture -->"


@dataclass(frozen=True)
class Outcome:
    """Errors (N, 12) of plain Method 3 and of the adjustment, its standard uncertainties, and k (N,)."""

    plain: np.ndarray
    errors: np.ndarray
    uncertainties: np.ndarray
    k: np.ndarray
    refused: list[str]


def one(task: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, str]:
    """One recording of a row: errors of both, u, k and the reasons of a refusal."""
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
    """Markdown line of a row and what fails in it."""
    n = len(result.errors)
    rms, bound = _rms(result.errors), _rms(result.uncertainties)
    naive = _rms(result.plain)
    ratio = rms / bound
    low, high = np.sqrt(stats.chi2.ppf([LEVEL / tests / 2, 1 - LEVEL / tests / 2], n) / n)
    inside = np.abs(result.errors) <= result.k[:, None] * result.uncertainties
    least, most = stats.binom.ppf([LEVEL / tests / 2, 1 - LEVEL / tests / 2], n, COVERED) / n
    covered = inside.mean(axis=0)
    faults = [f"{name}: RMS over bound {r:.2f} outside {low:.2f}..{high:.2f}" for r in ratio if not low <= r <= high]
    faults += [f"{name}: coverage {c:.3f} outside {least:.3f}..{most:.3f}" for c in covered if not least <= c <= most]
    if not 0.94 <= inside.mean() <= 0.97:
        faults.append(f"{name}: pooled coverage {inside.mean():.4f} outside 0.94..0.97")
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


HEADER = (
    "| fault in the recording | recordings | plain: main / transverse / Q | adjustment | bound (posterior u) "
    "| RMS over bound (band) | coverage, pooled (least–most of 12) |\n| --- | --- | --- | --- | --- | --- | --- |"
)


def main() -> int:
    """Run the table; 0 where every band holds."""
    options = _options()
    numbers = [i for i, row in enumerate(ROWS) if options.row in row.name]
    tests = 2 * 12 * len(numbers)
    lines, faults, results = [HEADER], [], {}
    print(HEADER)
    with multiprocessing.Pool(options.processes) as pool:
        for number in numbers:
            row, start = ROWS[number], time.monotonic()
            count = options.together if row.name == "all together" else options.recordings
            results[row.name] = outcome(pool, number, count)
            text, wrong = line(row.name, results[row.name], tests)
            lines.append(text)
            faults += wrong
            print(text, f"<!-- {time.monotonic() - start:.0f} s -->", flush=True)
    faults += _as_good_as_clean(results)
    for fault in faults:
        print("FAULT", fault)
    if options.write:
        _write(Path(options.write), "\n".join(lines))
    return 1 if faults else 0


def _as_good_as_clean(results: dict[str, Outcome]) -> list[str]:
    """Faults that have a mend: main and transverse within 0.02 % of the clean row."""
    clean = results.get(ROWS[0].name)
    if clean is None:
        return []
    least = _rms(clean.errors)[:9]
    return [
        f"{row.name}: {100 * (_rms(results[row.name].errors)[:9] - least).max():.3f} % above clean, 0.02 allowed"
        for row in ROWS
        if row.mended and row.name in results and (_rms(results[row.name].errors)[:9] - least).max() > 2e-4
    ]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="12 recordings a row: does it run, is nothing far off")
    parser.add_argument("--recordings", type=int, default=300)
    parser.add_argument("--together", type=int, default=1000, help="recordings of the last row")
    parser.add_argument("--row", default="", help="only rows whose name contains this")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--write", help="put the table into this file, between its markers")
    options = parser.parse_args()
    if options.quick:
        options.recordings = options.together = 12
    return options


def _write(path: Path, table: str) -> None:
    text = path.read_text() if path.exists() else f"# Performance\n\n{BEGIN}\n{END}\n"
    if BEGIN not in text:
        text = f"{text.rstrip()}\n\n## Plain Method 3 against the adjustment\n\n{BEGIN}\n{END}\n"
    head, rest = text.split(BEGIN, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{head}{BEGIN}\n{table}\n{END}{rest.split(END, 1)[1]}")


if __name__ == "__main__":
    sys.exit(main())
