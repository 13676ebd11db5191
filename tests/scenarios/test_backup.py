"""`fieldcal backup` while the agent writes: the copy is whole, passes the audit, and an agent goes on with it."""

from __future__ import annotations

import json
import shutil
import stat
import subprocess
from base64 import b64encode
from pathlib import Path
from typing import Any

import pytest

from agent.cli.main import run_cli
from agent.commanding.local import LocalAgent
from agent.delivery.store import Store
from agent.recording.continuation import UNKEPT_MAX
from hw.virtual.serial_port import PtyDevice
from tests.replay.test_audit_chain import write_keys
from tests.scenarios.processes import interrupt, recordings, results, started, wait_until
from tests.scenarios.resting_sensor import config_text, port
from tests.unit.command_desk import ANNA, sealed

__all__ = ["port"]  # a fixture

COMMANDS = f"""[commands]
enabled = true
[[commands.keys]]
id = "anna"
public_key = "{b64encode(ANNA.public_key().public_bytes_raw()).decode()}"
verbs = ["hold"]
sensors = ["*"]
"""


def release() -> bytes:
    """A command of anna that ends a hold, and changes nothing here."""
    return sealed({"release": True}, gateway="site/gateway", sensor="imu", valid_s=600)


def answer(data_dir: Path, command: bytes) -> dict[str, Any]:
    with LocalAgent(data_dir) as agent:
        return dict(json.loads(agent.send("imu/command/hold", command)))


@pytest.mark.slow
def test_a_restored_directory_goes_on(tmp_path: Path, port: PtyDevice) -> None:
    private, public = write_keys(tmp_path)
    config, data_dir, copy = tmp_path / "gateway.toml", tmp_path / "data", tmp_path / "copy"
    config.write_text(config_text(port, private) + COMMANDS)
    with started("run", config, "--data-dir", data_dir, output=tmp_path / "output") as process:
        wait_until(lambda: len(recordings(data_dir)) >= 4 and results(data_dir, "window"), 60, "recordings")
        old = [release()]
        assert answer(data_dir, old[0])["taken"]
        arguments = ["--data-dir", str(data_dir), "--config", str(config), "--with-keys"]
        assert run_cli(["backup", str(copy), *arguments]) == 0
        old.append(release())
        assert answer(data_dir, old[1])["taken"], "after the backup"
        interrupt(process)
    names = [path.name for path in recordings(copy / "data")]
    assert len(names) >= 4
    assert names[-1].endswith(".active"), "also the file that is being written"
    assert (copy / "data" / "head.json").exists()
    (engine,) = (data_dir / "engines").iterdir()
    assert (copy / "data" / "engines" / engine.name).read_bytes() == engine.read_bytes()
    assert (copy / "gateway.toml").read_text() == config.read_text()
    key = copy / "keys" / private.name
    assert key.read_bytes() == private.read_bytes()
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    checked = subprocess.run(["sha256sum", "-c", "SHA256SUMS"], cwd=copy, capture_output=True, check=False)
    assert checked.returncode == 0, checked.stdout
    stored = results(copy / "data", "window")
    assert stored
    shutil.rmtree(data_dir)
    shutil.copytree(copy / "data", data_dir)
    with started("run", config, "--data-dir", data_dir, output=tmp_path / "output") as process:
        wait_until(lambda: len(results(data_dir, "window")) > len(stored) + 1, 60, "new windows")
        for command in old:
            assert not (said := answer(data_dir, command))["taken"]
            assert "is not above" in said["reason"]
        assert answer(data_dir, release())["taken"]
        interrupt(process)
    assert process.returncode == 0, (tmp_path / "output").read_text()
    after = results(data_dir, "window")
    assert after[: len(stored)] == stored
    assert after[len(stored)]["epoch"] == stored[0]["epoch"], "the same gateway"
    assert run_cli(["audit", str(data_dir), "--public-key", str(public)]) == 0


def test_a_copy_never_uses_the_numbers_that_the_original_used_meanwhile(tmp_path: Path) -> None:
    store = Store(tmp_path / "data", 1000)
    store.close()
    assert run_cli(["backup", str(tmp_path / "copy"), "--data-dir", str(tmp_path / "data")]) == 0
    restored = Store(tmp_path / "copy" / "data")
    assert restored.last_sequence() == 1000 + UNKEPT_MAX
    restored.close()


def test_keys_are_copied_only_if_that_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data_dir = tmp_path / "data"
    data_dir.mkdir()
    write_keys(data_dir)
    names = ["command-counters.json", "fieldcal-000001.key", "fieldcal-000001.deleted", "fieldcal-000002.mcap.lock"]
    for name in [*names, "head.json", "notes.txt", "engines.whl"]:
        (data_dir / name).write_text("{}")
    (data_dir / "engines").mkdir()
    (data_dir / "engines" / "a.key").write_text("{}")
    for link in ("link", "engines/link.whl", "fieldcal-000003.deleted"):
        (data_dir / link).symlink_to("/etc/passwd")
    assert run_cli(["backup", str(tmp_path / "copy"), "--data-dir", str(data_dir)]) == 0
    found = {str(path.relative_to(tmp_path / "copy")) for path in (tmp_path / "copy").rglob("*") if path.is_file()}
    kept = {f"data/{name}" for name in (*names[2:], "head.json")}
    assert found == {*kept, "SHA256SUMS"}
    told = capsys.readouterr().out.splitlines()[-1]
    assert told == "not copied, since the agent did not make it: gateway.key, gateway.pub, link, notes.txt"
    assert stat.S_IMODE((tmp_path / "copy").stat().st_mode) == 0o700
    capsys.readouterr()
    assert run_cli(["backup", str(tmp_path / "copy"), "--data-dir", str(data_dir)]) == 2
    assert "it exists; name a new directory" in capsys.readouterr().err
    assert run_cli(["backup", str(tmp_path / "other"), "--data-dir", str(tmp_path / "none")]) == 2
    assert run_cli(["backup", str(tmp_path / "other"), "--data-dir", str(data_dir), "--with-keys"]) == 2
    (data_dir / "state.sqlite").write_bytes(b"no store" * 1000)
    capsys.readouterr()
    assert run_cli(["backup", str(tmp_path / "other"), "--data-dir", str(data_dir)]) == 2
    assert "file is not a database" in capsys.readouterr().err
