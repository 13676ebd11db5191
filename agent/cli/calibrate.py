"""`fieldcal calibrate`: determines S and Q from files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from agent.calibrate.calibrating import calibrated
from agent.calibrate.origin import origin
from agent.calibrate.outcome import as_json, print_outcome
from agent.calibrate.station import differences, write_proposed
from agent.calibrate.tables import REFERENCES
from agent.cli.finite import Finite
from agent.reading.source import TableError
from agent.terminal.text import say
from calib.signal.instrument import QUANTITIES

_REFERENCES = " or ".join(",".join(("time_s", *names)) for names in REFERENCES)
_FILE = click.Path(path_type=Path, dir_okay=False)
_U = Finite(0)


@click.command()
@click.option("--sensor", type=_FILE, required=True, help="Columns time_s,vx,vy,vz[,temperature_degc], or others.")
@click.option("--reference", type=_FILE, help=f"Columns {_REFERENCES} in SI units, or others.")
@click.option("--columns", metavar="time=NAME,x=NAME,...", help="Columns of the sensor, if they have other names.")
@click.option(
    "--reference-columns", metavar="time=NAME,x=NAME,...", help="Columns of the reference; a unit as x=NAME:mg."
)
@click.option("--sensitivity", metavar="'100 mV/g'", help="Of a reference whose file has mV or counts.")
@click.option("--mapping", type=_FILE, metavar="FILE", help="Fields of topics in recordings of ROS 2, in TOML.")
@click.option("--sensor-metadata", type=_FILE, metavar="FILE", help="StationXML of a sensor in MiniSEED.")
@click.option("--reference-metadata", type=_FILE, metavar="FILE", help="StationXML of a reference in MiniSEED.")
@click.option("--stationxml-out", type=_FILE, metavar="FILE",
              help="New file: the StationXML of the sensor with sensitivity and orientation as found.")  # fmt: skip
@click.option(
    "--poses", type=_FILE, help="Columns start_s,stop_s and theta_deg,alpha_deg | dx,dy,dz | axis | gx,gy,gz."
)
@click.option(
    "--method", type=click.Choice(["1", "2", "3"]), default="3", show_default=True, help="Method of the paper."
)
@click.option("--reference-quantity", type=click.Choice(list(QUANTITIES)), help="Default: by the header.")
@click.option("--reference-coupling", type=click.Choice(["dc", "ac"]), help="Default: ac for one axis, dc for three.")
@click.option(
    "--coupling", type=click.Choice(["dc", "ac"]), default="dc", show_default=True, help="Coupling of the sensor."
)
@click.option(
    "--u-angle-deg", type=_U, default=0.2, show_default=True, help="u of alpha or direction, for each position."
)
@click.option("--u-theta-deg", type=_U, default=0.2, show_default=True, help="u of theta, common to all positions.")
@click.option(
    "--u-alpha-common-deg", type=_U, default=0.1, show_default=True, help="u of alpha, common to all positions."
)
@click.option("--u-theta-position-deg", type=_U, default=0.0, show_default=True, help="u of theta, for each position.")
@click.option("--u-offset-mps2", type=_U, default=0.05, show_default=True, help="u of the offset between windows.")
@click.option(
    "--u-offset-position-mps2", type=_U, default=0.0, show_default=True, help="u of the offset, for each position."
)
@click.option("--u-reference-pct", type=_U, default=0.1, show_default=True, help="u of the reference's sensitivity.")
@click.option("--reference-certificate", type=_FILE, metavar="FILE",
              help="The reference's certificate (TOML with [certificate], or JSON or DCC of `fieldcal certificate`). "
              "Its u counts in the place of --u-reference-pct.")  # fmt: skip
@click.option(
    "--u-transverse-motion-pct",
    type=_U,
    default=1.0,
    show_default=True,
    help="u of motion transverse to a uniaxial reference.",
)
@click.option(
    "--reference-corner-hz",
    type=_U,
    default=0.0,
    show_default=True,
    help="Corner frequency of an AC-coupled reference.",
)
@click.option("--u-reference-corner-hz", type=_U, default=0.0, show_default=True, help="Its standard uncertainty.")
@click.option(
    "--sensor-corner-hz", type=_U, default=0.0, show_default=True, help="Corner frequency of an AC-coupled sensor."
)
@click.option("--u-sensor-corner-hz", type=_U, default=0.0, show_default=True, help="Its standard uncertainty.")
@click.option("--u-tilt-deg", type=_U, default=0.0, show_default=True, help="u of the mount's tilt.")
@click.option("--rotation", metavar="R11,...,R33", help="Rotation of a tri-axial reference: a = R a_ref.")
@click.option("--u-rotation-deg", type=_U, default=0.2, show_default=True, help="u of the rotation, about each axis.")
@click.option("--gravity", "gravity_mps2", type=Finite(9.7, 9.9), help="Local gravity in m/s2.")
@click.option("--u-gravity-mps2", type=_U, help="u of gravity. Default: 0.03, or 0 with --gravity.")
@click.option(
    "--static-sign",
    type=click.Choice(["+1", "-1"]),
    default="+1",
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
@click.option("--plain", is_flag=True, help="Method 3 exactly as in the paper, without nuisances.")
@click.option(
    "--json", "json_to", type=click.Path(path_type=Path, allow_dash=True, dir_okay=False, writable=True),
    help="Write one JSON object to this file; -: print it, and nothing else, on standard output.",
)  # fmt: skip
def calibrate(**options: Any) -> int:
    """Calibrate from files: sensor.csv, reference.csv, poses.csv.

    Exit status 0 if the calibration is valid, 2 on bad input, 3 if the data are refused. The reasons are printed.
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
    json_to: Path | None = options["json_to"]
    if json_to is not None:
        told = as_json(replace(outcome, more={**outcome.more, **origin(options)}))
        try:
            with click.open_file(str(json_to), "w") as file:
                file.write(told + "\n")
        except OSError as error:
            raise click.BadParameter(f"{json_to}: {error.strerror}", param_hint="--json") from None
    if json_to != Path("-"):
        print_outcome(outcome)
    for reason in outcome.reasons:
        say(f"refused: {reason}", err=True)
    return 3 if outcome.reasons else 0
