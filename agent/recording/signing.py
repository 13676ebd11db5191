"""Signatures of recordings: Ed25519 over the SHA-256 of all bytes of a file before the signature.

The signature is a metadata record, the last record of the file's data section. Only the summary follows it. The audit
derives what the summary must say from the signed bytes, so the summary needs no signature.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import struct
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from mcap.opcode import Opcode

from agent.config.key_file import KeyFileError, load_private_key, read_key_file

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

SIGNATURE_METADATA = "fieldcal.signature"
_CONTEXT = b"fieldcal recording, version 1\n"  # a signature that the key made for another purpose is not valid here
_HEAD = struct.Struct("<BQ")
_OTHER_BYTES = "its signature is of other bytes than the file holds: the file was changed after it was signed"


class Signer:
    """Signs recordings with a gateway's private key."""

    def __init__(self, key: Ed25519PrivateKey) -> None:
        self._key = key
        self.key_id = key_id(key.public_key())

    @staticmethod
    def load(path: Path) -> Signer:
        """Make a Signer with the key in a PEM file (PKCS #8, not encrypted). Raises KeyFileError."""
        return Signer(load_private_key(path))

    def metadata(self, sha256: bytes, length: int) -> dict[str, str]:
        """The metadata record that signs the first `length` bytes of a file, which have this SHA-256."""
        return {
            "algorithm": "Ed25519",
            "key_id": self.key_id,
            "bytes": str(length),
            "sha256": sha256.hex(),
            "signature": base64.b64encode(self._key.sign(_CONTEXT + sha256)).decode(),
        }


def load_public_key(path: Path) -> Ed25519PublicKey:
    """Read an Ed25519 public key from a PEM file. Raises KeyFileError."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    try:
        key = load_pem_public_key(read_key_file(path))
    except ValueError:
        raise KeyFileError(f"{path}: not a public key in PEM") from None
    if not isinstance(key, Ed25519PublicKey):
        raise KeyFileError(f"{path}: a public key, but not an Ed25519 key")
    return key


def key_id(key: Ed25519PublicKey) -> str:
    """The first 16 hexadecimal digits of the SHA-256 of the 32 bytes of a public key."""
    return hashlib.sha256(key.public_bytes_raw()).hexdigest()[:16]


def signature_fault(metadata: dict[str, str], sha256: bytes, length: int, key: Ed25519PublicKey) -> str:
    """Why a signature is not one by `key` over `length` bytes with this SHA-256; "" where it is."""
    from cryptography.exceptions import InvalidSignature

    if metadata.get("key_id") != key_id(key):
        return f"signed with the key {metadata.get('key_id', '')!r:.40}, not with {key_id(key)}"
    if metadata.get("sha256") != sha256.hex() or metadata.get("bytes") != str(length):
        return _OTHER_BYTES
    try:
        key.verify(base64.b64decode(metadata.get("signature", ""), validate=True), _CONTEXT + sha256)
    except (InvalidSignature, binascii.Error):
        return "its signature was not made with this key"
    return ""


def verify_file(file: BinaryIO, size: int, metadata: dict[str, str] | None, key: Ed25519PublicKey) -> str:
    """Why an MCAP file is not signed with `key` up to its summary; "" where it is. Raises OSError.

    `size`: of the file in bytes. `metadata`: its signature record, None where it has none.
    """
    if metadata is None:
        return "no signature in this file"
    length = metadata.get("bytes", "")
    if not (length.isascii() and length.isdigit() and len(length) < 19 and int(length) < size):
        return _OTHER_BYTES
    digest, left = hashlib.sha256(), int(length)
    file.seek(0)
    while left and (piece := file.read(min(left, 1 << 20))):
        digest.update(piece)
        left -= len(piece)
    # Here the record of the signature must begin, and the record DataEnd must follow it.
    opcode, body = _HEAD.unpack(file.read(_HEAD.size).ljust(_HEAD.size, b"\0"))
    file.seek(min(body, size), 1)
    if opcode != Opcode.METADATA or file.read(1) != bytes([Opcode.DATA_END]):
        return "unsigned data follow its signature"
    return signature_fault(metadata, digest.digest(), int(length), key)
