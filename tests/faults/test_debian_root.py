"""A fresh Debian root: the life of the package from the version before to the purge, and both commands of the README.

They take five minutes and the time of `make test`, so they are run by hand, as root:

    debootstrap --variant=minbase --include=python3,python3-venv,make,git,systemd,ca-certificates bookworm DIR
    FIELDCAL_DEBIAN_ROOT=DIR .venv/bin/python -m pytest -m faults tests/faults/test_debian_root.py

The version before is the revision FIELDCAL_BEFORE, by default the oldest one that has the package.
tests/faults/test_debian_root_arm64.py does the same on an emulated 64-bit Arm.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from hw.virtual.presets import COUNTS_PER_MPS2
from tests.faults.test_hardening import Systemd
from tests.scenarios.processes import ROOT

FRESH = os.environ.get("FIELDCAL_DEBIAN_ROOT", "")
BEFORE, NOW = "1.0~test", "1.1~test"
RUN_S = 62  # four positions take 52 s
DATA, CONFIG, UNIT = "/var/lib/fieldcal", "/etc/fieldcal/gateway.toml", "/lib/systemd/system/fieldcal.service"
AGENT = 'agent() { setpriv --reuid=fieldcal --regid=fieldcal --init-groups fieldcal "$@"; }\n'
SHOW = f"agent show --data-dir {DATA} --json -"
RUN = f"agent run {CONFIG} --data-dir {DATA} --duration {RUN_S}"
MOUNTS = (
    'mount --bind "$0" "$0" && mount -t proc proc "$0/proc" && mount --rbind /dev "$0/dev" && '
    'exec chroot "$0" sh -ec "$1"'
)
# A bench on two serial ports that every user may open, while the command in its place runs.
BENCH = """
fieldcal simulate --preset plain --link /tmp/bench > /tmp/served & bench=$!
trap 'kill $bench; wait $bench' EXIT
until grep -q reference /tmp/served; do sleep 0.2; done
for role in sensor reference; do
    chmod 755 "$(dirname "$(readlink /tmp/bench-$role)")"; chmod 666 "$(readlink -f /tmp/bench-$role)"
done
{command}
"""
FIRST = BENCH.format(
    command=f"""
fieldcal init {CONFIG} --sensor-port /tmp/bench-sensor --reference-port /tmp/bench-reference \\
    --theta-deg 35 --alpha-deg 0,30,120,210 --sensitivity {COUNTS_PER_MPS2:.6g}
