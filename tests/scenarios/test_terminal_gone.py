"""The agent's terminal disappears: its window is closed or the connection is lost."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.scenarios.processes import ROOT, interrupt, recordings, wait_until

CONFIG = """
[[devices]]
name = "imu"
driver = "serial-csv"
options = { port = "/nonexistent/port", rate_hz = 100 }
[[channels]]
sensor = "imu"
prior = {}
[recording]
rotate_s = 1
[zenoh]
enabled = false
"""


@contextmanager
def on_a_terminal(tmp_path: Path, *, controlling: bool) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """Run the agent on a pseudo-terminal until it records; yields it and the descriptor of the user's side."""
    config, data_dir = tmp_path / "config.toml", tmp_path / "data"
    config.write_text(CONFIG)
    person, terminal = pty.openpty()
    command = [sys.executable, "-m", "agent", "run", str(config), "--data-dir", str(data_dir)]
    if controlling:
        command = ["setsid", "--ctty", *command]
    agent = subprocess.Popen(
        command, cwd=ROOT, stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=not controlling
    )
    os.close(terminal)
    try:
        wait_until(lambda: data_dir.exists() and recordings(data_dir), 60, "it records")
        yield agent, person
    finally:
        if agent.poll() is None:
            agent.kill()
        agent.wait()


def test_hung_up_it_ends_as_with_ctrl_c(tmp_path: Path) -> None:
    with on_a_terminal(tmp_path, controlling=True) as (agent, person):
        os.close(person)
        assert agent.wait(60) == 0
    assert [path.suffix for path in recordings(tmp_path / "data")][-1] == ".mcap"


@pytest.mark.thorough
def test_a_terminal_that_is_gone_does_not_stop_it(tmp_path: Path) -> None:
    data_dir = tmp_path / "data"
    with on_a_terminal(tmp_path, controlling=False) as (agent, person):
        os.close(person)
        before = len(recordings(data_dir))
        wait_until(lambda: len(recordings(data_dir)) >= before + 3 or agent.poll() is not None, 60, "it goes on")
        assert agent.poll() is None
        interrupt(agent)
    assert agent.returncode == 0
