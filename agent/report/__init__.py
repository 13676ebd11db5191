"""`fieldcal report`: figures, one HTML page and the JSON of a calibration. Only this package draws (extra `report`)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from agent.report.material import Material
    from agent.report.trace import Residuals


@click.command()
@click.argument("inputs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="INPUT...")
@click.option("-o", "--output", type=click.Path(path_type=Path, file_okay=False), required=True, metavar="DIR",
              help="Where report.html, report.json and the figures go.")  # fmt: skip
@click.option("--unit", metavar="UNIT", help="Of the indications, where the result does not say it: mV, m/s2, count.")
@click.option("--sensor", metavar="NAME", help="Which one, where the input holds several; the name on the page.")
def report(inputs: tuple[Path, ...], output: Path, unit: str | None, sensor: str | None) -> int:
    """Figures and one page of a calibration.

    INPUT is RESULT.json of `fieldcal calibrate --json -` (several are compared), a recording (several are read one
    after the other), or the data directory of an agent: the calibration in force, with its history.

    Exit status 3 where the data were refused: the report then shows why. 2 where the input cannot be used.
    """
    try:
        import matplotlib  # noqa: F401 - asked for before any work is done
    except ImportError:
        click.echo("fieldcal report: figures need matplotlib: pip install 'fieldcal[report]'", err=True)
        return 1
    from agent.report.material import MaterialError, gather

    try:
        material = gather(inputs, sensor)
        _name_unit(material, unit)
    except MaterialError as error:
        click.echo(f"fieldcal report: {error}", err=True)
        return 2
    for notice in material.notices:
        click.echo(f"fieldcal report: {notice}", err=True)
    try:
        write(material, output)
    except OSError as error:
        click.echo(f"fieldcal report: {error.filename or output}: {error.strerror}", err=True)
        return 2
    click.echo(output / "report.html")
    return _status(material)


def _status(material: Material) -> int:
    refused = [result for result in material.results if result.refused]
    for result in refused:
        for reason in result.reasons:
            click.echo(f"refused: {reason}", err=True)
    return 3 if refused else 0


def _name_unit(material: Material, unit: str | None) -> None:
    """Name the unit where results do not; all must be in one. Raises MaterialError."""
    from agent.report.material import MaterialError
    from agent.report.units import output_unit

    if unit is not None:
        material.results = [replace(r, unit=r.unit or unit) for r in material.results]
    units = {output_unit(r.unit) for r in material.results} | ({output_unit(unit)} if unit else set())
    if len(units) > 1:
        raise MaterialError(f"one report has one unit of the indications, here are {', '.join(sorted(units))}")


def write(material: Material, output: Path) -> None:
    """Write report.html, report.json and figures/ into `output`, made if need be. Raises OSError."""
    import msgspec

    from agent.report.figures import draw
    from agent.report.page import page

    seen = left_over(material)
    figures = draw(material, seen[-1] if seen else None, output / "figures")
    (output / "report.html").write_text(page(material, figures, seen), encoding="utf-8")
    held = msgspec.json.format(msgspec.json.encode(as_object(material, seen, [drawn.name for drawn in figures])))
    (output / "report.json").write_bytes(held + b"\n")


def left_over(material: Material) -> list[Residuals]:
    """Residuals of the windows at hand, for the first result; those of which it covers no axis are left out."""
    import numpy as np

    from agent.report.trace import residuals

    seen = [residuals(trace, material.results[0]) for trace in material.traces.values()]
    return [r for r in seen if np.isfinite(r.rms).any()]


def as_object(material: Material, seen: list[Residuals], figures: list[str]) -> dict[str, Any]:
    """What report.json holds: results as in `fieldcal calibrate --json -`, with their unit."""
    from agent import __version__
    from agent.delivery.history import Record
    from agent.report.result import plain

    return {
        "version": __version__,
        "sensor": material.sensor,
        "results": [plain(r.fields) | {"output_unit": r.unit or None} for r in material.results],
        "history": [Record.of(update, recorded=True, recording="").fields for update in material.history],
        "residuals": [
            {"position": r.position, "start_s": plain(r.time_s[0]), "stop_s": plain(r.time_s[-1]), "rms": plain(r.rms)}
            for r in seen
        ],
        "facts": plain(material.facts),
        "files": material.files,
        "notices": material.notices,
        "figures": figures,
    }
