"""`fieldcal convert`: writes the samples of a file of any format as the plain CSV of `fieldcal calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from agent.calibrate.calibrating import as_arguments, by_driver, reference_of, sensor_of
from agent.config.whole_files import new_file, status_of
from agent.reading.dates import ORDERS
from agent.reading.formats import Description
from agent.reading.source import ROWS_AT_ONCE, TableError
from agent.terminal.text import say
from calib.model import Slices
from calib.recorded.columns import TEMPERATURE
from calib.recorded.table import REFERENCES, SENSOR

_FILE = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("file", type=_FILE)
@click.option("-o", "--output", type=_FILE, required=True, help="The CSV file to write; it must not exist.")
@click.option(
    "--as", "role", type=click.Choice(["sensor", "reference"]), default="sensor", show_default=True,
    help="A sensor keeps its unit; a reference is written in SI units.",
)  # fmt: skip
@click.option("--columns", metavar="time=NAME,x=NAME,...", help="Columns to take; a unit as x=NAME:mg.")
@click.option("--sensitivity", metavar="'100 mV/g'", help="Of a reference whose file has mV or counts.")
@click.option("--date-order", type=click.Choice(ORDERS), help="Order of day, month and year in dates as 03/04/2026.")
@click.option("--mapping", type=_FILE, metavar="FILE", help="Fields of topics in a recording of ROS 2, in TOML.")
@click.option("--metadata", type=_FILE, metavar="FILE", help="StationXML of a file in MiniSEED.")
def convert(file: Path, output: Path, role: str, columns: str | None, sensitivity: str | None, **beside: Any) -> int:
    """Write the samples of FILE as plain CSV: time_s,vx,vy,vz of a sensor; time_s,a of a reference, or ax,ay,az, v, d.

    Exit status 0 if it is written, 2 on bad input.
    """
    if sensitivity and role == "sensor":
        raise click.UsageError("--sensitivity is for --as reference")
    described = Description(**beside)
    try:
        if role == "sensor":
            sensor = sensor_of(file, columns, None, described)
            filters = sensor.filters
            names, values = [*SENSOR], [sensor.time_s, sensor.v]
            if sensor.temperature_degc is not None:
                names, values = [*names, TEMPERATURE], [*values, sensor.temperature_degc]
        else:
            reference = reference_of(file, columns, sensitivity, None, described)
            filters = reference.filters
            names = ["time_s", *_names(reference.quantity, reference.channels)]
            values = [reference.time_s, reference.x]
        rows = _write(output, names, values)
    except TableError as error:
        say(f"fieldcal convert: {error}", err=True)
        return 2
    except FileExistsError:
        say(f"fieldcal convert: {output}: the file exists; remove it, or choose another name", err=True)
        return 2
    except OSError as error:
        say(f"fieldcal convert: {error.filename}: {error.strerror}", err=True)
        return status_of(error)
    say(f"{output}: {rows} rows of {','.join(names)}")
    for argument in as_arguments(by_driver(role, filters)):
        say(f"its driver states a filter, which the CSV cannot hold; calibrate with {argument}", err=True)
    return 0


def _names(quantity: str, channels: int) -> tuple[str, ...]:
    for names, held in REFERENCES.items():
        if held == quantity and len(names) == channels:
            return names
    raise TableError(
        f"a {quantity} with {channels} axes is no reference; choose one axis with --columns time=NAME,x=NAME"
    )


def _write(path: Path, names: list[str], values: list[Slices]) -> int:
    """Write the columns so that reading them gives the same numbers; a gap is written as nan."""
    with new_file(path) as file:
        file.write(f"{','.join(names)}\n".encode())
        for first in range(0, len(values[0]), ROWS_AT_ONCE):
            part = np.column_stack([v[first : first + ROWS_AT_ONCE] for v in values]).tolist()
            file.writelines(f"{','.join(map(repr, row))}\n".encode() for row in part)
    return len(values[0])
