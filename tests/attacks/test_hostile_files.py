"""Hostile files of a fixed seed through the commands that read them; `python -m benchmarks.hostile_files` runs more."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILES = 25


@pytest.mark.thorough
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


MEMORY = """
import sys
from pathlib import Path
from benchmarks.hostile_files import Program
large = bytearray(b"x" * (300 << 20))  # Linux counts it for each process that is forked from this one
ran = Program(Path(sys.argv[1])).run(["--version"])
print(ran.status, b"fieldcal, version" in ran.output, ran.peak_bytes < len(large) / 2)
"""


def test_the_memory_of_the_program_is_not_that_of_the_process_that_starts_it(tmp_path: Path) -> None:
    run = [sys.executable, "-c", MEMORY, str(tmp_path / "output")]
    done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout == "0 True True\n", done.stderr
