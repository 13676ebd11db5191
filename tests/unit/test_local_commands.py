"""Commands on the gateway itself: a socket in the data directory, whoever speaks into it and however."""

from __future__ import annotations

import json
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from agent.cli.command import command
from agent.commanding.envelope import from_line, parse_envelope
from agent.commanding.local import SOCKET_NAME, LocalAgent, LocalDoor
from agent.keys.files import SigningKey, write_new
from tests.unit.command_desk import ANNA, GATEWAY, DeskSite, sealed


@pytest.fixture
def site(tmp_path: Path) -> Iterator[DeskSite]:
    """A directory deeper than the address of a socket may be long."""
    directory = tmp_path / ("deep" * 30)
    directory.mkdir()
    write_new(tmp_path, {"anna.key": SigningKey("anna", ANNA).pem})
    site = DeskSite(directory)
    with LocalDoor(directory, GATEWAY, site.desk):
        yield site


def run(site: DeskSite, *arguments: str) -> Result:
    key = site.directory.parent / "anna.key"
    return CliRunner().invoke(
        command, [*arguments, "--key", str(key), "--data-dir", str(site.directory)], standalone_mode=False
    )


def test_the_command_line_sends_what_the_desk_takes(site: DeskSite) -> None:
    done = run(site, "pose", "--sensor", "mems", "--theta-deg", "35", "--alpha-deg", "-30", "--position", "b")
    assert (done.return_value, done.stdout, done.stderr) == (0, "taken: pose of mems\n", "")
    assert run(site, "hold", "--sensor", "mems", "--release").return_value == 0
    assert run(site, "rollback", "--sensor", "mems", "--sequence", "101").return_value == 0
    assert [json.loads(event.arguments_json) for event in site.events] == [
        {"theta_deg": 35.0, "alpha_deg": -30.0, "position": "b"},
        {"release": True},
        {"sequence": 101},
    ]
    refused = run(site, "accept", "--sensor", "mems", "--sequence", "101")
    assert (refused.return_value, refused.stderr) == (3, "refused: key anna has no right to send accept to mems\n")
    elsewhere = run(site, "hold", "--sensor", "mems", "--gateway", "workshop/gateway-2")
    assert (elsewhere.return_value, "it is for 'workshop/gateway-2'" in elsewhere.stderr) == (3, True)


def test_a_signed_line_is_printed_and_sends_nothing(site: DeskSite) -> None:
    for arguments in (["hold"], ["rollback", "--sequence", "101"]):
        line = run(site, *arguments, "--sensor", "mems", "--gateway", GATEWAY, "--print").stdout
        assert site.events == []
        assert line.count("\n") == 1
        for pasted in (line, f" {line.rstrip()}\r\n", line.replace(" {", "\r\n{", 1)):
            assert parse_envelope(from_line(pasted.encode())).open(ANNA.public_key()).verb == arguments[0]
    for wrong in (["--print"], ["--print", "--gateway", GATEWAY, "--connect", "tcp/127.0.0.1:1"]):
        refused = run(site, "hold", "--sensor", "mems", *wrong)
        assert re.search("need --gateway SITE/NAME|leave --connect out", str(refused.exception)), refused


def test_who_may_use_the_socket_is_a_matter_of_its_group(site: DeskSite) -> None:
    assert (site.directory / SOCKET_NAME).stat().st_mode & 0o777 == 0o660


def test_without_an_agent_it_is_one_clear_line(tmp_path: Path) -> None:
    for directory in (tmp_path, tmp_path / "no"):
        with pytest.raises(ConnectionError, match="no agent takes commands here"):
            LocalAgent(directory)
    write_new(tmp_path, {"anna.key": SigningKey("anna", ANNA).pem})
    words = ["hold", "--sensor", "mems", "--key", str(tmp_path / "anna.key"), "--data-dir", str(tmp_path)]
    done = CliRunner().invoke(command, words, standalone_mode=False)
    assert (done.return_value, done.stdout) == (1, "")
    assert re.fullmatch("fieldcal command: .*no agent takes commands here.*\n", done.stderr)


def test_a_socket_that_a_killed_agent_left_is_no_obstacle(tmp_path: Path) -> None:
    site = DeskSite(tmp_path)
    left = socket.socket(socket.AF_UNIX)
    left.bind(str(tmp_path / SOCKET_NAME))
    left.close()
    with LocalDoor(tmp_path, GATEWAY, site.desk), LocalAgent(tmp_path) as agent:
        assert json.loads(agent.send("mems/command/hold", sealed()))["taken"]
    assert not (tmp_path / SOCKET_NAME).exists()


def connected(site: DeskSite) -> socket.socket:
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(10.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(site.directory)
        client.connect(SOCKET_NAME)
    return client


def test_neither_silence_nor_a_stream_without_end_keeps_others_out(
    site: DeskSite, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("agent.commanding.local.SENDER_S", 0.3)
    silent, endless, slow = (connected(site) for _ in range(3))
    with silent, endless, slow:
        slow.sendall(b"mems/command/hold\n")
        with pytest.raises((BrokenPipeError, ConnectionResetError)):
            endless.sendall(b"x" * 100_000_000)
        began_s = time.monotonic()
        with LocalAgent(site.directory) as agent:
            assert json.loads(agent.send("mems/command/hold", sealed()))["taken"]
        assert time.monotonic() - began_s < 9.0, "three who wait are cut off after 0.3 s each"
    assert [event.refused for event in site.events if not event.refused] == [""]
