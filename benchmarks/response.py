"""Instruments that respond differently over frequency: is S right at its frequency, covered by U, or refused?

    python -m benchmarks.response [--known|--skirts|--inside] [--runs 100] [--write]

A sensor and a tri-axial reference move together for 300 s; a filter is in the sensor or (its inverse) in the reference.
The reference's error is drawn from its stated uncertainty of 0.1 %, and the corners of the axes from theirs of 1 %
about their mean. With --known the filters are stated, and their corners differ from what is stated by errors drawn from
their uncertainty of 10 %. With --skirts the motion reaches beyond its upper end, into the filter's edge: it is random
motion behind Butterworth filters of an order. With --inside the pair is a bad one: a resonance, a dead axis or
incoherence is in the middle of the motion, and each run that is valid must be right.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import itertools
import multiprocessing
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.page import machine, write_part
from calib.estimate.nuisances import Priors
from calib.model import Array
from calib.recorded.adjusting import adjusted
from calib.signal.known_response import UNKNOWN, known_response_of
from calib.windows.deviations import U_CORNER
from tests.pair import (
    NOTHING,
    Filter,
    decimator,
    flat,
    highpass,
    lowpass,
    moving_mean,
    noise,
    pair,
    resonance,
    sinc3,
)  # fmt: skip

U_REFERENCE = 1e-3
BANDS_HZ = ((0.3, 2.0), (0.5, 20.0), (1.0, 40.0))
RATIOS = (1.5, 2.0, 5.0, 20.0)  # of a filter's corner over the upper end of the motion
BELOW = (5.0, 10.0, 20.0)  # of the lower end of the motion over the corner of an AC-coupled instrument
FILTERS: dict[str, Callable[[float], Filter]] = {
    "low-pass, order 1": lambda f: lowpass(1, f),
    "low-pass, order 2": lambda f: lowpass(2, f),
    "low-pass, order 4": lambda f: lowpass(4, f),
    "moving mean": lambda f: moving_mean(0.443 / f),  # 3 dB down at f
    "sinc3": lambda f: sinc3(0.2625 / f),
    "FIR decimator": decimator,
    "resonance, Q 5": lambda f: resonance(f, 5.0),
    "resonance, Q 50": lambda f: resonance(f, 50.0),
}
CORNERS: dict[str, Callable[[float], Filter]] = {
    "AC corner, order 1": highpass,
    "AC corner, order 2": lambda f: highpass(f, 2),
}
# The line of text that states a filter with this corner, and the filter whose frequencies are larger by a factor.
KNOWN: dict[str, Callable[[float], tuple[str, Callable[[float], Filter]]]] = {
    **{
        f"low-pass, order {n}": lambda f, n=n: (  # type: ignore[misc]
            f"lowpass order={n} corner_hz={f!r}", lambda by: lowpass(n, f * by)
        )
        for n in (1, 2, 4)
    },
    "moving mean": lambda f: (
        f"mean points=4096 rate_hz={4096.0 * f / 0.443!r} u_rate_pct=10", lambda by: moving_mean(0.443 / f / by)
    ),
    "sinc3": lambda f: (
        f"sinc order=3 points=4096 rate_hz={4096.0 * f / 0.2625!r} u_rate_pct=10", lambda by: sinc3(0.2625 / f / by)
    ),
}  # fmt: skip
U_KNOWN, KNOWN_RATIOS, KNOWN_BAND_HZ = 0.1, (1.2, 1.5, 2.0, 5.0), (0.5, 20.0)
SKIRT_RATIOS, SKIRT_BAND_HZ = (1.5, 2.0, 3.0), (0.5, 20.0)
SIDES_AND_ORDERS = tuple(itertools.product((False, True), (2, 3, 4, 8)))  # filter in the reference, order of the skirts
INSIDE_BAND_HZ = (0.5, 10.0)
WRONG = 4.0  # standard uncertainties: an error beyond, of a valid run, is no chance
Job = tuple[str, float, tuple[float, float], bool, int, int]
Result = tuple[bool, float, float]  # refused; relative error of S_xx without the reference's, over its u with it


def one(job: Job) -> Result:
    """One run: whether it was refused, the relative error of S_xx besides the reference's, and error over u."""
    name, ratio, band_hz, in_reference, skirts, seed = job
    key = [seed, [*FILTERS, *CORNERS].index(name), round(10.0 * ratio), round(band_hz[1]), int(in_reference)]
    key += [skirts] * bool(skirts)
    random = np.random.default_rng(key)
    error, differs = U_REFERENCE * random.normal(), random.normal(size=3)
    times = 1.0 + U_CORNER * np.sqrt(1.5) * (differs - differs.mean())
    corner_hz, make = (band_hz[0] / ratio, CORNERS) if name in CORNERS else (ratio * band_hz[1], FILTERS)
    own = [make[name](corner_hz * by) for by in times.tolist()]
    by_axis: Filter = lambda f: np.stack([h(f) for h in own])  # noqa: E731
    undone: Filter = lambda f: 1.0 / by_axis(f)  # noqa: E731
    # Motion that reaches beyond a filter of the reference is lost to it; motion that does not may be what it shows.
    lost = in_reference and bool(skirts)
    made = pair(
        seed, undone if in_reference and not lost else flat, of_outputs=flat if in_reference else by_axis,
        of_reference=by_axis if lost else flat, band_hz=band_hz, rate_hz=10.0 * band_hz[1], seconds=300.0,
        reference_error=float(error), skirts=skirts,
    )  # fmt: skip
    stated = Priors(
        reference=U_REFERENCE,
        reference_frequency_hz=made.reference_frequency_hz,
        corner_unknown=name in CORNERS,
    )
    found = adjusted(made.files, stated).calibration
    if found is None:
        return True, 0.0, 0.0
    away = found.sensitivity[0, 0] / made.sensitivity[0, 0] - 1.0
    u = found.standard_uncertainty[0] / made.sensitivity[0, 0]
    return False, float(away + error), float(away / u)


