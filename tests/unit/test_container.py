"""The container: what its Containerfile says, and, where somebody built one, that the agent runs in it without root.

`make container` needs root, buildah and minutes, so it is run by hand; its archive is then tested here by

    FIELDCAL_CONTAINER=dist/fieldcal_VERSION_ARCH.oci.tar .venv/bin/python -m pytest tests/unit/test_container.py
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import tarfile
from pathlib import Path

import pytest

from tests.scenarios.processes import ROOT

FOLDER = ROOT / "deploy" / "container"
ARCHIVE = os.environ.get("FIELDCAL_CONTAINER", "")


def instructions() -> list[tuple[str, str]]:
    lines = (FOLDER / "Containerfile").read_text().splitlines()
    return [(line.split()[0], line.partition(" ")[2]) for line in lines if line and not line.startswith("#")]


def test_the_containerfile() -> None:
    said = instructions()
    assert said[:2] == [("ARG", "BASE"), ("FROM", "${BASE}")], "any base, by argument"
    names = [name for name, _ in said]
    user = dict(said)["USER"]
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", user), "a number that is not root, which an orchestrator can check"
    assert names.index("USER") < names.index("ENTRYPOINT")
    assert names.count("USER") == names.count("ENTRYPOINT") == names.count("CMD") == 1
    # Nothing is fetched and nothing runs as root while it is built.
    assert not {"RUN", "ADD", "SHELL"} & set(names)
    assert ("COPY", f"--chown={user} data /var/lib/fieldcal") in said
    entry, command = (json.loads(dict(said)[name]) for name in ("ENTRYPOINT", "CMD"))
    unit = (ROOT / "deploy" / "fieldcal.service").read_text()
    assert f"ExecStart={entry[0]} run /etc/fieldcal/gateway.toml --data-dir {command[-1]}" in unit, "the same places"


def test_what_the_script_needs_is_said(tmp_path: Path) -> None:
    tools = tmp_path / "bin"
    tools.mkdir()
    for tool in ("dirname", "id"):
        (tools / tool).symlink_to(f"/usr/bin/{tool}")
    done = subprocess.run(
        ["/bin/sh", FOLDER / "build.sh"], env={"PATH": str(tools)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "buildah dpkg-deb debootstrap; apt-get install buildah debootstrap dpkg-dev" in done.stderr
    done = subprocess.run(["/bin/sh", FOLDER / "build.sh", "--bass", "x"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "build.sh: there is no option --bass\n")


@pytest.mark.skipif(not ARCHIVE, reason="FIELDCAL_CONTAINER names no archive; the first lines of this file say how")
def test_the_agent_runs_in_it_without_root(tmp_path: Path) -> None:
    with tarfile.open(ROOT / ARCHIVE) as archive:
        assert "oci-layout" in archive.getnames()
    environment = os.environ | {"BUILDAH_ISOLATION": "chroot", "STORAGE_DRIVER": "vfs"}

    def buildah(*words: str) -> str:
        command = ["buildah", "--root", str(tmp_path / "store"), "--runroot", str(tmp_path / "run"), *words]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout.strip()

    container = buildah("from", buildah("pull", "--quiet", f"oci-archive:{ROOT / ARCHIVE}"))
    fieldcal = "/opt/fieldcal/.venv/bin/fieldcal"
    assert buildah("run", container, "--", "id", "-u") == "10001"
    buildah("run", container, "--", fieldcal, "run", "--data-dir", "/var/lib/fieldcal", "--duration", "5")
    assert "fieldcal-000001.mcap" in buildah("run", container, "--", "ls", "/var/lib/fieldcal")
    buildah("run", container, "--", fieldcal, "audit", "/var/lib/fieldcal/fieldcal-000001.mcap")
    buildah("run", container, "--", "sh", "-c", "! touch /opt/fieldcal/x && ! touch /etc/x")
