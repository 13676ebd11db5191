"""`fieldcal engines`: lists engines, and makes an archive with which recordings can be audited in ten years."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from agent.cli.data_dir import DATA_DIR
from agent.terminal.text import say

if TYPE_CHECKING:
    from agent.engine.wheel import EngineWheel

MOST_LISTED = 1000  # files of a directory


@click.group()
def engines() -> None:
    """List the engines that computed recordings, and make an archive of them for auditors.

    An engine is the code that results depend on. Its wheel is kept beside the recordings, so that they can be computed
    again in ten years.
    """


@engines.command("list")
@click.argument(
    "directories", nargs=-1, type=click.Path(path_type=Path, exists=True, file_okay=False), metavar="[DIR...]"
)
@DATA_DIR
@click.option("--json", "json_to", type=click.Choice(["-"]), help="Print one JSON object on standard output.")
def list_engines(directories: tuple[Path, ...], data_dir: Path | None, json_to: str | None) -> int:
    """List the running engine, the releases that this program knows, and the wheels in DIR or in its `engines`.

    Nothing of these wheels is run. One that is no release is run by `fieldcal audit` only if --trust-engine names its
    SHA-256.
    """
    from agent.engine.identity import name
    from agent.engine.known import description, known_engines
    from agent.engine.wheel import ENGINES

    places = [
        inner if (inner := place / ENGINES).is_dir() else place for place in (*directories, *filter(None, [data_dir]))
    ]
    files = [description(path) for place in places for path in sorted(place.iterdir())[:MOST_LISTED]]
    if json_to:
        known = [release._asdict() for release in known_engines()]
        click.echo(json.dumps({"running": name(), "known": known, "files": files}))
        return 0
    say(f"this program computes with the engine {name()}")
    for release in known_engines():
        of = f"fieldcal {release.version} ({release.revision})"
        say(f"release {release.number}-{release.id}, of {of}: SHA-256 {release.sha256}")
    for file in files:
        if "fault" in file:
            say(f"{file['path']}: {file['fault']}")
        elif "engine" in file:
            say(f"{file['path']}: engine {file['engine']}, a release, of fieldcal {file['version']}")
        else:
            say(f"{file['path']}: no release; SHA-256 {file['sha256']}")
    return 0


def _interpreter(_: click.Context, parameter: click.Parameter, values: tuple[str, ...]) -> dict[str, Path]:
    from agent.engine.archive import ARCHITECTURES

    given = {}
    for value in values:
        machine, equals, file = value.partition("=")
        if machine not in ARCHITECTURES or not equals or not Path(file).is_file():
            raise click.BadParameter(f"{value!r}: state {' or '.join(ARCHITECTURES)}, '=' and a file", param=parameter)
        given[machine] = Path(file)
    return given


_file = click.Path(path_type=Path, exists=True, dir_okay=False)
_directory = click.Path(path_type=Path, exists=True, file_okay=False)


@engines.command()
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), metavar="DIR", help="The new directory."
)
@click.option("--program", required=True, type=_file, metavar="FILE.whl", help="The wheel of this fieldcal.")
@click.option("--lock", required=True, type=_file, metavar="FILE",
              help="The packages to import, with their hashes: requirements.lock of this fieldcal.")  # fmt: skip
@click.option("--wheels", type=_directory, metavar="DIR", help="Take the packages from DIR, without network.")
@click.option("--engines", "directories", multiple=True, type=_directory, metavar="DIR",
              help="A directory with wheels of engines, `<id>.whl`; repeat it for more.")  # fmt: skip
@click.option("--interpreter", "interpreters", multiple=True, callback=_interpreter, metavar="ARCH=FILE",
              help="A tar file with an interpreter for x86_64 or aarch64, as python-build-standalone makes them. "
                   "Default for the architecture of this machine: the running interpreter.")  # fmt: skip
def archive(
    output: Path,
    program: Path,
    lock: Path,
    wheels: Path | None,
    directories: tuple[Path, ...],
    interpreters: dict[str, Path],
) -> int:
    """Make an archive with which recordings can be audited in ten years, without network and without Python.

    It holds the running engine, every release whose wheel is in a directory of --engines, the program, all packages
    that they import, for x86_64 and aarch64, and an interpreter. `DIR/audit DATA` then audits. The end of the output
    says what is not in it.

    Exit status 2 where something that was given cannot be used, 1 where a file cannot be written.
    """
    from agent.engine.archive import ArchiveError, Parts, make_archive

    found, missing = _engines_for(directories)
    try:
        missing += make_archive(output, Parts(found, program, lock, wheels, interpreters))
    except ArchiveError as error:
        say(f"fieldcal engines archive: {error}", err=True)
        return 2
    say(f"{output}: with the engines {', '.join(engine.name for engine in found)}")
    for what in missing:
        say(f"not in it: {what}")
    return 0


def _engines_for(directories: tuple[Path, ...]) -> tuple[list[EngineWheel], list[str]]:
    """(the running engine, and each release that is in a directory; what is not there)."""
    from agent.engine.identity import engine_id
    from agent.engine.known import find_engine, known_engines
    from agent.engine.wheel import build, read_wheel

    found, missing = [read_wheel("this program", build())], []
    for release in known_engines():
        if release.id == engine_id():
            continue
        engine = find_engine(release.id, directories, ())
        if isinstance(engine, str):
            missing.append(f"engine {release.number}-{release.id}: {engine}")
        else:
            found.append(engine)
    return found, missing
