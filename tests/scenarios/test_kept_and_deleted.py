"""The agent with retention and a signing key is killed and started again: what it keeps, and what an audit says."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from agent.cli.main import run_cli
from hw.virtual.serial_port import PtyDevice
from tests.replay.test_audit_chain import write_keys
from tests.scenarios.processes import fieldcal, interrupt, recordings, results, started, wait_until
from tests.scenarios.resting_sensor import config_text, port

__all__ = ["port"]  # a fixture

KEPT = "keep_days = 0.00003"


def number(path: Path) -> int:
    return int(path.name.split("-")[1].split(".")[0])


@pytest.mark.slow
def test_a_life_of_recordings(tmp_path: Path, port: PtyDevice, capsys: pytest.CaptureFixture[str]) -> None:
    private, public = write_keys(tmp_path)
    config, data, output = tmp_path / "config.toml", tmp_path / "data", tmp_path / "output"
    config.write_text(config_text(port, private, KEPT))

    def up_to(least: int) -> None:
        wait_until(
            lambda: data.exists() and recordings(data) and number(recordings(data)[-1]) >= least, 120, "it rotates"
        )

    with started("run", config, "--data-dir", data, output=output) as agent:
        up_to(9)
        agent.kill()
        agent.wait()
    assert recordings(data)[-1].name.endswith(".active")
    before = number(recordings(data)[-1])
    with started("run", config, "--data-dir", data, output=output) as agent:
        up_to(before + 3)
        interrupt(agent)
    left = recordings(data)
    assert number(left[0]) > 3, "the oldest are deleted"
    assert number(left[-1]) - number(left[0]) == len(left) - 1
    assert run_cli(["audit", str(data), "--public-key", str(public)]) == 0, capsys.readouterr()

    taken = left[1].read_bytes()
    left[1].unlink()
    capsys.readouterr()
    assert run_cli(["audit", str(data)]) == 3
    assert f"recording {number(left[1])} is missing before it" in capsys.readouterr().out
    left[1].write_bytes(taken)

    windows = results(data, "window")
    state = data / "state.sqlite"
    content = bytearray(state.read_bytes())
    content[0:16] = bytes(16)
    state.write_bytes(content)
    for path in recordings(data)[:-2]:
        path.unlink()
    newest = number(recordings(data)[-1])
    with started("run", config, "--data-dir", data, output=output) as agent:
        up_to(newest + 1)
        interrupt(agent)
    text = output.read_text()
    assert f"the state file was corrupt and is kept as {data}/state.sqlite.corrupt-1" in text
    assert "that the state file lacked were found in the recordings" in text
    assert "Traceback" not in text
    again = {window["sequence"]: window for window in results(data, "window")}
    found = [window for window in windows if window["sequence"] in again]
    assert found
    assert all(again[window["sequence"]] == window for window in found)
    assert run_cli(["show", "--data-dir", str(data), "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["sensors"]["imu"]["windows"]


@pytest.mark.thorough
def test_a_signing_key_that_is_none_is_bad_input(tmp_path: Path, port: PtyDevice) -> None:
    key, config = tmp_path / "key", tmp_path / "config.toml"
    key.write_text("no key")
    config.write_text(config_text(port, key, KEPT))
    done = fieldcal("run", config, "--data-dir", tmp_path / "data")
    assert done.returncode == 2
    line = config.read_text().splitlines().index(f'signing_key = "{key}"') + 1
    why = f"{key}: not a private key in PEM without a password; `openssl genpkey -algorithm ed25519` makes one"
    assert done.stderr == f"{config}: line {line}: recording.signing_key: {why}\n"
