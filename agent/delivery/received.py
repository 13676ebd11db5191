"""One result as a consumer receives it. Its size and content are checked, since others may publish on the same key."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import msgspec

from agent.core.events import CalibrationUpdate, Estimate
from agent.delivery.history import result_of
from agent.delivery.keys import Address, parse_key

LARGEST_RESULT = 256 << 10  # bytes; the largest result, a calibration, has 5 kB
LARGEST_NUMBER = 2**63 - 1
_DIGITS_MAX = 19
_EPOCH = re.compile(r"(?:[0-9a-f]{16})?")


@dataclass(frozen=True, slots=True)
class Received:
    """One result. `fields`: its JSON, with the fields of its kind in agent.core.events and the field `recorded`."""

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


def receive(key: str, payload: bytes, attachment: bytes | None) -> Received | None:
    """Decode a sample; returns None where it is not a result of a gateway, for any bytes.

    A result of a known kind must have all its fields, of the right types and shapes. Of a kind that this version does
    not know, only the fields `sequence` and `sensor` are checked.
    """
    address = parse_key(key)
    if address is None or len(payload) > LARGEST_RESULT:
        return None
    try:
        fields = msgspec.json.decode(payload, type=dict[str, Any])
        result = result_of(address.what, fields)
    except (msgspec.DecodeError, ValueError, RecursionError):  # not UTF-8; or too many nested brackets
        return None
    calibration = result.calibration if isinstance(result, Estimate) else result
    if isinstance(calibration, CalibrationUpdate) and not _has_its_shapes(calibration):
        return None
    sequence = fields.get("sequence")
    if type(sequence) is not int or not 0 <= sequence <= LARGEST_NUMBER or fields.get("sensor") != address.sensor:
        return None
    epoch = fields.get("epoch", "")
    if not isinstance(epoch, str) or not _EPOCH.fullmatch(epoch):
        return None
    if attachment is None:
        return Received(key, address, sequence, fields, None, epoch=epoch)
    if len(attachment) > _DIGITS_MAX or not attachment.isdigit():
        return None
    return Received(key, address, sequence, fields, int(attachment), epoch=epoch)


def _has_its_shapes(calibration: CalibrationUpdate) -> bool:
    steady = calibration.sensitivity_at_0hz
    squares_3 = [square for square in (steady.sensitivity, steady.standard_uncertainty) if square]
    for band in calibration.response:
        squares_3 += [band.sensitivity_re, band.sensitivity_im, band.standard_uncertainty]
    lengths = (calibration.offset, 3), (calibration.standard_uncertainty, 12), (calibration.determined, 12)
    squares = (calibration.sensitivity, 3), (calibration.covariance, 12), *((square, 3) for square in squares_3)
    return (
        len(calibration.valid_band_hz) in (0, 2)
        and all(len(values) == n for values, n in lengths)
        and all(len(rows) == n and all(len(row) == n for row in rows) for rows, n in squares)
    )
