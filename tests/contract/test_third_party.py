"""The package of docs/add-a-sensor.md: installed like an installer does it, it passes its own tests."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "examples" / "fieldcal-mma8451"
PAGE = ROOT / "docs" / "add-a-sensor.md"


@pytest.mark.thorough
def test_its_own_tests_pass(tmp_path: Path) -> None:
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text("utf-8"))["project"]
    info = tmp_path / "fieldcal_mma8451-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    (name, value), *others = project["entry-points"]["fieldcal.sensors"].items()
    assert not others
    (info / "entry_points.txt").write_text(f"[fieldcal.sensors]\n{name} = {value}\n")
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{tmp_path}", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(PACKAGE), str(PACKAGE)]
    done = subprocess.run(command, cwd=PACKAGE, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(re.findall(r"(\d+) passed", done.stdout)[0]) > 40


def test_what_the_page_shows_is_what_the_package_is() -> None:
    shown = re.findall(r"^```(?:python|toml)\n(.*?)^```", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    assert len(shown) >= 4
    sources = "\n".join(path.read_text("utf-8") for path in sorted(PACKAGE.iterdir()) if path.is_file())
    for snippet in shown:
        assert snippet.strip() in sources, snippet
