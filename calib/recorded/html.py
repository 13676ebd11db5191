"""A result as HTML, as a notebook shows it: in the colours of the page, light or dark."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape

from calib.model import PARAMETERS, Window
from calib.recorded.measurement_result import MeasurementResult
from calib.recorded.told import largest_sources, notes_of, parameters_of, rows_of
from calib.rounding import rounded

MOST_WINDOWS = 20  # that are listed with the reason why they are not used
TABLE = 'style="color: inherit; font: inherit"'  # in quirks mode a browser does not hand these on to a table
CELL = 'style="text-align: right; padding: 0.15em 0.8em; white-space: nowrap"'


def html_of(result: MeasurementResult) -> str:
    """S and Q with U, the status with its reasons, and what else tells whether to use them."""
    return f"<div>{''.join(_parts(result))}</div>"


def _parts(result: MeasurementResult) -> Iterator[str]:
    used = sum(window.used for window in result.windows)
    windows = f"{used} of {len(result.windows)} windows used"
    yield f"<p><b>{result.status}</b>: method {escape(result.method)}, {windows}</p>"
    if result.warnings:
        yield f"<ul>{''.join(f'<li><b>Warning: {escape(warning)}</b></li>' for warning in result.warnings)}</ul>"
    if result.reasons:
        yield f"<ul>{''.join(f'<li>{escape(reason)}</li>' for reason in result.reasons)}</ul>"
    if result.calibration is not None:
        yield _table(("", "Sx", "Sy", "Sz", "Q"), rows_of(result))
        yield f"<p>{'. '.join(_notes(result))}.</p>"
        yield _sources(result)
    unused = [window for window in result.windows if not window.used]
    if unused:
        yield _unused(unused)


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th {CELL}>{escape(name)}</th>" for name in heads)
    told = [(f"<b>{escape(first)}</b>", *map(escape, rest)) for first, *rest in rows]
    body = "".join(f"<tr>{''.join(f'<td {CELL}>{cell}</td>' for cell in row)}</tr>" for row in told)
    return f"<table {TABLE}><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _notes(result: MeasurementResult) -> Iterator[str]:
    yield from map(escape, notes_of(result))
    if result.lag_s is not None:
        yield f"The sensor lags by {1000.0 * result.lag_s:.3g} ms"
    yield f"Sampling rate {result.rate_hz:.7g} Hz"


def _sources(result: MeasurementResult) -> str:
    """The largest sources of U and what makes them smaller; "" where nothing is known of them."""
    rows = [(s.name, *map(rounded, s.expanded), s.way) for s in largest_sources(result)]
    heads = ["largest sources", *(f"U({PARAMETERS[k]})" for k in parameters_of(result)), "smaller with"]
    return _table(heads, rows) if rows else ""


def _unused(windows: Sequence[Window]) -> str:
    told = [f"{w.start_s:.3f} to {w.stop_s:.3f} s, {w.pose.position}: {w.reason}" for w in windows[:MOST_WINDOWS]]
    if len(windows) > MOST_WINDOWS:
        told.append(f"and {len(windows) - MOST_WINDOWS} more")
    lines = "".join(f"<li>{escape(line)}</li>" for line in told)
    return f"<details><summary>{len(windows)} windows not used</summary><ul>{lines}</ul></details>"
