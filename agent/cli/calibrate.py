"""`fieldcal calibrate`: determines S and Q from files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from agent.calibrate.calibrating import calibrated
from agent.calibrate.origin import origin
from agent.calibrate.printing import print_outcome, print_warnings
from agent.calibrate.station import differences, write_proposed
from agent.cli.finite import Finite
from agent.config.whole_files import status_of, write_whole
from agent.reading.dates import ORDERS
from agent.reading.source import TableError
from agent.terminal.text import say
from calib.recorded.options import CHOICES, DEFAULTS, GRAVITY_MPS2
from calib.recorded.outcome import as_json
from calib.recorded.table import REFERENCES

_REFERENCES = " or ".join(",".join(("time_s", *names)) for names in REFERENCES)
_FILE = click.Path(path_type=Path, dir_okay=False)
_U = Finite(0)


def _choice(option: str, form: str = "{}") -> click.Choice[str]:
    return click.Choice([form.format(value) for value in CHOICES[option]])


def _u(name: str, told: str) -> Callable[[Any], Any]:
    """An option with a number from 0 on, whose default is that of calib."""
    return click.option(
        f"--{name.replace('_', '-')}", type=_U, default=getattr(DEFAULTS, name), show_default=True, help=told
    )


@click.command()
@click.option("--sensor", type=_FILE, required=True, help="Columns time_s,vx,vy,vz[,temperature_degc], or others.")
@click.option("--reference", type=_FILE, help=f"Columns {_REFERENCES} in SI units, or others.")
@click.option("--columns", metavar="time=NAME,x=NAME,...", help="Columns of the sensor, if they have other names.")
@click.option(
    "--reference-columns", metavar="time=NAME,x=NAME,...", help="Columns of the reference; a unit as x=NAME:mg."
)
@click.option("--sensitivity", metavar="'100 mV/g'", help="Of a reference whose file has mV or counts.")
@click.option("--date-order", type=click.Choice(ORDERS), help="Order of day, month and year in dates as 03/04/2026.")
@click.option("--mapping", type=_FILE, metavar="FILE", help="Fields of topics in recordings of ROS 2, in TOML.")
@click.option("--sensor-metadata", type=_FILE, metavar="FILE", help="StationXML of a sensor in MiniSEED.")
@click.option("--reference-metadata", type=_FILE, metavar="FILE", help="StationXML of a reference in MiniSEED.")
@click.option("--stationxml-out", type=_FILE, metavar="FILE",
              help="New file: the StationXML of the sensor with sensitivity and orientation as found.")  # fmt: skip
@click.option(
    "--poses", type=_FILE, help="Columns start_s,stop_s and theta_deg,alpha_deg | dx,dy,dz | axis | gx,gy,gz."
)
@click.option(
    "--method", type=_choice("method"), default=str(DEFAULTS.method), show_default=True, help="Method of the paper."
)
@click.option("--reference-quantity", type=_choice("reference_quantity"), help="Default: by the header.")
@click.option(
    "--reference-coupling",
    type=_choice("reference_coupling"),
    help="Default: dc for three axes, unless only the sensor feels gravity; else ac.",
)
@click.option(
    "--coupling", type=_choice("coupling"), default=DEFAULTS.coupling, show_default=True, help="Coupling of the sensor."
)
@_u("u_angle_deg", "u of alpha or direction, for each position.")
@_u("u_theta_deg", "u of theta, common to all positions.")
@_u("u_alpha_common_deg", "u of alpha, common to all positions.")
@_u("u_theta_position_deg", "u of theta, for each position.")
@_u("u_offset_mps2", "u of the offset between windows.")
@_u("u_offset_position_mps2", "u of the offset, for each position.")
@_u("u_reference_pct", "u of the reference's sensitivity.")
@_u("u_reference_transverse_pct", "u of the transverse sensitivities of a tri-axial reference.")
@click.option("--reference-certificate", type=_FILE, metavar="FILE",
              help="The reference's certificate (TOML with [certificate], or JSON or DCC of `fieldcal certificate`). "
              "Its u counts in the place of --u-reference-pct and --u-reference-transverse-pct.")  # fmt: skip
@_u("u_transverse_motion_pct", "u of motion transverse to a uniaxial reference.")
@click.option("--sensor-filter", multiple=True, metavar="'KIND NAME=NUMBER ...'", default=DEFAULTS.sensor_filter,
              help="A known filter of the sensor, as 'lowpass order=2 corner_hz=31'; 'flat': none that matters. "
              "May be given several times.")  # fmt: skip
@click.option("--reference-filter", multiple=True, metavar="'KIND NAME=NUMBER ...'", default=DEFAULTS.reference_filter,
              help="The same of the reference. Default: as its certificate says.")  # fmt: skip
@_u("reference_corner_hz", "Corner frequency of an AC-coupled reference.")
@_u("u_reference_corner_hz", "Its standard uncertainty.")
@_u("sensor_corner_hz", "Corner frequency of an AC-coupled sensor.")
@_u("u_sensor_corner_hz", "Its standard uncertainty.")
@_u("u_tilt_deg", "u of the mount's tilt.")
@click.option("--rotation", metavar="R11,...,R33", help="Rotation of a tri-axial reference: a = R a_ref.")
@_u("u_rotation_deg", "u of the rotation, about each axis.")
@click.option("--gravity", "gravity_mps2", type=Finite(*GRAVITY_MPS2), help="Local gravity in m/s2.")
@click.option(
    "--u-gravity-mps2",
    type=_U,
    help="u of gravity. Default: 0.03; with --gravity by its digits: 0.01 of 9.81, 3e-6 of 9.80123.",
)
@click.option(
    "--static-sign",
    type=_choice("static_sign", "{:+d}"),
    default=f"{DEFAULTS.static_sign:+d}",
    show_default=True,
    help="Sign of gravity in a pose; +1 as in Eqs. (9)-(11).",
)
@click.option("--nominal", type=Finite(min=0, min_open=True), help="Nominal sensitivity, output unit per m/s2.")
@click.option("--u-nominal-pct", type=Finite(0, min_open=True), help="Its standard uncertainty.")
@click.option("--prior", type=_FILE, help="Earlier result (JSON) or certificate (JSON, DCC XML), as prior.")
@click.option(
    "--reference-frequency-hz",
    type=Finite(min=0, min_open=True),
    help="The frequency at which S holds. Default: the geometric middle of the motion's band.",
)
@click.option("--all", "everything", is_flag=True, help="Print the nuisances too: lag, angles, response and others.")
@click.option("--band-hz", type=(Finite(min=0), Finite(min=0, min_open=True)), metavar="LOW HIGH",
              help="Limit sensor and reference to this band. Default: the widest that fits.")  # fmt: skip
@click.option("--plain", is_flag=True, help="Method 3 exactly as in the paper, without nuisances.")
@click.option(
    "--json", "json_to", type=click.Path(path_type=Path, allow_dash=True, dir_okay=False, writable=True),
    help="Write one JSON object to this file; -: print it, and nothing else, on standard output.",
)  # fmt: skip
def calibrate(*, everything: bool, **options: Any) -> int:
    """Calibrate from files: sensor.csv, reference.csv, poses.csv.

    Exit status 0 if the calibration is valid, 1 if the disk is full, 2 on bad input, 3 if the data are refused. The
    reasons are printed.
    """
    try:
        outcome = calibrated(options)
        proposed: Path | None = options["stationxml_out"]
        if proposed is not None and outcome.calibration is not None:
            write_proposed(options["sensor_metadata"], proposed, outcome.more["station"])
    except TableError as error:
        say(f"fieldcal calibrate: {error}", err=True)
        return 2
    for line in differences(outcome.more.get("station", ())):
        say(line, err=True)
    json_to = Path(options["json_to"]) if options["json_to"] else None
    unwritten = 0
    if json_to is not None:
        told = as_json(replace(outcome, more={**outcome.more, **origin(options)}))
        try:
            _write(json_to, told + "\n")
        except OSError as error:  # the result is printed all the same
            say(f"fieldcal calibrate: {json_to}: {error.strerror}", err=True)
            unwritten = status_of(error)
    if json_to == Path("-"):
        print_warnings(outcome.warnings, err=True)
    else:
        print_outcome(outcome, everything=everything)
    for reason in outcome.reasons:
        say(f"refused: {reason}", err=True)
    return unwritten or (3 if outcome.reasons else 0)


def _write(to: Path, text: str) -> None:
    """Write to a file, or to standard output for -. Raises OSError."""
    if to == Path("-"):
        click.echo(text, nl=False)
    else:
        write_whole(to, text.encode())
