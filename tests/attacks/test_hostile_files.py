"""Hostile files of a fixed seed through the commands that read them; `python -m benchmarks.hostile_files` runs more."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = 60


def test_no_hostile_file_ends_a_command_with_a_fault() -> None:
    """No exit status but 0, 2 and 3, no traceback, no control character, memory and CPU time within the limits."""
    run = [sys.executable, "-m", "benchmarks.hostile_files", "--quick", "--count", str(FILES)]
    done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    counts = [[int(cell) for cell in line.split(" | ")[1:8]] for line in done.stdout.splitlines() if " MB |" in line]
    assert sum(row[0] for row in counts) == FILES
    refused, harmless = sum(row[3] + row[4] for row in counts), sum(row[2] for row in counts)
    assert refused > FILES / 2
    assert harmless > 0
