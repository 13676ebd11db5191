"""Draws docs/images/import_graph.svg from the code: which room imports which; and lists it in docs/architecture.md.

python -m docs.images.import_graph

A room is a sub-package of `agent` or `calib`, or a file of `calib` beside them; `hw`, `hw.virtual`, `hw.conformance`.
The list names all imports. The drawing leaves out an arrow where a longer way leads to the same room, so that it can be
read. Imports for type checking alone do not count.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import grimp

from benchmarks.page import write_part

HERE = Path(__file__).parent
DRAWING = HERE / "import_graph.svg"
PAGE = HERE.parent / "architecture.md"
Imports = Mapping[str, frozenset[str]]  # by room, sorted: the rooms that it imports
Edge = tuple[str, str]

BOX_WIDTH, BOX_HEIGHT, ROW, GAP, MARGIN = 138, 30, 76, 22, 16  # in px
COLOURS = {"agent": ("#dbe9f6", "#2b6cb0"), "calib": ("#fdebd0", "#b9770e"), "hw": ("#d5f0dd", "#1e8449")}
SWEEPS = 12  # of the ordering; more change nothing


def imports_of_rooms() -> Imports:
    """Who imports whom, as the code stands."""
    graph = grimp.build_graph("agent", "calib", "hw", exclude_type_checking_imports=True, cache_dir=None)
    found: dict[str, set[str]] = {}
    for module in sorted(graph.modules):
        if (room := _room(module)) is None:
            continue
        others = found.setdefault(room, set())
        others |= {other for m in graph.find_modules_directly_imported_by(module) if (other := _room(m))}
        others.discard(room)
    return {room: frozenset(found[room]) for room in sorted(found)}


def _room(module: str) -> str | None:
    """Of a module; None for a package itself (it holds a version or a list of names) and the command's entry."""
    package, *rest = module.split(".")
    if package == "hw":
        return f"hw.{rest[0]}" if rest and rest[0] in ("virtual", "conformance") else "hw"
    return f"{package}.{rest[0]}" if rest and rest[0] != "__main__" else None


def table(imports: Imports) -> str:
    """All imports between rooms, in Markdown."""
    rows = [f"| `{room}` | {', '.join(f'`{r}`' for r in sorted(to)) or 'none'} |" for room, to in imports.items()]
    return "\n".join(["| room | imports directly |", "| --- | --- |", *rows])


def drawing(imports: Imports) -> str:
    """The SVG, rooms above those that they import."""
    row = _rows(imports)
    ways = [_way(edge, row) for edge in _needed(imports)]
    at = _places(imports, row, ways)
    width = max(x for x, _ in at.values()) + BOX_WIDTH / 2 + MARGIN
    height = ROW * max(row.values()) + BOX_HEIGHT + 2 * MARGIN
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        'font-family="sans-serif" font-size="13">',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
        'orient="auto-start-reverse"><path d="M0 0 8 4 0 8z" fill="#555"/></marker></defs>',
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#fff"/>',
        *(_arrow([at[node] for node in way]) for way in ways),
        *(_box(room, *at[room]) for room in imports),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _needed(imports: Imports) -> list[Edge]:
    """The arrows that no longer way replaces."""
    reached: dict[str, set[str]] = {}

    def below(room: str) -> set[str]:
        if room not in reached:
            reached[room] = set().union(*({other} | below(other) for other in imports[room]))
        return reached[room]

    return [
        (room, other)
        for room, others in imports.items()
        for other in sorted(others)
        if not any(other in below(third) for third in others)
    ]


def _rows(imports: Imports) -> dict[str, int]:
    """The row of each room: one below the lowest of those that import it; 0 is the uppermost."""
    row: dict[str, int] = {}

    def place(room: str) -> int:
        if room not in row:
            row[room] = max((place(by) + 1 for by, others in imports.items() if room in others), default=0)
        return row[room]

    for room in imports:
        place(room)
    return row


