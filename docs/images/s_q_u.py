"""The picture of docs/s-q-u.md: what S, Q and U do to accelerations of one size, in two of the three axes.

`.venv/bin/python -m docs.images.s_q_u` writes docs/images/s_q_u.svg; `tests/unit/test_docs_site.py` fails when it is
stale.
"""

from __future__ import annotations

import math
from pathlib import Path

DRAWING = Path(__file__).with_suffix(".svg")
SIZE, RADIUS = 300, 80
# S and Q are larger than those of a good sensor, so that they are seen; U is a tenth of the main sensitivity.
S = ((1.15, 0.25), (-0.15, 0.85))
Q = (0.30, -0.20)
U = 0.10
BLUE, RED, GREY = "#1f6fb4", "#c0392b", "#888888"


def drawing() -> str:
    """The SVG."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {2 * SIZE + 60} {SIZE + 70}" '
        'font-family="sans-serif" font-size="13">',
        '<rect width="100%" height="100%" fill="white"/>',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0 8 4 0 8z" fill="context-stroke"/></marker></defs>',
    ]
    left, right = (SIZE / 2 + 10, SIZE / 2 + 30), (SIZE * 1.5 + 50, SIZE / 2 + 30)
    for at, title, axes in ((left, "acceleration a", ("ax", "ay")), (right, "indication V = S a + Q", ("Vx", "Vy"))):
        parts += _axes(at, title, axes)
    parts.append(_curve(left, lambda angle: (math.cos(angle), math.sin(angle)), BLUE))
    parts.append(_curve(right, _indicated, BLUE))
    for sign in (1 - U, 1 + U):
        parts.append(_curve(right, lambda angle, sign=sign: _indicated(angle, sign), BLUE, dashed=True))
    for k, name in enumerate(("1 m/s² along x", "1 m/s² along y")):
        tip = (1.0, 0.0) if k == 0 else (0.0, 1.0)
        parts.append(_arrow(left, (0, 0), tip, GREY))
        column = (Q[0] + S[0][k], Q[1] + S[1][k])
        parts.append(_arrow(right, Q, column, GREY))
        parts.append(_text(left, tip, name, (-66, 22) if k == 0 else (8, -8)))
    parts.append(_arrow(right, (0, 0), Q, RED))
    parts.append(_text(right, Q, "Q", (2, 18), RED))
    parts.append(_text(right, (Q[0] + S[0][0], Q[1] + S[1][0]), "Sxx, Syx", (-46, 20)))
    parts.append(_text(right, (Q[0] + S[0][1], Q[1] + S[1][1]), "Sxy, Syy", (8, -14)))
    parts.append(_text(right, (-1.42, -1.45), "between the dashed lines: S within ± U", (-6, 0), BLUE))
    return "\n".join([*parts, "</svg>", ""])


def _indicated(angle: float, scale: float = 1.0) -> tuple[float, float]:
    a = scale * math.cos(angle), scale * math.sin(angle)
    return Q[0] + S[0][0] * a[0] + S[0][1] * a[1], Q[1] + S[1][0] * a[0] + S[1][1] * a[1]


def _at(centre: tuple[float, float], point: tuple[float, float]) -> tuple[float, float]:
    return round(centre[0] + RADIUS * point[0], 1), round(centre[1] - RADIUS * point[1], 1)


def _axes(centre: tuple[float, float], title: str, names: tuple[str, str]) -> list[str]:
    found = [_text(centre, (0, 1.75), title, (-50, 0))]
    for name, tip in zip(names, ((1.85, 0.0), (0.0, 1.55)), strict=True):
        (x1, y1), (x2, y2) = _at(centre, (-tip[0], -tip[1])), _at(centre, tip)
        found.append(f'<path d="M{x1} {y1} {x2} {y2}" stroke="{GREY}" stroke-width="0.6"/>')
        found.append(_text(centre, tip, name, (-14, -5) if tip[0] else (6, 8), GREY))
    return found


def _curve(centre, of, colour: str, dashed: bool = False) -> str:  # type: ignore[no-untyped-def]
    points = [_at(centre, of(2 * math.pi * k / 90)) for k in range(91)]
    path = " ".join(f"{x} {y}" for x, y in points)
    dash = ' stroke-dasharray="4 3" stroke-width="1"' if dashed else ' stroke-width="2"'
    return f'<path d="M{path}" fill="none" stroke="{colour}"{dash}/>'


def _arrow(centre: tuple[float, float], begin: tuple[float, float], end: tuple[float, float], colour: str) -> str:
    (x1, y1), (x2, y2) = _at(centre, begin), _at(centre, end)
    return f'<path d="M{x1} {y1} {x2} {y2}" stroke="{colour}" stroke-width="1.6" marker-end="url(#tip)"/>'


def _text(
    centre: tuple[float, float],
    point: tuple[float, float],
    text: str,
    shift: tuple[float, float],
    colour: str = "#222222",
) -> str:
    x, y = _at(centre, point)
    return f'<text x="{round(x + shift[0], 1)}" y="{round(y + shift[1], 1)}" fill="{colour}">{text}</text>'


if __name__ == "__main__":
    DRAWING.write_text(drawing(), "utf-8")
