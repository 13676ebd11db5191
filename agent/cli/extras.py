"""`fieldcal extras`: lists the optional parts of the package, and installs them, also without network."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import click

from agent.setup.extras import WHEELS, Extra, install_command
from agent.setup.extras import extras as optional_parts
from agent.terminal.text import say


@click.command()
@click.option("--install", "names", multiple=True, metavar="PART", help="Install this part; repeat it for more.")
@click.option(
    "--wheels", type=click.Path(path_type=Path, exists=True, file_okay=False), metavar="DIR",
    help="Take the wheels in DIR, without network; default: `wheels` in this Python environment, if it exists.",
)  # fmt: skip
@click.option("--index", is_flag=True, help="Take them from the package index, also where there are wheels.")
@click.option("--json", "json_to", type=click.Choice(["-"]), help="One JSON object on standard output.")
def extras(names: tuple[str, ...], wheels: Path | None, index: bool, json_to: str | None) -> int:
    """List the optional parts: what each is for, and whether it is installed. With --install, install parts.

    Every file is compared with the hash in the part's lock file, which is part of fieldcal.

    For a gateway without network, get the wheels on another machine with the same architecture and Python version:
    `python3 -m pip download --require-hashes -r LOCK -d DIR`, with the lock file that --json shows.

    Exit status 2 if a PART does not exist, 1 if the installation failed.
    """
    if index and wheels is not None:
        raise click.UsageError("give --wheels or --index, not both")
    known = {extra.name: extra for extra in optional_parts()}
    strangers = [name for name in names if name not in known]
    for name in strangers:
        say(f"fieldcal extras: no part {name!r}; the parts are {', '.join(known)}", err=True)
    if strangers:
        return 2
    if names:
        found = wheels or (WHEELS if WHEELS.is_dir() else None)
        if not _install([known[name] for name in names], None if index else found):
            return 1
    _list(optional_parts(), as_json=bool(json_to))
    return 0


def _list(parts: Sequence[Extra], *, as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps({"extras": [asdict(part) | {"installed": part.installed} for part in parts]}))
        return
    width = max(len(part.name) for part in parts)
    for part in parts:
        state = "installed" if part.installed else "not installed"
        say(f"{part.name.ljust(width)}  {state.ljust(13)}  {part.purpose}")


def _install(chosen: list[Extra], wheels: Path | None) -> bool:
    """Run pip; says what it does. Whether it succeeded."""
    command = install_command(chosen, wheels)
    if command is None:
        say("fieldcal extras: there is no pip; install it first: sudo apt-get install python3-pip", err=True)
        return False
    say(" ".join(command), err=True)
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if done.returncode != 0:
        source = f"the wheels in {wheels}" if wheels else "the package index"
        for line in done.stdout.splitlines():
            say(line, err=True)
        say(f"fieldcal extras: pip could not install this from {source}", err=True)
    return done.returncode == 0
