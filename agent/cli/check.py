"""`fieldcal check`: reports all faults of a configuration together."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import click

from agent.config import ConfigError, load_config
from agent.config.tls import expiry_warning
from agent.terminal.text import say


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
def check(config: Path) -> int:
    """Report every fault in CONFIG, with its line, its setting and what to do. Exit status 2 if there is a fault."""
    try:
        loaded = load_config(config)
    except ConfigError as error:
        for fault in error.faults:
            say(fault, err=True)
        return 2
    poses = sum(len(channel.poses) for channel in loaded.channels)
    stops = sum(len(channel.positions) for channel in loaded.channels if isinstance(channel.positions, tuple))
    if loaded.zenoh.tls and (warning := expiry_warning(loaded.zenoh.tls.files, datetime.now(UTC))):
        say(f"{config}: zenoh.tls.{warning}", err=True)
    for i, channel in enumerate(loaded.channels):
        for section, beside in zip(("", "check_reference."), channel.by_reference, strict=False):
            if overdue := beside.certificate.overdue(datetime.now(UTC)):
                say(f"{config}: channels.{i}.{section}certificate.{overdue}", err=True)
    told = f"{poses} poses" + (f", {stops} positions that the agent finds" if stops else "")
    say(f"{config}: good; {len(loaded.devices)} devices, {len(loaded.channels)} channels, {told}")
    return 0
