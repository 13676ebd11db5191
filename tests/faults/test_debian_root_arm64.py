"""A fresh Debian root of 64-bit Arm, emulated by QEMU: the package from its installation to the purge.

It takes some minutes, so it is run by hand, as root:

    apt-get install qemu-user-static debootstrap
    FIELDCAL_DEBIAN_ROOT_ARM64=DIR .venv/bin/python -m pytest -m faults tests/faults/test_debian_root_arm64.py

The root is made in DIR, which must be empty or not exist, with packages of this machine's release; a second run takes
it as it is. The kernel learns only within the test which program runs those of Arm: each command has a user namespace
with a binfmt_misc of its own (Linux 6.7 or later), so nothing of this machine changes.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from tests.faults.test_debian_root import (
    DATA,
    FIRST,
    NOW,
    DebianRoot,
    build,
    copied,
    in_force,
    remove_and_purge,
)
from tests.scenarios.processes import ROOT

FRESH = os.environ.get("FIELDCAL_DEBIAN_ROOT_ARM64", "")
EMULATOR = Path("/usr/lib/binfmt.d/qemu-aarch64.conf")  # of Debian's package: magic bytes, program and flags
PROGRAMS = {"debootstrap": "debootstrap", "qemu-aarch64-static": "qemu-user-static", "unshare": "util-linux"}
REGISTER = (
    "mount -t proc proc /proc && mount -t binfmt_misc binfmt_misc /proc/sys/fs/binfmt_misc && "
    f"cat {EMULATOR} > /proc/sys/fs/binfmt_misc/register && "
)
INCLUDED = "python3,systemd,ca-certificates"

pytestmark = [
    pytest.mark.faults,
    pytest.mark.root,
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root, for debootstrap and chroot"),
    pytest.mark.skipif(not FRESH, reason="FIELDCAL_DEBIAN_ROOT_ARM64 names no directory; this file says how to run it"),
]


class ArmRoot(DebianRoot):
    """Each command with a binfmt_misc of its own."""

    def entered(self, shell: list[str], environment: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
        script, *arguments = shell
        waiting = f"echo; read _; {REGISTER} {script}"  # until the users are named below
        command = ["unshare", "--user", "--mount", "--pid", "--fork", "sh", "-c", waiting, *arguments]
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
        ) as process:
            assert process.stdout is not None
            process.stdout.readline()
            for ids in ("uid_map", "gid_map"):
                Path(f"/proc/{process.pid}/{ids}").write_text("0 0 65536")
            said, wrong = process.communicate("\n")
        return subprocess.CompletedProcess(command, process.returncode, said, wrong)


def require_emulation() -> None:
    """Skip where programs of Arm cannot be run, with the reason."""
    lacking = [f"{name} (package {package})" for name, package in PROGRAMS.items() if shutil.which(name) is None]
    if not EMULATOR.exists():
        lacking.append(f"{EMULATOR} (package qemu-user-static)")
    if lacking:
        pytest.skip(f"needs {', '.join(lacking)}")
    tried = ArmRoot(Path("/")).entered(["true"], os.environ)
    if tried.returncode:
        pytest.skip(f"needs a private binfmt_misc (Linux 6.7 or later, this is {platform.release()}): {tried.stderr}")


def make_root(path: Path) -> None:
    """A fresh root of this machine's release. The second half of debootstrap runs emulated."""
    release = platform.freedesktop_os_release()["VERSION_CODENAME"]
    options = ["--arch", "arm64", "--foreign", "--variant=minbase", f"--include={INCLUDED}"]
    subprocess.run(["debootstrap", *options, release, path], check=True, capture_output=True)
    # In a user namespace no device can be made. The first half made all, and in a container debootstrap makes none.
    ArmRoot(path).run("/debootstrap/debootstrap --second-stage", {"container": "lxc"})


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[ArmRoot]:
    """A copy of the fresh root, which is made first where there is none."""
    require_emulation()
    fresh = Path(FRESH)
    if not fresh.exists() or not any(fresh.iterdir()):
        make_root(fresh)
    assert not (fresh / "debootstrap").exists(), f"debootstrap did not end in {fresh}; remove it"
    with copied(FRESH, tmp_path / "root") as path:
        yield ArmRoot(path)


def test_a_life_of_the_package_on_arm64(arm: ArmRoot) -> None:
    assert arm.run("uname -m; dpkg --print-architecture").split() == ["aarch64", "arm64"]
    build(ROOT, NOW, arm.path / "tmp", "--arch", "arm64")
    arm.install(NOW)
    assert "VALID" in arm.run(FIRST)
    assert in_force(arm)["windows"] > 0
    arm.run(f"agent audit {DATA}/fieldcal-000001.mcap")
    remove_and_purge(arm)
