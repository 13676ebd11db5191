"""Writes values with their uncertainties for people."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

KNOWN_BEFORE = "*"  # marks a parameter that a nominal value or a prior tells rather than the data


def plus_minus(value: float | None, expanded: float | None) -> str:
    """`value ± U`, both rounded to the second digit of U (GUM 7.2.6); `–` if there is no value."""
    if value is None or not math.isfinite(value):
        return "–"
    if expanded is None or not math.isfinite(expanded) or expanded <= 0:
        return f"{value:.6g} ± ?"
    decimals = 1 - int(f"{expanded:.1e}".partition("e")[2])  # below 0: tens, hundreds, ...
    told = [round(number, decimals) + 0.0 for number in (value, expanded)]  # + 0.0: no value is -0
    return " ± ".join(f"{number:.{max(0, decimals)}f}" for number in told)


def rounded(value: float) -> str:
    """The value with two digits that count: 330, 0.017."""
    return f"{float(f'{value:.2g}'):g}"


def aligned(rows: Sequence[Sequence[str]], words: Sequence[int] = (0,)) -> Iterator[str]:
    """The rows of a table, each as one line. Columns of `words` begin together, the others end together."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = zip(row, widths, strict=True)
        told = [cell.ljust(width) if k in words else cell.rjust(width) for k, (cell, width) in enumerate(cells)]
        yield "  ".join(told).rstrip()


def from_to(low: float, high: float) -> str:
    """`low to high`, with as many digits, three at least, as show that they differ."""
    texts = [(f"{low:.{digits}g}", f"{high:.{digits}g}") for digits in range(3, 8)]
    return " to ".join(next((both for both in texts if both[0] != both[1]), texts[0]))
