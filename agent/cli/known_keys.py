"""`fieldcal keys list`, `add` and `revoke`: the list of the keys that gateways sign with, and of the revoked ones."""

from __future__ import annotations

import base64
from pathlib import Path

import click

from agent.config.key_file import KeyFileError
from agent.config.known_keys import KnownKeys, add_key, identifier, public_key_of, read_known_keys, revoke_key
from agent.delivery.keys import CHUNK
from agent.terminal.text import say

list_option = click.option(
    "--keys", "known", type=click.Path(dir_okay=False, path_type=Path), default=Path("known.keys"), show_default=True,
    help="The list of known keys.")  # fmt: skip


@click.command("list")
@list_option
def list_keys(known: Path) -> int:
    """Show the list of known keys: each gateway with the identifiers of its keys, and the revoked keys."""
    try:
        listed = read_known_keys(known)
    except KeyFileError as error:
        return _say_refusal(error)
    for gateway, keys in sorted(listed.gateways.items()):
        for key in keys:
            revoked = f"  revoked: {listed.revoked[key]}" if key in listed.revoked else ""
            say(f"{gateway}  {identifier(key)}  {base64.b64encode(key).decode()}{revoked}")
    for key in listed.revoked.keys() - {key for keys in listed.gateways.values() for key in keys}:
        say(f"-  {identifier(key)}  {base64.b64encode(key).decode()}  revoked: {listed.revoked[key]}")
    return 0


@click.command("add")
@click.argument("gateway", metavar="SITE/GATEWAY")
@click.argument("public_key", type=click.Path(path_type=Path), metavar="KEY.pub")
@list_option
def add(gateway: str, public_key: Path, known: Path) -> int:
    """Add the key of a gateway (PEM, of `openssl pkey -pubout`) to the list. Get it on a way that you trust."""
    site, _, name = gateway.partition("/")
    if not (CHUNK.fullmatch(site) and CHUNK.fullmatch(name)):
        raise click.BadParameter(f"{gateway!r}: not SITE/GATEWAY", param_hint="SITE/GATEWAY")
    try:
        key = _of_file(public_key)
        add_key(known, gateway, key)
    except KeyFileError as error:
        return _say_refusal(error)
    say(f"{known}: {gateway} signs with the key {identifier(key)}")
    return 0


@click.command("revoke")
@click.argument("key", metavar="KEY")
@click.option("--reason", default="", metavar="TEXT", help="Why; it is shown where the key is refused.")
@list_option
def revoke(key: str, reason: str, known: Path) -> int:
    """Revoke a key: nothing that it signs is believed any more, whenever it was signed.

    KEY is a file with a public key (PEM), a public key in base64 (of a command key, as the configuration has it), or
    the identifier of a key in the list.
    """
    try:
        listed = read_known_keys(known) if known.exists() else KnownKeys()
        named = [one for keys in listed.gateways.values() for one in keys if identifier(one) == key]
        public_key = named[0] if named else public_key_of(key) or _of_file(Path(key))
        revoke_key(known, public_key, reason)
    except KeyFileError as error:
        return _say_refusal(error)
    say(f"{known}: the key {identifier(public_key)} is revoked")
    return 0


def _of_file(path: Path) -> bytes:
    from agent.recording.signing import load_public_key

    return load_public_key(path).public_bytes_raw()


def _say_refusal(error: KeyFileError) -> int:
    say(f"fieldcal keys: {error}", err=True)
    return 2
