"""One result as a consumer receives it. Its size and content are checked, since others may publish on the same key."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec

from agent.core.events import CalibrationUpdate, Estimate
from agent.delivery.keys import Address, parse_key
from agent.delivery.record import result_of
from agent.delivery.verifying import Verifier, differing, signer_of

LARGEST_RESULT = 256 << 10  # bytes; the largest result, a calibration, has 5 kB
LARGEST_NUMBER = 2**63 - 1
DEEPEST = 16  # levels of a result; a calibration has five
_DIGITS_MAX = 19
_EPOCH = re.compile(r"(?:[0-9a-f]{16})?")


@dataclass(frozen=True, slots=True)
class Received:
    """One result. `fields`: its JSON, with the fields of its kind in agent.core.events and the field `recorded`.

    Where the consumer has a list of keys, the fields come from the bytes that the gateway signed, except `recorded`.
    """

    key: str
    address: Address
    sequence: int
    fields: dict[str, Any]
    previous: int | None  # number of the result that the gateway published before; None in an answer to a query
    # Where not None: retention has deleted results between the last one received and this number.
    removed_up_to: int | None = None
    epoch: str = ""  # names the numbering that `sequence` belongs to; "" from an older version
    # The first result of an epoch, after results of another one: the gateway's store was made anew.
    new_epoch: bool = False
    # False: the gateway's store does not have this result. It may not have been able to write it; or a stranger
    # published it.
    confirmed: bool = True
    signed: bytes = b""  # as the gateway signed it (docs/audit.md), evidence for others; empty where it has no key
    signed_by: str = ""  # identifier of the key; "" where the consumer has no list of keys, so nothing was verified
    altered: tuple[str, ...] = ()  # fields of which the JSON said something else than the signed bytes


class _Numbered(msgspec.Struct):
    sequence: Annotated[int, msgspec.Meta(ge=0, le=LARGEST_NUMBER)]


_NUMBERED = msgspec.json.Decoder(_Numbered)  # made during the import, as agent.delivery.record says


def number_of(payload: bytes) -> int:
    """The number that a payload claims, whatever else it says; 0 where it has none."""
    try:
        return _NUMBERED.decode(payload).sequence if len(payload) <= LARGEST_RESULT else 0
    except (msgspec.DecodeError, ValueError, RecursionError):
        return 0


def receive(key: str, payload: bytes, attachment: bytes | None, verifier: Verifier | None = None) -> Received | None:
    """Decode a sample; returns None where it is not a result of a gateway, for any bytes.

    A result of a known kind must have all its fields, of the right types and shapes. Of a kind that this version does
    not know, only the fields `sequence` and `sensor` are checked. Integers have 64 bits in both. With a `verifier` only
    a result that its gateway signed is returned, and a result that is not verified raises UnverifiedError.
    """
    address = parse_key(key)
    before, _, signed = (attachment or b"").partition(b"\n")
    if address is None or len(payload) > LARGEST_RESULT or len(signed) > LARGEST_RESULT:
        return None
    if len(before) > _DIGITS_MAX or not (before.isdigit() or not before):
        return None
    previous = int(before) if before else None
    if verifier is None:
        return _plain(key, address, payload, previous, signed)
    if not address.is_result:
        return None  # so it is not signed
    return _verified(key, address, payload, previous, signed, verifier)


def _verified(
    key: str, address: Address, payload: bytes, previous: int | None, data: bytes, verifier: Verifier
) -> Received:
    signed, fields = verifier.verify(address, data)
    try:
        told = msgspec.json.decode(payload)
    except (msgspec.DecodeError, ValueError, RecursionError):
        told = None
    altered = differing(told, fields)
    fields["recorded"] = isinstance(told, dict) and told.get("recorded") is True
    by = signer_of(signed)
    return Received(
        key, address, signed.sequence, fields, previous, epoch=signed.epoch, signed=data, signed_by=by, altered=altered
    )


def _plain(key: str, address: Address, payload: bytes, previous: int | None, signed: bytes) -> Received | None:
    try:
        fields = msgspec.json.decode(payload, type=dict[str, Any])
        result = result_of(address.what, fields)
    except (msgspec.DecodeError, ValueError, RecursionError):  # not UTF-8; or too many nested brackets
        return None
    if not _is_bounded(fields, DEEPEST):
        return None
    calibration = result.calibration if isinstance(result, Estimate) else result
    if isinstance(calibration, CalibrationUpdate) and not _has_shapes(calibration):
        return None
    sequence = fields.get("sequence")
    if type(sequence) is not int or not 0 <= sequence <= LARGEST_NUMBER or fields.get("sensor") != address.sensor:
        return None
    epoch = fields.get("epoch", "")
    if not isinstance(epoch, str) or not _EPOCH.fullmatch(epoch):
        return None
    return Received(key, address, sequence, fields, previous, epoch=epoch, signed=signed)


def _is_bounded(value: Any, levels: int) -> bool:
    """Whether integers have 64 bits, and lists and objects are nested at most so many `levels` deep."""
    if isinstance(value, int):
        return -LARGEST_NUMBER <= value <= LARGEST_NUMBER
    if isinstance(value, (dict, list)):
        within = value.values() if isinstance(value, dict) else value
        return levels > 0 and all(_is_bounded(each, levels - 1) for each in within)
    return True


def _has_shapes(calibration: CalibrationUpdate) -> bool:
    steady = calibration.sensitivity_at_0hz
    squares_3 = [square for square in (steady.sensitivity, steady.standard_uncertainty) if square]
    for band in calibration.response:
        squares_3 += [band.sensitivity_re, band.sensitivity_im, band.standard_uncertainty]
    lengths = (calibration.offset, 3), (calibration.standard_uncertainty, 12), (calibration.determined, 12)
    squares = (calibration.sensitivity, 3), (calibration.covariance, 12), *((square, 3) for square in squares_3)
    return (
        len(calibration.valid_band_hz) in (0, 2)
        and all(len(values) == n for values, n in lengths)
        and all(shared.has_its_shapes for shared in calibration.shared_errors)
        and all(len(rows) == n and all(len(row) == n for row in rows) for rows, n in squares)
    )