def one_known(job: tuple[str, float, bool, int]) -> tuple[Result, Result]:
    """One run with the filters stated, and the same data with nothing stated."""
    name, ratio, in_reference, seed = job
    line, filter_by = KNOWN[name](ratio * KNOWN_BAND_HZ[1])
    random = np.random.default_rng([23, seed, [*KNOWN].index(name), round(10.0 * ratio), int(in_reference)])
    acts, error = filter_by(1.0 + U_KNOWN * random.normal()), U_REFERENCE * random.normal()
    response: Filter = (lambda f: 1.0 / acts(f)) if in_reference else acts
    found = []
    for known in (
        known_response_of(["flat"], [line]) if in_reference else known_response_of([line], ["flat"]),
        UNKNOWN,
    ):
        made = pair(
            seed, response, band_hz=KNOWN_BAND_HZ, rate_hz=200.0, seconds=300.0, reference_error=error, known=known
        )
        stated = Priors(reference=U_REFERENCE, reference_frequency_hz=made.reference_frequency_hz)
        outcome = adjusted(made.files, stated.beside_known(known)).calibration
        if outcome is None or not np.isfinite(outcome.sensitivity[0, 0]):
            found.append((True, 0.0, 0.0))
            continue
        true = made.sensitivity[0, 0]
        if in_reference and known is not UNKNOWN:  # S is then that of the sensor alone
            true = true * abs(acts(np.array([made.reference_frequency_hz]))[0])
        away, u = outcome.sensitivity[0, 0] / true - 1.0, outcome.standard_uncertainty[0] / true
        found.append((False, float(away + error), float(away / u)))
    return found[0], found[1]


