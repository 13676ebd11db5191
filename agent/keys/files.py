"""Key files: only the owner may read a private key, and an existing file is never overwritten."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
)

from agent.config.key_file import KeyFileError, read_private_key

_WHAT = "a command key, see `fieldcal keys command`"
_NAMED = "fieldcal command key "


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
    key, text = read_private_key(path, Ed25519PrivateKey, _WHAT)
    named = next((line for line in text.splitlines() if line.startswith(_NAMED.encode())), None)
    if named is None:
        raise KeyFileError(f"{path}: not {_WHAT}")
    return SigningKey(named.decode(errors="replace").removeprefix(_NAMED).strip(), key)
