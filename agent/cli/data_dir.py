"""The option --data-dir: one way to name the data directory of an agent, also where files may be given in its place."""

from __future__ import annotations

from pathlib import Path

import click

DATA_DIR = click.option(
    "--data-dir", type=click.Path(path_type=Path, exists=True, file_okay=False), metavar="D",
    help="The data directory of an agent, in the place of files.",
)  # fmt: skip


def files_or(data_dir: Path | None, files: tuple[Path, ...], metavar: str) -> tuple[Path, ...]:
    """The files, or the data directory in their place. Raises click.UsageError where neither or both are given.

    `metavar`: what the command calls the files.
    """
    if data_dir is not None and files:
        raise click.UsageError(f"give {metavar} or --data-dir {data_dir}, not both: remove {files[0]}")
    if data_dir is None and not files:
        raise click.UsageError(f"nothing is given; name {metavar}, or a data directory with --data-dir D")
    return files if data_dir is None else (data_dir,)
