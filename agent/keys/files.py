"""Files that hold keys: private ones are their owner's alone, and none is ever written over."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)

LARGEST = 1 << 16
_NAMED = "fieldcal command key "


class KeyFileError(Exception):
    """A file of a key that cannot be read or written. The message names it."""


@dataclass(frozen=True, slots=True)
class SigningKey:
    """An operator's private key with the name by which gateways know it."""

    key_id: str
    key: Ed25519PrivateKey

    @property
    def pem(self) -> bytes:
        """The file: the name in a line before the PEM, as RFC 7468 allows."""
        text = self.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        return f"{_NAMED}{self.key_id}\n".encode() + text


def write_new(directory: Path, files: Mapping[str, bytes]) -> None:
    """Write all of them, those named .key for the owner alone. Raises KeyFileError, before any, if one is there."""
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name in files:
            if (directory / name).exists():
                raise KeyFileError(f"{directory / name} is there already; keys are never written over")
        for name, content in files.items():
            mode = 0o600 if name.endswith(".key") else 0o644
            descriptor = os.open(directory / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
            with open(descriptor, "wb") as file:
                file.write(content)
    except OSError as error:
        raise KeyFileError(f"{error.filename or directory}: {error.strerror}") from None


def read_signing_key(path: Path) -> SigningKey:
    """An operator's key from its file. Raises KeyFileError."""
    try:
        with open(path, "rb") as file:
            if os.fstat(file.fileno()).st_mode & 0o077:
                raise KeyFileError(f"{path}: others can read it: chmod 600, and better make a new one")
            text = file.read(LARGEST)
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be read: {error.strerror}") from None
    named = next((line for line in text.splitlines() if line.startswith(_NAMED.encode())), None)
    try:
        key = load_pem_private_key(text, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        key = None
    if named is None or not isinstance(key, Ed25519PrivateKey):
        raise KeyFileError(f"{path}: not a command key, see `fieldcal keys command`")
    return SigningKey(named.decode(errors="replace").removeprefix(_NAMED).strip(), key)
