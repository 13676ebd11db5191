"""The Debian package: what is in it, who it depends on, and that its scripts keep and remove what they should."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest

from deploy.licences.licences import texts
from tests.scenarios.processes import ROOT

DEBIAN = ROOT / "deploy" / "debian"
PACKAGES = "opt/fieldcal/.venv/lib"


EPOCH_S = "1700000000"


def installed(directory: Path, program: str) -> Path:
    """Packages as pip leaves them: one, with a program that begins with the path of the Python that installed it."""
    information = directory / "site" / "part-1.0.dist-info"
    (information / "licenses").mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.4\nName: part\nVersion: 1.0\nLicense-Expression: MIT\n")
    (information / "licenses/LICENSE").write_text("Permission is granted by the author of part.\n")
    script = directory / "site/bin/part"
    script.parent.mkdir()
    script.write_text(f"#!{program}\n")
    (information / "RECORD").write_text(
        f"../../bin/part,sha256={hashlib.sha256(script.read_bytes()).hexdigest()},9\n"
        "part-1.0.dist-info/METADATA,,\npart-1.0.dist-info/licenses/LICENSE,,\npart-1.0.dist-info/RECORD,,\n"
    )
    return directory / "site"


def built(checkout: Path, directory: Path, umask: int) -> Path:
    """Built without the packages of the lock file: these come from the index in `make deb`."""
    for needed in ("dpkg-deb", "/usr/bin/python3", str(ROOT / ".venv/bin/python")):
        if shutil.which(needed) is None:
            pytest.skip(f"there is no {needed}")
    site = installed(directory, f"{directory}/bin/python")
    done = subprocess.run(
        [checkout / "deploy/debian/build.sh",
         "--arch", "arm64", "--version", "9.8~deb12", "--site", site, "--output", directory],
        capture_output=True, text=True, check=False, umask=umask, cwd=directory,
        env={**os.environ, "SOURCE_DATE_EPOCH": EPOCH_S, "TMPDIR": str(directory)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return directory / "fieldcal_9.8~deb12_arm64.deb"


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(ROOT, tmp_path_factory.mktemp("deb"), 0o022)


@pytest.mark.thorough
def test_another_path_gives_the_same_bytes(package: Path, tmp_path: Path) -> None:
    """Other are the checkout, the directory for scratch files, the umask, and the path of the Python that installed."""
    checkout = tmp_path / "another path" / "checkout"
    left = shutil.ignore_patterns(".git", ".venv*", "*cache*", "tests", "docs", "benchmarks", "data", "dist", "keys")
    shutil.copytree(ROOT, checkout, ignore=left)
    (checkout / ".venv").symlink_to(ROOT / ".venv")
    directory = tmp_path / "longer"
    directory.mkdir()
    other = built(checkout, directory, 0o077)
    assert hashlib.sha256(other.read_bytes()).digest() == hashlib.sha256(package.read_bytes()).digest()


def asked(*words: str | Path) -> str:
    return subprocess.run(["dpkg-deb", *words], capture_output=True, text=True, check=True).stdout


@pytest.mark.thorough
def test_what_it_depends_on(package: Path) -> None:
    fields = dict(line.split(": ", 1) for line in asked("-f", package).splitlines() if line[:1] != " ")
    minor = subprocess.run(
        ["/usr/bin/python3", "-c", "import sys; print(sys.version_info[1])"], capture_output=True, text=True, check=True
    ).stdout.strip()
    assert (fields["Architecture"], fields["Version"]) == ("arm64", "9.8~deb12")
    assert f"python3 (>= 3.{minor}), python3 (<< 3.{int(minor) + 1})" in fields["Depends"]
    assert int(fields["Installed-Size"]) > 1000


@pytest.mark.thorough
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
    assert "../../bin" not in (site / "part-1.0.dist-info/RECORD").read_text()
    copyright_ = (tmp_path / "usr/share/doc/fieldcal/copyright").read_text()
    for text in ("part 1.0: MIT", "by the author of part", "Apache License", "Leon Sorokin"):
        assert text in copyright_, "also of the one library that is part of fieldcal: uPlot"


def test_a_package_without_a_text_of_its_licence_is_named(tmp_path: Path) -> None:
    site = installed(tmp_path, "python")
    (site / "part-1.0.dist-info/licenses/LICENSE").unlink()
    command = [sys.executable, str(ROOT / "deploy/licences/licences.py"), str(site)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert "no text of a licence: part 1.0" in done.stderr


def test_every_package_of_a_gateway_has_a_text_of_its_licence() -> None:
    """Those of this environment, which has the versions of the lock file."""
    locked = re.findall(r"^([\w.-]+)==(\S+)", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    for name, version in locked:
        package = distribution(name)
        assert package.version == version
        assert any(text.strip() for _, text in texts(package)), name


SYSTEMCTL = """#!/bin/sh
case $1 in
    is-active) cat active; [ "$(cat active)" = active ] ;;
    is-enabled) [ "$(cat enabled)" = enabled ] ;;
    stop) echo inactive > active ;;
    start) echo active > active ;;
    enable | disable) echo "$1d" > enabled ;;
    daemon-reload) ;;
    *) echo "systemctl $*" >> unknown; exit 1 ;;