def _way(edge: Edge, row: Mapping[str, int]) -> list[str]:
    """The rooms of an arrow with a bend in each row between them."""
    first, last = edge
    return [first, *(f"{first}>{last}#{r}" for r in range(row[first] + 1, row[last])), last]


def _places(imports: Imports, row: Mapping[str, int], ways: Sequence[Sequence[str]]) -> dict[str, tuple[float, float]]:
    """Middle of each room and each bend: every row is put in the order of what its members are joined to."""
    levels: list[list[str]] = [[] for _ in range(max(row.values()) + 1)]
    for room in imports:
        levels[row[room]].append(room)
    joined: dict[str, list[str]] = {room: [] for room in imports}
    for way in ways:
        for k, node in enumerate(way[1:-1], start=row[way[0]] + 1):
            levels[k].append(node)
            joined[node] = []
        for a, b in itertools.pairwise(way):
            joined[a].append(b)
            joined[b].append(a)
    x = {node: float(k) for level in levels for k, node in enumerate(_spaced(level, dict.fromkeys(level, 0.0)))}
    for _ in range(SWEEPS):
        for level in [*levels, *reversed(levels)]:
            wanted = {n: sum(x[m] for m in joined[n]) / len(joined[n]) if joined[n] else x[n] for n in level}
            x |= _spaced(level, wanted)
    left = min(x[room] for room in imports) - BOX_WIDTH / 2 - MARGIN
    return {n: (x[n] - left, MARGIN + BOX_HEIGHT / 2 + ROW * k) for k, level in enumerate(levels) for n in level}


def _spaced(level: Sequence[str], wanted: Mapping[str, float]) -> dict[str, float]:
    """As near to where they want to be as their widths allow, in that order (pooled, as in isotonic regression)."""
    order = sorted(level, key=lambda node: (wanted[node], node))
    offsets = [0.0]
    for a, b in itertools.pairwise(order):
        offsets.append(offsets[-1] + (_width(a) + _width(b)) / 2 + GAP)
    pools: list[list[float]] = []  # of wanted places, less the offset
    for node, offset in zip(order, offsets, strict=True):
        pools.append([wanted[node] - offset])
        while len(pools) > 1 and _mean(pools[-2]) > _mean(pools[-1]):
            pools[-2:] = [pools[-2] + pools[-1]]
    starts = [start for pool in pools for start in [_mean(pool)] * len(pool)]
    return {node: start + offset for node, start, offset in zip(order, starts, offsets, strict=True)}


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _width(node: str) -> float:
    return 0.0 if ">" in node else BOX_WIDTH


def _arrow(points: Sequence[tuple[float, float]]) -> str:
    (x, y), *_ = points
    path = [f"M{x:.0f} {y + BOX_HEIGHT / 2:.0f}"]
    for k, ((x0, y0), (x1, y1)) in enumerate(itertools.pairwise(points)):
        begin, end = y0 + BOX_HEIGHT / 2 if k == 0 else y0, y1 - BOX_HEIGHT / 2 if k == len(points) - 2 else y1
        half = (begin + end) / 2
        path.append(f"C{x0:.0f} {half:.0f} {x1:.0f} {half:.0f} {x1:.0f} {end:.0f}")
    return f'<path d="{" ".join(path)}" fill="none" stroke="#555" stroke-width="1.2" marker-end="url(#tip)"/>'


def _box(room: str, x: float, y: float) -> str:
    fill, stroke = COLOURS[room.partition(".")[0]]
    return (
        f'<rect x="{x - BOX_WIDTH / 2:.0f}" y="{y - BOX_HEIGHT / 2:.0f}" width="{BOX_WIDTH}" height="{BOX_HEIGHT}" '
        f'rx="5" fill="{fill}" stroke="{stroke}"/>'
        f'<text x="{x:.0f}" y="{y + 5:.0f}" text-anchor="middle">{room}</text>'
    )


def main() -> None:
    """Write the drawing and the list."""
    imports = imports_of_rooms()
    DRAWING.write_text(drawing(imports), encoding="utf-8")
    write_part("imports", table(imports))


if __name__ == "__main__":
    main()
