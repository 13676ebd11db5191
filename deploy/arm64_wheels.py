"""Whether every locked package has a wheel for 64-bit Arm whose hash is in the lock file: nothing is compiled there.

    .venv/bin/python deploy/arm64_wheels.py [LOCK...]

Asks the package index, so it is run by hand; it installs nothing. Default: requirements.lock, for each Python that the
project supports. Exit status 1 if a wheel is missing; pip names it.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.11", "3.12", "3.13")
GLIBC = range(17, 37)  # 2.17 is the oldest for aarch64, 2.36 that of Debian 12


def missing(lock: Path, python: str) -> str:
    """What pip says is missing; "" where all packages of the lock file have a wheel."""
    platforms = [word for minor in GLIBC for word in ("--platform", f"manylinux_2_{minor}_aarch64")]
    with tempfile.TemporaryDirectory() as nowhere:
        command = [
            sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--disable-pip-version-check",
            "--ignore-installed", "--only-binary=:all:", "--require-hashes", "--no-deps",
            "--implementation", "cp", "--python-version", python, *platforms, "--target", nowhere, "-r", str(lock),
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
    return "" if done.returncode == 0 else "\n".join(lines) or done.stderr


def main() -> int:
    """Look at all lock files; print one line for each."""
    locks = [Path(name) for name in sys.argv[1:]] or [ROOT / "requirements.lock"]
    faults = 0
    for lock in locks:
        packages = sum("==" in line for line in lock.read_text().splitlines())
        for python in PYTHONS:
            told = missing(lock, python)
            faults += bool(told)
            print(f"{lock.name}, Python {python}: {told or f'all of {packages} packages have a wheel for aarch64'}")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
