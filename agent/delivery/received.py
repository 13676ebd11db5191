"""One result as a consumer gets it: bounded and checked, since others may put what they like on a key."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec

from agent.core.events import CalibrationUpdate, Estimate
from agent.delivery.history import result_of
from agent.delivery.keys import Address, parse_key

LARGEST_RESULT = 256 << 10  # bytes; a calibration, the largest, has 5 kB
LARGEST_NUMBER = 2**63 - 1
_DIGITS_MAX = 19


@dataclass(frozen=True, slots=True)
class Received:
    """One result. `fields` is its JSON: the fields of agent.core.events, and `recorded`."""

    key: str
    address: Address
    sequence: int
    fields: dict[str, Any]
    previous: int | None  # the result that the gateway put before this one; None in an answer to a query
    # Some results after the last one known, up to this number, are no longer kept: whoever wants them came too late.
    removed_up_to: int | None = None


def receive(key: str, payload: bytes, attachment: bytes | None) -> Received | None:
    """The result in a sample; None for what is none of ours, whatever the bytes are.

    A kind of result that this version knows has all its fields, of the right types and shapes; of a kind it does not
    know only the sequence and the sensor are looked at.
    """
    address = parse_key(key)
    if address is None or len(payload) > LARGEST_RESULT:
        return None
    try:
        fields = msgspec.json.decode(payload, type=dict[str, Any])
        result = result_of(address.what, fields)
    except (msgspec.DecodeError, ValueError, RecursionError):  # bytes that are no UTF-8; a thousand brackets deep
        return None
    calibration = result.calibration if isinstance(result, Estimate) else result
    if isinstance(calibration, CalibrationUpdate) and not _has_its_shapes(calibration):
        return None
    sequence = fields.get("sequence")
    if type(sequence) is not int or not 0 <= sequence <= LARGEST_NUMBER or fields.get("sensor") != address.sensor:
        return None
    if attachment is None:
        return Received(key, address, sequence, fields, None)
    if len(attachment) > _DIGITS_MAX or not attachment.isdigit():
        return None
    return Received(key, address, sequence, fields, int(attachment))


def _has_its_shapes(calibration: CalibrationUpdate) -> bool:
    lengths = (calibration.offset, 3), (calibration.standard_uncertainty, 12), (calibration.determined, 12)
    squares = (calibration.sensitivity, 3), (calibration.covariance, 12)
    return all(len(values) == n for values, n in lengths) and all(
        len(rows) == n and all(len(row) == n for row in rows) for rows, n in squares
    )
