"""Runs commands of `fieldcal` as on a system that lacks what only Linux and other Unix systems have.

`python -m tests.unit.other_system COMMANDS`: a JSON list, each a list of arguments. Prints the exit statuses as JSON,
in the last line.

Modules that Windows lacks cannot be imported, and functions, signals and socket families that it lacks are removed,
also from modules that are loaded already.
"""

from __future__ import annotations

import builtins
import json
import os
import signal
import socket
import sys
from collections.abc import Mapping, Sequence
from typing import Any

MODULES = {"fcntl", "termios", "pty", "tty", "grp", "pwd", "resource", "smbus2"}
FUNCTIONS: tuple[tuple[Any, tuple[str, ...]], ...] = (
    (os, ("statvfs", "fork", "getuid", "geteuid", "sysconf", "O_NONBLOCK", "O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW")),
    (
        signal,
        ("SIGUSR1", "SIGUSR2", "SIGHUP", "SIGALRM", "SIGPIPE", "SIGQUIT", "SIGKILL", "pthread_sigmask", "sigwait"),
    ),
    (socket, ("AF_UNIX", "AF_NETLINK")),
)
_import = builtins.__import__


def _refusing(
    name: str,
    globals_: Mapping[str, object] | None = None,
    locals_: Mapping[str, object] | None = None,
    fromlist: Sequence[str] = (),
    level: int = 0,
) -> Any:
    # What the standard library imports where it is there is not our business: it does so on every system.
    ours = str((globals_ or {}).get("__name__", "")).split(".")[0] in ("agent", "calib", "hw", "serial", "mcap")
    if level == 0 and name.split(".")[0] in MODULES and ours:
        raise ImportError(f"No module named {name!r}: this system has none")
    return _import(name, globals_, locals_, fromlist, level)


def main() -> None:
    """Take away what is missing elsewhere, then run the commands."""
    # Libraries that have a way of their own for each system are loaded before.
    import asyncio
    import subprocess
    import tempfile

    import scipy.signal

    del asyncio, subprocess, tempfile, scipy
    builtins.__import__ = _refusing  # type: ignore[assignment]
    for module, names in FUNCTIONS:
        for name in names:
            if hasattr(module, name):
                delattr(module, name)
    from agent.cli.main import run_cli

    print(json.dumps([run_cli(command) for command in json.loads(sys.argv[1])]))


if __name__ == "__main__":
    main()
