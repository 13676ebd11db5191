"""`fieldcal fleet`: what is done with a whole site at once. Each command has a file of its own."""

from __future__ import annotations

import importlib

import click

COMMANDS = {
    "adjust": "agent.cli.fleet_adjust", "replay": "agent.cli.fleet_replay", "watch": "agent.cli.fleet_watch",
}  # fmt: skip


class _LazyCommands(click.Group):
    """Loads a command's module only when the command is called."""

    def list_commands(self, _: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, _: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command = getattr(importlib.import_module(COMMANDS[cmd_name]), cmd_name)
        assert isinstance(command, click.Command)
        return command


@click.group(cls=_LazyCommands)
def fleet() -> None:
    """All devices of a site together."""
