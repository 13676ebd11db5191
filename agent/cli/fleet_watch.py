"""`fieldcal fleet watch`: the sensors of a site without a reference, watched together."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click
import msgspec

from agent.terminal.text import one_line, say

if TYPE_CHECKING:
    from agent.site_watch.source import SiteSource

WIDTHS = (28, 38, 18, 17, 0)  # of the columns of the table


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path, dir_okay=False), metavar="FILE...")
@click.option("--beside-reference", multiple=True, metavar="GATEWAY/SENSOR",
              help="This sensor stands beside a reference; may be given several times.")  # fmt: skip
@click.option("--site", metavar="NAME", help="The site, if the database of the monitor has several.")
@click.option(
    "--json", "json_to", type=click.Path(path_type=Path, allow_dash=True, dir_okay=False, writable=True),
    help="Write one JSON object to this file; -: print it, and nothing else, on standard output.",
)  # fmt: skip
def watch(files: tuple[Path, ...], beside_reference: tuple[str, ...], site: str | None, json_to: Path | None) -> int:
    """Watch all sensors of a site together, and name the one whose sensitivity has changed.

    Each FILE holds hourly `watch` results (docs/site-watch.md): one JSON object a line, in any order, or a recording.
    Or FILE is the database of the monitor, `monitor.sqlite`, which may run meanwhile.

    Exit status 0 if nothing has changed, 2 on bad input, 3 if a sensor, a gateway or the structure has changed.
    """
    from agent.site_watch.source import WatchError
    from agent.site_watch.view import as_object, blind_spots, rows, watch_site
    from calib.recorded.outcome import plain

    try:
        with ExitStack() as stack:
            found = _source(files, site, stack)
            told = watch_site(found, _positions(found, beside_reference))
    except (OSError, WatchError) as error:
        say(f"fieldcal fleet watch: {error}", err=True)
        return 2
    for reason, count in found.left_out.items():
        say(f"left out: {count} of {found.lines} lines: {reason}; first at {found.first[reason]}", err=True)
    if json_to is not None:
        with click.open_file(str(json_to), "w") as file:
            file.write(msgspec.json.encode(plain(as_object(told))).decode() + "\n")
    if json_to != Path("-"):
        for row in rows(told):
            say("  ".join(f"{one_line(cell):<{width}}" for cell, width in zip(row, WIDTHS, strict=True)).rstrip())
        for line in told.sentences:
            say(one_line(line))
        for line in blind_spots(told):
            say(line)
    return 3 if told.changed else 0


def _positions(found: SiteSource, beside_reference: tuple[str, ...]) -> list[int]:
    names = {"/".join(who): i for i, who in enumerate(found.sensors)}
    for name in beside_reference:
        if name not in names:
            raise click.BadParameter(f"{name!r} is no sensor of the files", param_hint="--beside-reference")
    return [names[name] for name in beside_reference]


def _source(files: tuple[Path, ...], site: str | None, stack: ExitStack) -> SiteSource:
    """The site in the files, or in the database of the monitor, while the stack is open. Raises OSError, WatchError."""
    from agent.monitor.watch_store import from_database, is_database
    from agent.site_watch.files import from_files
    from agent.site_watch.source import WatchError

    databases = [path for path in files if is_database(path)]
    if databases and len(files) > 1:
        raise WatchError(f"{databases[0]}: the database of the monitor is given alone, without other files")
    if databases:
        return stack.enter_context(from_database(databases[0], site))
    if site is not None:
        raise click.UsageError("--site chooses a site of the database of the monitor; files are one site")
    return from_files(files)
