"""The Debian package: what is in it, who it depends on, and that its scripts keep and remove what they should."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.scenarios.processes import ROOT

DEBIAN = ROOT / "deploy" / "debian"
PACKAGES = "opt/fieldcal/.venv/lib"


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built without the packages of the lock file: these come from the index in `make deb`."""
    for needed in ("dpkg-deb", "/usr/bin/python3", str(ROOT / ".venv/bin/python")):
        if shutil.which(needed) is None:
            pytest.skip(f"there is no {needed}")
    directory = tmp_path_factory.mktemp("deb")
    site = directory / "site"
    site.mkdir()
    built = subprocess.run(
        [DEBIAN / "build.sh", "--arch", "arm64", "--version", "9.8~deb12", "--site", site, "--output", directory],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    return directory / "fieldcal_9.8~deb12_arm64.deb"


def asked(*words: str | Path) -> str:
    return subprocess.run(["dpkg-deb", *words], capture_output=True, text=True, check=True).stdout


def test_what_it_depends_on(package: Path) -> None:
    fields = dict(line.split(": ", 1) for line in asked("-f", package).splitlines() if line[:1] != " ")
    minor = subprocess.run(
        ["/usr/bin/python3", "-c", "import sys; print(sys.version_info[1])"], capture_output=True, text=True, check=True
    ).stdout.strip()
    assert (fields["Architecture"], fields["Version"]) == ("arm64", "9.8~deb12")
    assert f"python3 (>= 3.{minor}), python3 (<< 3.{int(minor) + 1})" in fields["Depends"]
    assert int(fields["Installed-Size"]) > 1000


def test_what_is_in_it(package: Path, tmp_path: Path) -> None:
    asked("-x", package, tmp_path)
    for place, source in {
        "lib/systemd/system/fieldcal.service": "deploy/fieldcal.service",
        "usr/lib/sysusers.d/fieldcal.conf": "deploy/fieldcal.sysusers",
        "usr/lib/tmpfiles.d/fieldcal.conf": "deploy/fieldcal.tmpfiles",
        "lib/udev/rules.d/60-fieldcal.rules": "deploy/fieldcal.udev",
        "usr/share/doc/fieldcal/examples/gateway.toml": "examples/gateway.toml",
    }.items():
        assert (tmp_path / place).read_bytes() == (ROOT / source).read_bytes(), place
    # The program that the unit starts is in the package, and runs in the environment of the package.
    program = re.search(r"^ExecStart=(\S+)", (ROOT / "deploy/fieldcal.service").read_text(), re.MULTILINE)
    assert program is not None
    script = tmp_path / program[1].lstrip("/")
    assert os.access(script, os.X_OK)
    assert script.read_text().startswith("#!/opt/fieldcal/.venv/bin/python\n")
    assert os.readlink(tmp_path / "usr/bin/fieldcal") == program[1]
    (site,) = (tmp_path / PACKAGES).glob("python3.*/site-packages")
    assert os.readlink(script.with_name("python")) == f"/usr/bin/{site.parent.name}"
    assert (site / "agent/setup/deploy/fieldcal.service").exists(), "install-service works from there too"
    assert list((site / "agent/__pycache__").glob("*.pyc")), "the service cannot write them"
    everything = asked("-c", package).splitlines()
    assert all("root/root" in line for line in everything)
    leaked = [path for path in tmp_path.rglob("*") if path.is_file() and str(ROOT).encode() in path.read_bytes()]
    assert leaked == [], "no path of the machine that built it"


def test_scripts_are_sound_and_keep_the_state() -> None:
    for script in ("postinst", "prerm", "postrm", "build.sh"):
        subprocess.run(["sh", "-n", DEBIAN / script], check=True)
    removal, _, purge = (DEBIAN / "postrm").read_text().partition("purge)")
    assert "/var/lib/fieldcal" not in removal, "data stay until the package is purged"
    assert "/var/lib/fieldcal" in purge
    for script in ("postinst", "prerm"):
        assert "rm " not in (DEBIAN / script).read_text()
