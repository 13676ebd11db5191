"""`fieldcal fleet adjust`: all sensors and references of a site in one adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from agent.cli.calibrate import calibrate
from agent.config.reading import ConfigError
from agent.fleet.adjusting import Adjusted, adjusted
from agent.fleet.meeting import Meeting, device, meeting_of, stated_calibration
from agent.fleet.recorded import meetings_in
from agent.fleet.site_file import SiteSection, arguments_of, load_site
from agent.fleet.telling import as_json, as_object, reasons, show, write
from agent.reading.source import TableError
from agent.terminal.text import say
from calib.site_adjustment.device import SiteDevice


@click.command()
@click.argument("sources", nargs=-1, required=True, type=click.Path(path_type=Path, dir_okay=False),
                metavar="SITE.toml | RECORDING...")  # fmt: skip
@click.option("-o", "directory", type=click.Path(path_type=Path, file_okay=False), metavar="DIR",
              help="Write site.json and one result for each device here.")  # fmt: skip
@click.option("--between", nargs=2, multiple=True, metavar="A B",
              help="Tell the covariance of two devices in the JSON object; may be given several times.")  # fmt: skip
@click.option(
    "--json", "json_to", type=click.Path(path_type=Path, allow_dash=True, dir_okay=False, writable=True),
    help="Write one JSON object to this file; -: print it, and nothing else, on standard output.",
)  # fmt: skip
def adjust(
    sources: tuple[Path, ...], directory: Path | None, between: tuple[tuple[str, str], ...], json_to: Path | None
) -> int:
    """Adjust all sensors and references of a site together, and name the one that contradicts the others.

    SITE.toml lists who met whom, with files (docs/site.md). Recordings of gateways need no such list.

    Exit status 0 if no device contradicts the others, 2 on bad input, 3 if one does, or if no link can be used.
    """
    try:
        found = _adjusted(*_met_in(sources))
    except ConfigError as error:
        for fault in error.faults:
            say(fault, err=True)
        return 2
    except TableError as error:
        say(f"fieldcal fleet adjust: {error}", err=True)
        return 2
    except _NothingError as error:
        for line in error.args[0]:
            say(f"refused: {line}", err=True)
        return 3
    for name in (name for pair in between for name in pair):
        if name not in found.linked:
            raise click.BadParameter(f"{name!r} is in no link that was used", param_hint="--between")
    told = as_object(found, between)
    if directory is not None:
        write(told, directory)
    if json_to is not None:
        with click.open_file(str(json_to), "w") as file:
            file.write(as_json(told) + "\n")
    if json_to != Path("-"):
        show(found)
    for reason in reasons(found):
        say(f"refused: {reason}", err=True)
    return 3 if found.suspects else 0


class _NothingError(Exception):
    """No meeting can be used; one line for each."""


def _met_in(sources: Sequence[Path]) -> tuple[list[SiteDevice], list[Meeting]]:
    """The devices and meetings of a site, from its file or from recordings."""
    described = [path for path in sources if path.suffix == ".toml"]
    if not described:
        return meetings_in(sources)
    if len(sources) > 1:
        raise TableError(f"{described[0]}: the file of a site stands alone; name the recordings in it")
    site, directory = load_site(described[0]), described[0].parent
    meetings = [_meeting(site, k, directory) for k in range(len(site.links))]
    return [device(name, section, directory, meetings) for name, section in site.devices.items()], meetings


def _adjusted(devices: Sequence[SiteDevice], meetings: Sequence[Meeting]) -> Adjusted:
    if all(m.found is None for m in meetings):
        raise _NothingError([f"{m.sensor} beside {m.reference or 'gravity'}: {m.reasons[0]}" for m in meetings])
    return adjusted(devices, meetings)


def _meeting(site: SiteSection, k: int, directory: Path) -> Meeting:
    one = site.links[k]
    try:
        context = calibrate.make_context(f"links.{k}", arguments_of(site, one, directory))
        known = stated_calibration(site.devices[one.reference], directory) if one.reference else None
        return meeting_of(one.sensor, one.reference, context.params, known)
    except click.ClickException as error:
        raise TableError(f"links.{k}: {error.format_message()}") from None
    except TableError as error:
        raise TableError(f"links.{k}: {error}") from None
