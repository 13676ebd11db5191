"""`fieldcal keys`: makes certificates and command keys. agent.cli.known_keys has the list of gateways' keys."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable
from datetime import UTC, datetime
from functools import wraps
from pathlib import Path
from typing import Any

import click
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from cryptography.x509 import load_pem_x509_certificate

from agent.cli.known_keys import add, list_keys, revoke
from agent.config.key_file import KeyFileError, read_key_file, read_private_key
from agent.delivery.keys import CHUNK
from agent.keys.certificates import LONGEST_NAME, Credential, issue, make_authority
from agent.keys.files import SigningKey, write_new
from agent.terminal.text import say

AUTHORITY_DAYS = 3650
# Five years: a gateway is used for years, and its certificate must not expire before somebody visits it.
DAYS = 1825

directory_option = click.option(
    "--dir", "directory", type=click.Path(file_okay=False, path_type=Path), default=Path("keys"), show_default=True,
    help="Directory of the authority's files and of all keys.")  # fmt: skip
days_option = click.option(
    "--days", type=click.IntRange(1, 36500), default=DAYS, show_default=True, help="Days that the certificate is valid."
)


def _checked_name(_: click.Context, parameter: click.Parameter, value: str) -> str:
    if not CHUNK.fullmatch(value):
        raise click.BadParameter(f"{value!r}: use 1 to 63 ASCII letters, digits, '-', '_' and '.'", param=parameter)
    return value


def _refusing(command: Callable[..., None]) -> Callable[..., int]:
    @wraps(command)
    def run(*arguments: Any, **options: Any) -> int:
        try:
            command(*arguments, **options)
        except KeyFileError as error:
            say(f"fieldcal keys: {error}", err=True)
            return 2
        return 0

    return run


@click.group()
def keys() -> None:
    """Make certificates for Zenoh over TLS, and keys that sign commands; list the keys that gateways sign with.

    First make the authority, once for a site. Then make a certificate for the router and for each gateway, consumer and
    commander. Only the owner can read the private keys (*.key), and no file is ever overwritten.
    """


for listing in (list_keys, add, revoke):
    keys.add_command(listing)


@keys.command()
@directory_option
@click.option("--name", default="fieldcal authority", show_default=True, help="Common name of the authority.")
@click.option("--days", type=click.IntRange(1, 36500), default=AUTHORITY_DAYS, show_default=True,
              help="Days that the certificate is valid.")  # fmt: skip
@_refusing
def authority(directory: Path, name: str, days: int) -> None:
    """Make the authority that signs all certificates of a site.

    Everybody needs ca.pem. Keep ca.key secret: whoever has it can make certificates that the router accepts.
    """
    _save(directory, "ca", make_authority(name, days, datetime.now(UTC)))


@keys.command()
@click.option(
    "--host",
    "hosts",
    multiple=True,
    required=True,
    help="Host name or IP address of the router; may be given several times.",
)
@click.option("--name", default="router", show_default=True, callback=_checked_name,
              help="Name of the files and common name of the certificate.")  # fmt: skip
@directory_option
@days_option
@_refusing
def router(hosts: tuple[str, ...], name: str, directory: Path, days: int) -> None:
    """Make a router's certificate, valid for the given hosts only."""
    _issue(directory, name, name, days, hosts)


@keys.command()
@click.argument("site", callback=_checked_name)
@click.argument("name", callback=_checked_name)
@directory_option
@days_option
@_refusing
def gateway(site: str, name: str, directory: Path, days: int) -> None:
    """Make a gateway's certificate with the common name SITE/NAME, in the file SITE.NAME.pem."""
    _issue(directory, f"{site}.{name}", f"{site}/{name}", days)


@keys.command()
@click.argument("name", callback=_checked_name)
@directory_option
@days_option
@_refusing
def consumer(name: str, directory: Path, days: int) -> None:
    """Make a consumer's certificate. The router's rules must allow NAME to receive results."""
    _issue(directory, name, name, days)


@keys.command()
@click.argument("name", callback=_checked_name)
@directory_option
@days_option
@_refusing
def commander(name: str, directory: Path, days: int) -> None:
    """Make a commander's certificate. The router's rules must allow NAME to send commands, which must be signed too."""
    _issue(directory, name, name, days)


@keys.command()
@click.argument("key_id", callback=_checked_name)
@directory_option
@_refusing
def command(key_id: str, directory: Path) -> None:
    """Make an operator's key that signs commands, KEY_ID.command.key; print its section of the configuration."""
    key = Ed25519PrivateKey.generate()
    write_new(directory, {f"{key_id}.command.key": SigningKey(key_id, key).pem})
    public = b64encode(key.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)).decode()
    click.echo(f"""\
# Only {key_id} may have {directory / key_id}.command.key. Add this to the gateway's configuration:
[commands]
enabled = true

[[commands.keys]]
id = "{key_id}"
public_key = "{public}"
verbs = ["pose", "hold", "accept", "rollback"]   # remove the commands that {key_id} may not send
sensors = ["*"]""")


def _issue(directory: Path, file: str, name: str, days: int, hosts: tuple[str, ...] = ()) -> None:
    if len(name) > LONGEST_NAME:
        raise KeyFileError(f"{name}: {len(name)} characters, but a common name may have {LONGEST_NAME} at most")
    _save(directory, file, issue(_read_authority(directory), name, days, datetime.now(UTC), hosts))


def _save(directory: Path, file: str, credential: Credential) -> None:
    write_new(directory, {f"{file}.key": credential.key_pem, f"{file}.pem": credential.certificate_pem})
    ends = credential.certificate.not_valid_after_utc
    say(f"{directory / file}.pem, valid until {ends:%Y-%m-%d}, and {directory / file}.key")


def _read_authority(directory: Path) -> Credential:
    for name in ("ca.pem", "ca.key"):
        if not (directory / name).exists():
            raise KeyFileError(f"{directory / name}: No such file or directory; run `fieldcal keys authority` first")
    key, _ = read_private_key(directory / "ca.key")
    try:
        certificate = load_pem_x509_certificate(read_key_file(directory / "ca.pem"))
    except ValueError:
        raise KeyFileError(f"{directory / 'ca.pem'}: not a certificate in PEM") from None
    return Credential(certificate, key)
