"""Signatures of single results: Ed25519 over the message that the recording stores, and whose result it is.

The pipeline gives no signatures, so that a replay needs no key. Where the gateway has a key, the message of a result is
stored with one more field behind all others, `signature`. The signed bytes are some lines of text (gateway, epoch,
sequence, topic, key), an empty line, and the message without this field. docs/audit.md gives the layout.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from dataclasses import dataclass, replace

from agent.core.events import Event, Output, Result, RunStart
from agent.recording.messages import decode, encode, schema_of, topic_of
from agent.recording.results_chain import EPOCH
from agent.recording.signed_text import SignedTextError, count, values_of, written
from agent.recording.signing import Signer

PUBLIC_KEY = "public_key"  # in the metadata fieldcal.file: in base64; all results of this recording are signed with it
LARGEST_HEADER = 1024  # bytes; the names in it are short
_PURPOSE = "fieldcal result, version 1"
_NAMES = ["gateway", "epoch", "sequence", "topic", "public_key"]
_FIELD = b"\xc2\x3e\x40"  # of protobuf: field 1000, 64 bytes follow
_TAIL = len(_FIELD) + 64


@dataclass(frozen=True, slots=True)
class SignedResult:
    """A result as it was signed. `public_key`: 32 bytes. `message`: as the recording stores it, with its signature."""

    gateway: str
    epoch: str
    sequence: int
    topic: str
    public_key: bytes
    message: bytes

    @property
    def data(self) -> bytes:
        """The bytes that the store keeps and that are published: what is signed, then the field with the signature."""
        public_key = base64.b64encode(self.public_key).decode()
        values = (self.gateway, self.epoch or "-", str(self.sequence), self.topic, public_key)
        return written(_PURPOSE, dict(zip(_NAMES, values, strict=True))).encode() + b"\n" + self.message

    @property
    def is_written(self) -> bool:
        """Whether the names have one line each, so that `data` can be made; those of a hostile recording may not."""
        return not any("\n" in name for name in (self.gateway, self.epoch, self.topic))

    @staticmethod
    def read(data: bytes) -> SignedResult:
        """Read such bytes; the signature is not verified. Raises SignedTextError, for any bytes."""
        end = data.find(b"\n\n", 0, LARGEST_HEADER) + 1
        try:
            text = data[:end].decode()
            gateway, epoch, sequence, topic, key = values_of(text, _PURPOSE, _NAMES)
            public_key = base64.b64decode(key, validate=True)
        except (UnicodeDecodeError, binascii.Error) as error:
            raise SignedTextError(f"not a signed result: {error}") from None
        result = SignedResult(
            gateway, "" if epoch == "-" else epoch, count(sequence), topic, public_key, data[end + 1 :]
        )
        if len(public_key) != 32 or result.data != data:
            raise SignedTextError("its lines are not as this program writes them")
        return result

    @property
    def fault(self) -> str:
        """Why this was not signed with the stated key; "" where it was. Whose key this is, others must know."""
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

        if self.message[-_TAIL:-64] != _FIELD or not self.is_written:
            return "it is not signed"
        try:
            Ed25519PublicKey.from_public_bytes(self.public_key).verify(self.message[-64:], self.data[:-_TAIL])
        except (InvalidSignature, ValueError):
            return "its signature was not made with this key, or it was changed"
        return ""

    @property
    def result(self) -> Result | None:
        """The result; None where this version does not know its kind. Raises MessageError for other bytes."""
        try:
            schema = schema_of(self.topic)
        except (KeyError, IndexError):
            return None
        item = decode(schema, self.message)[1]
        return item if isinstance(item, Result) else None


class ResultSigner:
    """Encodes what is recorded, each result with its signature. Without a `signer` nothing is signed.

    `epoch`: of the store. `gateway`: `<site>/<gateway>`, as the newest RunStart says, which comes before all results.
    """

    def __init__(self, epoch: str, signer: Signer | None) -> None:
        self.gateway = ""
        self._epoch = epoch
        self._signer = signer
        self._event = -1
        self._signed: dict[int, tuple[Result, SignedResult]] = {}  # of the last event, by sequence

    def encode(self, event_sequence: int, item: Event | Output) -> bytes:
        """The message of an event or output, as `agent.recording.messages.encode`; of a result, with its signature."""
        if isinstance(item, RunStart):
            self.gateway = f"{item.site}/{item.gateway}"
        signed = self.signed(event_sequence, item) if isinstance(item, Result) else None
        return signed.message if signed is not None else encode(event_sequence, item)

    def signed(self, event_sequence: int, result: Result) -> SignedResult | None:
        """The signed result; None without a key. It is signed once, also where this is asked again."""
        if self._signer is None:
            return None
        if event_sequence != self._event:
            self._event, self._signed = event_sequence, {}
        of, signed = self._signed.get(result.sequence, (None, None))
        if of is not result or signed is None:
            signed = self._sign(self._signer, event_sequence, result)
            self._signed[result.sequence] = result, signed
        return signed

    def _sign(self, signer: Signer, event_sequence: int, result: Result) -> SignedResult:
        public_key, message = signer.public_key.public_bytes_raw(), encode(event_sequence, result)
        unsigned = SignedResult(self.gateway, self._epoch, result.sequence, topic_of(result), public_key, message)
        return replace(unsigned, message=message + _FIELD + signer.sign_bytes(unsigned.data))


def recorded_result(result: Result, message: bytes, gateway: str, origin: Mapping[str, str]) -> SignedResult | None:
    """A result of a recording with its signature, not verified; None where the recording names no key of its results.

    `origin`: the metadata fieldcal.file of the recording. `gateway`: of its RunStart.
    """
    if PUBLIC_KEY not in origin:
        return None
    try:
        public_key = base64.b64decode(origin[PUBLIC_KEY], validate=True)
    except ValueError:
        public_key = b""
    return SignedResult(gateway, origin.get(EPOCH, ""), result.sequence, topic_of(result), public_key, message)
