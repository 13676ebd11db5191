"""`fieldcal backup`: a consistent copy of a data directory, also while the agent runs."""

from __future__ import annotations

from pathlib import Path

import click

from agent.config import ConfigError, load_config
from agent.setup.backup import BackupError, back_up, key_files, left_out
from agent.terminal.quantity import size
from agent.terminal.text import say


@click.command()
@click.argument("target", type=click.Path(path_type=Path))
@click.option("--data-dir", type=click.Path(path_type=Path), default=Path("data"), show_default=True,
              help="Where the agent keeps recordings and results.")  # fmt: skip
@click.option("--config", "config_path", type=click.Path(path_type=Path), help="Copy this configuration too.")
@click.option("--with-keys", is_flag=True,
              help="Copy the keys too that the configuration names: whoever has the copy has the keys.")  # fmt: skip
def backup(target: Path, data_dir: Path, config_path: Path | None, with_keys: bool) -> int:
    """Copy a data directory to the new directory TARGET: results, states, recordings. The agent may go on meanwhile.

    TARGET/data can be used as a data directory; `sha256sum -c SHA256SUMS` checks the copy. Keys are copied only with
    --with-keys, wherever they lie. The counters of commands are not copied: an agent that begins with the copy takes
    only commands that are signed after its start. Files that the agent did not make are not copied, and are told.

    Exit status 2 if TARGET exists or there is nothing to copy, 1 if the disk fails.
    """
    if with_keys and config_path is None:
        raise click.UsageError("--with-keys needs --config, which names the keys")
    try:
        keys = key_files(load_config(config_path)) if with_keys and config_path is not None else []
        copied = back_up(data_dir, target, config_path, keys)
    except ConfigError as error:
        for fault in error.faults:
            say(fault, err=True)
        return 2
    except BackupError as error:
        say(f"fieldcal backup: {error}", err=True)
        return 2
    say(f"{target}: {len(copied)} files, {size(sum(path.stat().st_size for path in copied))}")
    if strange := left_out(data_dir):
        say(f"not copied, since the agent did not make it: {', '.join(strange)}")
    return 0
