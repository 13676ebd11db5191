"""Writes docs/paper.md: the paper's numbers beside those of the virtual bench."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.model import Array
from paper_reproduced.bench import DEVICES, MEMS, PIEZO, Device
from paper_reproduced.comparison import METHODS, Comparison
from paper_reproduced.faults import FREQUENCIES_HZ, STATED, Alone, Explanation
from paper_reproduced.monte_carlo import Drawn
from paper_reproduced.published import (
    DIFFERENCES_PCT,
    MISPRINT,
    OFFSET,
    REPEATABILITY_PCT,
    TRANSVERSE_PCT,
    UNCERTAINTY_PCT,
)

PAIRS = ((2, 1), (3, 1), (3, 2))
TABLE = {PIEZO.key: 3, MEMS.key: 4}
FIGURES = {PIEZO.key: ("7-9", "10-12"), MEMS.key: ("13-15", "16-18")}


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """Everything that the page shows. `at` {device: {frequency: comparison at 10 m/s2}}."""

    at: Mapping[str, Mapping[int, Comparison]]
    alone: Mapping[str, Sequence[Alone]]
    explained: Sequence[Explanation]
    drawn: Sequence[Drawn]


def page(found: Findings) -> str:
    """The whole page in Markdown."""
    devices = [_device(device, found) for device in DEVICES]
    parts = [_introduction(), _repeatability(found), *devices, _uncertainty(found), _alone(found), _explained(found)]
    return "\n\n".join(parts) + "\n"


def _introduction() -> str:
    stated = _table(
        ("quantity", "u"),
        (
            ("angles by position (mounting, α)", f"{np.rad2deg(STATED.angle_rad):g}°"),
            ("θ", f"{np.rad2deg(STATED.theta_rad):g}°"),
            ("α in common", f"{np.rad2deg(STATED.alpha_common_rad):g}°"),
            ("offset between positions", f"{STATED.offset_mps2:g} m/s²"),
            ("reference", f"{100 * STATED.reference:g} %"),
            ("motion transverse to the slide", f"{100 * STATED.transverse:g} %"),
            ("gravity", f"{STATED.gravity_mps2:g} m/s²"),
            ("lag of the sensor behind the reference", f"{1000 * STATED.lag_s:g} ms"),
        ),
    )
    return f"""# The paper on the virtual bench

After this page you can compare the results of fieldcal with those of the paper.

`python examples/paper.py` writes this page, with fixed seeds; do not edit it. The paper is: D'Emilia, Gaspari,
Mazzoleni, Natale and Schiavi, *Calibration of tri-axial MEMS accelerometers in the low-frequency range, Part 1:
comparison among methods*, J. Sens. Sens. Syst. 7, 2018.

The bench is the paper's: a horizontal slide moved by a sine of 3 or 6 Hz and 2 to 20 m/s², a laser vibrometer as the
reference (Eq. 12), 1000 samples a second, six cycles a run, three repetitions. In Method 1 one axis of the sensor is
along the motion (Eqs. 1-4). In Method 2 the sensor is on the clamp at θ = 35°, α = 135° (Eqs. 5-7). In Method 3 it is
on the same clamp at four α (Eqs. 8-11), and the equations are solved by least squares over all points, as printed.
The sensors are the {PIEZO.name} (10 mV per m/s², AC-coupled) and the {MEMS.name} (DC-coupled, output in m/s²). The
paper does not say which four α each sensor had; here they are {_list(PIEZO.alphas_deg)}° and
{_list(MEMS.alphas_deg)}°. The true S of the sensors is chosen inside the paper's bounds (transverse below
{TRANSVERSE_PCT["piezo"]:g} and {TRANSVERSE_PCT["mems"]:g} %); Q is that of sections 3.1.3 and 3.2.3 at 3 Hz.

The table has the *stated* standard uncertainties of the bench. Those of the paper's own bench are left to its Part 2.

{stated}

The code is in `calib/paper/`: `method1.py`, `method2.py`, `method3.py` (Method 3 as printed), `statistics.py`
(Appendix A), `sine_fit.py` (the sine fit of ISO 16063), and `propagation.py` (the uncertainty budgets).

![Outputs and reference inputs over one period](paper/figure-2.svg)

