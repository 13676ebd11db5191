"""Key files: a private key must be its owner's alone, whatever it is used for."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.config.files import read_file, read_private_file

if TYPE_CHECKING:  # only who reads keys pays for it
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

LARGEST_KEY_FILE = 1 << 16  # bytes; a key has 120
SERVICE_USER = "fieldcal"  # as deploy/fieldcal.sysusers makes it
_MAKE = "; `openssl genpkey -algorithm ed25519` makes one"


class KeyFileError(Exception):
    """A key file cannot be read or holds no usable key. The message names the file."""


def load_private_key(path: Path) -> Ed25519PrivateKey:
    """Read an Ed25519 private key from a PEM file (PKCS #8, not encrypted). Raises KeyFileError."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    key: Ed25519PrivateKey = read_private_key(path, Ed25519PrivateKey, remedy=_MAKE)[0]
    return key


def read_private_key(
    path: Path, kind: type = object, what: str = "a private key in PEM without a password", remedy: str = ""
) -> tuple[Any, bytes]:
    """Read a private key (PEM, not encrypted); gives the key, which is of this `kind`, and the content of the file.

    `what` says in the error what is expected, `remedy` what the reader can do.

    Raises KeyFileError, also where another user may read or write the file.
    """
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        text, exposed = read_private_file(path, LARGEST_KEY_FILE)
    except OSError as error:
        raise _unread(path, error, remedy) from None
    try:
        key = load_pem_private_key(text, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm):  # its message may quote the key
        raise KeyFileError(f"{path}: not {what}{remedy}") from None
    if not isinstance(key, kind):
        raise KeyFileError(f"{path}: a private key, but not an Ed25519 key{_MAKE}")
    if exposed:
        raise KeyFileError(f"{path}: {exposed}")
    return key, text


def read_key_file(path: Path) -> bytes:
    """Read a file with a public key or a certificate, of at most LARGEST_KEY_FILE bytes. Raises KeyFileError."""
    try:
        return read_file(path, LARGEST_KEY_FILE)
    except OSError as error:
        raise _unread(path, error) from None


def service_uid() -> int | None:
    """The user of the service on this machine; None where it is not installed."""
    import pwd  # Windows has none

    try:
        return pwd.getpwnam(SERVICE_USER).pw_uid
    except KeyError:
        return None


def _unread(path: Path, error: OSError, remedy: str = "") -> KeyFileError:
    if isinstance(error, PermissionError):
        remedy = "; its owner must be the user that runs this (chown)"
    return KeyFileError(f"{path}: cannot be read: {error.strerror}{remedy}")
