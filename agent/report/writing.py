"""The files of a report: report.html, report.json and the figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from agent import __version__
from agent.config.whole_files import write_together
from agent.delivery.history import StoredResult
from agent.report.figures import draw
from agent.report.material import Material
from agent.report.page import page
from agent.report.result import plain
from agent.report.trace import Residuals, residuals


def write(material: Material, output: Path) -> None:
    """Write report.html, report.json and figures/ into `output`, which is created if needed. Raises OSError."""
    seen = left_over(material)
    figures = draw(material, seen[-1] if seen else None, output / "figures")
    held = msgspec.json.format(msgspec.json.encode(as_object(material, seen, [drawn.name for drawn in figures])))
    write_together(output, {"report.html": page(material, figures, seen).encode(), "report.json": held + b"\n"})


def left_over(material: Material) -> list[Residuals]:
    """Residuals of the traced windows for the first result, without windows of which it determines no axis."""
    seen = [residuals(trace, material.results[0]) for trace in material.traces.values()]
    return [r for r in seen if np.isfinite(r.rms).any()]


def as_object(material: Material, seen: list[Residuals], figures: list[str]) -> dict[str, Any]:
    """The content of report.json: results as in `fieldcal calibrate --json -`, with their unit."""
    return {
        "version": __version__,
        "sensor": material.sensor,
        "results": [plain(r.fields) | dict.fromkeys(("unit", "output_unit"), r.unit or None) for r in material.results],
        "history": [StoredResult.of(update, recorded=True, recording="").fields for update in material.history],
        "residuals": [
            {"position": r.position, "start_s": plain(r.time_s[0]), "stop_s": plain(r.time_s[-1]), "rms": plain(r.rms)}
            for r in seen
        ],
        "facts": plain(material.facts),
        "files": material.files,
        "notices": material.notices,
        "figures": figures,
    }
