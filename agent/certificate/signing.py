"""Signatures of a certificate (Ed25519): inside certificate.json and certificate.xml, and over all files."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import TYPE_CHECKING

import msgspec

from agent.recording.signed_text import SignedText, sign, written

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

PURPOSE = "fieldcal certificate 1"


class CertificateSigner:
    """Signs the parts of one certificate; without a key the parts stay unsigned."""

    def __init__(self, key: Ed25519PrivateKey | None, number: str) -> None:
        self._key, self._number = key, number

    @property
    def words(self) -> str:
        """What the pages say of the signature."""
        if self._key is None:
            return "not signed"
        from agent.recording.signed_text import key_id

        return f"Ed25519, key {key_id(self._key.public_key())}; certificate.sig has the signature over all files"

    def sign(self, parts: Mapping[str, bytes]) -> bytes | None:
        """The JSON of the signed text that names the SHA-256 of each part; None without a key."""
        if self._key is None:
            return None
        digests = {name: hashlib.sha256(content).hexdigest() for name, content in parts.items()}
        return msgspec.json.encode(sign(self._key, written(PURPOSE, {"number": self._number, **digests})))


def as_json(body: bytes, signer: CertificateSigner) -> bytes:
    """certificate.json: `body`, the JSON of the content, with the signature over exactly these bytes, or null."""
    return b'{"certificate":' + body + b',\n"signature":' + (signer.sign({"certificate": body}) or b"null") + b"}\n"


def signed_json(data: bytes) -> tuple[bytes, SignedText | None]:
    """The content of certificate.json as it was signed, and its signature. Raises msgspec.DecodeError."""
    held = msgspec.json.decode(data, type=_Signed)
    return bytes(held.certificate), held.signature


class _Signed(msgspec.Struct):
    certificate: msgspec.Raw
    signature: SignedText | None
