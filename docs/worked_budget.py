"""The tables of docs/budget.md, from one calibration of the plain virtual bench.

`.venv/bin/python -m docs.worked_budget` writes them; `tests/unit/test_docs_site.py` fails when they are stale.
"""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from pathlib import Path
from typing import Any

PAGE = Path(__file__).with_name("budget.md")
BEGIN, END = "<!-- worked: begin -->", "<!-- worked: end -->"
SHOWN = ("Sxx", "Szz", "Szx", "Qz")
NAMES = ["Sxx", "Sxy", "Sxz", "Syx", "Syy", "Syz", "Szx", "Szy", "Szz", "Qx", "Qy", "Qz"]
LEAST = 0.02  # of the combined standard uncertainty; smaller lines are summed


def result() -> dict[str, Any]:
    """The result of the two commands on the page."""
    from agent.cli.main import run_cli

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        site = Path(folder)
        assert run_cli(["simulate", "--preset", "plain", "--csv", folder]) == 0
        files = [word for name in ("sensor", "reference", "poses") for word in (f"--{name}", str(site / f"{name}.csv"))]
        assert run_cli(["calibrate", *files, "--json", str(site / "result.json")]) == 0
        found: dict[str, Any] = json.loads((site / "result.json").read_text())
    return found


def table(found: dict[str, Any]) -> str:
    """The budget of the parameters SHOWN: standard uncertainties, two digits."""
    variance = dict(zip(NAMES, (found["covariance"][k][k] for k in range(12)), strict=True))
    lines = {source: [of[name] for name in SHOWN] for source, of in found["budget"].items()}
    combined = [variance[name] ** 0.5 for name in SHOWN]
    kept = {
        source: values
        for source, values in lines.items()
        if any(value >= LEAST * u for value, u in zip(values, combined, strict=True))
    }
    rest = [sum(lines[s][k] ** 2 for s in lines if s not in kept) ** 0.5 for k in range(len(SHOWN))]
    rows = [("source", *(f"u({name})" for name in SHOWN)), ("---",) * (len(SHOWN) + 1)]
    ordered = sorted(kept.items(), key=lambda line: -max(v / u for v, u in zip(line[1], combined, strict=True)))
    rows += [(source, *map(_shown, values, combined)) for source, values in ordered]
    rows.append((f"{len(lines) - len(kept)} sources below {100 * LEAST:.0f} % of u", *map(_shown, rest, combined)))
    rows.append(("**combined, u**", *(f"**{_shown(u, u)}**" for u in combined)))
    k = found["expanded_uncertainty"]["coverage_factor"]
    rows.append((f"**expanded, U = {k:.3g} u**", *(f"**{_shown(k * u, u)}**" for u in combined)))
    values = dict(zip(NAMES, [*(s for row in found["sensitivity"] for s in row), *found["offset"]], strict=True))
    rows.append(("value", *(f"{values[name]:.5g}" for name in SHOWN)))
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _shown(value: float, combined: float) -> str:
    """Two digits; 0 for what is below a thousandth of the combined standard uncertainty."""
    return f"{float(f'{value:.2g}'):g}" if value >= 1e-3 * combined else "0"


def page(found: dict[str, Any]) -> str:
    """The page with today's table."""
    before, _, rest = PAGE.read_text("utf-8").partition(BEGIN)
    return f"{before}{BEGIN}\n{table(found)}\n{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    PAGE.write_text(page(result()), "utf-8")
