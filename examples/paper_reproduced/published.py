"""Numbers printed in the paper: D'Emilia, Gaspari, Mazzoleni, Natale, Schiavi, Part 1, J. Sens. Sens. Syst. 7, 2018."""

from __future__ import annotations

Pair = tuple[int, int]
Printed = tuple[str, str, str]


def _rows(d_21: str, d_31: str, d_32: str) -> dict[Pair, Printed]:
    rows = [text.split() for text in (d_21, d_31, d_32)]
    return {pair: (x, y, z) for pair, (x, y, z) in zip(((2, 1), (3, 1), (3, 2)), rows, strict=True)}


# Tables 3 and 4, d_rel (S_xx, S_yy, S_zz) in %, as printed; the number of digits gives the rounding.
DIFFERENCES_PCT: dict[tuple[str, int], dict[Pair, Printed]] = {
    ("piezo", 3): _rows("0.51 1.3 2.0", "-0.18 -0.24 0.91", "-0.69 -1.5 -1.1"),
    ("piezo", 6): _rows("0.54 1.2 1.9", "-0.20 -1.1 -1.3", "-0.74 -2.3 -3.2"),
    ("mems", 3): _rows("0.73 -0.12 -0.19", "2.8 -0.49 1.1", "2.1 -0.37 -0.93"),
    ("mems", 6): _rows("0.68 -0.25 0.11", "1.8 1.5 1.4", "1.1 1.7 1.3"),
}
# In this entry the printed d_31 of 1.1 contradicts the other two differences; it must be -1.1.
MISPRINT = ("mems", 3, 2)

# Sections 3.1.3 and 3.2.3, Q of Method 3 in output unit (mV, m/s2).
OFFSET: dict[tuple[str, int], tuple[float, float, float]] = {
    ("piezo", 3): (0.3113, 0.5427, 0.06098),
    ("piezo", 6): (0.2477, 0.5668, 0.5839),
    ("mems", 3): (0.3576, -0.06304, 0.1650),
    ("mems", 6): (0.1662, -0.07268, 0.1345),
}

# Upper bounds of s_rel of the main sensitivities, in %, by method.
REPEATABILITY_PCT: dict[str, dict[int, float]] = {
    "piezo": {1: 0.03, 2: 0.04, 3: 0.08},
    "mems": {1: 0.02, 2: 0.09, 3: 0.06},
}
# Upper bounds of the relative transverse sensitivities, in %.
TRANSVERSE_PCT: dict[str, float] = {"piezo": 3.0, "mems": 4.0}
# Section 3.3: "relative uncertainty of the order of", in %, by method.
UNCERTAINTY_PCT: dict[int, float] = {1: 0.5, 2: 5.0, 3: 3.0}


def decimals(text: str) -> int:
    """Digits after the point of a printed number."""
    return len(text.partition(".")[2])


def corrected_pct(device: str, frequency_hz: int, pair: Pair) -> tuple[float, float, float]:
    """A row of Table 3 or 4 as numbers, with the misprint corrected."""
    x, y, z = (float(text) for text in DIFFERENCES_PCT[device, frequency_hz][pair])
    if (device, frequency_hz) == MISPRINT[:2] and pair == (3, 1):
        z = -z
    return x, y, z
