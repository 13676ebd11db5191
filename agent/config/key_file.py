"""The private key that signs recordings, from its file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # only who reads keys pays for it
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

LARGEST_KEY_FILE = 1 << 16  # bytes; a key has 120


class KeyFileError(Exception):
    """A key file cannot be read or holds no usable key. The message names the file."""


def load_private_key(path: Path) -> Ed25519PrivateKey:
    """Read an Ed25519 private key from a PEM file (PKCS #8, not encrypted). Raises KeyFileError."""
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        key = load_pem_private_key(read_key_file(path), password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm):  # its message may quote the key
        raise KeyFileError(f"{path}: not a private key in PEM without a password") from None
    if not isinstance(key, Ed25519PrivateKey):
        raise KeyFileError(
            f"{path}: a private key, but not an Ed25519 key; `openssl genpkey -algorithm ed25519` makes one"
        )
    return key


def read_key_file(path: Path) -> bytes:
    """Read a key file, at most LARGEST_KEY_FILE bytes of it. Raises KeyFileError."""
    try:
        with open(path, "rb") as file:
            return file.read(LARGEST_KEY_FILE)
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be read: {error.strerror}") from None
