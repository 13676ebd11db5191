"""A result as HTML, as a notebook shows it: in the colours of the page, light or dark."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from typing import TYPE_CHECKING

from calib.model import Window
from calib.rounding import KNOWN_BEFORE

if TYPE_CHECKING:
    from calib.recorded.outcome import Outcome

MOST_WINDOWS = 20  # that are listed with the reason why they are not used
TABLE = 'style="color: inherit; font: inherit"'  # in quirks mode a browser does not hand these on to a table
CELL = 'style="text-align: right; padding: 0.15em 0.8em; white-space: nowrap"'


def html_of(outcome: Outcome) -> str:
    """S and Q with U, the status with its reasons, and what else tells whether to use them."""
    return f"<div>{''.join(_parts(outcome))}</div>"


def _parts(outcome: Outcome) -> Iterator[str]:
    used = sum(window.used for window in outcome.windows)
    windows = f"{used} of {len(outcome.windows)} windows used"
    yield f"<p><b>{outcome.status}</b>: method {escape(outcome.method)}, {windows}</p>"
    if outcome.reasons:
        yield f"<ul>{''.join(f'<li>{escape(reason)}</li>' for reason in outcome.reasons)}</ul>"
    if outcome.calibration is not None:
        yield _table(outcome)
        yield f"<p>{'. '.join(_notes(outcome))}.</p>"
    unused = [window for window in outcome.windows if not window.used]
    if unused:
        yield _unused(unused)


def _table(outcome: Outcome) -> str:
    cells = outcome.cells()
    rows = []
    for i, axis in enumerate("xyz"):
        row = [f"<b>{axis}</b>", *map(escape, [*cells[3 * i : 3 * i + 3], cells[9 + i]])]
        rows.append("".join(f"<td {CELL}>{cell}</td>" for cell in row))
    head = "".join(f"<th {CELL}>{name}</th>" for name in ("", "Sx", "Sy", "Sz", "Q"))
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    return f"<table {TABLE}><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _notes(outcome: Outcome) -> Iterator[str]:
    kind = f" ({escape(outcome.uncertainty_kind)})" if outcome.uncertainty_kind else ""
    yield f"S in output unit per m/s², Q in output unit, ± U with k = {outcome.coverage_factor:.3g}{kind}"
    if any(KNOWN_BEFORE in cell for cell in outcome.cells()):
        yield f"{KNOWN_BEFORE} known before: the data do not halve its uncertainty"
    if outcome.where_it_holds:
        yield outcome.where_it_holds
    if outcome.lag_s is not None:
        yield f"The sensor lags by {1000.0 * outcome.lag_s:.3g} ms"
    yield f"Sampling rate {outcome.rate_hz:.7g} Hz"


def _unused(windows: Sequence[Window]) -> str:
    told = [f"{w.start_s:.3f} to {w.stop_s:.3f} s, {w.pose.position}: {w.reason}" for w in windows[:MOST_WINDOWS]]
    if len(windows) > MOST_WINDOWS:
        told.append(f"and {len(windows) - MOST_WINDOWS} more")
    lines = "".join(f"<li>{escape(line)}</li>" for line in told)
    return f"<details><summary>{len(windows)} windows not used</summary><ul>{lines}</ul></details>"
