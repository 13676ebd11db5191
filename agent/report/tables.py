"""Numbers of a result as HTML tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from agent.report.result import CalibrationResult
from agent.report.trace import Residuals
from agent.report.units import in_words, offset_unit, output_unit, position_name, sensitivity_unit
from agent.terminal.text import page_text
from calib.model import PARAMETERS
from calib.output_unit import ACCELERATION
from calib.rounding import plus_minus

AXES = "xyz"
MOST_ROWS = 200  # of windows; report.json has all
NOT_KNOWN = "not determined"
KNOWN_BEFORE = "known before"  # a parameter whose value the prior tells rather than the data


def table(
    heads: Sequence[str], rows: Iterable[Sequence[str]], style: str = "", text: frozenset[int] = frozenset()
) -> str:
    """An HTML table of escaped cells. Columns in `text` are aligned to the left and may wrap."""

    def cell(tag: str, k: int, content: str) -> str:
        return f"<{tag}{' class=text' if k in text else ''}>{page_text(content)}</{tag}>"

    head = "".join(cell("th", k, h) for k, h in enumerate(heads))
    body = "".join("<tr>" + "".join(cell("td", k, c) for k, c in enumerate(row)) + "</tr>" for row in rows)
    return f'<div class="wide {style}"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def number(value: float | None, digits: int = 4) -> str:
    """A number with few digits; `–` if there is none, `∞` if it is infinite."""
    if value is None or math.isnan(value):
        return "–"
    return ("∞" if value > 0 else "−∞") if math.isinf(value) else f"{value:.{digits}g}".replace("-", "−")


def matrix(result: CalibrationResult) -> str:
    """S and Q, each with ± U."""
    cells = [_cell(result, k) for k in range(12)]
    rows = [[axis, *cells[3 * i : 3 * i + 3], cells[9 + i]] for i, axis in enumerate(AXES)]
    return table(["", "S along x", "S along y", "S along z", "Q"], rows, "matrix")


def parameters(result: CalibrationResult) -> str:
    """All twelve parameters with u, U, k and degrees of freedom."""
    units = [sensitivity_unit(result.unit)] * 9 + [offset_unit(result.unit)] * 3
    rows = [
        [
            f"{name[0]} {name[1:]}",
            number(result.values[k], 7),
            number(result.standard_uncertainty[k]),
            number(result.expanded_uncertainty[k]),
            number(result.coverage_factor[k], 3) if result.determined[k] else "–",
            number(result.degrees_of_freedom[k]),
            "yes" if result.determined[k] else "no",
            units[k],
        ]
        for k, name in enumerate(PARAMETERS)
    ]
    return table(["", "value", "u", "U", "k", "degrees of freedom", "determined", "unit"], rows)


def covariance(result: CalibrationResult) -> str:
    """The covariance, 12 x 12, in the units of the parameters."""
    rows = [[name, *(number(v, 3) for v in row)] for name, row in zip(PARAMETERS, result.covariance, strict=True)]
    return table(["", *PARAMETERS], rows, "small")


def nuisances(result: CalibrationResult) -> str:
    """The nuisances, which were estimated together with S and Q."""
    rows = []
    for name, held in (result.fields.get("nuisances") or {}).items():
        held = held if isinstance(held, Mapping) else {"value": held}
        value, u = held.get("value"), held.get("standard_uncertainty")
        rows.append([name, number(value), number(u), str(held.get("unit") or "1")])
    return table(["nuisance", "value", "u", "unit"], rows)


def budget(result: CalibrationResult) -> str:
    """The standard uncertainty of each parameter from each source."""
    rows = [[name, *(number(u, 3) for u in values)] for name, values in result.budget.items()]
    rows.append(["all", *(number(u, 3) for u in result.standard_uncertainty)])
    return table(["source", *PARAMETERS], rows, "small")


def windows(result: CalibrationResult) -> str:
    """Each window with its verdict; only the newest MOST_ROWS if there are more."""
    rows = [
        [
            f"{w.start_s:.2f}",
            f"{w.stop_s:.2f}",
            position_name(w.position),
            {"used": "yes", "held": "held"}.get(w.verdict, "no"),
            str(w.points),
            str(w.left_out),
            w.reason,
        ]
        for w in result.windows[-MOST_ROWS:]
    ]
    return table(
        ["start in s", "stop in s", "position", "used", "points", "left out", "reason"], rows, "windows", frozenset({6})
    )


def statistics(held: Mapping[str, Any]) -> str:
    """Appendix A: a row for each parameter and run, and below the statistics without runs."""
    runs = {name: value for name, value in held.items() if isinstance(value, list) and _are_runs(value)}
    rest = facts({name: value for name, value in held.items() if name not in runs})
    if not runs:
        return rest
    heads = list(next(iter(runs.values()))[0])
    rows = [
        [name, str(k), *(_words(run.get(head)) for head in heads)]
        for name, of_name in runs.items()
        for k, run in enumerate(of_name, start=1)
    ]
    return table(["parameter", "run", *(in_words(head) for head in heads)], rows) + rest


def _are_runs(value: list[Any]) -> bool:
    return bool(value) and all(isinstance(run, Mapping) for run in value)


def over_frequency(result: CalibrationResult) -> str:
    """|S_ii| with U in each band of frequency in which it is known."""
    k = result.coverage_factor[[0, 4, 8]]
    rows = []
    for band in result.frequencies.bands:
        re, im, u = (
            np.diag(np.array(m, dtype=float))
            for m in (band.sensitivity_re, band.sensitivity_im, band.standard_uncertainty)
        )
        known = zip(np.hypot(re, im), k * u, strict=True)
        cells = [plus_minus(float(S), float(U)) if np.isfinite(S) else NOT_KNOWN for S, U in known]
        rows.append([f"{band.low_hz:.3g} to {band.high_hz:.3g}", *cells])
    return table(["Hz", *(f"|S{axis}{axis}|" for axis in AXES)], rows)


def left_over(seen: Sequence[Residuals], result: CalibrationResult) -> str:
    """Root mean square of the residual of each window, in the output unit and as acceleration."""
    unit = output_unit(result.unit)
    main = np.abs(np.diag(result.sensitivity))
    with_acceleration = unit != ACCELERATION
    heads = ["position", *(f"{axis} in {unit}" for axis in AXES)]
    heads += [f"{axis} in {ACCELERATION}" for axis in AXES] if with_acceleration else []
    rows = [
        [
            position_name(r.position),
            *(number(v, 3) for v in r.rms),
            *((number(v, 3) for v in r.rms / main) if with_acceleration else ()),
        ]
        for r in seen
    ]
    return table(heads, rows)


def facts(pairs: Mapping[str, Any]) -> str:
    """Names and values."""
    rows = [[in_words(name), _words(value)] for name, value in pairs.items() if value not in (None, "", [], {})]
    return table(["", ""], rows, "words", frozenset({1})) if rows else ""


def _cell(result: CalibrationResult, k: int) -> str:
    """Value ± U, which may wrap before ± only."""
    if not np.isfinite(result.values[k]):
        return NOT_KNOWN
    text = plus_minus(float(result.values[k]), float(result.expanded_uncertainty[k])).replace("-", "−")
    text = text.replace("± ", "±\N{NO-BREAK SPACE}")
    return text if result.determined[k] else f"{text} ({KNOWN_BEFORE})"


def _words(value: Any) -> str:
    """A value from JSON as text; lists and objects inside it are in brackets."""
    if isinstance(value, Mapping):
        held = {name: item for name, item in value.items() if item not in (None, "", [], {})}
        nests = {name for name, item in held.items() if isinstance(item, Mapping | list)}
        return ", ".join(
            f"{in_words(name)} ({_words(v)})" if name in nests else f"{in_words(name)} {_words(v)}"
            for name, v in held.items()
        )
    if isinstance(value, list | tuple):
        return ", ".join(f"({_words(v)})" if isinstance(v, list | Mapping) else _words(v) for v in value)
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "–"}[value]
    return number(value, 7) if isinstance(value, float) else str(value)
