"""The Debian package in a fresh Debian root: installed, a first calibration, upgraded, taken back, purged.

It takes five minutes, so it is run by hand, as root:

    debootstrap --variant=minbase --include=python3,systemd,ca-certificates bookworm DIR
    FIELDCAL_DEBIAN_ROOT=DIR .venv/bin/python -m pytest -m faults tests/faults/test_debian_root.py
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from hw.virtual.presets import COUNTS_PER_MPS2
from tests.scenarios.processes import ROOT

pytestmark = [pytest.mark.faults, pytest.mark.root]
FRESH = os.environ.get("FIELDCAL_DEBIAN_ROOT", "")
VERSIONS = ("1.0~test", "1.1~test")
CALIBRATE = f"""
fieldcal simulate --preset plain --link /tmp/bench > /tmp/served & bench=$!
until grep -q reference /tmp/served; do sleep 0.2; done
for role in sensor reference; do
    chmod 755 "$(dirname "$(readlink /tmp/bench-$role)")"; chmod 666 "$(readlink -f /tmp/bench-$role)"
done
fieldcal init /etc/fieldcal/gateway.toml --sensor-port /tmp/bench-sensor --reference-port /tmp/bench-reference \\
    --theta-deg 35 --alpha-deg 0,30,120,210 --sensitivity {COUNTS_PER_MPS2:.6g}
agent check /etc/fieldcal/gateway.toml
agent doctor /etc/fieldcal/gateway.toml --data-dir /var/lib/fieldcal --measure 3
agent run /etc/fieldcal/gateway.toml --data-dir /var/lib/fieldcal --duration 62
kill $bench; wait $bench
"""


class DebianRoot:
    """Runs shell commands in the root, each with /proc and /dev of its own."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def run(self, script: str) -> str:
        mounts = 'mount -t proc proc "$0/proc" && mount --rbind /dev "$0/dev" && exec chroot "$0" sh -ec "$1"'
        agent = 'agent() { setpriv --reuid=fieldcal --regid=fieldcal --init-groups fieldcal "$@"; }\n'
        done = subprocess.run(
            ["unshare", "--mount", "sh", "-c", mounts, self.path, agent + script],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def install(self, version: str) -> None:
        self.run(f"dpkg -i /tmp/fieldcal_{version}_*.deb")
        assert self.run("dpkg-query -Wf '${Version}' fieldcal") == version


@pytest.fixture
def debian(tmp_path: Path) -> Iterator[DebianRoot]:
    """A copy of the fresh root, with two packages in its /tmp."""
    if os.geteuid() != 0:
        pytest.skip("needs root, for chroot and mount")
    if not FRESH:
        pytest.skip("FIELDCAL_DEBIAN_ROOT names no fresh root; the first lines of this file say how to make one")
    path = tmp_path / "root"
    subprocess.run(["cp", "-a", FRESH, path], check=True)
    first, second = VERSIONS
    build = [ROOT / "deploy/debian/build.sh", "--output", path / "tmp", "--version"]
    subprocess.run([*build, first], check=True, capture_output=True)
    (package,) = (path / "tmp").glob("*.deb")
    subprocess.run(["dpkg-deb", "-x", package, tmp_path / "unpacked"], check=True)
    (site,) = (tmp_path / "unpacked/opt/fieldcal/.venv/lib").glob("python3.*/site-packages")
    subprocess.run([*build, second, "--site", site], check=True, capture_output=True)
    yield DebianRoot(path)
    shutil.rmtree(path)


def test_a_life_of_the_package(debian: DebianRoot) -> None:
    first, second = VERSIONS
    debian.install(first)
    said = debian.run(CALIBRATE)
    assert "VALID, consistent with the calibration so far" in said
    before = debian.run("agent show --data-dir /var/lib/fieldcal --json -")
    for version in (second, first):  # an upgrade, and back again
        debian.install(version)
        assert debian.run("agent show --data-dir /var/lib/fieldcal --json -") == before
    debian.run("agent audit /var/lib/fieldcal/fieldcal-000001.mcap")
    debian.run("dpkg -r fieldcal")
    assert (debian.path / "var/lib/fieldcal/state.sqlite").exists()
    assert (debian.path / "etc/fieldcal/gateway.toml").exists()
    debian.run("dpkg -P fieldcal")
    left = [path for path in debian.path.rglob("*fieldcal*") if not path.is_relative_to(debian.path / "tmp")]
    assert left == []
    assert "fieldcal" not in (debian.path / "etc/passwd").read_text()