esac
"""


class Machine:
    """Runs the scripts as dpkg does where systemd is. `systemctl` keeps the state of one service in two files."""

    def __init__(self, directory: Path, active: str, enabled: str) -> None:
        self.directory = directory
        (directory / "run/systemd/system").mkdir(parents=True)
        programs = directory / "programs"
        programs.mkdir()
        for name in ("systemd-sysusers", "systemd-tmpfiles", "udevadm"):
            (programs / name).symlink_to("/bin/true")
        (programs / "systemctl").write_text(SYSTEMCTL)
        (programs / "systemctl").chmod(0o755)
        (directory / "active").write_text(active + "\n")
        (directory / "enabled").write_text(enabled + "\n")

    def call(self, script: str, *arguments: str) -> None:
        environment = {"PATH": f"{self.directory}/programs:{os.environ['PATH']}", "DPKG_ROOT": str(self.directory)}
        subprocess.run(["sh", DEBIAN / script, *arguments], cwd=self.directory, env=environment, check=True)

    @property
    def state(self) -> tuple[str, str]:
        assert not (self.directory / "unknown").exists()
        assert not (self.directory / "run/fieldcal.ran").exists(), "what an upgrade noted is not left behind"
        return tuple((self.directory / name).read_text().strip() for name in ("active", "enabled"))  # type: ignore[return-value]


@pytest.mark.parametrize("enabled", ["enabled", "disabled"])
@pytest.mark.parametrize(
    ("active", "after"), [("active", "active"), ("activating", "active"), ("inactive", "inactive")]
)
def test_an_upgrade_leaves_the_service_as_it_was(tmp_path: Path, active: str, after: str, enabled: str) -> None:
    machine = Machine(tmp_path, active, enabled)
    machine.call("prerm", "upgrade", "0.4.0")
    assert (tmp_path / "active").read_text() == "inactive\n", "stopped while its files change"
    machine.call("postinst", "configure", "0.3.0")
    assert machine.state == (after, enabled)


def test_an_upgrade_that_is_given_up_starts_what_ran(tmp_path: Path) -> None:
    machine = Machine(tmp_path, "active", "disabled")
    machine.call("prerm", "upgrade", "0.4.0")
    machine.call("postinst", "abort-upgrade", "0.4.0")
    assert machine.state == ("active", "disabled")


@pytest.mark.parametrize(("enabled", "after"), [("enabled", "active"), ("disabled", "inactive")])
def test_an_upgrade_from_0_2_0(tmp_path: Path, enabled: str, after: str) -> None:
    """Its prerm stops the service and leaves no note; what is enabled runs again."""
    machine = Machine(tmp_path, "inactive", enabled)
    machine.call("postinst", "configure", "0.2.0~deb12")
    assert machine.state == (after, enabled)


def test_a_first_installation_starts_nothing_and_a_removal_ends_it(tmp_path: Path) -> None:
    machine = Machine(tmp_path, "inactive", "disabled")
    machine.call("postinst", "configure", "")
    assert machine.state == ("inactive", "disabled")
    machine.call("prerm", "remove")
    assert machine.state == ("inactive", "disabled")
    machine = Machine(tmp_path / "running", "active", "enabled")
    machine.call("prerm", "remove")
    assert machine.state == ("inactive", "disabled")


def test_scripts_are_sound_and_keep_the_state() -> None:
    for script in ("postinst", "prerm", "postrm", "build.sh"):
        subprocess.run(["sh", "-n", DEBIAN / script], check=True)
    removal, _, purge = (DEBIAN / "postrm").read_text().partition("purge)")
    assert "/var/lib/fieldcal" not in removal, "data stay until the package is purged"
    assert "/var/lib/fieldcal" in purge
    for script in ("postinst", "prerm"):
        assert "rm -" not in (DEBIAN / script).read_text()
