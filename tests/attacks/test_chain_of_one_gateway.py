"""A directory holds the recordings of one gateway: files of another one, signed with the same key, are refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from agent.recording.owner import check_owner
from tests.attacks.chain_site import audited, record

ROOT = Path(__file__).parents[2]
OTHER = """
[gateway]
site = "site"
name = "other"
[[devices]]
name = "acc"
driver = "serial-csv"
options = { port = "/dev/there-is-no-such-port", rate_hz = 1000, axes = 3, unit = "count" }
[[channels]]
sensor = "acc"
prior = { sensitivity = 26105 }
poses = [{ start_s = 3, stop_s = 13, gravity_mps2 = [0, 0, 9.81] }]
[zenoh]
enabled = false
"""


def test_a_directory_of_one_gateway_passes(tmp_path: Path) -> None:
    assert len(record(tmp_path / "a")) >= 5
    status, text = audited(tmp_path / "a")
    assert status == 0, text


@pytest.mark.parametrize("replaced", [slice(2, 3), slice(1, None), slice(-1, None)], ids=["one", "most", "last"])
def test_files_of_another_gateway_with_the_same_key_are_refused(tmp_path: Path, replaced: slice) -> None:
    files, others = record(tmp_path / "a"), record(tmp_path / "b", gateway="other", seed=2)
    for path, other in zip(files[replaced], others[replaced], strict=True):
        path.write_bytes(other.read_bytes())
    status, text = audited(tmp_path / "a")
    assert status == 3
    said = f"{files[replaced][0]}: FAILED"
    assert said in text
    reason = text[text.index(said) :].splitlines()[1:]
    assert any("site/other" in line and "site/gateway" in line for line in reason), text


def test_the_agent_does_not_add_to_the_directory_of_another_gateway(tmp_path: Path) -> None:
    record(tmp_path / "a")
    check_owner(tmp_path / "a", "site/gateway")
    settings = tmp_path / "other.toml"
    settings.write_text(OTHER)
    before = sorted((path.name, path.stat().st_size) for path in (tmp_path / "a").iterdir())
    command: list[str | Path] = [
        sys.executable,
        "-m",
        "agent",
        "run",
        settings,
        "--data-dir",
        tmp_path / "a",
        "--duration",
        "1",
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "site/gateway" in done.stderr
    assert "site/other" in done.stderr
    assert sorted((path.name, path.stat().st_size) for path in (tmp_path / "a").iterdir()) == before
