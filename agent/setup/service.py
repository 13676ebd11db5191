"""The files of the service: where each goes, and writing or removing them."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

HERE = Path(__file__).parent
# In a wheel the files are beside this module; in a checkout they are in deploy/.
DEPLOY = HERE / "deploy" if (HERE / "deploy").is_dir() else HERE.parents[1] / "deploy"
PROGRAM = "/opt/fieldcal/.venv/bin/fieldcal"  # as deploy/fieldcal.service states it
HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # ProtectHome and PrivateTmp hide these from the service

Done = Literal["written", "changed", "unchanged", "kept", "removed", "absent"]


@dataclass(frozen=True, slots=True)
class ServiceFile:
    """One file: its name in deploy/, and where it goes. `keep`: the user changes it, so it is written only once."""

    name: str
    target: str
    keep: bool = False


FILES = (
    ServiceFile("fieldcal.sysusers", "/etc/sysusers.d/fieldcal.conf"),
    ServiceFile("fieldcal.tmpfiles", "/etc/tmpfiles.d/fieldcal.conf"),
    ServiceFile("fieldcal.udev", "/etc/udev/rules.d/60-fieldcal.rules"),
    ServiceFile("fieldcal.service", "/etc/systemd/system/fieldcal.service"),
    ServiceFile("zenoh/router.json5", "/etc/fieldcal/router.json5", keep=True),
    ServiceFile("completion/fieldcal.bash", "/usr/local/share/bash-completion/completions/fieldcal"),
    ServiceFile("completion/fieldcal.zsh", "/usr/local/share/zsh/site-functions/_fieldcal"),
    ServiceFile("completion/fieldcal.fish", "/etc/fish/completions/fieldcal.fish"),
)


def hidden_from_service(program: Path) -> bool:
    """Whether the limits of the unit hide the program."""
    return any(program.is_relative_to(directory) for directory in HIDDEN)


def install(root: Path, program: Path) -> Iterator[tuple[Path, Done]]:
    """Write the files below `root`; yields each file and what was done. Raises OSError."""
    for file in FILES:
        path = root / file.target.lstrip("/")
        text = (DEPLOY / file.name).read_text("utf-8").replace(PROGRAM, str(program))
        before = path.read_text("utf-8", errors="replace") if path.is_file() else None
        if before == text or (before is not None and file.keep):
            yield path, "unchanged" if before == text else "kept"
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_name(path.name + ".new")
        beside.write_text(text, "utf-8")
        beside.chmod(stat.S_IRUSR | stat.S_IWUSR | stat.S_IRGRP | stat.S_IROTH)
        os.replace(beside, path)  # never half a unit
        yield path, "written" if before is None else "changed"


def uninstall(root: Path) -> Iterator[tuple[Path, Done]]:
    """Remove the files, except those that the user changes; yields each file and what was done. Raises OSError."""
    for file in FILES:
        path = root / file.target.lstrip("/")
        if file.keep and path.exists():
            yield path, "kept"
            continue
        existed = path.exists()
        path.unlink(missing_ok=True)
        yield path, "removed" if existed else "absent"
