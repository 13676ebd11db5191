"""`fieldcal keys`: makes certificates and command keys."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable
from datetime import UTC, datetime
from functools import wraps
from pathlib import Path
from typing import Any

import click
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key
from cryptography.x509 import load_pem_x509_certificate

from agent.delivery.keys import CHUNK
from agent.keys.certificates import LONGEST_NAME, Credential, issue, make_authority
from agent.keys.files import KeyFileError, SigningKey, write_new

AUTHORITY_DAYS = 3650
# A gateway stands for years, and its certificate must not end before somebody comes by.
DAYS = 1825

directory_option = click.option(
    "--dir", "directory", type=click.Path(file_okay=False, path_type=Path), default=Path("keys"), show_default=True,
    help="Where the authority and all keys are.")  # fmt: skip
days_option = click.option(
    "--days", type=click.IntRange(1, 36500), default=DAYS, show_default=True, help="How long it is good."
)


def _checked_name(_: click.Context, parameter: click.Parameter, value: str) -> str:
    if not CHUNK.fullmatch(value):
        raise click.BadParameter(f"{value!r}: 1 to 63 ASCII letters, digits, '-', '_', '.'", param=parameter)
    return value


def _refusing(command: Callable[..., None]) -> Callable[..., int]:
    @wraps(command)
    def run(*arguments: Any, **options: Any) -> int:
        try:
            command(*arguments, **options)
        except KeyFileError as error:
            click.echo(f"fieldcal keys: {error}", err=True)
            return 2
        return 0

    return run


@click.group()
def keys() -> None:
    """Certificates for Zenoh over TLS, and keys that sign commands.

    First `authority`, once a site; then one certificate each for the router, every gateway, consumer and commander.
    Private keys (*.key) are readable by their owner alone and never written over.
    """


@keys.command()
@directory_option
@click.option("--name", default="fieldcal authority", show_default=True, help="Its common name.")
@click.option("--days", type=click.IntRange(1, 36500), default=AUTHORITY_DAYS, show_default=True)
@_refusing
def authority(directory: Path, name: str, days: int) -> None:
    """The authority that signs all certificates of a site: ca.pem, which everybody needs, and ca.key, which nobody may
    have who is not to let others in."""
    _save(directory, "ca", make_authority(name, days, datetime.now(UTC)))


@keys.command()
@click.option("--host", "hosts", multiple=True, required=True, help="Name or address by which it is reached; repeat.")
@click.option("--name", default="router", show_default=True, callback=_checked_name)
@directory_option
@days_option
@_refusing
def router(hosts: tuple[str, ...], name: str, directory: Path, days: int) -> None:
    """A router's certificate: good for the hosts alone."""
    _issue(directory, name, name, days, hosts)


@keys.command()
@click.argument("site", callback=_checked_name)
@click.argument("name", callback=_checked_name)
@directory_option
@days_option
@_refusing
def gateway(site: str, name: str, directory: Path, days: int) -> None:
    """A gateway's certificate, common name SITE/NAME, file SITE.NAME.pem."""
    _issue(directory, f"{site}.{name}", f"{site}/{name}", days)


@keys.command()
@click.argument("name", callback=_checked_name)
@directory_option
@days_option
@_refusing
def consumer(name: str, directory: Path, days: int) -> None:
    """A consumer's certificate: the router's rules let NAME listen and ask."""
    _issue(directory, name, name, days)


@keys.command()
@click.argument("name", callback=_checked_name)
@directory_option
@days_option
@_refusing
def commander(name: str, directory: Path, days: int) -> None:
    """A commander's certificate: the router's rules let NAME send commands; each must be signed as well."""
    _issue(directory, name, name, days)


@keys.command()
@click.argument("key_id", callback=_checked_name)
@directory_option
@_refusing
def command(key_id: str, directory: Path) -> None:
    """An operator's key that signs commands: KEY_ID.command.key. Prints what the gateway's configuration needs."""
    key = Ed25519PrivateKey.generate()
    write_new(directory, {f"{key_id}.command.key": SigningKey(key_id, key).pem})
    public = b64encode(key.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)).decode()
    click.echo(f"""\
# {directory / key_id}.command.key stays with {key_id}. For the gateway's configuration:
[commands]
enabled = true

[[commands.keys]]
id = "{key_id}"
public_key = "{public}"
verbs = ["pose", "hold", "accept", "rollback"]   # leave out what {key_id} may not do
sensors = ["*"]""")


def _issue(directory: Path, file: str, name: str, days: int, hosts: tuple[str, ...] = ()) -> None:
    if len(name) > LONGEST_NAME:
        raise KeyFileError(f"{name}: {len(name)} characters, a common name has {LONGEST_NAME} at most")
    _save(directory, file, issue(_read_authority(directory), name, days, datetime.now(UTC), hosts))


def _save(directory: Path, file: str, credential: Credential) -> None:
    write_new(directory, {f"{file}.key": credential.key_pem, f"{file}.pem": credential.certificate_pem})
    ends = credential.certificate.not_valid_after_utc
    click.echo(f"{directory / file}.pem, good until {ends:%Y-%m-%d}, and {directory / file}.key")


def _read_authority(directory: Path) -> Credential:
    try:
        certificate = load_pem_x509_certificate((directory / "ca.pem").read_bytes())
        key = load_pem_private_key((directory / "ca.key").read_bytes(), password=None)
    except OSError as error:
        raise KeyFileError(f"{error.filename}: {error.strerror}; first `fieldcal keys authority`") from None
    except (ValueError, TypeError):
        raise KeyFileError(f"{directory}: ca.pem or ca.key is not PEM") from None
    return Credential(certificate, key)  # type: ignore[arg-type]