**Figure 2.** MEMS, α = 30°, 3 Hz, 333 points: outputs V and reference inputs a."""


def _device(device: Device, found: Findings) -> str:
    at = found.at[device.key]
    rows, bars = FIGURES[device.key]
    explained = {e.frequency_hz: e.found for e in found.explained if e.device is device}
    lines = []
    for f in FREQUENCIES_HZ:
        for pair in PAIRS:
            printed = list(DIFFERENCES_PCT[device.key, f][pair])
            if (device.key, f) == MISPRINT[:2] and pair == (3, 1):
                printed[MISPRINT[2]] += " ¹"
            cells = [_three(d.differences_pct[pair], ".2f") for d in (at[f], explained[f])]
            lines.append((f"{f} Hz", f"{pair[0]} - {pair[1]}", " · ".join(printed), *cells))
    table = _table(("", "methods", "paper", "bench without faults", "bench with the faults below"), lines)
    note = ""
    if device is MEMS:
        note = """

¹ A misprint: d₃₂ is -0.93 only if d₃₁ is -1.1. All other entries of both tables follow from each other within
their rounding (`tests/unit/test_paper_tables.py`)."""
    transverse = max(float(np.nanmax(np.abs(r))) for c in at.values() for r in c.rel_s_pct.values())
    return f"""## {device.name[0].upper()}{device.name[1:]}

**Table {TABLE[device.key]}.** Differences d_rel of S_xx · S_yy · S_zz in %, at 10 m/s².

{table}{note}

Without faults Methods 1 and 3 agree to {_worst(at, (3, 1)):.3f} %. Method 2 differs because it neglects the
transverse sensitivities. Transverse sensitivities of at most {transverse:.1f} % (paper: all under
{TRANSVERSE_PCT[device.key]:g} %) explain the paper's differences between Methods 2 and 1.

{_offsets(device, found)}

![Rows of S in space](paper/rows-{device.key}.svg)

**Figures {rows}.** Rows of the sensitivity matrix in the notation of Figure 6.

![Main sensitivities by method](paper/methods-{device.key}.svg)

**Figures {bars}.** Main sensitivities with expanded uncertainty (k = 2).
Crosses: values calculated from the printed d_rel."""


def _offsets(device: Device, found: Findings) -> str:
    explained = {e.frequency_hz: e.found for e in found.explained if e.device is device}
    lines = []
    for f in FREQUENCIES_HZ:
        printed = " · ".join(f"{q:g}" for q in OFFSET[device.key, f])
        cells = [_three(c.offset, ".4f") for c in (found.at[device.key][f], explained[f])]
        lines.append((f"{f} Hz", printed, *cells))
    head = ("", "paper", "bench without faults", "bench with the faults below")
    return f"Offset q_x · q_y · q_z of Method 3 in {device.unit}:\n\n{_table(head, lines)}"


def _repeatability(found: Findings) -> str:
    lines = []
    for device in DEVICES:
        for method in METHODS:
            worst = [c.s_rel_pct[method].max() for c in found.at[device.key].values()]
            lines.append((device.name, method, f"< {REPEATABILITY_PCT[device.key][method]:g}", f"{max(worst):.3f}"))
    return f"""## Repeatability

s_rel over the six cycles (Appendix A) at 10 m/s², in %: the largest of three repetitions, three axes and both
frequencies. White noise of {MEMS.noise_mps2:g} m/s² on the sensor gives values of the paper's order. s_rel is
inversely proportional to the amplitude.

{_table(("sensor", "method", "paper", "bench"), lines)}

![s_rel over amplitude](paper/repeatability.svg)"""


def _uncertainty(found: Findings) -> str:
    lines = [
        (
            row.device.name,
            row.method,
            f"{UNCERTAINTY_PCT[int(row.method)]:g}" if row.method.isdigit() else "",
            _three(row.gum_pct, ".2f"),
            _three(row.monte_carlo_pct, ".2f"),
            f"{row.within} of {row.errors}",
        )
        for row in found.drawn
    ]
    head = ("sensor", "method", "paper", "GUM", "Monte Carlo", "errors within U")
    return f"""## Uncertainty

Expanded uncertainty (k = 2) of S_xx · S_yy · S_zz in %, 3 Hz. For the Monte Carlo, virtual benches and sensors are
drawn from the stated uncertainties, with transverse sensitivities anywhere below the verified limit. The last column
counts the errors of the three axes that lie within U. The Monte Carlo shares no code with the budgets.

{_table(head, lines)}

![Budget by source](paper/budgets.svg)

