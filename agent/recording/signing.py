"""Signatures of recordings: Ed25519 over a text about the file: its gateway, number, predecessor, results and content.

The signature is a metadata record, the last record of the file's data section. Only the summary follows it. The audit
derives what the summary must say from the signed bytes, so the summary needs no signature. docs/audit.md gives the
layout. Files of version 1 have a signature over the SHA-256 of the content alone.
"""

from __future__ import annotations

import base64
import hashlib
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from mcap.opcode import Opcode

from agent.config.key_file import KeyFileError, load_private_key, read_key_file
from agent.config.known_keys import KnownKeys
from agent.recording.signed_text import (
    SignedText,
    SignedTextError,
    count,
    sign,
    signature_fault,
    values_of,
    written,
)

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

SIGNATURE_METADATA = "fieldcal.signature"
_CONTEXT_1 = b"fieldcal recording, version 1\n"
_PURPOSE_2 = "fieldcal recording, version 2"
_LINES_2 = ["gateway", "epoch", "recording", "previous", "results", "content"]
_HEAD = struct.Struct("<BQ")
_OTHER_BYTES = "its signature is of other bytes than the file holds: the file was changed after it was signed"


@dataclass(frozen=True, slots=True)
class SignedStatement:
    """What the signature of a recording says.

    `epoch`: of the store, "" where there was none. `previous_sha256`: of the whole file before it, "" where there is
    none or it was never closed. `results`: the text of the ResultsChain at the end. `length`, `sha256`: of all bytes
    before the record of the signature.
    """

    gateway: str
    epoch: str
    file_sequence: int
    previous_sha256: str
    results: str
    length: int
    sha256: str

    @property
    def values(self) -> dict[str, str]:
        """The lines that signatures and heads have in common."""
        return {
            "gateway": self.gateway,
            "epoch": self.epoch or "-",
            "recording": str(self.file_sequence),
            "previous": self.previous_sha256 or "-",
            "results": self.results,
            "content": f"{self.length} {self.sha256}",
        }

    @property
    def text(self) -> str:
        """The bytes that a signature of version 2 is over. Raises ValueError for a name of several lines."""
        return written(_PURPOSE_2, self.values)


class Signer:
    """Signs with a gateway's private key. `earlier`: public keys (32 bytes each) with which it signed before."""

    def __init__(self, key: Ed25519PrivateKey, earlier: Sequence[bytes] = ()) -> None:
        self._key = key
        self.public_key = key.public_key()
        self.known = KnownKeys(anywhere=(self.public_key.public_bytes_raw(), *earlier))  # what this gateway believes
        self.public_base64 = base64.b64encode(self.public_key.public_bytes_raw()).decode()

    @staticmethod
    def load(path: Path, earlier: Sequence[Path] = ()) -> Signer:
        """Make a Signer with the key in a PEM file (PKCS #8, not encrypted), and earlier public keys in PEM files.

        Raises KeyFileError.
        """
        return Signer(load_private_key(path), [load_public_key(one).public_bytes_raw() for one in earlier])

    def sign(self, text: str) -> SignedText:
        """Sign a text of `signed_text.written`."""
        return sign(self._key, text)

    def sign_bytes(self, data: bytes) -> bytes:
        """The signature of bytes that begin with the line of their purpose."""
        return self._key.sign(data)

    def metadata(self, statement: SignedStatement) -> dict[str, str]:
        """The metadata record with the signature of a recording."""
        signed = self.sign(statement.text)
        return {
            "algorithm": "Ed25519",
            "text": signed.text,
            "public_key": signed.public_key,
            "signature": signed.signature,
        }


def load_public_key(path: Path) -> Ed25519PublicKey:
    """Read an Ed25519 public key from a PEM file, the only one in it. Raises KeyFileError."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    data = read_key_file(path)
    if (keys := data.count(b"-----BEGIN ")) > 1:
        raise KeyFileError(f"{path}: {keys} keys, of which one would be taken; write each into a file of its own")
    try:
        key = load_pem_public_key(data)
    except ValueError:
        raise KeyFileError(f"{path}: not a public key in PEM") from None
    if not isinstance(key, Ed25519PublicKey):
        raise KeyFileError(f"{path}: a public key, but not an Ed25519 key")
    return key


def signed_text(metadata: dict[str, str]) -> SignedText:
    """The text, key and signature in the record of a signature; "" where the record lacks one."""
    return SignedText(*(metadata.get(name, "") for name in ("text", "public_key", "signature")))


def signed_results(metadata: dict[str, str] | None) -> str | None:
    """The chain of results at the end of a file, as its signature names it; None where it names none."""
    try:
        return values_of((metadata or {}).get("text", ""), _PURPOSE_2, _LINES_2)[4]
    except SignedTextError:
        return None


def verify_file(
    file: BinaryIO, size: int, metadata: dict[str, str] | None, keys: KnownKeys, found: SignedStatement
) -> str:
    """Why an MCAP file is not signed up to its summary with one of its gateway's keys; "" where it is. Raises OSError.

    `size`: of the file in bytes. `metadata`: its signature record, None where it has none. `found`: what its signature
    must say, as its other records do; length and SHA-256 are computed here.
    """
    if metadata is None:
        return "no signature in this file"
    try:
        said = values_of(metadata["text"], _PURPOSE_2, _LINES_2) if "text" in metadata else []
        length = count(said[5].partition(" ")[0] if said else metadata.get("bytes", ""))
    except SignedTextError as error:
        return f"its signature cannot be read: {error}"
    if length >= size:
        return _OTHER_BYTES
    digest = prefix_sha256(file, length)
    # Here the record of the signature must begin, and the record DataEnd must follow it.
    opcode, body = _HEAD.unpack(file.read(_HEAD.size).ljust(_HEAD.size, b"\0"))
    file.seek(min(body, size), 1)
    if opcode != Opcode.METADATA or file.read(1) != bytes([Opcode.DATA_END]):
        return "unsigned data follow its signature"
    if not said:
        return _fault_1(metadata, digest, keys, found.gateway)
    return _fault_2(metadata, replace(found, length=length, sha256=digest.hex()), said, keys)


def prefix_sha256(file: BinaryIO, length: int) -> bytes:
    """The SHA-256 of the first `length` bytes of a file; the file is then positioned after them. Raises OSError."""
    digest, left = hashlib.sha256(), length
    file.seek(0)
    while left and (piece := file.read(min(left, 1 << 20))):
        digest.update(piece)
        left -= len(piece)
    return digest.digest()


def _fault_1(metadata: dict[str, str], sha256: bytes, keys: KnownKeys, gateway: str) -> str:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    key_id = metadata.get("key_id", "")
    public_key = keys.key_named(gateway, key_id)
    if public_key is None:
        return keys.other_key(gateway, key_id)
    if fault := keys.fault(gateway, public_key):
        return fault
    if metadata.get("sha256") != sha256.hex():
        return _OTHER_BYTES
    key = Ed25519PublicKey.from_public_bytes(public_key)
    return signature_fault(metadata.get("signature", ""), _CONTEXT_1 + sha256, key)


def _fault_2(metadata: dict[str, str], found: SignedStatement, said: list[str], keys: KnownKeys) -> str:
    signed = signed_text(metadata)
    if fault := signed.key_fault(keys, found.gateway):
        return fault
    values = found.values
    if said[5] != values["content"]:
        return _OTHER_BYTES
    for name, value in zip(values, said, strict=True):
        if value != values[name]:
            return f"its signature says {name} {value!r:.80}, its content {values[name]!r:.80}"
    return signed.fault()
