"""`fieldcal fleet watch`: the sensors of a site without a reference, watched together."""

from __future__ import annotations

from pathlib import Path

import click
import msgspec

from agent.terminal.text import one_line, say


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path, dir_okay=False), metavar="FILE...")
@click.option("--beside-reference", multiple=True, metavar="GATEWAY/SENSOR",
              help="This sensor stands beside a reference; may be given several times.")  # fmt: skip
@click.option(
    "--json", "json_to", type=click.Path(path_type=Path, allow_dash=True, dir_okay=False, writable=True),
    help="Write one JSON object to this file; -: print it, and nothing else, on standard output.",
)  # fmt: skip
def watch(files: tuple[Path, ...], beside_reference: tuple[str, ...], json_to: Path | None) -> int:
    """Watch all sensors of a site together, and name the one whose sensitivity has changed.

    Each FILE holds hourly `watch` results, one JSON object a line, in any order (docs/site-watch.md).

    Exit status 0 if nothing has changed, 2 on bad input, 3 if a sensor, a gateway or the structure has changed.
    """
    from agent.fleet.watched import WatchError, watched
    from agent.fleet.watching import as_object, not_seen, rows, seen
    from calib.recorded.outcome import plain

    try:
        found = watched(files)
    except (OSError, WatchError) as error:
        say(f"fieldcal fleet watch: {error}", err=True)
        return 2
    names = {"/".join(who): i for i, who in enumerate(found.sensors)}
    for name in beside_reference:
        if name not in names:
            raise click.BadParameter(f"{name!r} is no sensor of the files", param_hint="--beside-reference")
    told = seen(found, [names[name] for name in beside_reference])
    for reason, count in found.left_out.items():
        say(f"left out: {count} of {found.lines} lines: {reason}; first at {found.first[reason]}", err=True)
    if json_to is not None:
        with click.open_file(str(json_to), "w") as file:
            file.write(msgspec.json.encode(plain(as_object(told))).decode() + "\n")
    if json_to != Path("-"):
        for row in rows(told):
            say(
                "  ".join(
                    f"{one_line(cell):<{width}}" for cell, width in zip(row, (28, 38, 18, 17, 0), strict=True)
                ).rstrip()
            )
        for line in not_seen(told):
            say(line)
    return 3 if told.changed else 0
