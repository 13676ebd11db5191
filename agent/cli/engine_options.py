"""Options of the commands that replay recordings: which engines may run, and on how many cores."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from agent.audit.engines import Engines
from agent.audit.parallel import cores
from agent.audit.replaying import Restore
from agent.engine.wheel import ENGINES as ENGINES_NAME

ENGINES = click.option(
    "--engines", multiple=True, metavar="DIR", type=click.Path(path_type=Path),
    help="A directory with wheels of engines. One runs only if this program knows it as a release or you trust it.",
)  # fmt: skip
TRUST_ENGINE = click.option(
    "--trust-engine", "trusted", multiple=True, metavar="ID",
    help="Trust this engine too: the SHA-256 of its wheel, or its first 16 digits or more.",
)  # fmt: skip
JOBS = click.option(
    "--jobs", metavar="N", type=click.IntRange(min=1), default=cores, show_default="all cores",
    help="On how many cores files are replayed at the same time.",
)  # fmt: skip


def engines_for(restore: Restore, files: Sequence[Path], engines: Sequence[Path], trusted: Sequence[str]) -> Engines:
    """The engines of these options, and those beside the recordings. Raises click.UsageError."""
    from agent.engine.known import check_trusted

    try:
        digests = tuple(map(check_trusted, trusted))
    except ValueError as error:
        raise click.UsageError(f"--trust-engine {error}") from None
    homes = {path if path.is_dir() else path.parent: None for path in files}
    return Engines(restore, (*engines, *(home / ENGINES_NAME for home in homes)), digests, tuple(engines))
