"""Verifies published results: their fields come from the bytes that the gateway signed, not from the JSON beside."""

from __future__ import annotations

from collections import Counter
from typing import Any

import msgspec

from agent.config.key_file import KeyFileError
from agent.config.known_keys import KnownKeys, WatchedKeys, add_key, identifier
from agent.delivery.keys import Address
from agent.delivery.record import payload_of
from agent.delivery.seldom import Seldom
from agent.recording.messages import MessageError
from agent.recording.result_signing import SignedResult
from agent.recording.signed_text import SignedTextError

GATEWAYS_MAX = 1000  # named in counts, and trusted at their first result; strangers may invent names for ever
REFUSED_MAX = 10_000  # newest refused results that are known again


class UnverifiedError(Exception):
    """A result cannot be shown to be of its gateway. The message gives the reason."""


class Refusals:
    """Counts results that were not verified, by gateway, and logs one of them in a while.

    A result comes as a message, and again in each answer of its gateway's store. It counts once.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._refused: dict[int, None] = {}  # hashes, the oldest first
        self._log = Seldom()

    def count(self, source: str, reason: str, *result: bytes) -> None:
        """Count a result of a gateway, given as its JSON and what was signed, unless it was counted before.

        Of gateways beyond GATEWAYS_MAX the count is common, under the name "".
        """
        identity = hash((source, *result))
        if identity in self._refused:
            return
        self._refused[identity] = None
        if len(self._refused) > REFUSED_MAX:
            del self._refused[next(iter(self._refused))]
        self.counts[source if source in self.counts or len(self.counts) < GATEWAYS_MAX else ""] += 1
        told = "a result published as one of %s is refused: %s (%d refused so far)"
        self._log.warning(told, source, reason, self.counts.total())


class Verifier:
    """Verifies results with a list of known keys, which is read again when it changes.

    `trust_first`: a gateway without a key in the list gets the key of its first result, which is added to the list.
    Raises KeyFileError where the list cannot be read.
    """

    def __init__(self, keys: WatchedKeys, *, trust_first: bool = False) -> None:
        keys.now()
        self._keys = keys
        self._trust_first = trust_first

    def verify(self, address: Address, data: bytes) -> tuple[SignedResult, dict[str, Any]]:
        """(the signed result, its fields as in the JSON but without `recorded`) of published bytes.

        Raises UnverifiedError, nothing else, for any bytes.
        """
        if not data:
            raise UnverifiedError("it is not signed")
        try:
            signed = SignedResult.read(data)
            self._check_place(address, signed)
            keys = self._keys.now()
            if fault := signed.fault or self._key_fault(keys, signed):
                raise UnverifiedError(fault)
            result = signed.result
        except (SignedTextError, MessageError, KeyFileError) as error:
            raise UnverifiedError(str(error)) from None
        if result is None:  # of a kind that this version does not know
            return signed, {"sensor": address.sensor, "sequence": signed.sequence, "epoch": signed.epoch}
        if (result.sequence, result.sensor) != (signed.sequence, address.sensor):
            raise UnverifiedError(f"its message is of {result.sensor!r:.70}, result {result.sequence}")
        fields: dict[str, Any] = msgspec.json.decode(payload_of(result, recorded=False, epoch=signed.epoch))
        del fields["recorded"]
        return signed, fields

    @staticmethod
    def _check_place(address: Address, signed: SignedResult) -> None:
        topic = f"/{address.sensor}/{address.what}"
        if (signed.gateway, signed.topic) != (address.source, topic):
            raise UnverifiedError(f"it is signed as {signed.topic!r:.140} of {signed.gateway!r:.130}")

    def _key_fault(self, keys: KnownKeys, signed: SignedResult) -> str:
        new = signed.gateway not in keys.gateways and signed.public_key not in keys.revoked
        if new and self._trust_first and len(keys.gateways) < GATEWAYS_MAX:
            add_key(self._keys.path, signed.gateway, signed.public_key)
            return ""
        return keys.fault(signed.gateway, signed.public_key)


def signer_of(signed: SignedResult) -> str:
    """The identifier of the key of a signed result."""
    return identifier(signed.public_key)


def differing(told: Any, fields: dict[str, Any]) -> tuple[str, ...]:
    """The names of the fields of which the JSON `told` says something else than the signed `fields`."""
    if not isinstance(told, dict):
        return ("all",)
    return tuple(sorted(name for name in fields if name in told and told[name] != fields[name]))
