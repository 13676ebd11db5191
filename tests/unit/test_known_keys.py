"""The list of known keys: one key for one gateway, several keys for a gateway, revoked keys; each bad line is named."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.cli.keys import keys
from agent.config.key_file import KeyFileError
from agent.config.known_keys import LARGEST, WatchedKeys, identifier, read_known_keys
from tests.attacks.chain_site import KEY, public_pem
from tests.attacks.signed_site import OTHER, in_base64
from tests.unit.command_desk import ANNA, DeskSite, sealed

RAW, OTHER_RAW = (key.public_key().public_bytes_raw() for key in (KEY, OTHER))


def run(*arguments: str | Path) -> Result:
    result = CliRunner().invoke(keys, [str(argument) for argument in arguments], standalone_mode=False)
    assert result.exception is None, result.exception
    return result


def pem(directory: Path, key: Ed25519PrivateKey) -> Path:
    path = directory / f"{identifier(key.public_key().public_bytes_raw())}.pub"
    path.write_bytes(public_pem(key))
    return path


def test_keys_are_added_listed_and_revoked(tmp_path: Path) -> None:
    known = tmp_path / "known.keys"
    assert run("add", "workshop/gateway-1", pem(tmp_path, KEY), "--keys", known).return_value == 0
    assert run("add", "workshop/gateway-1", pem(tmp_path, OTHER), "--keys", known).return_value == 0
    assert read_known_keys(known).gateways == {"workshop/gateway-1": (RAW, OTHER_RAW)}
    assert run("revoke", identifier(RAW), "--reason", "stolen\nin May", "--keys", known).return_value == 0
    listed = read_known_keys(known)
    assert listed.revoked == {RAW: "stolen in May"}
    assert listed.fault("workshop/gateway-1", OTHER_RAW) == ""
    assert listed.fault("workshop/gateway-1", RAW).endswith("which is revoked: stolen in May")
    assert "names no key of 'workshop/gateway-2'" in listed.fault("workshop/gateway-2", OTHER_RAW)
    lines = run("list", "--keys", known).output.splitlines()
    assert lines[0] == f"workshop/gateway-1  56475aa75463474c  {in_base64(KEY)}  revoked: stolen in May"
    before = known.read_bytes()
    assert run("add", "workshop/gateway-1", pem(tmp_path, OTHER), "--keys", known).return_value == 0
    assert known.read_bytes() == before, "a key is in the list once"


@pytest.mark.parametrize(
    "arguments",
    [
        ("add", "workshop/gateway-2", "KEY"),  # the key of another gateway
        ("add", "workshop/gateway-2", "no-such-file"),
        ("revoke", "0123456789abcdef"),
    ],
)
def test_a_wrong_use_changes_nothing(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    known = tmp_path / "known.keys"
    run("add", "workshop/gateway-1", pem(tmp_path, KEY), "--keys", known)
    before = known.read_bytes()
    given = [str(pem(tmp_path, KEY)) if argument == "KEY" else argument for argument in arguments]
    result = run(*given, "--keys", known)
    assert (result.return_value, result.stderr.count("\n")) == (2, 1), result.stderr
    assert known.read_bytes() == before


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (f"gateway a/b {in_base64(KEY)}\ngateway a/c {in_base64(KEY)}", "line 2: this is the key of a/b too"),
        (f"gateway ab {in_base64(KEY)}", "line 1: not `gateway <site>/<gateway> <public key>`"),
        ("# x\n\ngateway a/b AAAA", "line 3: 'AAAA' is not a public key"),
        (f"gateway a/b {in_base64(KEY)[:-2]}5=", "is not a public key"),  # the same bytes, spelled in another way
        ("revoke it", "line 1: begins with 'revoke'"),
        ("revoked", "line 1: '' is not a public key"),
        ("\udcff", "not a list of keys"),
        ("#" * (LARGEST + 1), "cannot be read"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, content: str, told: str) -> None:
    path = tmp_path / "known.keys"
    path.write_bytes(content.encode("utf-8", "surrogateescape"))
    with pytest.raises(KeyFileError, match=told):
        read_known_keys(path)


def test_a_list_that_changes_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "known.keys"
    path.write_text("")
    watched = WatchedKeys(path)
    assert watched.now().gateways == {}
    run("add", "workshop/gateway-1", pem(tmp_path, KEY), "--keys", path)
    assert watched.now().gateways == {"workshop/gateway-1": (RAW,)}
    path.unlink()
    with pytest.raises(KeyFileError, match="No such file"):
        watched.now()


def test_a_command_of_a_revoked_key_is_refused_without_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "revoked.keys"
    path.write_text("")
    site = DeskSite(tmp_path, revoked_keys=path)
    assert site.send(sealed()).taken
    assert run("revoke", in_base64(ANNA), "--reason", "left", "--keys", path).return_value == 0
    answer = site.send(sealed())
    assert (answer.taken, answer.reason) == (False, "this key is revoked: left")
    assert site.events[-1].refused == "revoked key: this key is revoked: left"
    path.write_text("rubbish")
    answer = site.send(sealed())
    assert not answer.taken
    assert "while the list of revoked keys is bad" in answer.reason
