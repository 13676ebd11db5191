"""Key files: only the owner may read a private key, and an existing file is never overwritten."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_public_key,
)

from agent.config.key_file import (
    SERVICE_USER,
    KeyFileError,
    load_private_key,
    read_key_file,
    read_private_key,
    service_uid,
)

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

    Raises KeyFileError. Where one of the files exists already, or the disk fails, none is written.
    """
    begun: list[Path] = []
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
            begun.append(directory / name)
            with open(descriptor, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(descriptor)
    except OSError as error:
        for path in begun:
            path.unlink()
        raise KeyFileError(f"{error.filename or directory}: {error.strerror}") from None


def read_signing_key(path: Path) -> SigningKey:
    """Read an operator's key from its file. Raises KeyFileError."""
    key, text = read_private_key(path, Ed25519PrivateKey, _WHAT)
    named = next((line for line in text.splitlines() if line.startswith(_NAMED.encode())), None)
    if named is None:
        raise KeyFileError(f"{path}: not {_WHAT}")
    return SigningKey(named.decode(errors="replace").removeprefix(_NAMED).strip(), key)


@dataclass(frozen=True, slots=True)
class KeyPair:
    """The files of a key with which a gateway signs. `made`: whether the private key was made now."""

    private: Path
    public: Path
    made: bool


def gateway_key(path: Path) -> KeyPair:
    """The key with which a gateway signs, in the file `path` (PEM, `*.key`) with its public key beside it (`*.pub`).

    An existing key is used, never overwritten; a missing one is made. Where root makes it on a machine with the service,
    it belongs to the service's user, because only the owner may read it. Raises KeyFileError.
    """
    if path.suffix != ".key":
        raise KeyFileError(f"{path}: the name of a private key must end in .key; its public key is beside it, in *.pub")
    public, made = path.with_suffix(".pub"), not os.path.lexists(path)
    key = Ed25519PrivateKey.generate() if made else load_private_key(path)
    if os.path.lexists(public) and (made or _public_key(public) != key.public_key().public_bytes_raw()):
        raise KeyFileError(f"{public}: not the public key of {path}; move this file away, or state another key")
    new_directory = not path.parent.exists()
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    shown = key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    files = ({path.name: private} if made else {}) | ({} if os.path.lexists(public) else {public.name: shown})
    write_new(path.parent, files)
    if made:
        _give_to_service([path, path.parent] if new_directory else [path])
    return KeyPair(path, public, made)


def _public_key(path: Path) -> bytes:
    """The 32 bytes of an Ed25519 public key; none where the file holds another kind. Raises KeyFileError."""
    try:
        key = load_pem_public_key(read_key_file(path))
    except ValueError:
        return b""
    return key.public_bytes_raw() if isinstance(key, Ed25519PublicKey) else b""


def _give_to_service(paths: list[Path]) -> None:
    """Where root runs this and the service is installed, make the files its user's. Raises KeyFileError."""
    if os.geteuid() != 0 or (uid := service_uid()) is None:
        return
    for path in paths:
        try:
            os.chown(path, uid, -1)
        except OSError as error:
            raise KeyFileError(f"{path}: cannot be given to the user {SERVICE_USER}: {error.strerror}") from None
