"""A PostgreSQL of its own for tests, on a socket in a temporary directory."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

BINARIES = Path("/usr/lib/postgresql/15/bin")  # where Debian's package puts them
USER = "fieldcal"


@contextmanager
def postgres(*, fsync: bool = False) -> Iterator[str]:
    """Its address. Without `fsync` a power cut may damage it.

    Skips where the server or the extra `fleet` is not installed.
    """
    pytest.importorskip("sqlalchemy", reason="the extra fleet is not installed")
    pytest.importorskip("psycopg", reason="the extra fleet is not installed")
    if not (BINARIES / "initdb").exists():
        pytest.skip("PostgreSQL 15 is not installed")
    with tempfile.TemporaryDirectory(prefix="fieldcal-postgres-") as name:
        place, data = Path(name), Path(name) / "data"
        as_user: list[str] = []
        if os.geteuid() == 0:  # PostgreSQL refuses to run as root
            owner = pwd.getpwnam("nobody")
            shutil.chown(place, owner.pw_uid, owner.pw_gid)
            as_user = ["setpriv", "--reuid=nobody", "--regid=nogroup", "--clear-groups"]

        def run(binary: str, *arguments: str) -> None:
            told = [*as_user, str(BINARIES / binary), *arguments]
            done = subprocess.run(told, cwd=place, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, timeout=60)
            assert done.returncode == 0, done.stderr.decode()

        run("initdb", "-D", str(data), "-U", USER, "-A", "trust", "--no-sync", "--locale=C", "-E", "UTF8")
        options = f"-k {place} -c listen_addresses='' -c fsync={'on' if fsync else 'off'}"
        run("pg_ctl", "-D", str(data), "-l", str(place / "log"), "-o", options, "-w", "start")
        try:
            yield f"postgresql://{USER}@/postgres?host={place}"
        finally:
            run("pg_ctl", "-D", str(data), "-m", "immediate", "-w", "stop")
