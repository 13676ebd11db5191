"""Writes values with their uncertainties for people."""

from __future__ import annotations

import math

KNOWN_BEFORE = "*"  # marks a parameter that a nominal value or a prior tells rather than the data


def plus_minus(value: float | None, expanded: float | None) -> str:
    """`value ± U`, both rounded to the second digit of U; `–` if there is no value."""
    if value is None or not math.isfinite(value):
        return "–"
    if expanded is None or not math.isfinite(expanded) or expanded <= 0:
        return f"{value:.6g} ± ?"
    decimals = max(0, 1 - math.floor(math.log10(expanded)))
    return f"{value:.{decimals}f} ± {expanded:.{decimals}f}"


def rounded(value: float) -> str:
    """The value with two digits that count: 330, 0.017."""
    return f"{float(f'{value:.2g}'):g}"


def from_to(low: float, high: float) -> str:
    """`low to high`, with as many digits, three at least, as show that they differ."""
    texts = [(f"{low:.{digits}g}", f"{high:.{digits}g}") for digits in range(3, 8)]
    return " to ".join(next((both for both in texts if both[0] != both[1]), texts[0]))
