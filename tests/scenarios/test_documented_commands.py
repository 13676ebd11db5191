"""Every command in README and docs runs as it stands there."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.scenarios.processes import ROOT, interrupt, started, wait_until

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FIRST = ("README.md", "calibrate.md")  # in `make test`; the other pages in `make test-all`
FENCE = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
# Commands that run until they are stopped, each with a text in its first output.
ENDLESS = {"run": "recording", "router": "tcp/", "simulate": "sensor "}


def commands(page: Path) -> list[str]:
    blocks = FENCE.findall(page.read_text())
    return [line.split("  #")[0].strip() for block in blocks for line in block.splitlines() if line.strip()]


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data directory of a short run, for commands that read one; its public key is in keys/ beside it."""
    directory = tmp_path_factory.mktemp("documented") / "data"
    key = directory.with_name("keys") / "virtual.bench.signing.key"  # as the Makefile has it
    words: list[str | Path] = ["run", "--data-dir", directory, "--duration", "4", "--signing-key", key]
    with started(*words, output=directory.with_name("output")) as process:
        process.wait(60)
    return directory


@pytest.mark.one_case
@pytest.mark.parametrize(
    "page", [pytest.param(p, marks=[] if p.name in FIRST else pytest.mark.thorough, id=p.name) for p in PAGES]
)
def test_documented_commands_run(page: Path, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    if any(name in line for line in commands(page) for name in ("data", "keys")):
        data_dir: Path = request.getfixturevalue("data_dir")
        for directory in (data_dir, data_dir.with_name("keys")):
            shutil.copytree(directory, tmp_path / directory.name)
    for line in commands(page):
        words = shlex.split(line)
        if words[0] == "make":
            targets = (ROOT / "Makefile").read_text()
            assert re.search(rf"^{re.escape(words[1])}:", targets, re.MULTILINE), line
        elif words[:3] == ["python", "-m", "pytest"]:
            assert all((ROOT / word).exists() for word in words[3:] if "/" in word), line
        elif words[:3] == ["sudo", "apt-get", "install"]:
            continue  # commands that install software or change the machine are not run
        elif words[0] == "fieldcal":
            run_command(words[1:], tmp_path, line)
        else:
            raise AssertionError(f"{page.name}: {line!r} is no command that this test knows how to run")


def run_command(words: list[str], directory: Path, line: str) -> None:
    words = [word.replace("/tmp/", f"{directory}/").replace(":7447", ":17447") for word in words]
    if words[0] in ENDLESS and "--csv" not in words:
        output = directory / "output"
        output.unlink(missing_ok=True)
        with started(*words, output=output, directory=directory) as process:
            sign = ENDLESS[words[0]]
            wait_until(lambda: sign in output.read_text() or process.poll() is not None, 20, line)
            interrupt(process)
        assert sign in output.read_text(), line
        assert process.returncode == 0, line
        return
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "agent", *words]
    done = subprocess.run(
        command, cwd=directory, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