def known_table(runs: int) -> list[str]:
    """The lines of the table of stated filters."""
    lines = [
        "| filter | corner over motion | in | stated: refused | RMS of S less the reference's error, % | within 2 u"
        " | most | not stated: refused | RMS, % | within 2 u | most |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    with multiprocessing.Pool() as pool:
        for name, ratio, side in itertools.product(KNOWN, KNOWN_RATIOS, (False, True)):
            found = pool.map(one_known, [(name, ratio, side, seed) for seed in range(runs)], chunksize=1)
            told = " | ".join(_told([both[k] for both in found]) for k in (0, 1))
            line = f"| {name} | {ratio:g} | {'reference' if side else 'sensor'} | {told} |"
            print(line, flush=True)
            lines.append(line)
    return lines


def _told(found: list[Result]) -> str:
    """Refused, RMS of S less the reference's error, within 2 u, and the largest error over u."""
    told = np.array([(away, z) for refused, away, z in found if not refused]).reshape(-1, 2)
    rms = f"{100.0 * np.sqrt(np.mean(told[:, 0] ** 2)):.4f}" if len(told) else "-"
    within = f"{np.count_nonzero(np.abs(told[:, 1]) <= 2.0)} of {len(told)}"
    most = f"{np.abs(told[:, 1]).max():.1f}" if len(told) else "-"
    return f"{len(found) - len(told)} of {len(found)} | {rms} | {within} | {most}"


def table(runs: int) -> list[str]:
    """The lines of the table, one for each filter, ratio and side; the three bands of motion are in each line."""
    lines = [
        "| filter | corner over motion, or its inverse | in | refused | RMS of S less the reference's error, %"
        " | within 2 u | most |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    cells = [*itertools.product(FILTERS, RATIOS), *itertools.product(CORNERS, BELOW)]
    keys = [(name, ratio, side) for name, ratio in cells for side in (False, True)]
    with multiprocessing.Pool() as pool:
        for name, ratio, side in keys:
            jobs = [(name, ratio, band, side, 0, seed) for band in BANDS_HZ for seed in range(runs)]
            found = pool.map(one, jobs, chunksize=1)
            line = f"| {name} | {ratio:g} | {'reference' if side else 'sensor'} | {_told(found)} |"
            print(line, flush=True)
            lines.append(line)
    return lines


def skirt_jobs(name: str, ratio: float, runs: int) -> list[Job]:
    """The runs of a line of `skirts_table`: the side and the order of the skirts change from run to run."""
    line, ways = [*itertools.product(FILTERS, SKIRT_RATIOS)].index((name, ratio)), SIDES_AND_ORDERS
    return [(name, ratio, SKIRT_BAND_HZ, *ways[(3 * line + seed) % len(ways)], seed) for seed in range(runs)]


def skirts_table(runs: int) -> list[str]:
    """The lines of the table of motion that reaches into a filter's edge: one for each filter and ratio."""
    lines = [
        "| filter | corner over motion | refused | RMS of S less the reference's error, % | within 2 u | most |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    with multiprocessing.Pool() as pool:
        for name, ratio in itertools.product(FILTERS, SKIRT_RATIOS):
            found = pool.map(one, skirt_jobs(name, ratio, runs), chunksize=1)
            line = f"| {name} | {ratio:g} | {_told(found)} |"
            print(line, flush=True)
            lines.append(line)
    return lines


def _resonates(random: np.random.Generator) -> dict[str, Any]:
    own = resonance(INSIDE_BAND_HZ[1] * random.uniform(0.1, 1.1), random.uniform(3.0, 50.0))
    return {"response": own if random.random() < 0.5 else lambda f: 1.0 / own(f)}


def _dead(random: np.random.Generator) -> dict[str, Any]:
    axis, of_sensor = random.integers(3), random.random() < 0.5

    def silenced(_: np.random.Generator, u: Array, rate_hz: float) -> tuple[Array, Array]:
        del rate_hz
        lost = np.zeros(u.shape)
        lost[:, axis] = -u[:, axis]
        return (lost, NOTHING) if of_sensor else (NOTHING, lost)

    return {"response": lowpass(2, 1.5 * INSIDE_BAND_HZ[1]), "disturbed": silenced}


def _incoherent(random: np.random.Generator) -> dict[str, Any]:
    at_hz, octaves = np.exp(random.uniform(*np.log(INSIDE_BAND_HZ))), random.uniform(0.2, 1.0)
    level = random.uniform(0.1, 1.0) / np.sqrt(INSIDE_BAND_HZ[1])  # of the motion's density
    added = noise(lambda f: level * np.exp(-((np.log2(f / at_hz) / octaves) ** 2)), of_reference=random.random() < 0.5)
    return {"response": lowpass(2, random.uniform(0.7, 3.0) * INSIDE_BAND_HZ[1]), "disturbed": added}


INSIDE: dict[str, Callable[[np.random.Generator], dict[str, Any]]] = {
    "a resonance": _resonates, "a dead axis": _dead, "incoherence": _incoherent,
}  # fmt: skip


def one_inside(job: tuple[str, int, int]) -> tuple[str, float]:
    """One bad pair: what was told of it, a column of `inside_table`, and the largest error over u where S was told.

    Where a refusal says that the data would be accepted with flat filters, they are stated."""
    name, skirts, seed = job
    random = np.random.default_rng([29, [*INSIDE].index(name), skirts, seed])
    made = pair(seed, band_hz=INSIDE_BAND_HZ, rate_hz=100.0, seconds=60.0, skirts=skirts, **INSIDE[name](random))
    at_hz = Priors(reference=U_REFERENCE, reference_frequency_hz=made.reference_frequency_hz)
    outcome, told = adjusted(made.files, at_hz), "valid at once"
    if outcome.reasons and "`sensor_filter` flat" in outcome.reasons[-1]:
        outcome, told = (
            adjusted(made.files, at_hz.beside_known(known_response_of(["flat"], ["flat"]))),
            "with flat filters",
        )
    elif outcome.reasons:
        return "refused", 0.0
    elif outcome.more["band_hz"] is not None:
        told = "in a narrower band"
    away = np.abs(outcome.sensitivity - made.sensitivity).ravel() / outcome.standard_uncertainty[:9]
    return told, float(np.nanmax(away))


def inside_table(runs: int) -> list[str]:
    """The lines of the table of bad pairs."""
    columns = ("refused", "valid at once", "in a narrower band", "with flat filters")
    lines = [f"| in the motion | {' | '.join(columns)} | wrong | most, u |", "| --- " * (len(columns) + 3) + "|"]
    with multiprocessing.Pool() as pool:
        for name in INSIDE:
            found = pool.map(one_inside, [(name, (0, 4)[seed % 2], seed) for seed in range(runs)], chunksize=1)
            counts = [sum(told == column for told, _ in found) for column in columns]
            away = [most for _, most in found]
            told = f"{sum(most > WRONG for most in away)} | {max(away):.1f}"
            line = f"| {name} | {' | '.join(map(str, counts))} | {told} |"
            print(line, flush=True)
            lines.append(line)
    return lines


TABLES = {"table": table, "known": known_table, "skirts": skirts_table, "inside": inside_table}
OF = {"table": "band of motion", "known": "line", "skirts": "line", "inside": "line"}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--write", action="store_true", help="write docs/response.md")
    parser.set_defaults(of="table")
    which = parser.add_mutually_exclusive_group()
    for option, told in (
        ("--known", "the table of stated filters"), ("--skirts", "motion that reaches into a filter's edge"),
        ("--inside", "pairs with a fault in the motion"),
    ):  # fmt: skip
        which.add_argument(option, dest="of", action="store_const", const=option.removeprefix("--"), help=told)
    arguments = parser.parse_args()
    lines = TABLES[arguments.of](arguments.runs)
    if arguments.write:
        text = "\n".join([*lines, "", f"{arguments.runs} runs a {OF[arguments.of]}; {machine()}."])
        write_part(arguments.of, text)


if __name__ == "__main__":
    main()
