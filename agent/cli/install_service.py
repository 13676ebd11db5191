"""`fieldcal install-service`: puts the systemd unit, its user, rules and completion files in place, or removes them."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import click

from agent.setup.service import hidden_from_service, install, uninstall
from agent.terminal.text import say

BEFORE_REMOVAL = (("systemctl", "disable", "--now", "fieldcal"),)
AFTER = (
    ("systemd-sysusers",),
    ("systemd-tmpfiles", "--create"),
    ("udevadm", "control", "--reload"),
    ("systemctl", "daemon-reload"),
)


@click.command(name="install-service")
@click.option("--root", type=click.Path(path_type=Path, file_okay=False), default=Path("/"), show_default=True,
              help="Write below this directory; unless it is /, no system command is run.")  # fmt: skip
@click.option("--program", type=click.Path(path_type=Path, dir_okay=False), default=None,
              help="The program that the unit starts; default: this one.")  # fmt: skip
@click.option("--uninstall", "remove", is_flag=True, help="Stop the service and remove the files.")
def install_service(root: Path, program: Path | None, remove: bool) -> int:
    """Install the service: systemd unit, user, groups, directories, udev rules, a router's file, shell completion.

    It says what it does with each file; doing it again changes nothing. Configuration, keys, data and user stay when
    the service is removed.

    Exit status 2 if the unit could not start the program, 1 if a file cannot be written or a system command fails.
    """
    program = (program or Path(sys.executable).with_name("fieldcal")).absolute()
    if not remove and hidden_from_service(program):
        say(
            f"fieldcal install-service: {program}: the unit hides this directory from the service (ProtectHome, "
            "PrivateTmp); install the program at /opt/fieldcal, as docs/install.md says",
            err=True,
        )
        return 2
    here = root == Path("/")
    if here and remove and not _run(BEFORE_REMOVAL):
        say("the service was not running", err=True)
    for path, done in uninstall(root) if remove else install(root, program):
        say(f"{done:9}  {path}")
    if here and not _run(AFTER):
        return 1
    if not remove:
        say("next:")
        say("  sudo fieldcal init /etc/fieldcal/gateway.toml && sudo chgrp fieldcal /etc/fieldcal/gateway.toml")
        say("  sudo systemctl enable --now fieldcal")
    return 0


def _run(commands: tuple[tuple[str, ...], ...]) -> bool:
    """Run system commands, and say each; one that is not there is left out. Whether all succeeded."""
    good = True
    for command in commands:
        if shutil.which(command[0]) is None:
            say(f"left out   {' '.join(command)}: there is no {command[0]}", err=True)
            continue
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        said = done.stderr.strip().partition("\n")[0]
        say(f"run        {' '.join(command)}" + (f": {said}" if done.returncode else ""), err=done.returncode != 0)
        good = good and done.returncode == 0
    return good
