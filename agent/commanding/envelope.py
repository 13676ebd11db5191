"""A command as bytes: a line with the key's identifier and the signature, then the signed body.

    fieldcal-command-1 <key id> <Ed25519 signature, base64>\\n<body>

The signed bytes are `fieldcal-command-1 <key id>\\n<body>`. The body is one JSON object in UTF-8. It is parsed only
after its signature is verified, so that only the owner of a key can reach the parser. Since the bytes themselves are
signed, the same command with other spacing or order of fields is not valid.
"""

from __future__ import annotations

import re
from base64 import b64decode, b64encode
from dataclasses import dataclass
from typing import Annotated

import msgspec
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from agent.commanding.arguments import Arguments, Verb
from agent.commanding.refusal import Refused
from agent.config.strict_json import strict

LARGEST = 4096  # bytes of a command; the longest pose takes 400
_MARK = b"fieldcal-command-1"
_HEAD = re.compile(_MARK + rb" ([A-Za-z0-9][A-Za-z0-9_.-]{0,62}) ([A-Za-z0-9+/]{85}[AQgw]==)\n")
Int64 = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]


class Order(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The signed content. `gateway`: `<site>/<gateway>`; `counter`: the sender's UTC in ns, above all earlier ones."""

    gateway: str
    sensor: str
    verb: Verb
    arguments: msgspec.Raw
    counter: Int64
    expires_utc_ns: Int64

    @staticmethod
    def of(gateway: str, sensor: str, verb: Verb, arguments: Arguments, counter: int, expires_utc_ns: int) -> Order:
        """Make an order with these arguments; they are encoded as JSON."""
        raw = msgspec.Raw(msgspec.json.encode(arguments))
        return Order(
            gateway=gateway, sensor=sensor, verb=verb, arguments=raw, counter=counter, expires_utc_ns=expires_utc_ns
        )


_ORDER = msgspec.json.Decoder(Order)  # made during the import, as agent.delivery.record says


@dataclass(frozen=True, slots=True)
class Envelope:
    """The parts of the bytes of a command. The signature is not verified yet."""

    key_id: str
    signature: bytes
    body: bytes

    def open(self, key: Ed25519PublicKey) -> Order:
        """Verify the signature with `key` and return the signed order. Raises Refused."""
        try:
            key.verify(self.signature, _signed(self.key_id, self.body))
        except InvalidSignature:
            raise Refused("bad signature", f"the signature was not made with key {self.key_id}") from None
        try:
            strict(self.body)
            return _ORDER.decode(self.body)
        except (msgspec.DecodeError, ValueError, RecursionError) as error:
            raise Refused("malformed", f"not a command: {error}") from None


def seal(order: Order, key_id: str, key: Ed25519PrivateKey) -> bytes:
    """Sign an order; returns the bytes to send."""
    body = msgspec.json.encode(order)
    signature = b64encode(key.sign(_signed(key_id, body)))
    return b" ".join([_MARK, key_id.encode(), signature]) + b"\n" + body


def parse_envelope(data: bytes) -> Envelope:
    """Split the bytes of a command into their parts, without verifying the signature. Raises Refused."""
    if len(data) > LARGEST:
        raise Refused("too large", f"{len(data)} bytes, more than the limit of {LARGEST}")
    head = _HEAD.match(data)
    if head is None:
        raise Refused("unsigned", "it does not begin with a key identifier and a signature")
    return Envelope(head[1].decode(), b64decode(head[2]), data[head.end() :])


def as_line(data: bytes) -> str:
    """The bytes of a command as one line of text, which a person can copy."""
    return data.decode().replace("\n", " ", 1)


def from_line(line: bytes) -> bytes:
    """The bytes of a command from its line, with any white space around the line and before the body."""
    head, brace, body = line.strip().partition(b"{")
    return head.rstrip() + b"\n" + brace + body


def _signed(key_id: str, body: bytes) -> bytes:
    return b" ".join([_MARK, key_id.encode()]) + b"\n" + body
