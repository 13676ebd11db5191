"""Short texts that a gateway or a witness has signed, so that anybody can check them with `openssl`.

The first line of a text is its purpose: a signature made for another purpose is not valid for it. Every further line is
a name, a space and a value. The signature (Ed25519) is over the bytes of the text in UTF-8.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import msgspec

from agent.config.known_keys import KnownKeys, identifier
from agent.config.strict_json import strict

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

_NO_KEY = "its public key is not 32 bytes in base64"
LARGEST = 4 << 10  # bytes of a signed text with its signature, in JSON; a head has 900


class SignedTextError(ValueError):
    """Bytes that are no signed text, or a text without the expected lines."""


class SignedText(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A text with its signature. `public_key` (32 bytes) and `signature` (64 bytes) are in base64."""

    text: str
    public_key: str
    signature: str

    @staticmethod
    def read(data: bytes, largest: int = LARGEST) -> SignedText:
        """Read the JSON of a signed text; the signature is not checked. Raises SignedTextError, for any bytes.

        `largest`: bytes that it may have.
        """
        if len(data) > largest:
            raise SignedTextError(f"more than {largest} bytes")
        try:
            signed = msgspec.json.decode(data, type=SignedText)
            strict(data)  # two readers could take one of two texts each
        except (msgspec.DecodeError, ValueError, RecursionError) as error:
            raise SignedTextError(f"not a signed text in JSON: {error}") from None
        return signed

    @property
    def json(self) -> bytes:
        """The JSON object with the three fields, in one line."""
        return msgspec.json.encode(self)

    @property
    def key_id(self) -> str:
        """The identifier of the stated public key; "" where the key is not 32 bytes in base64."""
        try:
            raw = base64.b64decode(self.public_key, validate=True)
        except (binascii.Error, ValueError):
            return ""
        return identifier(raw) if len(raw) == 32 else ""

    def fault_by(self, keys: KnownKeys, gateway: str) -> str:
        """Why this is not a text signed with a known key of a gateway (`<site>/<gateway>`); "" where it is."""
        return self.key_fault(keys, gateway) or self.fault()

    def key_fault(self, keys: KnownKeys, gateway: str) -> str:
        """Why the stated key is none of the gateway's; "" where it is one. The signature is not verified."""
        return keys.fault(gateway, base64.b64decode(self.public_key)) if self.key_id else _NO_KEY

    def fault(self, key: Ed25519PublicKey | None = None) -> str:
        """Why this is not a text signed with `key`, or with the stated key where `key` is None; "" where it is."""
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

        if key is None:
            if not self.key_id:
                return _NO_KEY
            key = Ed25519PublicKey.from_public_bytes(base64.b64decode(self.public_key))
        elif self.key_id != key_id(key):
            return f"signed with the key {self.key_id!r}, not with {key_id(key)}"
        return signature_fault(self.signature, self.text.encode(), key)


def sign(key: Ed25519PrivateKey, text: str) -> SignedText:
    """The text with the signature of a key."""
    public = base64.b64encode(key.public_key().public_bytes_raw()).decode()
    return SignedText(text, public, base64.b64encode(key.sign(text.encode())).decode())


def signature_fault(signature: str, message: bytes, key: Ed25519PublicKey) -> str:
    """Why a signature in base64 is not one of `message` by `key`; "" where it is."""
    from cryptography.exceptions import InvalidSignature

    try:
        key.verify(base64.b64decode(signature, validate=True), message)
    except (InvalidSignature, ValueError):
        return "its signature was not made with this key"
    return ""


def key_id(key: Ed25519PublicKey) -> str:
    """The first 16 hexadecimal digits of the SHA-256 of the 32 bytes of a public key."""
    return identifier(key.public_bytes_raw())


def written(purpose: str, values: Mapping[str, str]) -> str:
    """The text with this first line and one line for each value. Raises ValueError for a value of several lines."""
    for name, value in values.items():
        if "\n" in value:
            raise ValueError(f"{name}: {value!r} has more than one line")
    return "".join(f"{line}\n" for line in (purpose, *(f"{name} {value}" for name, value in values.items())))


def values_of(text: str, purpose: str, names: Sequence[str]) -> list[str]:
    """The values of a text that `written` made with these names in this order. Raises SignedTextError for others."""
    first, *lines = text.split("\n")
    if first != purpose:
        raise SignedTextError(f"a text for another purpose: {first!r:.60}, not {purpose!r}")
    pairs = [line.partition(" ") for line in lines]
    if [pair[0] for pair in pairs] != [*names, ""]:
        raise SignedTextError(f"its lines are not {', '.join(names)}")
    return [pair[2] for pair in pairs[:-1]]


def count(value: str) -> int:
    """A number of a text: at most 19 decimal digits. Raises SignedTextError."""
    if not (value.isascii() and value.isdigit() and len(value) < 20):
        raise SignedTextError(f"{value!r:.40} is not a number")
    return int(value)