agent check {CONFIG}
{RUN}
"""
)
LIMITED = BENCH.format(
    command=f"python3 /tmp/limits.py {UNIT} {DATA} $(id -u fieldcal) -- "
    f"fieldcal run {CONFIG} --data-dir {DATA} --duration {RUN_S}"
)

pytestmark = [
    pytest.mark.faults,
    pytest.mark.root,
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root, for chroot and mount"),
    pytest.mark.skipif(not FRESH, reason="FIELDCAL_DEBIAN_ROOT names no fresh root; this file says how to make one"),
]


class DebianRoot:
    """Runs shell commands in the root, each with /proc and /dev of its own."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def run(self, script: str, environment: Mapping[str, str] | None = None, status: int | None = 0) -> str:
        """What was printed; the errors too where the exit status may be another one than 0 (`status` None: any)."""
        done = self.entered([MOUNTS, str(self.path), AGENT + script], {**os.environ, **(environment or {})})
        assert status in (None, done.returncode), done.stdout + done.stderr
        return done.stdout + ("" if status == 0 else done.stderr)

    def entered(self, shell: list[str], environment: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
        """Run `sh -c` with these arguments where it may mount."""
        return subprocess.run(
            ["unshare", "--mount", "sh", "-c", *shell], capture_output=True, text=True, check=False, env=environment
        )

    def install(self, version: str) -> None:
        self.run(f"dpkg -i /tmp/fieldcal_{version}_*.deb")
        assert self.run("dpkg-query -Wf '${Version}' fieldcal") == version


@contextmanager
def copied(fresh: str, path: Path) -> Iterator[Path]:
    """A copy of a fresh root."""
    subprocess.run(["cp", "-a", fresh, path], check=True)
    (path / "etc/hosts").write_text("127.0.0.1 localhost\n")  # the installer of Debian writes it, debootstrap does not
    yield path
    shutil.rmtree(path)


@pytest.fixture
def debian(tmp_path: Path) -> Iterator[DebianRoot]:
    with copied(FRESH, tmp_path / "root") as path:
        yield DebianRoot(path)


def build(checkout: Path, version: str, output: Path, *more: str) -> None:
    command: list[str | Path] = [checkout / "deploy/debian/build.sh", "--output", output, "--version", version, *more]
    subprocess.run(command, check=True, capture_output=True)


@pytest.fixture
def packages(debian: DebianRoot, tmp_path: Path) -> Iterator[None]:
    """The package of the version before and of this checkout, in /tmp of the root."""
    born = ["git", "log", "--diff-filter=A", "--format=%H", "--", "deploy/debian/build.sh"]
    revision = os.environ.get("FIELDCAL_BEFORE") or subprocess.check_output(born, cwd=ROOT, text=True).split()[-1]
    checkout = tmp_path / "before"
    subprocess.run(["git", "worktree", "add", "--detach", checkout, revision], cwd=ROOT, check=True)
    (checkout / ".venv").symlink_to(ROOT / ".venv")  # pip and hatchling
    try:
        build(checkout, BEFORE, debian.path / "tmp")
        build(ROOT, NOW, debian.path / "tmp")
        yield
    finally:
        subprocess.run(["git", "worktree", "remove", "--force", checkout], cwd=ROOT, check=True)


def in_force(debian: DebianRoot) -> dict[str, Any]:
    """The calibration in force, by the program that is installed."""
    shown: dict[str, Any] = json.loads(debian.run(SHOW))["sensors"]["sensor"]["calibration"]
    return shown


@pytest.mark.usefixtures("packages")
def test_a_life_of_the_package(debian: DebianRoot) -> None:
    debian.install(BEFORE)
    assert "VALID" in debian.run(FIRST)
    before = in_force(debian)

    debian.install(NOW)
    told = start_under_the_limits(debian)
    assert {"READY=1", "WATCHDOG=1", "STOPPING=1"} <= told
    after = in_force(debian)
    assert after["windows"] > before["windows"], "the agent went on from the state of the version before"
    debian.run(f"agent audit {DATA}/fieldcal-000002.mcap")

    debian.install(BEFORE)
    if "version" in debian.run(BENCH.format(command=RUN), status=None):  # as the runbook says
        debian.run(f"mv {DATA}/state.sqlite {DATA}/state.sqlite.later")
        said = debian.run(BENCH.format(command=RUN))
        assert "VALID, restored from the previous run" in said
    assert in_force(debian)["windows"] > before["windows"]

    remove_and_purge(debian)


def remove_and_purge(debian: DebianRoot) -> None:
    """The state stays at the first, and nothing at the second."""
    debian.run("dpkg -r fieldcal")
    assert (debian.path / DATA[1:] / "state.sqlite").exists()
    assert (debian.path / CONFIG[1:]).exists()
    debian.run("dpkg -P fieldcal")
    left = [path for path in debian.path.rglob("*fieldcal*") if not path.is_relative_to(debian.path / "tmp")]
    assert left == []
    assert "fieldcal" not in (debian.path / "etc/passwd").read_text()


def start_under_the_limits(debian: DebianRoot) -> set[str]:
    """Run the agent of the package as its unit does; what it tells systemd."""
    shutil.copy(ROOT / "tests/faults/limits.py", debian.path / "tmp/limits.py")
    systemd, ended = Systemd(debian.path / "tmp/notify"), threading.Event()
    (debian.path / "tmp/notify").chmod(0o666)
    reader = threading.Thread(target=lambda: [systemd.told() for _ in iter(lambda: ended.wait(0.1), True)])
    reader.start()
    try:
        debian.run(LIMITED, systemd.environment | {"NOTIFY_SOCKET": "/tmp/notify"})
    finally:
        ended.set()
        reader.join()
    told = systemd.told()
    systemd.close()
    return told


def test_both_commands_of_the_readme(debian: DebianRoot) -> None:
    """In a checkout without a virtual environment. pip finds the wheels of both lock files beside it, and no index."""
    checkout = debian.path / "srv/fieldcal"
    subprocess.run(["git", "clone", "--quiet", ROOT, checkout], check=True)
    download: list[str | Path] = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--require-hashes",
        "--dest",
        debian.path / "wheels",
    ]
    for lock in ("requirements.lock", "requirements-dev.lock"):
        subprocess.run([*download, "-r", ROOT / lock], check=True)
    pip = {"PIP_CONFIG_FILE": "/dev/null", "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": "/wheels"}
    debian.run("cd /srv/fieldcal; make .venv/runtime", pip)
    assert "VALID" in debian.run(f"cd /srv/fieldcal; timeout --signal=INT {RUN_S} make run || [ $? = 124 ]", pip)
    debian.run("cd /srv/fieldcal; make test", pip)