The main source of the 3 % of Method 3 is the half degree in θ. The main source of the 5 % of Method 2 are the
transverse sensitivities, which are only known to be small. The adjustment (`calib/estimate/`, "3, adjusted") uses the
recordings of Method 3 and the same stated uncertainties. With the DC-coupled sensor it can estimate θ from the data."""


def _alone(found: Findings) -> str:
    tables = "\n\n".join(_alone_table(device, found.alone[device.key]) for device in DEVICES)
    tilted = next(row for row in found.alone[MEMS.key] if row.name.startswith("θ")).at[3]
    residual = float(tilted.three.residual_sd.max())
    return f"""## Which fault explains differences like the paper's

In each row there is one fault alone, and no noise. In the first row there is no fault: its d₂₁ comes from the
transverse sensitivities, which Method 2 neglects. d₂₁ is the same at both frequencies.

{tables}

The methods differ because the same fault affects each of them differently. An error of half a degree in θ moves S_zz
of the MEMS by {tilted.differences_pct[3, 1][2]:.1f} % in Method 3 and leaves a residual of only {residual:.2f} m/s²:
the residual does not reveal it. Only two kinds of fault make the results of Method 3 different at 3 Hz and 6 Hz:
faults that change the phase (a lag, the corner of an AC-coupled instrument), and faults that change from run to run
(angles set anew, offsets)."""


def _alone_table(device: Device, rows: Sequence[Alone]) -> str:
    head = ["fault", "d₂₁", "d₃₁, 3 Hz", "d₃₁, 6 Hz", *(["q, 3 Hz", "q, 6 Hz"] if device.dc else [])]
    lines = []
    for row in rows:
        cells = [row.at[f].differences_pct[pair] for pair, f in (((2, 1), 3), ((3, 1), 3), ((3, 1), 6))]
        q = [_three(row.at[f].offset, ".3f") for f in FREQUENCIES_HZ] if device.dc else []
        lines.append((row.name, *(_three(cell, ".2f") for cell in cells), *q))
    units = "% (q in m/s²)" if device.dc else "%"
    return f"{device.name[0].upper()}{device.name[1:]}, x · y · z in {units}:\n\n{_table(head, lines)}"


def _explained(found: Findings) -> str:
    lines = []
    for e in found.explained:
        largest = "; ".join(_pull(name, size) for name, size in list(e.pulls.items())[:6])
        lines.append((e.device.name, f"{e.frequency_hz} Hz", f"{e.chi2:.0f} of {e.numbers}", largest))
    factors = [f"{np.sqrt(e.chi2 / e.numbers):.1f}" for e in found.explained if e.device is MEMS]
    moved = abs(OFFSET[MEMS.key, 3][0] - OFFSET[MEMS.key, 6][0])
    return f"""## The smallest faults that give the paper's numbers

Which faults would give exactly the printed d₂₁ and d₃₁ and, for the MEMS, the printed Q? Many sets of faults would; the
table has the smallest set, in units of their stated standard uncertainties. Each frequency is treated as a separate
bench; the true Q of the MEMS is the mean of both. The last column of the tables above is the virtual bench with exactly
these faults. χ² compares the paper's numbers with the stated uncertainties. If the stated uncertainties explain the
numbers, χ² is about as large as the count of the numbers.

{_table(("sensor", "", "χ²", "largest faults, in units of their u"), lines)}

For the piezo-electric sensor at 3 Hz the stated uncertainties explain the numbers. At 6 Hz the numbers need a lag
between sensor and vibrometer. The numbers of the MEMS, with its Q, need {" and ".join(factors)} times the stated
uncertainties, spread over many faults. Its data came over USB with a clock of its own, and q_x changed by {moved:.2f}
m/s² between two fits of the same sensor. So the cause is geometry, offset and time in the fit, not the sensor; the
adjustment has these as unknowns. The printed numbers cannot show which of these faults the bench had, because there
are more faults than numbers."""


def _pull(name: str, size: float) -> str:
    if name.endswith("second order"):
        return f"lag {1000 * STATED.lag_s * np.sqrt(size):.1f} ms ({np.sqrt(size):.1f})"
    readable = name.replace("transverse_", "motion across, ").replace("_", " ").replace(" deg", "°")
    return f"{readable} {size:+.1f}"


def _worst(at: Mapping[int, Comparison], pair: tuple[int, int]) -> float:
    return max(float(np.abs(c.differences_pct[pair]).max()) for c in at.values())


def _three(values: Array, style: str) -> str:
    texts = [f"{v:{style}}" for v in values]
    return " · ".join(text.lstrip("-") if float(text) == 0 else text for text in texts)


def _list(values: Iterable[float]) -> str:
    return ", ".join(f"{v:g}" for v in values)


def _table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)
