"""The key that signs recordings: `fieldcal init` makes it, keeps it from others, and tells where it is misplaced."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from agent.cli.main import run_cli
from agent.config import load_config
from agent.delivery.store import Store
from agent.recording.signing import Signer, load_public_key
from tests.scenarios.processes import fieldcal

STATED = ["--sensor", "adxl355", "--no-reference", "--site", "workshop", "--gateway", "gateway-1"]


@pytest.fixture
def place() -> Iterator[Path]:
    """A directory that every user may enter, with a lax umask, as on a machine that was set up carelessly."""
    directory = Path(tempfile.mkdtemp())
    directory.chmod(0o755)
    before = os.umask(0)
    yield directory
    os.umask(before)
    shutil.rmtree(directory)


def test_init_makes_a_key_that_is_its_owners_alone(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = place / "gateway.toml"
    assert run_cli(["init", str(config), *STATED]) == 0
    told = capsys.readouterr().out
    key = load_config(config).recording.signing_key
    assert key == place / "keys" / "workshop.gateway-1.signing.key"
    assert key.stat().st_mode & 0o777 == 0o600
    assert key.parent.stat().st_mode & 0o777 == 0o700
    public = key.with_suffix(".pub")
    assert load_public_key(public) == Signer.load(key).public_key
    assert f"{key}: made; it signs what this gateway records. Never copy it" in told
    assert f"{public}: give this public key to the auditor: fieldcal audit DATA --public-key {public.name}" in told
    assert "PRIVATE" not in told + config.read_text()
    assert run_cli(["check", str(config)]) == 0
    assert capsys.readouterr().err == ""


def test_an_existing_key_is_used_and_a_lost_public_key_made_anew(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, other = (place / f"{name}.toml" for name in ("first", "second", "other"))
    assert run_cli(["init", str(first), *STATED]) == 0
    key = load_config(first).recording.signing_key
    assert key is not None
    before, public = key.read_bytes(), key.with_suffix(".pub").read_bytes()
    key.with_suffix(".pub").unlink()
    assert run_cli(["init", str(second), *STATED]) == 0
    assert load_config(second).recording.signing_key == key
    assert (key.read_bytes(), key.with_suffix(".pub").read_bytes()) == (before, public)
    assert f"{key}: this key exists" in capsys.readouterr().out
    assert run_cli(["init", str(other), *STATED[:-1], "gateway-2"]) == 0
    assert load_config(other).recording.signing_key != key, "another gateway in the same directory has its own key"


def test_what_init_refuses_leaves_no_configuration(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, keys = place / "gateway.toml", place / "keys"
    key, public = keys / "a.key", keys / "a.pub"

    def refused(told: str, path: Path = key) -> None:
        capsys.readouterr()
        assert run_cli(["init", str(config), *STATED, "--signing-key", str(path)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert told in line
        assert "--no-signing-key" in line
        assert not config.exists()

    refused("must end in .key", keys / "a.pem")
    assert not keys.exists()
    refused("/dev/null: ", Path("/dev/null/a.key"))
    keys.mkdir()
    public.write_text("of another key")
    refused("not the public key of")
    assert not key.exists()
    public.unlink()
    key.symlink_to(keys / "elsewhere")
    refused("cannot be read: No such file")
    key.unlink()
    key.write_text("-----BEGIN PRIV")  # what a full disk could leave
    refused("not a private key in PEM")
    assert key.read_text() == "-----BEGIN PRIV", "never overwritten"
    key.unlink()
    assert run_cli(["init", str(config), *STATED, "--signing-key", str(key)]) == 0
    config.unlink()
    key.chmod(0o644)
    refused("mode 0644")


def test_no_key_where_none_is_wanted(place: Path) -> None:
    config = place / "gateway.toml"
    assert run_cli(["init", str(config), *STATED, "--no-signing-key"]) == 0
    assert load_config(config).recording.signing_key is None
    assert not (place / "keys").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give files to another user")
def test_the_service_can_read_the_key_that_root_makes(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Here the service's user is `nobody`. /etc/fieldcal/keys has other rights than a directory that init makes."""
    monkeypatch.setattr("agent.config.key_file.SERVICE_USER", "nobody")
    uid, gid = pwd.getpwnam("nobody")[2:4]
    installed = place / "installed"
    (installed / "keys").mkdir(parents=True)
    for path in (installed, installed / "keys"):
        os.chown(path, 0, gid)
        path.chmod(0o750)
    for directory in (place, installed):
        config = directory / "gateway.toml"
        assert run_cli(["init", str(config), *STATED]) == 0
        key = load_config(config).recording.signing_key
        assert key is not None
        read = subprocess.run(["cat", key], user=uid, group=gid, extra_groups=[], capture_output=True, check=False)
        assert read.stdout == key.read_bytes(), read.stderr
        assert key.stat().st_mode & 0o777 == 0o600
        capsys.readouterr()
        assert run_cli(["check", str(config)]) == 0
        assert capsys.readouterr().err == ""
        for owner, told in ((0, "root"), (1, "daemon"), (54321, "54321")):
            os.chown(key, owner, -1)
            assert run_cli(["check", str(config)]) == 0
            assert f"{key} belongs to the user {told}; give it" in capsys.readouterr().err


def test_a_key_inside_the_data_directory_is_told(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, data = place / "gateway.toml", place / "data"
    key = data / "keys" / "a.key"
    assert run_cli(["init", str(config), *STATED, "--signing-key", str(key)]) == 0
    told = f"{key} is in the data directory {data}"
    capsys.readouterr()
    run_cli(["doctor", str(config), "--data-dir", str(data)])
    assert told in capsys.readouterr().out
    assert run_cli(["check", str(config)]) == 0
    assert told not in capsys.readouterr().err, "nothing tells `check` yet that this is a data directory"
    (data / "state.sqlite").write_bytes(b"")
    assert run_cli(["check", str(config)]) == 0
    assert told in capsys.readouterr().err


def test_a_configuration_states_its_key_itself(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key = place / "a.key"
    assert run_cli(["run", "examples/gateway.toml", "--signing-key", str(key)]) == 2
    assert "state recording.signing_key in CONFIG" in capsys.readouterr().err
    assert not key.exists()


@pytest.mark.slow
def test_a_run_tells_where_its_key_is_misplaced(place: Path) -> None:
    config, data = place / "gateway.toml", place / "data"
    assert run_cli(["init", str(config), *STATED, "--signing-key", str(data / "a.key")]) == 0
    store = Store(data, 0)  # holds the lock, as an agent does, so that the run ends at once
    done = fieldcal("run", config, "--data-dir", data)
    store.close()
    assert done.returncode == 1
    assert f"{data / 'a.key'} is in the data directory {data}" in " ".join(done.stdout.split())
