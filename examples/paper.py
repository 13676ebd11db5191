"""The paper's experiment on the virtual bench: its three methods, Tables 3 and 4, Figures 2 and 7-18.

    python examples/paper.py [DOCS] [--benches N]        writes DOCS/paper.md and DOCS/paper/*.svg; default DOCS: docs/

All seeds are fixed: the same machine writes the same files.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from paper_reproduced import figures
from paper_reproduced.bench import DEVICES, MEMS, Faults, record
from paper_reproduced.comparison import Comparison, compare
from paper_reproduced.faults import AMPLITUDE_MPS2, FREQUENCIES_HZ, STATED, alone, explain
from paper_reproduced.monte_carlo import monte_carlo
from paper_reproduced.page import Findings, page

from calib.paper.amplitudes import SineRun
from calib.paper.sine_fit import four_parameter

SEED = 2018
AMPLITUDES_MPS2 = (2.0, 5.0, AMPLITUDE_MPS2, 20.0)
ONE_PERIOD = 333  # samples of 1 kHz, as in Figure 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("docs", type=Path, nargs="?", default=Path(__file__).parents[1] / "docs")
    parser.add_argument("--benches", type=int, default=100, help="number of benches of the Monte Carlo, per sensor")
    options = parser.parse_args()
    docs: Path = options.docs
    started = time.perf_counter()
    (docs / "paper").mkdir(parents=True, exist_ok=True)

    runs = {
        (device, f, a): record(device, Faults(), f, a, SEED)
        for device in DEVICES
        for f in FREQUENCIES_HZ
        for a in AMPLITUDES_MPS2
    }
    found = {(device, f, a): compare(device, recorded, STATED) for (device, f, a), recorded in runs.items()}
    at = {device.key: {f: found[device, f, AMPLITUDE_MPS2] for f in FREQUENCIES_HZ} for device in DEVICES}
    draw(docs / "paper", list(found.values()), at, runs[MEMS, 3, AMPLITUDE_MPS2])
    text = page(
        Findings(
            at=at,
            alone={device.key: alone(device, SEED) for device in DEVICES},
            explained=[explain(device, f, SEED) for device in DEVICES for f in FREQUENCIES_HZ],
            drawn=[row for device in DEVICES for row in monte_carlo(device, STATED, options.benches, SEED)],
        )
    )
    (docs / "paper.md").write_text(text, encoding="utf-8")
    print(f"{docs / 'paper.md'} and its figures written in {time.perf_counter() - started:.1f} s")


def draw(folder: Path, found: list[Comparison], at: dict[str, dict[int, Comparison]], runs: list[SineRun]) -> None:
    """Write all figures as SVG into `folder`."""
    run = next(r for r in runs if r.pose.position == "method 3, 30 deg")
    period = slice(0, ONE_PERIOD)
    a_ref = four_parameter(run.time_s, run.reference).derivative(run.time_s)[period, 0]
    first = SineRun(run.time_s[period], run.reference[period], run.indications[period], run.pose, run.quantity)
    figures.save(figures.figure_2(first, a_ref, MEMS.unit), folder / "figure-2.svg")
    for device in DEVICES:
        figures.save(figures.rows_of_s(device, at[device.key]), folder / f"rows-{device.key}.svg")
        figures.save(figures.bars(device, at[device.key]), folder / f"methods-{device.key}.svg")
    figures.save(figures.repeatability(found), folder / "repeatability.svg")
    figures.save(figures.budgets({key: c[3] for key, c in at.items()}), folder / "budgets.svg")


if __name__ == "__main__":
    main()
