"""Key files: only the owner may read a private key, and an existing file is never overwritten."""

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
    """A key file cannot be read or written. The message names the file."""


@dataclass(frozen=True, slots=True)
class SigningKey:
    """An operator's private key with its identifier, which gateways have in their configuration."""

    key_id: str
    key: Ed25519PrivateKey

    @property
    def pem(self) -> bytes:
        """The content of the key file: a line with the identifier before the PEM, as RFC 7468 allows."""
        text = self.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        return f"{_NAMED}{self.key_id}\n".encode() + text


def write_new(directory: Path, files: Mapping[str, bytes]) -> None:
    """Write `files` (name: content) into `directory`; only the owner may read those named `*.key`.

    Raises KeyFileError. Where one of the files exists already, none is written.
    """
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name in files:
            if (directory / name).exists():
                raise KeyFileError(
                    f"{directory / name} exists already, and keys are never overwritten; "
                    f"use another directory, or move the old file away"
                )
        for name, content in files.items():
            mode = 0o600 if name.endswith(".key") else 0o644
            descriptor = os.open(directory / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
            with open(descriptor, "wb") as file:
                file.write(content)
    except OSError as error:
        raise KeyFileError(f"{error.filename or directory}: {error.strerror}") from None


def read_signing_key(path: Path) -> SigningKey:
    """Read an operator's key from its file. Raises KeyFileError."""
    try:
        with open(path, "rb") as file:
            if os.fstat(file.fileno()).st_mode & 0o077:
                raise KeyFileError(
                    f"{path}: other users can read this private key; make a new key, or run chmod 600 on this file"
                )
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
