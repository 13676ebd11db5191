"""`fieldcal report`: figures, one HTML page and JSON of a calibration. It needs the extra `report` of the package."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from agent.cli.data_dir import DATA_DIR, files_or
from agent.config.whole_files import status_of
from agent.terminal.text import say

if TYPE_CHECKING:
    from agent.report.material import Material


@click.command()
@click.argument("inputs", nargs=-1, type=click.Path(path_type=Path), metavar="[INPUT...]")
@DATA_DIR
@click.option("-o", "--output", type=click.Path(path_type=Path, file_okay=False), required=True, metavar="DIR",
              help="Directory for report.html, report.json and the figures.")  # fmt: skip
@click.option(
    "--unit", metavar="UNIT", help="Unit of the indications, if the result does not state it: mV, m/s2, count."
)
@click.option(
    "--sensor",
    metavar="NAME",
    help="The sensor to report, if the input has several. For results: the name on the page.",
)
@click.option(
    "--site-verdicts", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help="What `fieldcal fleet watch --json FILE` tells: U then holds a change that is suspected of the sensor.",
)  # fmt: skip
def report(
    inputs: tuple[Path, ...], data_dir: Path | None, output: Path, unit: str | None, sensor: str | None,
    site_verdicts: Path | None,
) -> int:  # fmt: skip
    """Make figures and one page of a calibration.

    INPUT is RESULT.json of `fieldcal calibrate --json -` (several are compared), or a recording (several are read one
    after the other). Of --data-dir the calibration in force is reported, with its history.

    Exit status 3 if the data were refused (the report then shows why), 2 if the input cannot be used.
    """
    inputs = files_or(data_dir, inputs, "INPUT")
    try:
        import matplotlib  # noqa: F401 - imported to check for it before any other work
    except ImportError:
        say("fieldcal report: the figures need matplotlib; install it with: fieldcal extras --install report", err=True)
        return 1
    from agent.report.material import MaterialError, gather
    from agent.report.writing import write
    from agent.site_watch.source import WatchError

    try:
        material = gather(inputs, sensor)
        _name_unit(material, unit)
        _suspect(material, site_verdicts, sensor)
    except (MaterialError, WatchError) as error:
        say(f"fieldcal report: {error}", err=True)
        return 2
    for notice in material.notices:
        say(f"fieldcal report: {notice}", err=True)
    try:
        write(material, output)
    except OSError as error:
        say(f"fieldcal report: {error.filename or output}: {error.strerror}", err=True)
        return status_of(error)
    say(str(output / "report.html"))
    return _status(material)


def _status(material: Material) -> int:
    refused = [result for result in material.results if result.refused]
    for result in refused:
        for reason in result.reasons:
            say(f"refused: {reason}", err=True)
    return 3 if refused else 0


def _suspect(material: Material, verdicts: Path | None, sensor: str | None) -> None:
    """Enlarge U by what is suspected of the sensor. Raises MaterialError, WatchError."""
    from agent.report.material import MaterialError
    from agent.report.suspected import suspect
    from agent.site_watch.suspicion import suspicion_of

    if verdicts is None:
        return
    name = material.sensor or sensor
    if not name:
        raise MaterialError(f"--site-verdicts {verdicts}: the results name no sensor; add --sensor NAME")
    suspect(material, suspicion_of(verdicts, name, material.facts.get("gateway", "")))


def _name_unit(material: Material, unit: str | None) -> None:
    """Set the unit of results that do not state it. Raises MaterialError if the results have several units."""
    from agent.report.material import MaterialError
    from agent.report.units import output_unit
    from calib.recorded.units import unit_name

    if unit is not None:
        named = unit_name(unit) or unit
        if told := [r.unit for r in material.results if r.unit and (unit_name(r.unit) or r.unit) != named]:
            raise MaterialError(f"--unit {unit}: the indications are in {told[0]}; leave --unit out")
        material.results = [replace(r, unit=r.unit or named) for r in material.results]
    units = {output_unit(r.unit) for r in material.results}
    if len(units) > 1:
        raise MaterialError(f"all indications in a report must have one unit, but here are {', '.join(sorted(units))}")
