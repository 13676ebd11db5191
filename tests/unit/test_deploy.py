"""The systemd unit: systemd knows every key in it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

UNIT = Path(__file__).parents[2] / "deploy" / "fieldcal.service"


def test_systemd_understands_the_unit(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    # The program is where the unit says only on a gateway; that one complaint must not hide another.
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text().replace("/opt/fieldcal/.venv/bin/fieldcal", "/bin/true"))
    verified = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, check=False)
    # It exits 0 even for a key it does not know: only what it says counts.
    assert [line for line in verified.stderr.splitlines() if UNIT.name in line] == []
