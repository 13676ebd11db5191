"""The list of known keys: which public key signs for which gateway, and which keys are revoked.

A text file in UTF-8, one key a line; a line that begins with `#` is a comment:

    gateway <site>/<gateway> <public key: 32 bytes in base64>
    revoked <public key> <reason, to the end of the line>

A gateway may have several keys, since keys are replaced. A key belongs to one gateway. A revoked key counts nowhere:
not for a gateway, and not for commands.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from agent.config.files import read_file
from agent.config.key_file import KeyFileError

LARGEST = 1 << 20  # bytes of a list; ten thousand keys
_GATEWAY = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}/[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")
_BEGIN = "# Keys that gateways sign with, and revoked keys. `fieldcal keys` changes this list.\n"


def identifier(public_key: bytes) -> str:
    """The first 16 hexadecimal digits of the SHA-256 of a public key."""
    return hashlib.sha256(public_key).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class KnownKeys:
    """Public keys (32 bytes each) by gateway (`<site>/<gateway>`), and the reasons of the revoked ones.

    `anywhere`: keys that count for every gateway. `source`: the file, for messages.
    """

    gateways: Mapping[str, tuple[bytes, ...]] = field(default_factory=dict)
    revoked: Mapping[bytes, str] = field(default_factory=dict)
    anywhere: tuple[bytes, ...] = ()
    source: str = ""

    def fault(self, gateway: str, public_key: bytes) -> str:
        """Why a key does not count for a gateway; "" where it does."""
        if public_key in self.revoked:
            return f"signed with the key {identifier(public_key)}, which is revoked: {self.revoked[public_key]}"
        known = (*self.gateways.get(gateway, ()), *self.anywhere)
        if not known:
            return f"signed with the key {identifier(public_key)}, but {self.source} names no key of {gateway!r:.130}"
        return "" if public_key in known else self.other_key(gateway, identifier(public_key))

    def other_key(self, gateway: str, key_id: str) -> str:
        """The fault of a signature by a key with this identifier, which is none of the gateway's."""
        known = map(identifier, (*self.gateways.get(gateway, ()), *self.anywhere))
        return f"signed with the key {key_id!r:.40}, not with {' or '.join(known)}"

    def key_named(self, gateway: str, key_id: str) -> bytes | None:
        """The key of a gateway with this identifier; None where it has none such."""
        known = (*self.gateways.get(gateway, ()), *self.anywhere)
        return next((key for key in known if identifier(key) == key_id), None)


def public_key_of(text: str) -> bytes | None:
    """The public key that a text in base64 is; None where it is none, or is spelled in another way."""
    try:
        key = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        return None
    return key if len(key) == 32 and base64.b64encode(key).decode() == text else None


def read_known_keys(path: Path) -> KnownKeys:
    """Read a list of known keys. Raises KeyFileError, which names the line."""
    try:
        text = read_file(path, LARGEST).decode()
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise KeyFileError(f"{path}: not a list of keys: {error}") from None
    gateways: dict[str, tuple[bytes, ...]] = {}
    revoked: dict[bytes, str] = {}
    owners: dict[bytes, str] = {}
    for number, line in enumerate(text.split("\n"), start=1):
        what, _, rest = line.strip().partition(" ")
        where = f"{path}: line {number}"
        if what == "gateway":
            name, key = _of_gateway(rest, where)
            if owners.setdefault(key, name) != name:
                raise KeyFileError(f"{where}: this is the key of {owners[key]} too; a key signs for one gateway")
            gateways[name] = (*gateways.get(name, ()), key)
        elif what == "revoked":
            encoded, _, reason = rest.strip().partition(" ")
            revoked[_public_key(encoded, where)] = reason.strip() or "no reason is given"
        elif what and not what.startswith("#"):
            raise KeyFileError(f"{where}: begins with {what!r:.40}, neither with gateway nor with revoked nor with #")
    return KnownKeys(gateways, revoked, source=str(path))


class WatchedKeys:
    """A list of known keys in a file that may change."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stamp: tuple[int, ...] = ()
        self._keys = KnownKeys()

    def now(self) -> KnownKeys:
        """The list as the file is now. Raises KeyFileError: without the list nobody knows which keys are revoked."""
        try:
            found = os.stat(self.path)
        except OSError as error:
            raise KeyFileError(f"{self.path}: cannot be read: {error.strerror}") from None
        stamp = (found.st_ino, found.st_size, found.st_mtime_ns)
        if stamp != self._stamp:
            self._keys = read_known_keys(self.path)
            self._stamp = stamp
        return self._keys


def add_key(path: Path, gateway: str, public_key: bytes) -> None:
    """Add the key of a gateway to a list, which is made where it does not exist. Raises KeyFileError."""
    if not _GATEWAY.fullmatch(gateway):
        raise KeyFileError(f"{path}: {gateway!r:.130} is not <site>/<gateway>, so it gets no key")
    known = read_known_keys(path) if path.exists() else KnownKeys()
    owner = next((name for name, keys in known.gateways.items() if public_key in keys), gateway)
    if owner != gateway:
        raise KeyFileError(f"{path}: this is the key of {owner}; a key signs for one gateway, so make another one")
    if public_key in known.revoked:
        raise KeyFileError(f"{path}: this key is revoked: {known.revoked[public_key]}")
    if public_key not in known.gateways.get(gateway, ()):
        _append(path, f"gateway {gateway} {base64.b64encode(public_key).decode()}")


def revoke_key(path: Path, public_key: bytes, reason: str) -> None:
    """Add a revoked key to a list, which is made where it does not exist. Raises KeyFileError."""
    known = read_known_keys(path) if path.exists() else KnownKeys()
    if public_key not in known.revoked:
        _append(path, f"revoked {base64.b64encode(public_key).decode()} {' '.join(reason.split())}")


def _append(path: Path, line: str) -> None:
    try:
        with open(path, "a+b") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 1))
            begin = _BEGIN if file.tell() == 0 else "" if file.read() == b"\n" else "\n"
            file.write(f"{begin}{line}\n".encode())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be written: {error.strerror}") from None


def _of_gateway(rest: str, where: str) -> tuple[str, bytes]:
    words = rest.split()
    if len(words) != 2 or not _GATEWAY.fullmatch(words[0]):
        raise KeyFileError(f"{where}: not `gateway <site>/<gateway> <public key>`")
    return words[0], _public_key(words[1], where)


def _public_key(text: str, where: str) -> bytes:
    key = public_key_of(text)
    if key is None:
        raise KeyFileError(f"{where}: {text!r:.60} is not a public key, which is 32 bytes in base64")
    return key
