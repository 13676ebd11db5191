"""Is a row of the store what the gateway signed?"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from agent.delivery.record import StoredResult
from agent.delivery.schema import StoreError
from agent.delivery.verifying import differing
from agent.recording.messages import MessageError, topic_of
from agent.recording.result_signing import SignedResult
from agent.recording.signed_text import SignedTextError

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys


class UnprovenError(Exception):
    """A result in the store is not what the gateway signed. The message says why."""


def proven(record: StoredResult, keys: KnownKeys | None) -> tuple[StoredResult, str]:
    """(the record as its signed bytes say it, in what the stored row differs from them; "" where it does not).

    `recorded` and `recording` are not signed and stay. With `keys`, one of them must have signed; without, the key
    that the bytes name. Raises UnprovenError where that is not so, or where the bytes are of another result.
    """
    place = f"/{record.sensor}/{record.what}"
    try:
        signed = SignedResult.read(record.signed)
        if fault := signed.fault or (keys.fault(signed.gateway, signed.public_key) if keys is not None else ""):
            raise UnprovenError(fault)
        result = signed.result
    except (SignedTextError, MessageError) as error:
        raise UnprovenError(str(error)) from None
    if (signed.sequence, signed.topic) != (record.sequence, place):
        raise UnprovenError(f"it has the signature of result {signed.sequence} ({signed.topic!r:.140})")
    if result is None:  # of a kind that this version does not know
        return record, ""
    if (result.sequence, topic_of(result)) != (signed.sequence, place):
        raise UnprovenError(f"it is signed as another result: {result.sequence} ({topic_of(result)!r:.140})")
    made = StoredResult.of(
        result, recorded=record.recorded, recording=record.recording, epoch=signed.epoch, signed=record.signed
    )
    names = list(_differing(record, made))
    if replace(record, payload=made.payload) != made:
        names.append("a column")
    return made, f"its row says something else than what was signed: {', '.join(names)}" if names else ""


def _differing(record: StoredResult, made: StoredResult) -> tuple[str, ...]:
    try:
        return differing(record.fields, made.fields)
    except StoreError:  # no JSON
        return ("all",)
